//! Visual-inertial odometry: camera and IMU in, metric poses out, compared with the exact flight.
#![allow(clippy::print_stdout)] // an example prints

use vidar_core::{BodyFrame, SensorEvent, StampedPose, Trajectory};
use vidar_dataset::{OpenOptions, Recording};
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::{Odometry, OdometryConfig};
use vidar_synth::{SynthConfig, write_sequence};

type Failure = Box<dyn std::error::Error>;

/// Renders a flight of six seconds, runs the odometry over it and prints the error of the trajectory.
pub fn main() -> Result<(), Failure> {
    let folder = tempfile::tempdir()?;
    let config = SynthConfig {
        duration_secs: 6.0,
        camera_rate_hz: 20.0,
        depth: false,
        scan_spacing_m: 0.2,
        ..SynthConfig::default()
    };
    write_sequence(folder.path(), &config, None, &|_, _| true)?;
    let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default())?;

    let estimate = run_odometry(&dataset)?;
    let truth = dataset.ground_truth.as_ref().ok_or("the sequence has no ground truth")?;
    let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default())?;
    let ate_m = report.ate_se3_m.ok_or("too few poses to compare")?.rmse;
    let scale_error = report.scale_error.ok_or("too few poses to compare")?;
    println!("{} poses, ATE {ate_m:.4} m after an SE(3) fit, |ln s| {scale_error:.4}", estimate.len());
    assert!(estimate.len() * 2 > dataset.images.len(), "a pose for most images");
    assert!(ate_m < 0.05 && scale_error < 0.05);
    Ok(())
}

/// Pushes every event in time order. A pose counts once its scale is metric.
fn run_odometry(dataset: &Recording) -> Result<Trajectory, Failure> {
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, &OdometryConfig::default())?;
    let mut outputs = Vec::new();
    for event in dataset.events() {
        let event = event?;
        if matches!(event, SensorEvent::Image(_) | SensorEvent::Imu(_)) {
            outputs.extend(odometry.push(event)?);
        }
    }
    outputs.extend(odometry.finish());
    let poses = outputs.iter().filter_map(|output| {
        let tracking = output.tracking().filter(|t| t.health.is_metric())?;
        Some(StampedPose { time: output.time, world_from_body: tracking.state.world_from_body })
    });
    Ok(Trajectory::new(BodyFrame::Imu, poses.collect())?)
}
