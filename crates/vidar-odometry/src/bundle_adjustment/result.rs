//! What the adjustment found: calibration, scale, and a state for every image.

use super::envelope::Envelope;
use super::inertial::GAIN_DIM;
use super::initial::preintegrate;
use super::noise::WeighedImu;
use super::observation::TIMING_AND_PLACE;
use super::problem::Problem;
use super::system::System;
use super::{
    AdjustmentFinding, AdjustmentInput, MAX_INERTIAL_CHI2, MAX_REJECTED_SHARE, Measurements, Solution,
};
use super::{delays, findings, keyframes};
use crate::calibration::loud_noise;
use crate::imu::{ImuBuffer, ImuModel, NavState};
use crate::pipeline::{Joined, public_state};
use nalgebra::Vector3;
use vidar_core::{CameraModel, Duration, FrameId, LieGroup, OdometryKeyframe, Se3, So3, Timestamp};

/// Longest time before the first or after the last adjusted state that is carried by the IMU, s.
const MAX_EDGE_SECS: f64 = 0.5;

/// The camera's calibration as estimated, with standard deviations; zero where it was held.
#[derive(Clone, Debug, PartialEq)]
pub struct AdjustedCalibration {
    /// Intrinsics.
    pub camera: CameraModel,
    /// Pose of the camera on the body.
    pub body_from_camera: Se3,
    /// `t_imu = stamp + offset`, s.
    pub time_offset_secs: f64,
    /// From the first to the last row, s.
    pub readout_secs: f64,
    /// Standard deviations: clock offset and readout (s), rotation (rad, about the axes of the camera), position (m, in the body),
    /// intrinsics (their own units).
    pub sigmas: Vec<f64>,
}

/// The IMU as estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdjustedImu {
    /// What measurements of the gyroscope are to be multiplied by, per axis of the body.
    pub gyro_gain: Vector3<f64>,
    /// What measurements of the accelerometer are to be multiplied by.
    pub accel_gain: Vector3<f64>,
    /// Standard deviations of both, relative; zero where they were held.
    pub gyro_gain_sigma: Vector3<f64>,
    /// See `gyro_gain_sigma`.
    pub accel_gain_sigma: Vector3<f64>,
    /// White noise as the residuals show it, rad/s/√Hz, at least the data sheet's.
    pub gyro_noise_density: f64,
    /// White noise of the accelerometer, m/s²/√Hz.
    pub accel_noise_density: f64,
}

/// How the adjustment went.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct AdjustmentReport {
    /// States adjusted.
    pub states: usize,
    /// Landmarks at the end.
    pub landmarks: usize,
    /// Observations at the end, and those that were left out.
    pub observations: usize,
    /// Observations that did not fit.
    pub rejected: usize,
    /// Iterations of all rounds.
    pub iterations: usize,
    /// Loop constraints: pairs of places, seen at different times, that show the same, and landmarks seen again in them.
    pub loops: usize,
    /// See `loops`.
    pub loop_matches: usize,
    /// Cost before and after.
    pub cost: (f64, f64),
    /// Mean squared residual of the inertial factors, whitened with the noise as given.
    pub inertial_chi2_per_dof: f64,
    /// How many times the noise that the IMU's samples show (or its data sheet states, if more) is needed to reconcile the IMU with the images. Healthy
    /// recordings have 0.7 to 1.3; beyond [`AdjustmentReport::EXPLAINED_NOISE`] something is not modelled.
    pub noise_ratio: f64,
}

impl AdjustmentReport {
    /// The noise ratio up to which noise explains what camera and IMU differ by. Real MH_01 has 1.3, 322 adjustments of rendered recordings up to 1.4 where all
    /// was modelled; 43 in which something was not (a focal length that changes, stabilised images, a carrier in view, swapped axes) 2.5 to 100.
    pub const EXPLAINED_NOISE: f64 = 2.5;

    /// Whether noise explains what camera and IMU differ by.
    pub fn is_explained(&self) -> bool {
        self.noise_ratio <= Self::EXPLAINED_NOISE
    }
}

