//! Chunks of depth, each in a frame and scale of its own, aligned in one metric world by the coupled graph.
#![allow(clippy::print_stdout)] // an example prints

use std::sync::Arc;
use vidar_align::streaming::chunk_ranges;
use vidar_align::{
    Aligner, AlignerConfig, ChunkObservation, CouplingMode, FrameObservation, Placement, PosePrior,
};
use vidar_core::{ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, GeometryModel, Image, Pinhole};
use vidar_synth::predict::{Conditioning, PredictionErrors, SyntheticModel};
use vidar_synth::{Simulation, SynthConfig};

type Failure = Box<dyn std::error::Error>;

const FRAMES: usize = 36;

/// Predicts chunks with a simulated network, aligns them with the poses of the flight and prints scales and errors.
pub fn main() -> Result<(), Failure> {
    let simulation = Arc::new(Simulation::new(&SynthConfig { clutter: 20, ..SynthConfig::default() }, None)?);
    let placement = align(&simulation)?;
    for chunk in &placement.chunks {
        println!("chunk {}: {:.3} m per unit", chunk.chunk_id, chunk.world_from_chunk.scale);
    }
    let mut squares = 0.0;
    for view in &placement.views {
        let truth =
            simulation.world_from_camera(simulation.frame_time(view.frame_id.index())).ok_or("no pose")?;
        squares += (view.world_from_camera.translation - truth.translation).norm_squared();
    }
    let rmse_m = (squares / placement.views.len() as f64).sqrt();
    println!(
        "{} views placed, camera centres within {rmse_m:.3} m of the truth (RMS)",
        placement.views.len()
    );
    assert!(placement.is_metric && placement.views.len() == FRAMES && rmse_m < 0.05);
    Ok(())
}

/// Chunks of 12 frames, of which neighbours share 4; every fourth frame has a metric pose.
fn align(simulation: &Arc<Simulation>) -> Result<Placement, Failure> {
    let errors = PredictionErrors::default();
    let mut network = SyntheticModel::new(Arc::clone(simulation), errors, Conditioning::PoseFree, 112, 1)?;
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default())?;
    for (id, range) in (0..).zip(chunk_ranges(FRAMES, 12, 4)?) {
        let range = range.frames;
        let prediction = network.predict(&views(simulation, ChunkId(id), range.clone())?)?;
        let frames = range.map(|k| {
            let time = simulation.frame_time(k);
            let frame = FrameObservation::new(FrameId(k as u32), time);
            match simulation.world_from_camera(time).filter(|_| k % 4 == 0) {
                Some(world_from_camera) => frame.with_pose_prior(PosePrior::new(world_from_camera)),
                None => frame,
            }
        });
        aligner.push(ChunkObservation { prediction, frames: frames.collect() })?;
    }
    Ok(aligner.finish())
}

/// Views of a chunk. The simulated network needs their times only, so the images are empty.
fn views(
    simulation: &Simulation,
    id: ChunkId,
    frames: std::ops::Range<usize>,
) -> Result<ChunkViews, Failure> {
    let intrinsics = Pinhole::new(230.0, 230.0, 187.5, 119.5, 376, 240)?;
    let view = |k: usize| ChunkView {
        frame_id: FrameId(k as u32),
        time: simulation.frame_time(k),
        image: FrameImage::Gray8(Image::filled(376, 240, 0)),
        intrinsics,
        world_from_camera: None,
    };
    Ok(ChunkViews { id, views: frames.map(view).collect() })
}
