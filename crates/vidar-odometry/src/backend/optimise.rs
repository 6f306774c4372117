//! Levenberg-Marquardt over the window.

use super::Smoother;
use super::delay::Delay;
use super::image_shift::ImageShift;
use super::prior::Part;
use super::system::System;
use super::window::{CALIBRATION_DIM, CalibrationState};
use crate::imu::{NavState, Vector15};
use nalgebra::{SVector, Vector2, Vector3};
use std::convert::Infallible;
use vidar_core::{FrameId, LandmarkId};
use vidar_solve::levenberg_marquardt::{Decrease, Increase, LeastSquares, Limits, Schedule, Trial, minimise};

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

/// Nielsen's damping, nearly Gauss-Newton to begin with.
const SCHEDULE: Schedule = Schedule {
    first: 1e-4,
    least: 1e-9,
    on_accepted: Decrease::GainRatio,
    on_rejected: FAILURE,
    on_unsolvable: Some(FAILURE),
};
const FAILURE: Increase = Increase { acceleration: 4.0, least: 1e-3, ..Increase::by(4.0) };
const LIMITS: Limits = Limits { damping: 1e8, ..Limits::NONE };

/// Moves of pixels, by shifts of images that moved, that are not worth another descent, px.
const SETTLED_PIXELS: f64 = 0.05;

/// Inverse squares of the steps at which damping of 1 sets in: 0.1 rad, 1 m; 1 m/s, 0.05 rad/s, 0.5 m/s²; a delay 5 ms; a shift 0.01 rad; calibration
/// 0.02 rad, 2 cm, 5 ms.
///
/// Damping by the system's own diagonal would hold biases in place: each is coupled to its neighbours by a walk a million
/// times stiffer than what is known of all of them together.
const POSE_DAMPING: [f64; 6] = [1e2, 1e2, 1e2, 1.0, 1.0, 1.0];
const MOTION_DAMPING: [f64; 9] = [1.0, 1.0, 1.0, 4e2, 4e2, 4e2, 4.0, 4.0, 4.0];
const DELAY_DAMPING: f64 = 4e4;
const IMAGE_SHIFT_DAMPING: f64 = 1e4;
const CALIBRATION_DAMPING: [f64; CALIBRATION_DIM] = [2.5e3, 2.5e3, 2.5e3, 2.5e3, 2.5e3, 2.5e3, 4e4];

/// A frame's state before a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StateBackup {
    state: NavState,
    step: Vector15,
    delay: Delay,
    image_shift: ImageShift,
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
        self.optimise_from(SCHEDULE.first, max_iterations, report);
    }

    /// As [`Smoother::optimise_into`], with a damping to begin with (larger for rough starts).
    pub(crate) fn optimise_from(&mut self, first: f64, max_iterations: usize, report: &mut OptimiseReport) {
        self.turn_shifted_pixels();
        self.descend(first, max_iterations, report);
        // Where shifts of images moved, so did what a turned camera would have seen.
        if self.turn_shifted_pixels() > SETTLED_PIXELS {
            let (iterations, cost_before) = (report.iterations, report.cost_before);
            self.descend(first, max_iterations, report);
            (report.iterations, report.cost_before) = (iterations + report.iterations, cost_before);
        }
        self.find_outliers(report);
    }

    fn descend(&mut self, first: f64, max_iterations: usize, report: &mut OptimiseReport) {
        let mut system = std::mem::take(&mut self.system);
        let cost = self.linearise(&mut system, first);
        let calibration = self.calibration;
        let mut window = Window { smoother: self, system: &mut system, calibration, promised: 0.0 };
        let limits = Limits { trials: max_iterations, ..LIMITS };
        let Ok(done) = minimise(&mut window, cost, &Schedule { first, ..SCHEDULE }, &limits);
        (report.iterations, report.converged) = (done.trials, done.converged);
        (report.cost_before, report.cost_after) = (done.cost_before, done.cost_after);
        self.system = system;
    }

    fn save(&self, system: &mut System) -> CalibrationState {
        system.saved.clear();
        system.saved.extend(self.frames.iter().map(|f| StateBackup {
            state: f.state,
            step: f.step,
            delay: f.delay,
            image_shift: f.image_shift,
        }));
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
            frame.delay = saved.delay;
            frame.image_shift = saved.image_shift;
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
        let calibrates = system.calibrates();
        let calibration_step = if calibrates {
            let at = system.offset(Part::Calibration);
            SVector::<f64, CALIBRATION_DIM>::from_column_slice(&system.step[at..])
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
        for k in 0..self.frames.len() {
            let at = system.offset(Part::Motion(k));
            let motion_step = SVector::<f64, 9>::from_column_slice(&system.step[at..at + 9]);
            if system.delays > 0 {
                self.apply_with_delay(
                    k,
                    &pose_step(k),
                    &motion_step,
                    system.step[system.offset(Part::Delay(k))],
                );
            } else {
                self.frames[k].apply(&pose_step(k), &motion_step);
            }
            if system.image_shifts > 0 {
                let at = system.offset(Part::ImageShift(k));
                self.frames[k].image_shift.apply(&Vector2::new(system.step[at], system.step[at + 1]));
            }
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

/// The window while it is optimised.
struct Window<'a> {
    smoother: &'a mut Smoother,
    system: &'a mut System,
    /// The calibration before the last trial; what else it moved is saved in `system`.
    calibration: CalibrationState,
    promised: f64,
}

impl LeastSquares for Window<'_> {
    type Error = Infallible;
    type Values = ();

    /// Ends linearised at the new values: the cost comes with it, and of most trials the system is the next one's.
    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, ())>, Infallible> {
        self.calibration = self.smoother.save(self.system);
        let Some(promised) = solve(self.system, damping) else { return Ok(None) };
        self.promised = promised;
        self.smoother.apply(self.system);
        Ok(Some((self.smoother.linearise(self.system, (damping / 3.0).max(SCHEDULE.least)), ())))
    }

    fn promised_decrease(&self) -> f64 {
        self.promised
    }

    /// A cost that rises by what rounding makes of it is none that rises.
    fn improves(&self, cost_before: f64, cost_after: f64) -> bool {
        let change = cost_before - cost_after;
        change >= 0.0 || -change < 1e-9 * cost_before
    }

    fn accept(&mut self, (): ()) {}

    /// The cost is that of IMU measurements which the trial may have integrated again, about its own biases.
    fn reject(&mut self, _: f64, next_damping: f64) -> f64 {
        self.smoother.restore(self.system, self.calibration);
        self.smoother.linearise(self.system, next_damping)
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        trial.is_accepted && trial.decrease() <= CONVERGED_CHANGE * trial.cost_before
    }
}

/// Solves the damped system into `system.step`; the decrease of the cost that the linear model promises, or `None`
/// when the system is not positive definite.
fn solve(system: &mut System, lambda: f64) -> Option<f64> {
    system.damping.clear();
    let frames = system.frames;
    system.damping.extend((0..frames).flat_map(|_| MOTION_DAMPING));
    system.damping.resize(9 * frames + system.delays, DELAY_DAMPING);
    system.damping.resize(system.offset(Part::Pose(0)), IMAGE_SHIFT_DAMPING);
    system.damping.extend((0..frames).flat_map(|_| POSE_DAMPING));
    if system.calibrates() {
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