/// The factor by which the IMU's noise exceeds what its samples show with vibration and its data sheet states, of the sensor for which that is more. Noise that
/// the residuals do not tell is what was assumed; it counts where so much was assumed that it may hide anything, and 1 is returned where neither does.
fn noise_ratio(input: &AdjustmentInput<'_>, weighed: &WeighedImu) -> f64 {
    let (sheet, found) = (&input.data_sheet, &weighed.model.noise);
    let seen = loud_noise(input.log.imu_samples());
    let gyro = found.gyro_density / seen.map_or(0.0, |n| n.gyro).max(sheet.gyro_density);
    let accel = found.accel_density / seen.map_or(0.0, |n| n.accel).max(sheet.accel_density);
    let [gyro_told, accel_told] = weighed.is_told;
    let counted = [(gyro, gyro_told || gyro > HIDING_NOISE), (accel, accel_told || accel > HIDING_NOISE)];
    counted.into_iter().filter(|(_, counts)| *counts).map(|(ratio, _)| ratio).reduce(f64::max).unwrap_or(1.0)
}

/// Assumed noise, as a multiple of the IMU's own, that would hide errors of the model: the odometry takes it two and four times as large.
const HIDING_NOISE: f64 = 5.0;

/// An adjusted recording. The world is levelled, z up, its origin where the first state was.
#[derive(Clone, Debug, PartialEq)]
pub struct Adjusted {
    /// The segment of the odometry in whose world the states are.
    pub segment: u32,
    /// A state for every image between the first and the last adjusted one, in the order of time.
    pub images: Vec<(FrameId, vidar_core::NavState)>,
    /// The images that took part, as keyframes of one segment with the landmarks that they observe. Covariances of poses are
    /// accumulated along the chain.
    pub keyframes: Vec<OdometryKeyframe>,
    /// The calibration.
    pub calibration: AdjustedCalibration,
    /// The IMU.
    pub imu: AdjustedImu,
    /// What was given and the recording contradicts.
    pub findings: Vec<AdjustmentFinding>,
    /// Standard deviation of ln(scale) over the whole path, as the measurements and their noise give it, times the noise ratio where that is above 1.
    pub scale_std: f64,
    /// How it went.
    pub report: AdjustmentReport,
}

impl Adjusted {
    /// Takes all poses to the world of another segment.
    pub fn join(&mut self, joined: &Joined) {
        for (_, state) in &mut self.images {
            joined.apply(&mut self.segment.clone(), state);
        }
        self.keyframes.iter_mut().for_each(|k| joined.apply_to_keyframe(k));
        if self.segment == joined.segment {
            self.segment = joined.into;
        }
    }

    /// Whether camera and IMU agree in the solution.
    pub fn is_consistent(&self) -> bool {
        let AdjustmentReport { observations, rejected, inertial_chi2_per_dof, .. } = self.report;
        let images_are_plausible = self.findings.iter().all(AdjustmentFinding::is_plausible);
        agree(inertial_chi2_per_dof, observations, rejected)
            && images_are_plausible
            && self.scale_std.is_finite()
    }
}

/// Every image of the log between the first and the last adjusted one, with its stamp and its state. `recording` has IMU measurements with the
/// gains applied; `t_imu = stamp + offset`.
pub(super) fn states_of_images(
    recording: &Measurements<'_>,
    (problem, images): (&Problem, &[usize]),
    offset: Duration,
) -> Vec<(FrameId, Timestamp, NavState)> {
    let Measurements { log, imu, model } = *recording;
    let secs = problem.calibration.clock_secs;
    let clock = Duration::from_secs_f64(secs);
    let adjusted: Vec<(Timestamp, NavState)> =
        problem.frames.iter().map(|f| (f.time + clock, f.body.state_after(secs))).collect();
    let delays = delays::of_images(log, problem, images);
    let state = |((frame, stamp), delay): (&(FrameId, Timestamp), &f64)| {
        let exposed = *stamp + offset + Duration::from_secs_f64(*delay);
        Some((*frame, *stamp, state_at(&adjusted, exposed, imu, model)?))
    };
    log.stamps.iter().zip(&delays).filter_map(state).collect()
}

/// Whether camera and IMU agree in a solution with this mean squared inertial residual and so many observations left out.
pub(super) fn agree(inertial_chi2_per_dof: f64, observations: usize, rejected: usize) -> bool {
    let share = rejected as f64 / (observations + rejected).max(1) as f64;
    inertial_chi2_per_dof < MAX_INERTIAL_CHI2 && share < MAX_REJECTED_SHARE
}

