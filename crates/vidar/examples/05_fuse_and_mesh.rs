//! Metric depth and poses fused into a surface: a TSDF volume, its mesh as a PLY file, and its F-score.
#![allow(clippy::print_stdout)] // an example prints

use vidar_core::{AlignedView, BodyFrame, Confidence, Duration, PointCloud, Se3};
use vidar_dataset::OpenOptions;
use vidar_eval::{SurfaceEvalConfig, evaluate_surface};
use vidar_fusion::{FusionConfig, TsdfVolume};
use vidar_synth::{SynthConfig, write_sequence};

type Failure = Box<dyn std::error::Error>;

/// Fuses the depth images of a short flight, writes the mesh and compares its vertices with the exact scan.
pub fn main() -> Result<(), Failure> {
    let folder = tempfile::tempdir()?;
    let config = SynthConfig { duration_secs: 2.0, scan_spacing_m: 0.04, ..SynthConfig::default() };
    write_sequence(folder.path(), &config, None, &|_, _| true)?;
    let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default())?;
    let sensor = dataset.depth_sensor.as_ref().ok_or("the sequence has no depth")?;
    let truth = dataset.ground_truth.as_ref().ok_or("the sequence has no ground truth")?;
    let trajectory = truth.in_frame(BodyFrame::Camera(dataset.camera), &dataset.rig)?;

    let mut volume = TsdfVolume::new(&FusionConfig { voxel_size_m: 0.04, ..FusionConfig::default() })?;
    for image in &dataset.images {
        let Some(entry) = dataset.depth_for(image.time) else { continue };
        let depth = dataset.load_depth(entry)?;
        let camera = trajectory.interpolate(image.time, Duration::from_millis(100)).ok_or("no pose")?;
        let world_from_camera = camera * sensor.color_from_depth;
        let full = Confidence::full(depth.image().width(), depth.image().height());
        let intrinsics = sensor.intrinsics;
        volume.integrate(&AlignedView::new(
            image.frame_id,
            image.time,
            world_from_camera,
            intrinsics,
            depth,
            full,
        )?)?;
    }
    let mesh = volume.extract_mesh();
    let path = folder.path().join("mesh.ply");
    vidar_export::write_ply_mesh(std::fs::File::create(&path)?, &mesh, &[])?;
    let size_kib = std::fs::metadata(&path)?.len() / 1024;

    let scan = dataset.reference_cloud.as_ref().ok_or("the sequence has no scan")?;
    let scan = vidar_export::read_ply(&std::fs::read(scan)?)?.cloud;
    let cloud = PointCloud::from_positions(mesh.positions.clone());
    let report = evaluate_surface(&cloud, &scan, &Se3::IDENTITY, &SurfaceEvalConfig::default())?;
    let score = report.rigid.first().ok_or("no threshold")?;
    println!("{} triangles in {size_kib} KiB, F@{} {:.3}", mesh.triangles.len(), score.threshold_m, score.f);
    assert!(score.f > 0.8);
    Ok(())
}
