//! Levenberg-Marquardt over the window.

use super::Smoother;
use super::linearise::System;
use super::prior::Part;
use super::window::{CALIBRATION_DIM, CalibrationState};
use crate::imu::{NavState, Vector15};
use nalgebra::{SVector, Vector3};
use vidar_core::{FrameId, LandmarkId};

/// An observation that does not fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outlier {
    /// The frame.
    pub frame: FrameId,
    /// The landmark.
    pub landmark: LandmarkId,
    /// Its squared whitened residual; 2 is what fits.
    pub chi2: f64,
}

/// What an optimisation did. Refill one report per image to stay free of allocations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OptimiseReport {
    /// Steps taken.
    pub iterations: usize,
    /// Robust cost before.
    pub cost_before: f64,
    /// Robust cost after.
    pub cost_after: f64,
    /// Whether the last step changed the cost by less than a 1e-4th.
    pub converged: bool,
    /// Observations beyond the outlier limit, for the caller to remove.
    pub outliers: Vec<Outlier>,
    /// Observations in the system.
    pub observations: usize,
    /// Mean squared whitened residual per dimension over the observations that are no outliers; 1 is what fits.
    pub chi2_per_dof: f64,
}

/// Smallest relative change of the cost that is worth another step.
const CONVERGED_CHANGE: f64 = 1e-4;

/// Nearly Gauss-Newton to begin with.
const FIRST_LAMBDA: f64 = 1e-4;
const LEAST_LAMBDA: f64 = 1e-9;
const MOST_LAMBDA: f64 = 1e8;

/// Inverse squares of the steps at which damping of 1 sets in: 0.1 rad, 1 m; 1 m/s, 0.05 rad/s, 0.5 m/s²; calibration
/// 0.02 rad, 2 cm, 5 ms.
///
/// Damping by the system's own diagonal would hold biases in place: each is coupled to its neighbours by a walk a million
/// times stiffer than what is known of all of them together.
const POSE_DAMPING: [f64; 6] = [1e2, 1e2, 1e2, 1.0, 1.0, 1.0];
const MOTION_DAMPING: [f64; 9] = [1.0, 1.0, 1.0, 4e2, 4e2, 4e2, 4.0, 4.0, 4.0];
const CALIBRATION_DAMPING: [f64; CALIBRATION_DIM] = [2.5e3, 2.5e3, 2.5e3, 2.5e3, 2.5e3, 2.5e3, 4e4];

/// A frame's state before a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StateBackup {
    state: NavState,
    step: Vector15,
}

impl Smoother {
    /// At most `max_iterations` steps of Levenberg-Marquardt (Nielsen's damping), then a search for outliers.
    pub fn optimise(&mut self, max_iterations: usize) -> OptimiseReport {
        let mut report = OptimiseReport::default();
        self.optimise_into(max_iterations, &mut report);
        report
    }

    /// As [`Smoother::optimise`], into a report whose memory is used again.
    pub fn optimise_into(&mut self, max_iterations: usize, report: &mut OptimiseReport) {
        self.optimise_from(FIRST_LAMBDA, max_iterations, report);
    }

