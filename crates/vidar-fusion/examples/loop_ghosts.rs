//! Effect of a loop closure on double walls: a rendered room, flown round twice, fused in chunks whose poses
//! drift, then corrected.
//!
//! `loop_ghosts [OUT.png]` prints the double-wall rate of the reference map (true poses), of the drifted map, of the map
//! whose sub-volumes moved with the graph, and of the map whose moved chunks were fused again, with processor times;
//! the picture shows a slice at 1 to 1.2 m above the floor: drifted left, moved in the middle, fused again right.

use nalgebra::Vector3;
use std::error::Error;
use vidar_core::{AlignedView, ChunkId, Confidence, FrameId, Pinhole, Se3, So3, TriangleMesh};
use vidar_fusion::{DoubleWallDetector, FusionConfig, RevisedView, SubVolumeConfig, SubVolumes, TsdfVolume};
use vidar_synth::predict::{TruePlace, TrueView, true_views};
use vidar_synth::{FlightKind, Simulation, SynthConfig};

/// Views of a chunk.
const CHUNK: usize = 16;
const VIEWS: usize = 112;

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let views = flight()?;
    let fusion = FusionConfig { voxel_size_m: 0.03, ..FusionConfig::default() };
    let walls = DoubleWallDetector::default();
    let print = |what: &str, mesh: &TriangleMesh, secs: f64| -> Result<(), Box<dyn Error>> {
        let report = walls.of_mesh(mesh)?;
        println!(
            "{{\"map\": \"{what}\", \"double_wall_rate\": {:.4}, \"vertices\": {}, \"cpu_secs\": {secs:.2}}}",
            report.rate, report.points
        );
        Ok(())
    };

    let start = cpu_secs();
    let mut plain = TsdfVolume::new(&fusion)?;
    for view in &views {
        plain.integrate(&aligned(view, &view.world_from_camera)?)?;
    }
    print("true poses", &plain.extract_mesh(), cpu_secs() - start)?;

    let start = cpu_secs();
    let mut volumes = SubVolumes::new(&SubVolumeConfig { fusion, ..SubVolumeConfig::default() })?;
    for (i, view) in views.iter().enumerate() {
        volumes.integrate(chunk_of(i), &aligned(view, &drifted(i, &view.world_from_camera))?)?;
    }
    let before = volumes.extract_mesh()?;
    print("drifted", &before, cpu_secs() - start)?;

    let start = cpu_secs();
    for chunk in volumes.chunks().collect::<Vec<_>>() {
        let of_chunk = views.iter().enumerate().filter(|(i, _)| chunk_of(*i) == chunk);
        let revised: Vec<RevisedView> = of_chunk
            .map(|(_, v)| RevisedView {
                frame_id: v.frame_id,
                world_from_camera: v.world_from_camera,
                depth_factor: 1.0,
            })
            .collect();
        volumes.revise(chunk, &revised)?;
    }
    let moved = volumes.extract_mesh()?;
    print("sub-volumes moved", &moved, cpu_secs() - start)?;

    let start = cpu_secs();
    for (chunk, _) in volumes.stale() {
        let of_chunk = views.iter().enumerate().filter(|(i, _)| chunk_of(*i) == chunk);
        let again: Result<Vec<AlignedView>, _> =
            of_chunk.map(|(_, v)| aligned(v, &v.world_from_camera)).collect();
        volumes.rebuild(chunk, again?)?;
    }
    let rebuilt = volumes.extract_mesh()?;
    print("moved chunks fused again", &rebuilt, cpu_secs() - start)?;
    let report = volumes.report();
    let mut bytes = 0;
    for chunk in volumes.chunks().collect::<Vec<_>>() {
        bytes += volumes.offload(chunk)?.len();
    }
    println!(
        "{{\"sub_volumes_mib\": {:.1}, \"offloaded_mib\": {:.1}, \"one_volume_mib\": {:.1}}}",
        report.memory_bytes as f64 / 1048576.0,
        bytes as f64 / 1048576.0,
        plain.memory_bytes() as f64 / 1048576.0
    );
    if let Some(path) = std::env::args().nth(1) {
        slices(&[&before, &moved, &rebuilt]).save(path)?;
    }
    Ok(())
}

fn chunk_of(i: usize) -> ChunkId {
    ChunkId((i / CHUNK) as u32)
}

/// The pose of view `i` by an odometry that drifts by 2.5 cm and 0.5° per chunk.
fn drifted(i: usize, world_from_camera: &Se3) -> Se3 {
    let chunks = i as f64 / CHUNK as f64;
    let turn = So3::from_axis_angle(&Vector3::z(), 0.5_f64.to_radians() * chunks);
    Se3::new(turn, Vector3::new(0.02, -0.01, 0.01) * chunks) * *world_from_camera
}

fn aligned(view: &TrueView, at: &Se3) -> Result<AlignedView, Box<dyn Error>> {
    let k = view.intrinsics;
    let sure = Confidence::full(k.width, k.height);
    Ok(AlignedView::new(view.frame_id, view.time, *at, k, view.depth.clone(), sure)?)
}

/// Two rounds through the demo's room, looking outward.
fn flight() -> Result<Vec<TrueView>, Box<dyn Error>> {
    let config = SynthConfig { flight: FlightKind::Sweep, duration_secs: 22.4, ..SynthConfig::default() };
    let simulation = Simulation::new(&config, None)?;
    let intrinsics = Pinhole::new(170.0, 170.0, 139.5, 90.5, 280, 182)?;
    let place = |k: usize| {
        let time = simulation.frame_time(2 * k);
        let world_from_camera = simulation.world_from_camera(time)?;
        Some(TruePlace { frame_id: FrameId(k as u32), time, world_from_camera })
    };
    let places: Vec<TruePlace> = (0..VIEWS).filter_map(place).collect();
    Ok(true_views(simulation.world(), &places, &intrinsics))
}

/// Slices of the meshes between 1 and 1.2 m above the floor, side by side, 2 cm a pixel.
fn slices(meshes: &[&TriangleMesh]) -> image::GrayImage {
    let side = 420_u32;
    let mut picture = image::GrayImage::from_pixel(side * meshes.len() as u32, side, image::Luma([255]));
    for (k, mesh) in meshes.iter().enumerate() {
        for p in mesh.positions.iter().filter(|p| p[2] > 1.0 && p[2] < 1.2) {
            let [x, y] = [p[0], p[1]].map(|v| (f64::from(v) / 0.02 + 0.5 * f64::from(side)).round());
            if x >= 0.0 && y >= 0.0 && x < f64::from(side) && y < f64::from(side) {
                picture.put_pixel(x as u32 + side * k as u32, y as u32, image::Luma([0]));
            }
        }
    }
    picture
}

/// Processor time of this process so far, s; other programs on the machine do not count.
fn cpu_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name in parentheses may hold spaces; 14th and 15th fields are user and system time in ticks of 10 ms.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |i: usize| fields.get(i).and_then(|f| f.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}
