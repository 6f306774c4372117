//! The newest state of a log from an adjustment of all its states, while the odometry goes on.

use super::inertial::ImuGain;
use super::initial::onto;
use super::log::{LoggedState, TrackLog};
use super::optimise::OptimiseReport;
use super::problem::Problem;
use super::progress::Watch;
use super::{AdjustmentError, AdjustmentInput, Measurements, PASSES, Work};
use super::{grow, initial, optimise, result};
use crate::backend::GaugePriorSigmas;
use crate::imu::{Matrix15, NavState, hat};
use nalgebra::{Matrix3, Vector3};
use std::ops::ControlFlow;
use vidar_core::{Duration, FrameId, LieGroup, Se3};
use vidar_solve::statistics::median_upper;

/// States whose scale is compared with others of the same images: some 2 s.
const COMPARED_STATES: usize = 12;

/// The newest state that a log determines.
#[derive(Clone, Debug)]
pub(crate) struct NewestState {
    /// The odometry's own number of the image.
    pub(crate) frame: FrameId,
    /// In a world that is levelled and whose origin and heading mean nothing.
    pub(crate) state: NavState,
    /// Standard deviations of `state`, of the direction that is known least; position and heading are held.
    pub(crate) sigmas: GaugePriorSigmas,
    /// Standard deviation of ln(scale).
    pub(crate) scale_std: f64,
    /// Median distance of the landmarks that the image shows, m.
    pub(crate) median_distance_m: f64,
    /// Every logged image with its state, in the order of time.
    pub(crate) states: Vec<(FrameId, NavState)>,
    /// The images whose stamps the log has, by the caller's number, with their poses world_from_body.
    pub(crate) images: Vec<(FrameId, Se3)>,
    /// `t_imu = stamp + offset`.
    pub(crate) time_offset: Duration,
    /// From the first to the last row, s.
    pub(crate) readout_secs: f64,
    /// Place of the camera on the body.
    pub(crate) body_from_camera: Se3,
    /// Of the sensors as they are logged.
    pub(crate) gain: ImuGain,
}

impl NewestState {
    /// The pose world_from_body of an image, by the caller's number.
    pub(crate) fn pose_of(&self, image: FrameId) -> Option<Se3> {
        self.images.iter().find(|(frame, _)| *frame == image).map(|(_, pose)| *pose)
    }
}

/// Adjusts all states of a log: those of the segment of most states, then outward, then all together.
///
/// # Errors
/// As [`super::adjust`]; [`AdjustmentError::Undetermined`] also where camera and IMU do not agree.
pub(crate) fn newest_state(input: &AdjustmentInput<'_>) -> Result<NewestState, AdjustmentError> {
    let log = input.log;
    let mut tell = |_| ControlFlow::Continue(());
    let mut watch = Watch::new(log.images.len(), &mut tell);
    let imu = log.imu();
    let recording = Measurements { log, imu: &imu, model: &input.model };
    let (_, guess) = initial::longest_segment(log, &imu, &input.model, input.camera.time_offset);
    let mut work = Work::new(input, guess);
    let mut passed = work.pass(&recording, &mut watch)?;
    // The images before the start; an earlier result gave them states.
    if work.guess.images.first().is_some_and(|first| *first > 0) {
        work.guess = grow::outward(&recording, &work, &mut watch)?;
        passed = work.pass(&recording, &mut watch)?;
    }
    for _ in 1..PASSES {
        let doubts = |system| work.doubt_images(&passed.problem, &system);
        if passed.is_settled && !optimise::solution(&passed.problem).is_some_and(doubts) {
            break;
        }
        passed = work.pass(&recording, &mut watch)?;
    }
    let problem = &passed.problem;
    let OptimiseReport { observations, rejected, .. } = passed.report;
    if !result::agree(optimise::inertial_chi2_per_dof(problem), observations, rejected) {
        return Err(AdjustmentError::Undetermined);
    }
    let system = optimise::solution(problem).ok_or(AdjustmentError::Undetermined)?;
    let covariance = system.factor.inverse(problem.calibration_offset());
    let newest = problem.frames.len() - 1;
    let at = problem.offset(newest);
    let state = problem.frames[newest].body.state;
    let time_offset = passed.clock_offset + Duration::from_secs_f64(problem.calibration.clock_secs);
    let with_gains =
        Measurements { log, imu: &imu.multiplied(&problem.calibration.gain), model: &input.model };
    let images = result::states_of_images(&with_gains, (problem, &passed.images), time_offset).into_iter();
    let number = |k: usize| log.images[passed.images[k]].number();
    Ok(NewestState {
        frame: number(newest),
        state,
        sigmas: sigmas(&state, &Matrix15::from_fn(|a, b| covariance.entry(at + a, at + b))),
        scale_std: result::log_scale_sigma(problem, &system).max(result::arm_doubt(input, problem)),
        median_distance_m: median_distance(problem, newest).ok_or(AdjustmentError::Undetermined)?,
        states: problem.frames.iter().enumerate().map(|(k, f)| (number(k), f.body.state)).collect(),
        images: images.map(|(image, _, state)| (image, state.world_from_body)).collect(),
        time_offset,
        readout_secs: problem.calibration.readout_secs,
        body_from_camera: problem.calibration.body_from_camera,
        gain: problem.calibration.gain,
    })
}

