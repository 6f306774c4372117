//! Values of the paper's tables, printed next to ours. They are of real sequences; rendered ones do not reproduce them.

/// A row of the paper's Table II: F@0.10 and F@0.05 of PF, VIO and GT; absent where the paper leaves it out.
pub(super) type DenseRow = (&'static str, [Option<f64>; 3], [Option<f64>; 3]);

/// Table II, EuRoC against the Leica scan.
pub(super) const DENSE: [DenseRow; 6] = [
    ("V1_01", [Some(0.583), Some(0.527), Some(0.591)], [Some(0.397), Some(0.324), Some(0.392)]),
    ("V1_02", [Some(0.025), Some(0.528), Some(0.618)], [Some(0.013), Some(0.322), Some(0.437)]),
    ("V1_03", [Some(0.436), Some(0.422), Some(0.395)], [Some(0.292), Some(0.253), Some(0.252)]),
    ("V2_01", [Some(0.554), Some(0.545), Some(0.539)], [Some(0.394), Some(0.338), Some(0.422)]),
    ("V2_02", [Some(0.358), None, Some(0.586)], [Some(0.215), None, Some(0.386)]),
    ("V2_03", [Some(0.476), Some(0.291), Some(0.295)], [Some(0.299), Some(0.169), Some(0.197)]),
];

/// Mean of Table II.
pub(super) const DENSE_MEAN: DenseRow =
    ("mean", [Some(0.405), Some(0.463), Some(0.504)], [Some(0.268), Some(0.281), Some(0.348)]);

/// Mean F@0.10 of the decoupled hybrid (section V-C).
pub(super) const HYBRID_F10: f64 = 0.676;

/// Table III: name, PF, VIO, GT.
pub(super) const METRICNESS: [(&str, [f64; 3]); 5] = [
    ("mean |ln s|", [0.458, 0.009, 0.000]),
    ("std(ln s)", [0.561, 0.012, 0.000]),
    ("F@0.10 native", [0.405, 0.463, 0.504]),
    ("F@0.10 free", [0.661, 0.481, 0.50]),
    ("ΔF", [0.256, 0.018, 0.0]),
];

/// Table I, EuRoC: method, valid sequences, mean and median Sim(3) RMSE in metres.
pub(super) const EUROC_TRAJECTORY: [(&str, &str, f64, f64); 3] = [
    ("SVO mono", "11/11", 0.898, 0.740),
    ("SVO mono-IMU", "11/11", 0.125, 0.120),
    ("DA3-Streaming, 5 fps", "11/11", 2.228, 1.710),
];

/// Table I, TUM RGB-D.
pub(super) const TUM_TRAJECTORY: [(&str, &str, f64, f64); 2] =
    [("SVO mono", "5/6", 0.429, 0.369), ("Best DA3 per sequence", "6/6", 0.031, 0.023)];

/// Largest GPU memory of the paper's runs, bytes (section V-E).
pub(super) const GPU_BYTES: f64 = 11_125e6;
