//! The robustness ladder in a fast form: one small rendered flight, corrupted in every way that recordings are corrupted.
//!
//! Each test demands accuracy and consistency: a state reported as healthy is accurate, and what cannot be accurate is
//! rejected, degraded or lost with a reason. The long forms are run with
//! `cargo test --release -p vidar-odometry --test flights ladder -- --ignored`.

mod images;
mod inertial;
mod recording;
mod rest;

use self::recording::{clean_outputs, lost, recording};
use vidar_core::{ImuSample, SensorEvent};

#[test]
fn a_clean_flight_is_tracked_to_centimetres_with_a_consistent_covariance() {
    let recording = recording();
    let outputs = clean_outputs();
    let report = recording.evaluate(outputs);
    let ate = report.ate_se3_m.unwrap().rmse;
    assert!(ate < 0.02, "{ate}");
    assert!(report.scale_error.unwrap() < 0.02, "{:?}", report.scale_error);
    assert!(report.estimate_poses as f64 > 0.6 * recording.images.len() as f64, "{}", report.estimate_poses);
    assert!(lost(outputs).is_empty());
    let last = outputs.last().unwrap().tracking().unwrap();
    let position_std = (3..6).map(|k| last.covariance[(k, k)]).sum::<f64>().sqrt();
    assert!((1e-4..0.1).contains(&position_std), "{position_std}");
    assert!(last.landmarks.len() >= 15 && last.landmarks.iter().all(|l| l.inverse_depth > 0.0));
    let keyframes: Vec<_> = outputs.iter().filter_map(|o| o.tracking()?.keyframe.as_ref()).collect();
    assert!(keyframes.len() >= 3, "{}", keyframes.len());
    assert!(keyframes[2].previous.is_some_and(|(id, c)| id == keyframes[1].id && c[(3, 3)] > 0.0));
    assert!(outputs.iter().filter_map(|o| o.tracking()).any(|t| t.revised.iter().any(|r| r.is_final)));
}

#[test]
fn the_same_events_give_the_same_bits() {
    assert!(recording().run() == clean_outputs());
}

#[test]
fn events_out_of_order_are_counted_and_left_out() {
    let recording = recording();
    let mut events = recording.events();
    let old: Vec<SensorEvent> = events[200..230].to_vec();
    events.splice(900..900, old.clone());
    let broken = ImuSample {
        gyro: vidar_core::AngularRate(nalgebra::Vector3::new(f64::NAN, 0.0, 0.0)),
        ..recording.imu[600]
    };
    events.insert(1000, SensorEvent::Imu(broken));
    let (outputs, odometry) = recording.run_events(events);
    let counts = odometry.counts();
    let images = old.iter().filter(|e| matches!(e, SensorEvent::Image(_))).count();
    assert_eq!((counts.images_out_of_order, counts.imu_samples_rejected), (images, old.len() - images + 1));
    assert!(outputs == clean_outputs(), "what is left out changes nothing");
}
