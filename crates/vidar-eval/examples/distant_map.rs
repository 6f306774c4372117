//! Time and peak memory of the evaluation of a map that is metres off: `distant_map [POINTS [OFFSET_M]]`.
//!
//! The reference is a furnished room of 6 m × 5 m × 2.5 m, the estimate the same room bent and moved by `OFFSET_M`.

use std::error::Error;
use vidar_core::{PointCloud, Se3};
use vidar_eval::{PlacementStart, SurfaceEvalConfig, evaluate_surface_from};

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let count: usize = arguments.next().map_or(Ok(1_000_000), |a| a.parse())?;
    let offset_m: f32 = arguments.next().map_or(Ok(3.0), |a| a.parse())?;
    let reference = PointCloud::from_positions(room(count, 1, |p| p));
    let estimate = PointCloud::from_positions(room(count, 2, |[x, y, z]| {
        // Bent like a drifting trajectory, and noisy by a few centimetres.
        let noise = 0.03 * ((x * 91.7).sin() + (y * 77.3).sin() * (z * 83.1).cos());
        [x + offset_m + 0.1 * y * y, y + 0.5 * offset_m - 0.2 * x, z + 0.3 * x + noise]
    }));
    let config = SurfaceEvalConfig { keep_point_errors: true, ..SurfaceEvalConfig::default() };
    let start = PlacementStart {
        truth_from_estimate: Se3::IDENTITY,
        truth_from_estimate_sim3: Some(vidar_core::Sim3::IDENTITY),
    };
    let before = std::time::Instant::now();
    let report = evaluate_surface_from(&estimate, &reference, &start, &config)?;
    println!(
        "{count} points, {offset_m} m off: {:.1} s, peak {} MiB; rigid F {:.4}, free F {:.4}, chamfer {:.4} m, {}",
        before.elapsed().as_secs_f64(),
        peak_kib() / 1024,
        report.rigid[0].f,
        report.free[0].f,
        report.chamfer.chamfer_m,
        report.placement.reason,
    );
    println!("{}", serde_json::to_string(&report)?);
    Ok(())
}

/// Points on the walls, the floor and boxes of a room, by a low-discrepancy sequence.
fn room(count: usize, seed: usize, bend: impl Fn([f32; 3]) -> [f32; 3]) -> Vec<[f32; 3]> {
    (0..count)
        .map(|k| {
            let at = |step: f64| ((k + seed * 7919) as f64 * step).fract() as f32;
            let (u, v, w) = (at(0.819_172_513_396), at(0.671_043_606_703), at(0.549_700_477_901));
            let p = match (w * 8.0) as u32 {
                0 | 1 => [6.0 * u, 5.0 * v, 0.0],
                2 => [6.0 * u, 0.0, 2.5 * v],
                3 => [6.0 * u, 5.0, 2.5 * v],
                4 => [0.0, 5.0 * u, 2.5 * v],
                5 => [6.0, 5.0 * u, 2.5 * v],
                6 => [1.0 + u, 1.5 + v, 0.8],
                _ => [3.0 + u, 3.0, v],
            };
            bend(p)
        })
        .collect()
}

/// Peak resident memory of this process; 0 without `/proc`.
fn peak_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM"));
    line.and_then(|l| l.split_whitespace().nth(1)?.parse().ok()).unwrap_or(0)
}
