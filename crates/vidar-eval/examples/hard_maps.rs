//! Time and peak memory of the evaluation of good and of hopeless maps: `hard_maps CASE [POINTS [THREADS]]`.
//!
//! The reference is a furnished room of 6 m × 5 m × 2.5 m, the estimate the same room sampled elsewhere with noise of 1 cm, changed
//! by the case; `--help` lists them. The trajectories' Sim(3) fit is given, so that every refinement of the protocol runs. The clouds hold
//! positions alone.

mod process;

use process::{peak_mib, processor_secs};
use std::error::Error;
use std::time::Instant;
use vidar_core::{PointCloud, Se3, Sim3};
use vidar_eval::{PlacementStart, SurfaceEvalConfig, evaluate_surface_from};

const CASES: [(&str, &str); 6] = [
    ("good", "noise alone"),
    ("moved", "3 m and 1.5 m off"),
    ("rotated", "turned by 40 degrees about the vertical and by 10 degrees about x"),
    ("scaled", "1.3 times as large"),
    ("outliers", "30 % of the points about 50 m away in all directions"),
    ("bent", "3 m off, sheared, bent like a drifting trajectory and noisy by a few centimetres"),
];

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let case = arguments.next().unwrap_or_default();
    if !CASES.iter().any(|(name, _)| *name == case) {
        println!("hard_maps CASE [POINTS [THREADS]]");
        CASES.iter().for_each(|(name, what)| println!("  {name}: {what}"));
        return Ok(());
    }
    let count: usize = arguments.next().map_or(Ok(1_000_000), |a| a.parse())?;
    let threads: usize = arguments.next().map_or(Ok(2), |a| a.parse())?;
    let reference = PointCloud::from_positions(room(count, 1));
    let mut points = room(count, 2);
    points.iter_mut().enumerate().for_each(|(k, p)| *p = changed(&case, k, *p));
    let estimate = PointCloud::from_positions(points);
    let config = SurfaceEvalConfig { keep_point_errors: true, ..SurfaceEvalConfig::default() };
    let start =
        PlacementStart { truth_from_estimate: Se3::IDENTITY, truth_from_estimate_sim3: Some(Sim3::IDENTITY) };
    let given_mib = peak_mib();
    let (wall, processor) = (Instant::now(), processor_secs());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let report = pool.install(|| evaluate_surface_from(&estimate, &reference, &start, &config))?;
    println!(
        "{case}, {count} points: {:.1} s of processor time, {:.1} s of wall time, peak {:.0} MiB (before it {given_mib:.0}); rigid F {:.4} {:.4}, \
         native {:.4}, free {:.4}, chamfer {:.6} m, {}",
        processor_secs() - processor,
        wall.elapsed().as_secs_f64(),
        peak_mib(),
        report.rigid[0].f,
        report.rigid[1].f,
        report.native[0].f,
        report.free[0].f,
        report.chamfer.chamfer_m,
        report.placement.reason,
    );
    println!("{}", serde_json::to_string(&report)?);
    Ok(())
}

/// Point k of the estimate before noise, changed as the case says.
fn changed(case: &str, k: usize, [x, y, z]: [f32; 3]) -> [f32; 3] {
    let noise = |salt: usize| {
        // A sum of three uniform numbers in ±1, to one standard deviation of 1 cm.
        let at = |step: f64| ((k * 3 + salt) as f64 * step).fract() as f32 * 2.0 - 1.0;
        0.01 * (at(0.754_877_666_247) + at(0.569_840_290_998) + at(0.414_213_562_373))
    };
    let [x, y, z] = [x + noise(0), y + noise(1), z + noise(2)];
    match case {
        "moved" => [x + 3.0, y + 1.5, z],
        "rotated" => {
            let ((s, c), (t, d)) = (40.0_f32.to_radians().sin_cos(), 10.0_f32.to_radians().sin_cos());
            let [x, y] = [c * x - s * y, s * x + c * y];
            [x, d * y - t * z, t * y + d * z]
        }
        "scaled" => [1.3 * x, 1.3 * y, 1.3 * z],
        "outliers" if k % 10 < 3 => {
            let (sin, cos) = (k as f32 * 2.399_963).sin_cos();
            let height = ((k as f64 * 0.618_033_988_75).fract() * 2.0 - 1.0) as f32;
            let (ring, radius) = ((1.0 - height * height).sqrt(), 50.0 + 100.0 * noise(0));
            [3.0 + radius * ring * cos, 2.5 + radius * ring * sin, 1.2 + radius * height]
        }
        "bent" => {
            let ripple = 0.03 * ((x * 91.7).sin() + (y * 77.3).sin() * (z * 83.1).cos());
            [x + 3.0 + 0.1 * y * y, y + 1.5 - 0.2 * x, z + 0.3 * x + ripple]
        }
        _ => [x, y, z],
    }
}

/// Points on the walls, the floor and boxes of a room, by a low-discrepancy sequence.
fn room(count: usize, seed: usize) -> Vec<[f32; 3]> {
    (0..count)
        .map(|k| {
            let at = |step: f64| ((k + seed * 7919) as f64 * step).fract() as f32;
            let (u, v, w) = (at(0.819_172_513_396), at(0.671_043_606_703), at(0.549_700_477_901));
            match (w * 8.0) as u32 {
                0 | 1 => [6.0 * u, 5.0 * v, 0.0],
                2 => [6.0 * u, 0.0, 2.5 * v],
                3 => [6.0 * u, 5.0, 2.5 * v],
                4 => [0.0, 5.0 * u, 2.5 * v],
                5 => [6.0, 5.0 * u, 2.5 * v],
                6 => [1.0 + u, 1.5 + v, 0.8],
                _ => [3.0 + u, 3.0, v],
            }
        })
        .collect()
}
