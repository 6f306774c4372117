//! Dense depth from posed keyframes by multi-view stereo, compared with the exact depth.
#![allow(clippy::print_stdout)] // an example prints

use vidar_core::remap::{RemapTable, undistorted_view};
use vidar_core::{BodyFrame, ChunkId, ChunkView, ChunkViews, Duration, GeometryModel};
use vidar_dataset::{OpenOptions, Recording};
use vidar_stereo::{StereoConfig, StereoModel};
use vidar_synth::predict::{TruePlace, true_views};
use vidar_synth::{Simulation, SynthConfig, write_sequence};

type Failure = Box<dyn std::error::Error>;

/// Predicts the depth of six keyframes and prints how far it is from the truth.
pub fn main() -> Result<(), Failure> {
    let folder = tempfile::tempdir()?;
    let config = SynthConfig { duration_secs: 1.5, depth: false, ..SynthConfig::default() };
    write_sequence(folder.path(), &config, None, &|_, _| true)?;
    let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default())?;

    // Every geometry model has the same interface; a Depth Anything 3 network would stand here as well.
    let mut model: Box<dyn GeometryModel> = Box::new(StereoModel::new(StereoConfig::default())?);
    let views = read_views(&dataset, 6)?;
    let prediction = model.predict(&views)?;

    let simulation = Simulation::new(&config, None)?;
    let mut errors = Vec::new();
    for view in &prediction.views {
        let shown = views.views.iter().find(|v| v.frame_id == view.frame_id).ok_or("an unknown frame")?;
        let world_from_camera = simulation.world_from_camera(shown.time).ok_or("outside the flight")?;
        let place = TruePlace { frame_id: view.frame_id, time: shown.time, world_from_camera };
        let truth = &true_views(simulation.world(), &[place], &view.intrinsics)[0];
        let pairs = view.depth.image().data().iter().zip(truth.depth.image().data());
        errors.extend(pairs.map(|(z, exact)| (z / exact - 1.0).abs()).filter(|e| e.is_finite()));
    }
    errors.sort_by(f32::total_cmp);
    let median = *errors.get(errors.len() / 2).ok_or("no depth was predicted")?;
    println!("{} pixels with depth, median relative error {:.2} %", errors.len(), 100.0 * median);
    assert!(median < 0.03);
    Ok(())
}

/// The first `count` images as a model sees them: undistorted, with their poses.
fn read_views(dataset: &Recording, count: usize) -> Result<ChunkViews, Failure> {
    let camera = &dataset.rig.camera(dataset.camera).ok_or("the rig lacks the camera")?.model;
    let remap = RemapTable::new(camera, &undistorted_view(camera, camera.width(), camera.height())?);
    let truth = dataset.ground_truth.as_ref().ok_or("the sequence has no ground truth")?;
    let trajectory = truth.in_frame(BodyFrame::Camera(dataset.camera), &dataset.rig)?;
    let view = |entry: &vidar_dataset::ImageEntry| -> Result<ChunkView, Failure> {
        Ok(ChunkView {
            frame_id: entry.frame_id,
            time: entry.time,
            image: remap.apply(&dataset.load_image(entry)?),
            intrinsics: *remap.target(),
            world_from_camera: trajectory.interpolate(entry.time, Duration::from_millis(100)),
        })
    };
    let views = dataset.images.iter().take(count).map(view).collect::<Result<_, _>>()?;
    Ok(ChunkViews { id: ChunkId(0), views })
}
