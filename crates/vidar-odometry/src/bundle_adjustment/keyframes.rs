//! The adjusted images as keyframes: pose, covariance to the one before, and landmarks with their depth.

use super::observation::{self, MovingBody};
use super::{Measurements, Solution};
use crate::backend::d_relative_d_poses;
use crate::pipeline::public_state;
use nalgebra::{Matrix6, SMatrix};
use vidar_core::{
    Health, KeyframeId, LandmarkId, LieGroup, OdometryKeyframe, PoseCovariance, SparseLandmark,
};

/// σ(ln s) above which a keyframe's health says that the scale is not settled.
const SETTLED_SCALE_STD: f64 = 0.02;

pub(super) fn of(recording: &Measurements<'_>, solution: &Solution, scale_std: f64) -> Vec<OdometryKeyframe> {
    let Solution { problem, images, .. } = solution;
    let mut landmarks = seen_landmarks(solution);
    let mut pose_covariance = PoseCovariance::zeros();
    let health = if scale_std > SETTLED_SCALE_STD { Health::ScaleConverging } else { Health::Ok };
    let mut keyframes = Vec::with_capacity(problem.frames.len());
    for (k, (frame, image)) in problem.frames.iter().zip(images).enumerate() {
        let logged = &recording.log.images[*image];
        let state = frame.body.state_after(problem.calibration.clock_secs + frame.body.delay_secs);
        let previous = k.checked_sub(1).map(|before| {
            let covariance = relative_covariance(solution, before, k);
            pose_covariance += covariance;
            (KeyframeId(before as u32), covariance)
        });
        keyframes.push(OdometryKeyframe {
            id: KeyframeId(k as u32),
            frame_id: logged.caller_frame,
            segment: solution.segment,
            state: public_state(&state, logged.stamp),
            world_from_camera: state.world_from_body * problem.calibration.body_from_camera,
            pose_covariance,
            previous,
            gravity_in_world: recording.model.gravity(),
            scale_std,
            health,
            lens: frame.body.lens,
            landmarks: std::mem::take(&mut landmarks[k]),
        });
    }
    keyframes
}

/// Landmarks of each state, where a global shutter at the image's instant would show them.
fn seen_landmarks(solution: &Solution) -> Vec<Vec<SparseLandmark>> {
    let Solution { problem, system, .. } = solution;
    let mut all = vec![Vec::new(); problem.frames.len()];
    for (id, (seen, block)) in problem.landmarks.iter().zip(&system.landmarks).enumerate() {
        let relative = block.inverse_distance_sigma() / seen.landmark.positive_inverse();
        for observation in &seen.observations {
            let body: &MovingBody = &problem.frames[observation.frame].body;
            let camera = body.pose_after(problem.calibration.clock_secs + body.delay_secs)
                * problem.calibration.body_from_camera;
            let ray = observation::from_camera(&seen.landmark, &camera.translation);
            let in_camera = camera.rotation.inverse().act(&ray) / seen.landmark.positive_inverse();
            let pixel = problem.calibration.camera.project(&in_camera);
            let pixel = pixel.map(|pixel| body.lens.shown(&problem.calibration.camera, &pixel, 0.0));
            let (Some(pixel), true) = (pixel, in_camera.z > 1e-3 && relative.is_finite()) else { continue };
            all[observation.frame].push(SparseLandmark {
                id: LandmarkId(id as u32),
                pixel,
                inverse_depth: 1.0 / in_camera.z,
                inverse_depth_std: relative / in_camera.z,
            });
        }
    }
    all
}

/// Covariance of `a_from_b · exp(δ)` between the bodies of two neighbouring states.
fn relative_covariance(solution: &Solution, a: usize, b: usize) -> Matrix6<f64> {
    let Solution { problem, covariance, .. } = solution;
    let unknown = |k: usize| problem.offset(if k < 6 { a } else { b }) + k % 6;
    let joint =
        SMatrix::<f64, 12, 12>::from_fn(|row, column| covariance.entry(unknown(row), unknown(column)));
    let pose = |k: usize| problem.frames[k].body.state.world_from_body;
    let j = d_relative_d_poses(&pose(a), &pose(b));
    j * joint * j.transpose()
}
