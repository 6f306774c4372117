//! What was given of the camera's place and the recording contradicts, and what its lens and its clock were found to do.

use super::envelope::Envelope;
use super::image_evidence::{Focus, FoundImages};
use super::observation::{POSITION, ROTATION};
use super::problem::Problem;
use super::sigmas::CalibrationSigmas;
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, Se3};

/// Departures below these are none that a user should mend, m and rad: a calibration with a target is good to millimetres and
/// tenths of a degree, and the recording's own errors (lens, gains) move the place by as much.
const MIN_POSITION_M: f64 = 0.03;
const MIN_ROTATION_RAD: f64 = 0.02;

/// And departures below this many of the standard deviations that the given value was stated with.
const MIN_STATED_SIGMAS: f64 = 3.0;

/// From here on the prior of a given position is widened, m: what a hand with a ruler misses a camera by. Real MH_01 shows 12 mm at a
/// stated 4 mm although it was calibrated with a target, so that less is no reason.
const DOUBTED_POSITION_M: f64 = 0.02;

/// A calibration that the recording contradicts.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum AdjustmentFinding {
    /// The camera is elsewhere on the body than was given.
    CameraPosition {
        /// As given, body axes, m.
        given_m: Vector3<f64>,
        /// As the recording shows it, m.
        found_m: Vector3<f64>,
        /// Standard deviation per axis, m.
        sigma_m: Vector3<f64>,
    },
    /// The camera is turned against what was given.
    CameraRotation {
        /// By how much, as a rotation vector in the camera's axes, rad.
        turned_rad: Vector3<f64>,
        /// Standard deviation per axis, rad.
        sigma_rad: Vector3<f64>,
    },
    /// The focal length differs from what was given, and from image to image.
    FocalLength(Focus),
    /// Images are shifted against what the gyroscope says: optical stabilisation, or a camera that is loose on the IMU.
    Shifted {
        /// Root mean square of the shift, focal lengths.
        rms: f64,
    },
    /// Images were exposed earlier and later than their stamps say, beyond one clock offset for all.
    StampsScatter {
        /// Root mean square of what was found, s: less than the scatter where the camera hardly turns.
        rms_secs: f64,
    },
}

/// No lens does more: autofocus scatters the focal length by less than this (its range is 2 %), and a stabiliser shifts images by two degrees at most.
/// A gyroscope with swapped axes was explained by 2.6 % and 0.014, and the path was 400 times too long. Stamps of when images arrive scatter by some ms.
const MOST_FOCUS_SPREAD: f64 = 0.02;
const MOST_SHIFT: f64 = 0.035;
const MOST_SCATTER_SECS: f64 = 0.02;

impl AdjustmentFinding {
    /// Whether it says that something that was given is wrong.
    pub fn contradicts_given(&self) -> bool {
        !matches!(self, Self::Shifted { .. } | Self::StampsScatter { .. })
    }

    /// Whether a lens, or a clock, does what was found of it. Where none does, something else is wrong.
    pub(super) fn is_plausible(&self) -> bool {
        match self {
            Self::FocalLength(focus) => focus.spread <= MOST_FOCUS_SPREAD,
            Self::Shifted { rms } => *rms <= MOST_SHIFT,
            Self::StampsScatter { rms_secs } => *rms_secs <= MOST_SCATTER_SECS,
            _ => true,
        }
    }
}

/// How far rotation and position are from what the prior takes them for, and how well the recording alone knows them.
pub(super) struct Departures {
    rotation: Departure,
    position: Departure,
}

struct Departure {
    by: Vector3<f64>,
    /// Squared, in standard deviations, over three degrees of freedom.
    chi2: f64,
    least: f64,
}

impl Departures {
    pub(super) fn contradicts(&self, at: usize) -> bool {
        let one = if at == ROTATION { &self.rotation } else { &self.position };
        one.chi2 > CHI2_DOUBTED && one.by.norm() > one.least
    }
}

/// The probability of 3 standard deviations (0.27 %) over three degrees of freedom.
const CHI2_3_SIGMAS: f64 = 14.2;

