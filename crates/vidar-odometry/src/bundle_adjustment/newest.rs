//! The newest state of a log from an adjustment of all its states, while the odometry goes on.

use super::inertial::ImuGain;
use super::problem::{FRAME_DIM, Problem};
use super::progress::Watch;
use super::{
    AdjustmentError, AdjustmentInput, MAX_INERTIAL_CHI2, MAX_REJECTED_SHARE, Measurements, PASSES, Work,
};
use super::{grow, initial, optimise, result};
use crate::backend::GaugePriorSigmas;
use crate::imu::{Matrix15, NavState, hat};
use nalgebra::Matrix3;
use std::ops::ControlFlow;
use vidar_core::{Duration, FrameId, LieGroup};
use vidar_solve::statistics::median_upper;

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
    /// `t_imu = stamp + offset`.
    pub(crate) time_offset: Duration,
    /// From the first to the last row, s.
    pub(crate) readout_secs: f64,
    /// Of the sensors as they are logged.
    pub(crate) gain: ImuGain,
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
    work.pass(&recording, &mut watch)?;
    work.guess = grow::outward(&recording, &work, &mut watch)?;
    let mut passed = work.pass(&recording, &mut watch)?;
    for _ in 1..PASSES {
        if passed.is_settled {
            break;
        }
        passed = work.pass(&recording, &mut watch)?;
    }
    let problem = &passed.problem;
    let rejected =
        passed.report.rejected as f64 / (passed.report.observations + passed.report.rejected).max(1) as f64;
    if optimise::inertial_chi2_per_dof(problem) > MAX_INERTIAL_CHI2 || rejected > MAX_REJECTED_SHARE {
        return Err(AdjustmentError::Undetermined);
    }
    let system = optimise::solution(problem).ok_or(AdjustmentError::Undetermined)?;
    let covariance = system.factor.inverse(problem.calibration_offset());
    let newest = problem.frames.len() - 1;
    let at = FRAME_DIM * newest;
    let state = problem.frames[newest].body.state;
    let number = |k: usize| log.images[passed.images[k]].number();
    Ok(NewestState {
        frame: number(newest),
        state,
        sigmas: sigmas(&state, &Matrix15::from_fn(|a, b| covariance.entry(at + a, at + b))),
        scale_std: result::log_scale_sigma(problem, &system),
        median_distance_m: median_distance(problem, newest).ok_or(AdjustmentError::Undetermined)?,
        states: problem.frames.iter().enumerate().map(|(k, f)| (number(k), f.body.state)).collect(),
        time_offset: passed.clock_offset + Duration::from_secs_f64(problem.calibration.clock_secs),
        readout_secs: problem.calibration.readout_secs,
        gain: problem.calibration.gain,
    })
}

/// Median distance of the landmarks that state `k` sees, m.
fn median_distance(problem: &Problem, k: usize) -> Option<f64> {
    let camera =
        problem.frames[k].body.state.world_from_body.act(&problem.calibration.body_from_camera.translation);
    let seen = problem.landmarks.iter().filter(|l| l.observations.iter().any(|o| o.frame == k));
    let place = |l: &super::observation::Landmark| l.origin + l.direction / l.inverse_distance;
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
