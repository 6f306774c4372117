//! A small adjustment for tests.

use super::image_prior::ImagePrior;
use super::observation::{self, tests::example};
use super::problem::{CalibrationPrior, FrameState, ObservedLandmark, Problem, WhitenedObservation};
use nalgebra::{Matrix2, Vector3};
use vidar_core::{LensMotion, Timestamp};

/// Three states that see four landmarks where they are, with the clock among the unknowns.
pub(super) fn problem() -> Problem {
    let (body, landmark, calibration, measured) = example();
    let mut frames = Vec::new();
    for frame in 0..3 {
        let mut body = body;
        body.state.world_from_body.translation += Vector3::new(0.2, 0.05, -0.1) * f64::from(frame);
        (body.lens, body.delay_secs) = (LensMotion::NONE, 0.0);
        let time = Timestamp::from_nanos(i64::from(frame) * 200_000_000);
        frames.push(FrameState { time, body, inertial: None });
    }
    let landmarks = (0..4).map(|k| {
        let aside = Vector3::new(0.02 * f64::from(k), -0.03 * f64::from(k), 0.05);
        let landmark = landmark.plus(&aside);
        let seen = |(frame, state): (usize, &FrameState)| {
            let mut pixel = measured;
            // The row decides on the instant, which decides on the row.
            for _ in 0..20 {
                pixel = observation::project(&state.body, &landmark, &calibration, &pixel).unwrap();
            }
            WhitenedObservation { frame, pixel, whitening: Matrix2::identity() * 0.1 }
        };
        ObservedLandmark { landmark, observations: frames.iter().enumerate().map(seen).collect() }
    });
    let landmarks = landmarks.collect();
    let mut sigmas = vec![0.0; calibration.dim()];
    sigmas[0] = 0.01;
    let image = ImagePrior { focal: Some(0.015), shift: Some(0.01), delay: Some(0.004) };
    let prior = CalibrationPrior { sigmas, mean: calibration.clone(), image };
    let gauge = (0, frames[0].body.state);
    Problem { frames, landmarks, calibration, prior, active: vec![0], gauge }
}