/// From 1 % over three degrees of freedom on a prior is widened, which is told of nobody: where it is right, that costs some of what it says; where it is
/// wrong, the noise has been taken for larger for its sake, up to 1.6 times as large in simulated flights with a lever arm 10 cm off.
const CHI2_DOUBTED: f64 = 11.3;

/// The departures from the prior. What the recording alone says follows from taking the prior off the solution.
pub(super) fn departures(problem: &Problem, covariance: &Envelope) -> Departures {
    let moved = problem.calibration.minus(&problem.prior.mean);
    let departure = |at: usize, least: f64| {
        let by = Vector3::from_column_slice(&moved[at..at + 3]);
        let none = Departure { by: Vector3::zeros(), chi2: 0.0, least };
        let (Some(joint), sigma) = (block(problem, covariance, at), problem.prior.sigmas[at]) else {
            return none;
        };
        let Some(information) = joint.try_inverse() else { return none };
        let own = information - Matrix3::identity() * sigma.powi(-2);
        // With Λ = Λ_own + Λ_prior and Λ δ = Λ_own δ_own, where δ counts from the prior's mean.
        let Some(own_covariance) = own.try_inverse() else { return none };
        let alone = own_covariance * (information * by);
        Departure { by: alone, chi2: alone.dot(&(own * alone)), least }
    };
    Departures {
        rotation: departure(ROTATION, MIN_ROTATION_RAD),
        position: departure(POSITION, DOUBTED_POSITION_M),
    }
}

/// Covariance of three unknowns of the calibration; `None` where they are held.
fn block(problem: &Problem, covariance: &Envelope, at: usize) -> Option<Matrix3<f64>> {
    let border = problem.calibration_offset();
    let row = |k: usize| Some(border + problem.active.iter().position(|index| *index == at + k)?);
    let rows = [row(0)?, row(1)?, row(2)?];
    Some(Matrix3::from_fn(|a, b| covariance.entry(rows[a], rows[b])))
}

/// What the solution says of a camera's place that was given as well as `sigmas` state: a guess is contradicted by more than a
/// calibration is.
pub(super) fn of(
    problem: &Problem,
    covariance: &Envelope,
    given: &Se3,
    sigmas: &CalibrationSigmas,
    of_images: &FoundImages,
) -> Vec<AdjustmentFinding> {
    let found = &problem.calibration.body_from_camera;
    let mut findings: Vec<AdjustmentFinding> =
        of_images.focus.map(AdjustmentFinding::FocalLength).into_iter().collect();
    findings.extend(of_images.shift.map(|rms| AdjustmentFinding::Shifted { rms }));
    findings.extend(of_images.delay.map(|rms_secs| AdjustmentFinding::StampsScatter { rms_secs }));
    let contradicts = |by: &Vector3<f64>, joint: &Matrix3<f64>, least: f64| {
        let chi2 = joint.try_inverse().map_or(0.0, |inverse| by.dot(&(inverse * by)));
        chi2 > CHI2_3_SIGMAS && by.norm() > least
    };
    let roots = |joint: &Matrix3<f64>| joint.diagonal().map(f64::sqrt);
    let least = |floor: f64, stated: f64| floor.max(MIN_STATED_SIGMAS * stated);
    if let Some(joint) = block(problem, covariance, POSITION) {
        let by = found.translation - given.translation;
        if contradicts(&by, &joint, least(MIN_POSITION_M, sigmas.position_m)) {
            let (given_m, found_m) = (given.translation, found.translation);
            findings.push(AdjustmentFinding::CameraPosition { given_m, found_m, sigma_m: roots(&joint) });
        }
    }
    if let Some(joint) = block(problem, covariance, ROTATION) {
        let turned_rad = (given.rotation.inverse() * found.rotation).log();
        if contradicts(&turned_rad, &joint, least(MIN_ROTATION_RAD, sigmas.rotation_rad)) {
            findings.push(AdjustmentFinding::CameraRotation { turned_rad, sigma_rad: roots(&joint) });
        }
    }
    findings
}