/// `recording` has IMU measurements with the gains applied; the stamps are those of `input`.
pub(super) fn collect(
    input: &AdjustmentInput<'_>,
    recording: &Measurements<'_>,
    solution: &Solution,
) -> Adjusted {
    let Solution { problem, clock_offset, report, system, covariance, .. } = solution;
    let clock = Duration::from_secs_f64(problem.calibration.clock_secs);
    let offset = *clock_offset + clock;
    let states = states_of_images(recording, (problem, &solution.images), offset).into_iter();
    let every_image = states.map(|(frame, stamp, state)| (frame, public_state(&state, stamp))).collect();
    let noise_ratio = noise_ratio(input, &solution.weighed);
    // Noise that stands in for an error of the model keeps its sign for seconds, which white noise does not.
    let scale_std = (log_scale_sigma(problem, system) * noise_ratio.max(1.0)).max(arm_doubt(input, problem));
    let mut sigmas = calibration_sigmas(problem, covariance);
    if let Some(focus) = solution.of_images.focus {
        let intrinsics = problem.calibration.camera.parameters();
        for axis in 0..2 {
            let own = sigmas[TIMING_AND_PLACE + axis];
            sigmas[TIMING_AND_PLACE + axis] = own.hypot(focus.mean_sigma * intrinsics[axis]);
        }
    }
    let gains = problem.calibration.dim() - GAIN_DIM;
    Adjusted {
        segment: solution.segment,
        images: every_image,
        keyframes: keyframes::of(recording, solution, scale_std),
        calibration: AdjustedCalibration {
            camera: problem.calibration.camera.clone(),
            body_from_camera: problem.calibration.body_from_camera,
            time_offset_secs: offset.as_secs_f64(),
            readout_secs: problem.calibration.readout_secs,
            sigmas: sigmas[..gains].to_vec(),
        },
        imu: AdjustedImu {
            gyro_gain: problem.calibration.gain.gyro.add_scalar(1.0),
            accel_gain: problem.calibration.gain.accel.add_scalar(1.0),
            gyro_gain_sigma: Vector3::from_column_slice(&sigmas[gains..gains + 3]),
            accel_gain_sigma: Vector3::from_column_slice(&sigmas[gains + 3..]),
            gyro_noise_density: recording.model.noise.gyro_density,
            accel_noise_density: recording.model.noise.accel_density,
        },
        findings: findings::of(
            problem,
            covariance,
            &input.given_body_from_camera,
            input.sigmas,
            &solution.of_images,
        ),
        scale_std,
        report: AdjustmentReport {
            states: problem.frames.len(),
            landmarks: problem.landmarks.len(),
            observations: report.observations,
            rejected: report.rejected,
            iterations: report.iterations,
            loops: solution.closed.pairs,
            loop_matches: solution.closed.matches,
            cost: (report.before.total(), report.after.total()),
            inertial_chi2_per_dof: solution.inertial_chi2_per_dof,
            noise_ratio,
        },
    }
}

/// The state at an instant: carried by the IMU from the adjusted state before it, and corrected by what the IMU misses the
/// next one by, in proportion to the time.
fn state_at(
    states: &[(Timestamp, NavState)],
    time: Timestamp,
    imu: &ImuBuffer,
    model: &ImuModel,
) -> Option<NavState> {
    let after = states.partition_point(|(t, _)| *t < time);
    if let Some((_, state)) = states.get(after).filter(|(t, _)| *t == time) {
        return Some(*state);
    }
    let mut interval = Vec::new();
    let mut carry = |from: &(Timestamp, NavState), until: Timestamp| {
        Some(preintegrate(imu, model, &from.1, from.0, until, &mut interval)?.predict(&from.1))
    };
    let is_near = |other: Timestamp| (time - other).as_secs_f64().abs() <= MAX_EDGE_SECS;
    match (after.checked_sub(1).map(|k| &states[k]), states.get(after)) {
        (Some(before), Some(next)) => {
            let carried = carry(before, time)?;
            let missed = carry(before, next.0)?;
            let share = (time - before.0).nanos() as f64 / (next.0 - before.0).nanos() as f64;
            let error = next.1.minus(&missed);
            // Rotation, position, velocity; the biases are those of the state before.
            let mut step = error * share;
            step.fixed_rows_mut::<6>(9).fill(0.0);
            Some(carried.plus(&step))
        }
        (Some(last), None) if is_near(last.0) => carry(last, time),
        (None, Some(first)) if is_near(first.0) => {
            let secs = (time - first.0).as_secs_f64();
            let sample = imu.at(time)?;
            let turn = So3::exp(&((sample.gyro.0 - first.1.bias.gyro) * secs));
            let pose = &first.1.world_from_body;
            let place = pose.translation + first.1.velocity * secs;
            Some(NavState { world_from_body: Se3::new(pose.rotation * turn, place), ..first.1 })
        }
        _ => None,
    }
}

