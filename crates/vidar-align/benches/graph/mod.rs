//! The coupled graph whose cost is measured: 500 keyframes, 25 chunks. The example `solve_graphs` measures the same one.

use nalgebra::{Matrix6, SMatrix, SVector, Vector3, Vector6};
use vidar_align::coupled::{Attachment, CoupledState, Factor, Kernel, RelativeChunk, inflation};
use vidar_core::{LieGroup, Se3, Sim3, So3};

/// 500 keyframes, 25 chunks that overlap by 5, 16 loops.
pub fn graph() -> (CoupledState, Vec<Factor>) {
    let (n, chunks) = (500_usize, 25_usize);
    let truth: Vec<Se3> = (0..n)
        .map(|i| {
            let a = 6.0 * std::f64::consts::TAU * i as f64 / n as f64;
            let turn =
                So3::from_axis_angle(&Vector3::z(), a) * So3::exp(&Vector3::new(0.1 * a.sin(), 0.2, 0.0));
            Se3::new(turn, Vector3::new(3.0 * a.cos(), 3.0 * a.sin(), 0.3 * (2.0 * a).sin()))
        })
        .collect();
    let wave = |i: usize, k: f64| (i as f64 * k).sin();
    let bent = |i: usize| truth[i].plus(&Vector6::from_fn(|r, _| 0.004 * wave(i, 12.9898 + r as f64)));
    let gauges: Vec<Sim3> = (0..chunks)
        .map(|k| {
            let turn = So3::exp(&Vector3::new(wave(k, 3.1), wave(k, 5.3), wave(k, 7.7)));
            Sim3::new(turn, Vector3::new(wave(k, 1.3), wave(k, 2.9), 0.5), (0.3 * wave(k, 9.1)).exp())
                .expect("a similarity")
        })
        .collect();
    let mut factors = vec![Factor::GaugePrior {
        i: 0,
        world_from_camera: truth[0],
        position_std_m: 1e-3,
        heading_std_rad: 1e-3,
    }];
    for i in 1..n {
        let whitening = Box::new(Matrix6::identity() * 300.0);
        factors.push(Factor::Odometry {
            i: i - 1,
            j: i,
            i_from_j: bent(i - 1).inverse() * bent(i),
            whitening,
        });
    }
    for (k, gauge) in gauges.iter().enumerate() {
        for i in (k * 20)..(k * 20 + 25).min(n) {
            factors.push(Factor::Attachment(Attachment {
                i,
                k,
                chunk_from_camera: gauge.inverse().transform_pose(&truth[i]),
                rotation_std_rad: inflation(25) * 0.008,
                position_std_m: inflation(25) * 0.012,
                kernel: Kernel::Cauchy { k: 3.0 },
                moves_keyframe: true,
            }));
        }
        let link = |l: usize, kernel| {
            let relative = gauges[l].inverse() * *gauge;
            let variances = [0.02, 0.02, 0.02, 0.05, 0.05, 0.05, 0.015_f64].map(|s| s * s);
            let covariance = SMatrix::from_diagonal(&SVector::from(variances));
            let Some(link) = RelativeChunk::from_covariance(k, l, relative, &covariance, kernel) else {
                unreachable!("positive")
            };
            Factor::Relative(link)
        };
        if k > 0 {
            factors.push(link(k - 1, Kernel::Cauchy { k: 3.0 }));
        }
        if k >= 9 {
            factors.push(link(k - 8, Kernel::GemanMcClure { k: 4.0 }));
        }
    }
    let start = CoupledState { keyframes: (0..n).map(bent).collect(), chunks: gauges };
    (start, factors)
}