/// Median distance of the landmarks that state `k` sees, m.
fn median_distance(problem: &Problem, k: usize) -> Option<f64> {
    let camera =
        problem.frames[k].body.state.world_from_body.act(&problem.calibration.body_from_camera.translation);
    let seen = problem.landmarks.iter().filter(|l| l.observations.iter().any(|o| o.frame == k));
    let place = |l: &super::landmark::Landmark| l.origin + l.direction / l.positive_inverse();
    median_upper(&mut seen.map(|l| (place(&l.landmark) - camera).norm()).collect::<Vec<f64>>())
}

/// A gauge prior knows no correlations, and one number for three axes: it gets that of the axis that is known least.
fn sigmas(state: &NavState, covariance: &Matrix15) -> GaugePriorSigmas {
    let block = |a: usize, b: usize| covariance.fixed_view::<3, 3>(a, b).into_owned();
    let largest = |square: Matrix3<f64>| square.symmetric_eigenvalues().max().max(0.0).sqrt();
    let world_from_body = state.world_from_body.rotation.matrix();
    let turn = world_from_body * block(0, 0) * world_from_body.transpose();
    // Velocity in the body's axes: d(Rᵀ v) = [Rᵀ v]× δθ + Rᵀ δv.
    let body_from_world = world_from_body.transpose();
    let by_rotation = hat(&(body_from_world * state.velocity));
    let cross = by_rotation * block(0, 6) * world_from_body;
    let velocity = by_rotation * block(0, 0) * by_rotation.transpose()
        + (cross + cross.transpose())
        + body_from_world * block(6, 6) * world_from_body;
    GaugePriorSigmas {
        tilt_rad: turn.fixed_view::<2, 2>(0, 0).into_owned().symmetric_eigenvalues().max().max(0.0).sqrt(),
        velocity_mps: largest(velocity),
        gyro_bias: largest(block(9, 9)),
        accel_bias: largest(block(12, 12)),
        ..GaugePriorSigmas::GAUGE
    }
}

impl TrackLog {
    /// The pose world_from_body that was logged of an image, by the caller's number.
    pub(crate) fn pose_of(&self, image: FrameId) -> Option<Se3> {
        let logged = self.images.iter().find(|i| i.caller_frame == image)?;
        Some(logged.state?.state.world_from_body)
    }

    /// `ln` of how much larger the newest [`COMPARED_STATES`] of other states (in the order of numbers) are than those logged in `segment`: by the
    /// scatter of their positions. `None` where either does not move.
    pub(crate) fn log_scale_to(&self, states: &[(FrameId, NavState)], segment: u32) -> Option<f64> {
        let both = self.images.iter().rev().filter(|image| image.is_of(segment)).filter_map(|image| {
            let at = states.binary_search_by_key(&image.number(), |(frame, _)| *frame).ok()?;
            let place = |state: &NavState| state.world_from_body.translation;
            Some((place(&image.state?.state), place(&states[at].1)))
        });
        let (logged, other): (Vec<_>, Vec<_>) = both.take(COMPARED_STATES).unzip();
        let scatter = |places: &[Vector3<f64>]| {
            let mean = places.iter().sum::<Vector3<f64>>() / places.len().max(1) as f64;
            places.iter().map(|p| (p - mean).norm_squared()).sum::<f64>()
        };
        let ln = 0.5 * (scatter(&other) / scatter(&logged)).ln();
        ln.is_finite().then_some(ln)
    }

