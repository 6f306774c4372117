//! Measures in seconds of processor time how fast worlds are built and views are rendered: `render_speed [SCENE...]`.
//!
//! One line of JSON per scene and size: views per second with one ray per pixel and with three (motion blur or smooth
//! edges), depth alone, and seconds to build the world.

use std::error::Error;
use vidar_core::{CameraModel, FrameId, Pinhole};
use vidar_synth::predict::{TruePlace, true_views};
use vidar_synth::{SceneKind, Simulation, SynthConfig, SynthView, render_views};

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let asked: Vec<String> = std::env::args().skip(1).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    for (name, scene) in
        [("room", SceneKind::Room), ("hall", SceneKind::Hall), ("corridor", SceneKind::Corridor)]
    {
        if !asked.is_empty() && !asked.iter().any(|a| a == name) {
            continue;
        }
        for [width, height] in [[280, 182], [752, 480]] {
            let config = SynthConfig { scene, width, height, ..SynthConfig::default() };
            let start = cpu_secs();
            let simulation = pool.install(|| Simulation::new(&config, None))?;
            let build_secs = cpu_secs() - start;
            let focal = 0.61 * width as f64;
            let [cx, cy] = [width, height].map(|s| 0.5 * (s as f64 - 1.0));
            let intrinsics = Pinhole::new(focal, focal, cx, cy, width, height)?;
            let camera = CameraModel::Pinhole(intrinsics);
            let times: Vec<_> = (0..20).map(|k| simulation.frame_time(5 * k)).collect();
            let places: Vec<_> = times.iter().filter_map(|t| simulation.world_from_camera(*t)).collect();
            let views: Vec<SynthView> =
                places.iter().map(|p| SynthView { world_from_camera: *p, camera: camera.clone() }).collect();
            let per_sec = |samples: usize| -> Result<f64, Box<dyn Error>> {
                let start = cpu_secs();
                pool.install(|| render_views(simulation.world(), &views, samples))?;
                Ok(views.len() as f64 / (cpu_secs() - start))
            };
            let (one, three) = (per_sec(1)?, per_sec(3)?);
            let truths: Vec<_> = places
                .iter()
                .zip(&times)
                .map(|(p, t)| TruePlace { frame_id: FrameId(0), time: *t, world_from_camera: *p })
                .collect();
            let start = cpu_secs();
            pool.install(|| true_views(simulation.world(), &truths, &intrinsics));
            let depth = truths.len() as f64 / (cpu_secs() - start);
            println!(
                "{{\"scene\": \"{name}\", \"size\": \"{width}x{height}\", \"shapes\": {}, \"build_secs\": {build_secs:.2}, \
                 \"views_per_sec\": {one:.1}, \"views_per_sec_3_rays\": {three:.1}, \"depth_views_per_sec\": {depth:.1}}}",
                simulation.world().shape_count()
            );
        }
    }
    Ok(())
}

/// Processor time of this process so far, s; other programs on the machine do not count.
fn cpu_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name in parentheses may hold spaces; 14th and 15th fields are user and system time in ticks of 10 ms.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |i: usize| fields.get(i).and_then(|f| f.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}