fn calibration_sigmas(problem: &Problem, covariance: &Envelope) -> Vec<f64> {
    let mut sigmas = vec![0.0; problem.calibration.dim()];
    for (k, index) in problem.active.iter().enumerate() {
        let row = problem.calibration_offset() + k;
        sigmas[*index] = covariance.entry(row, row).max(0.0).sqrt();
    }
    sigmas
}

/// A camera's place that is stated no better than this was measured by nobody, m.
const ASSUMED_POSITION_M: f64 = 0.03;

/// σ(ln s) where the body's whole path is shorter than what was found of the camera's arm beyond what was given of it: a camera that goes round something and looks at it
/// turns as one does on an arm of any length, and the accelerometer's bias takes up what is left. A stabilised phone that circled the middle of a hall at 5 m shrank to a path of
/// 0.6 m about an arm of 0.15 m, at a formal σ of 3 %.
pub(super) fn arm_doubt(input: &AdjustmentInput<'_>, problem: &Problem) -> f64 {
    let found = problem.calibration.body_from_camera.translation;
    let is_assumed = input.sigmas.position_m > ASSUMED_POSITION_M;
    let given = if is_assumed { Vector3::zeros() } else { input.given_body_from_camera.translation };
    doubt_of(&(found - given), &places(problem))
}

/// Where the body was.
fn places(problem: &Problem) -> Vec<Vector3<f64>> {
    problem.frames.iter().map(|f| f.body.state.world_from_body.translation).collect()
}

/// From their mean to places.
fn about_their_mean(places: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mean = places.iter().sum::<Vector3<f64>>() / places.len() as f64;
    places.iter().map(|p| p - mean).collect()
}

fn sum_of_squares(vectors: &[Vector3<f64>]) -> f64 {
    vectors.iter().map(Vector3::norm_squared).sum()
}

/// The length of `arm` over how far `places` lie from their mean (root mean square) where that is more than 1, else 0.
fn doubt_of(arm: &Vector3<f64>, places: &[Vector3<f64>]) -> f64 {
    let spread = (sum_of_squares(&about_their_mean(places)) / places.len() as f64).sqrt();
    let ratio = arm.norm() / spread;
    if ratio > 1.0 { ratio } else { 0.0 }
}

/// With positions `p_k` about their mean `m`, `d ln s / d p_k = (p_k − m) / Σ |p − m|²`.
pub(super) fn log_scale_sigma(problem: &Problem, system: &System) -> f64 {
    let places = about_their_mean(&places(problem));
    let spread = sum_of_squares(&places);
    if !(spread > 0.0) {
        return f64::INFINITY;
    }
    let mut slope = vec![0.0; problem.dim()];
    for (k, place) in places.iter().enumerate() {
        let at = problem.offset(k) + 3;
        slope[at..at + 3].copy_from_slice((place / spread).as_slice());
    }
    system.sigma_of(slope)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_within_reach_of_an_arm_that_nobody_gave_says_nothing_of_the_scale() {
        let circle = |radius: f64| -> Vec<Vector3<f64>> {
            let angles = (0..36).map(|k| f64::from(k) * std::f64::consts::TAU / 36.0);
            angles.map(|a| Vector3::new(3.0 + radius * a.cos(), radius * a.sin(), 1.0)).collect()
        };
        let arm = Vector3::new(0.0, 0.1, 0.1);
        assert_eq!(doubt_of(&arm, &circle(0.3)), 0.0);
        assert!((doubt_of(&arm, &circle(0.05)) - 0.2 * f64::sqrt(2.0) / 0.1).abs() < 1e-9);
        assert_eq!(doubt_of(&Vector3::zeros(), &circle(0.001)), 0.0, "as it was given");
        assert_eq!(doubt_of(&arm, &circle(0.0)), f64::INFINITY);
    }
}
