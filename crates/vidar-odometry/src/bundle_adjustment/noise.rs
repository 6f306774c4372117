//! The IMU's noise as the residuals of the adjustment show it.
//!
//! Variance components by group (Förstner 1979): with residuals `r` of a group, whitened with the noise as assumed, and the group's
//! redundancy `Σ (1 − jᵀ Σ j)`, the share of its measurements that the unknowns did not take up, `|r|² / redundancy` is what the
//! assumed variance is to be multiplied by.

use super::envelope::Envelope;
use super::inertial::GAIN_DIM;
use super::linearise::inertial_jacobians;
use super::optimise;
use super::problem::{FRAME_DIM, Problem};
use crate::imu::{ImuModel, StepNoise};
use nalgebra::SMatrix;

/// Fewest degrees of freedom from which a variance is estimated: σ is then known to 16 %.
const MIN_REDUNDANCY: f64 = 20.0;

/// A density is raised to this many times what it was taken for, at most: beyond it camera and IMU contradict each other, which
/// the consistency check tells.
const MAX_FACTOR: f64 = 3.0;

/// Unknowns of an inertial factor: two states and the gains.
const UNKNOWNS: usize = 2 * FRAME_DIM + GAIN_DIM;

/// Squared residuals and redundancy of a group of measurements.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Component {
    pub(super) chi2: f64,
    pub(super) redundancy: f64,
}

impl Component {
    /// What the assumed variance is to be multiplied by; `None` where too little is left over to tell.
    fn factor(&self) -> Option<f64> {
        (self.redundancy >= MIN_REDUNDANCY).then(|| self.chi2 / self.redundancy)
    }
}

/// Gyroscope and accelerometer: rotation, and position with velocity given the rotation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Components {
    pub(super) gyro: Component,
    pub(super) accel: Component,
}

/// The IMU's model with noise as the residuals show it.
#[derive(Clone, Copy, Debug)]
pub(super) struct WeighedImu {
    pub(super) model: ImuModel,
    /// Whether enough was left over to tell the noise of gyroscope and accelerometer; otherwise it is what was assumed.
    pub(super) is_told: [bool; 2],
}

impl Components {
    /// See [`WeighedImu::is_told`].
    fn told(&self) -> [bool; 2] {
        [&self.gyro, &self.accel].map(|component| component.factor().is_some())
    }
}

/// The components at the solution whose covariance (within the envelope) is `covariance`.
pub(super) fn components(problem: &Problem, covariance: &Envelope) -> Components {
    let mut found = Components::default();
    // Where the gains are among the unknowns; held ones are not.
    let first = problem.calibration.dim() - GAIN_DIM;
    let gains: [Option<usize>; GAIN_DIM] = std::array::from_fn(|k| {
        let at = problem.active.iter().position(|index| *index == first + k)?;
        Some(problem.calibration_offset() + at)
    });
    for k in 1..problem.frames.len() {
        let Some(at) = inertial_jacobians(problem, k) else { continue };
        let mut j = SMatrix::<f64, 15, UNKNOWNS>::zeros();
        j.fixed_view_mut::<15, 15>(0, 0).copy_from(&at.by_i);
        j.fixed_view_mut::<15, 15>(0, 15).copy_from(&at.by_j);
        j.fixed_view_mut::<15, GAIN_DIM>(0, 30).copy_from(&at.by_gain);
        let at_states = [problem.offset(k - 1), problem.offset(k)];
        let unknown = |a: usize| {
            if a < 30 { Some(at_states[a / FRAME_DIM] + a % FRAME_DIM) } else { gains[a - 30] }
        };
        let joint = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|a, b| {
            unknown(a).zip(unknown(b)).map_or(0.0, |(a, b)| covariance.entry(a, b))
        });
        let taken = (j * joint).component_mul(&j).column_sum();
        for row in 0..9 {
            let group = if row < 3 { &mut found.gyro } else { &mut found.accel };
            group.chi2 += at.residual[row] * at.residual[row];
            group.redundancy += (1.0 - taken[row]).max(0.0);
        }
    }
    found
}

/// The model with densities as the residuals show them, bounded below by the data sheet's.
pub(super) fn reweighed(model: &ImuModel, found: &Components, data_sheet: &StepNoise) -> WeighedImu {
    let scaled = |density: f64, component: &Component, least: f64| {
        let factor = component.factor().unwrap_or(1.0).sqrt();
        (density * factor.min(MAX_FACTOR)).max(least)
    };
    let noise = StepNoise {
        gyro_density: scaled(model.noise.gyro_density, &found.gyro, data_sheet.gyro_density),
        accel_density: scaled(model.noise.accel_density, &found.accel, data_sheet.accel_density),
        ..model.noise
    };
    WeighedImu { model: ImuModel { noise, ..*model }, is_told: found.told() }
}

/// By how much the densities of two models differ, relatively.
pub(super) fn largest_change(before: &ImuModel, after: &ImuModel) -> f64 {
    let change = |a: f64, b: f64| (b / a - 1.0).abs();
    change(before.noise.gyro_density, after.noise.gyro_density)
        .max(change(before.noise.accel_density, after.noise.accel_density))
}

/// The covariance within the envelope at the present values; `None` where the solution is not determined.
pub(super) fn covariance(problem: &Problem) -> Option<Envelope> {
    optimise::solution(problem).map(|system| system.factor.inverse(problem.calibration_offset()))
}