    /// As [`Smoother::optimise_into`], with a damping to begin with (larger for rough starts).
    pub(crate) fn optimise_from(
        &mut self,
        first_lambda: f64,
        max_iterations: usize,
        report: &mut OptimiseReport,
    ) {
        let mut system = std::mem::take(&mut self.system);
        let mut lambda = first_lambda;
        let mut growth = 4.0;
        let mut cost = self.linearise(&mut system, lambda);
        (report.iterations, report.converged, report.cost_before) = (0, false, cost);
        while report.iterations < max_iterations && !report.converged && lambda < MOST_LAMBDA {
            report.iterations += 1;
            let calibration = self.save(&mut system);
            let gain = solve(&mut system, lambda);
            let Some(expected) = gain else {
                lambda = (lambda * growth).max(1e-3);
                growth *= 4.0;
                cost = self.linearise(&mut system, lambda);
                continue;
            };
            self.apply(&system);
            let lambda_next = (lambda / 3.0).max(LEAST_LAMBDA);
            let after = self.linearise(&mut system, lambda_next);
            let change = cost - after;
            if change >= 0.0 || -change < 1e-9 * cost {
                let ratio = change / expected.max(1e-300);
                lambda =
                    (lambda * (1.0 - (2.0 * ratio - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0)).max(LEAST_LAMBDA);
                growth = 4.0;
                report.converged = change <= CONVERGED_CHANGE * cost;
                cost = after;
            } else {
                self.restore(&system, calibration);
                lambda = (lambda * growth).max(1e-3);
                growth *= 4.0;
                cost = self.linearise(&mut system, lambda);
            }
        }
        report.cost_after = cost;
        self.system = system;
        self.find_outliers(report);
    }

    fn save(&self, system: &mut System) -> CalibrationState {
        system.saved.clear();
        system.saved.extend(self.frames.iter().map(|f| StateBackup { state: f.state, step: f.step }));
        system.saved_landmarks.clear();
        for e in &system.eliminated {
            let landmark = &self.landmarks[e.slot];
            system.saved_landmarks.push((e.slot, landmark.bearing, landmark.rho));
        }
        self.calibration
    }

    fn restore(&mut self, system: &System, calibration: CalibrationState) {
        for (frame, saved) in self.frames.iter_mut().zip(&system.saved) {
            frame.state = saved.state;
            frame.step = saved.step;
        }
        for &(slot, bearing, rho) in &system.saved_landmarks {
            self.landmarks[slot].bearing = bearing;
            self.landmarks[slot].rho = rho;
        }
        self.calibration = calibration;
    }

    fn apply(&mut self, system: &System) {
        let pose_step = |k: usize| {
            let at = system.offset(Part::Pose(k));
            SVector::<f64, 6>::from_column_slice(&system.step[at..at + 6])
        };
        let calibrates = system.n > 15 * system.frames;
        let calibration_step = if calibrates {
            SVector::<f64, CALIBRATION_DIM>::from_column_slice(&system.step[15 * system.frames..])
        } else {
            SVector::zeros()
        };
        // Landmarks: V δ_l = −g_l − Σ Wᵀ δ_x.
        for e in &system.eliminated {
            let mut rhs: Vector3<f64> = e.gradient;
            for cross in &system.cross[e.cross_begin..e.cross_end] {
                rhs += cross.value.transpose() * pose_step(cross.frame);
            }
            if calibrates {
                rhs += e.by_calibration.transpose() * calibration_step;
            }
            self.landmarks[e.slot].apply(&-(e.inverse * rhs));
        }
        for (k, frame) in self.frames.iter_mut().enumerate() {
            let at = system.offset(Part::Motion(k));
            frame.apply(&pose_step(k), &SVector::<f64, 9>::from_column_slice(&system.step[at..at + 9]));
        }
        if calibrates {
            self.calibration.apply(&calibration_step);
        }
    }

    fn find_outliers(&self, report: &mut OptimiseReport) {
        report.outliers.clear();
        let (mut sum, mut fitting, mut all) = (0.0, 0_usize, 0);
        for landmark in self.landmarks.iter().filter(|l| l.alive) {
            for s in &landmark.observations {
                all += 1;
                if s.chi2 > self.config.outlier_chi2 {
                    let frame = self.frames[s.frame].id;
                    report.outliers.push(Outlier { frame, landmark: landmark.id, chi2: s.chi2 });
                } else {
                    sum += s.chi2;
                    fitting += 1;
                }
            }
        }
        report.observations = all;
        report.chi2_per_dof = if fitting > 0 { sum / (2 * fitting) as f64 } else { 0.0 };
    }
}

/// Solves the damped system into `system.step`; the decrease of the cost that the linear model promises, or `None`
/// when the system is not positive definite.
fn solve(system: &mut System, lambda: f64) -> Option<f64> {
    let n = system.n;
    system.damping.clear();
    let frames = system.frames;
    system.damping.extend((0..frames).flat_map(|_| MOTION_DAMPING));
    system.damping.extend((0..frames).flat_map(|_| POSE_DAMPING));
    if n > 15 * frames {
        system.damping.extend(CALIBRATION_DAMPING);
    }
    system.damping.iter_mut().for_each(|d| *d *= lambda);
    if !system.cholesky.factorise(&system.h, &system.damping, &system.first) {
        return None;
    }
    system.step.clear();
    system.step.extend(system.gradient.iter().map(|g| -g));
    system.cholesky.solve(&mut system.step);
    let expected = system
        .step
        .iter()
        .zip(&system.gradient)
        .zip(&system.damping)
        .map(|((s, g), d)| 0.5 * s * (d * s - g))
        .sum::<f64>();
    expected.is_finite().then_some(expected)
}