    /// Takes over other states of logged images (in the order of numbers), moved into the world of `segment`. Later states of the segment follow the
    /// last of them with their own motion, in its scale.
    pub(crate) fn replace_states(&mut self, segment: u32, states: &[(FrameId, NavState)], placed: &Se3) {
        let Some((last, newest)) = states.last().map(|(frame, state)| (*frame, state.moved(placed))) else {
            return;
        };
        let factor = self.log_scale_to(states, segment).unwrap_or(0.0).exp();
        let before =
            self.images.iter().find(|i| i.number() == last && i.is_of(segment)).and_then(|i| i.state);
        for image in &mut self.images {
            if let Ok(at) = states.binary_search_by_key(&image.number(), |(frame, _)| *frame) {
                image.state = Some(LoggedState { segment, state: states[at].1.moved(placed) });
            } else if image.number() > last && image.is_of(segment) {
                image.state = image.state.zip(before).map(|(logged, before)| {
                    let (from, mut state) = (before.state.world_from_body, logged.state);
                    let moved = state.world_from_body.translation - from.translation;
                    state.world_from_body.translation = from.translation + moved * factor;
                    state.velocity *= factor;
                    LoggedState { segment, state: state.moved(&onto(&from, &newest.world_from_body)) }
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::log::tests::log;
    use super::*;

    #[test]
    fn scales_are_compared_by_the_newest_common_states() {
        let log = log(20);
        let mut larger: Vec<_> =
            log.images.iter().filter_map(|i| Some((i.number(), i.state?.state))).take(18).collect();
        assert_eq!(log.log_scale_to(&larger, 3), Some(0.0));
        larger.iter_mut().for_each(|(_, s)| s.world_from_body.translation *= 1.5);
        // An old one does not count.
        larger[2].1.world_from_body.translation.y = 100.0;
        let ln = log.log_scale_to(&larger, 3).unwrap();
        assert!((ln - 1.5_f64.ln()).abs() < 1e-12, "{ln}");
        assert_eq!(log.log_scale_to(&larger, 4), None);
        larger.iter_mut().for_each(|(_, s)| *s = NavState::REST);
        assert_eq!(log.log_scale_to(&larger, 3), None);
    }

    #[test]
    fn states_taken_over_are_moved_and_later_ones_follow() {
        let mut log = log(6);
        log.images[5].state = log.images[5].state.map(|s| LoggedState { segment: 4, ..s });
        let placed = Se3::new(vidar_core::So3::IDENTITY, Vector3::new(0.0, 7.0, 0.0));
        let solved = |k: u32| {
            let mut state = NavState::REST;
            state.world_from_body.translation.z = 8.0 * f64::from((k - 1) / 2);
            (FrameId(k), state)
        };
        log.replace_states(3, &[solved(1), solved(3)], &placed);
        let place = |k: usize| log.images[k].state.map(|s| s.state.world_from_body.translation);
        assert_eq!(place(0), Some(Vector3::zeros()), "before what was solved");
        assert_eq!(place(1), Some(Vector3::new(0.0, 7.0, 0.0)));
        assert_eq!(place(2), Some(Vector3::new(2.0, 0.0, 0.0)), "not solved");
        assert_eq!(place(3), Some(Vector3::new(0.0, 7.0, 8.0)));
        // The last two states that were solved are four times as far apart as they were; what follows goes on from there.
        assert_eq!(place(4), Some(Vector3::new(4.0, 7.0, 8.0)), "after what was solved");
        assert_eq!(place(5), Some(Vector3::new(5.0, 0.0, 0.0)), "of another segment");
    }
}
