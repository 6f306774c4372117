//! Visual-inertial bundle adjustment of a whole recording, after its end.
//!
//! The odometry estimates every state from what came before it, with a window of a few seconds. Once the recording has ended,
//! one adjustment over all logged images with every IMU measurement between them gives better states, and states for
//! the images before the start: poses, velocities, biases, landmarks and, where asked for, the camera's calibration
//! (clock, readout, place on the body, intrinsics) are estimated together; scale and gravity are part of it, because states are
//! metric and z is up. Segments that the odometry had to leave apart are joined by the IMU where the gap is short.
//!
//! [`adjust`] is the way through: the odometry's longest segment → outward over images without a state, and over other segments
//! → all together → covariance → a state for every image.

mod envelope;
mod grow;
mod initial;
mod keyframes;
mod linearise;
mod log;
mod observation;
mod optimise;
mod problem;
mod result;

pub(crate) use log::LoggedState;
pub use log::TrackLog;
pub use result::{Adjusted, AdjustedCalibration, AdjustmentReport};

use crate::imu::{ImuBuffer, ImuModel};
use initial::Guess;
use linearise::System;
use observation::{Calibration, TIMING_AND_PLACE};
use optimise::OptimiseReport;
use problem::{CalibrationPrior, Problem};
use vidar_core::{Duration, RigCamera};

/// Adjustments of all states at most: another one follows where the clock was corrected.
const PASSES: usize = 3;

/// Corrections of the clock below this are left in the row times, s.
const SETTLED_CLOCK_SECS: f64 = 2e-4;

/// The solution with what belongs to it.
struct Solution {
    problem: Problem,
    /// Which images of the log the states belong to.
    images: Vec<usize>,
    /// What the states' instants are their images' stamps plus.
    clock_offset: Duration,
    report: OptimiseReport,
    system: System,
}

/// Why a recording cannot be adjusted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum AdjustmentError {
    /// Too few images with a state, or without IMU measurements around them.
    #[error("only {images} logged images can be chained by IMU measurements")]
    TooShort {
        /// How many.
        images: usize,
    },
    /// Too few landmarks were seen often enough.
    #[error("only {landmarks} landmarks are seen by three logged images")]
    FewLandmarks {
        /// How many.
        landmarks: usize,
    },
    /// More states than one adjustment takes.
    #[error("{images} logged images are more than one adjustment takes ({limit})")]
    TooLong {
        /// How many.
        images: usize,
        /// Most.
        limit: usize,
    },
    /// The solution is not determined.
    #[error("the adjustment's solution is not determined by the measurements")]
    Undetermined,
}

/// What may change of the camera: standard deviations of the given values, zero where they are held.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationSigmas {
    /// Clock offset, s.
    pub time_offset_secs: f64,
    /// Readout, s.
    pub readout_secs: f64,
    /// Rotation of the camera on the body, rad per axis.
    pub rotation_rad: f64,
    /// Position of the camera on the body, m per axis.
    pub position_m: f64,
    /// Focal lengths, relative.
    pub focal: f64,
    /// Principal point, px.
    pub principal_point_px: f64,
    /// Distortion parameters, in their own units.
    pub distortion: f64,
}

impl Default for CalibrationSigmas {
    /// A calibrated camera whose clock and readout are not known: what alignment with the gyroscope leaves open of them after
    /// a few seconds (rendered phones: 7 ms and 24 ms at worst), and half a degree of its rotation.
    fn default() -> Self {
        Self {
            time_offset_secs: 1e-2,
            readout_secs: 2e-2,
            rotation_rad: 5e-3,
            position_m: 0.0,
            focal: 0.0,
            principal_point_px: 0.0,
            distortion: 0.0,
        }
    }
}

impl CalibrationSigmas {
    fn of(&self, calibration: &Calibration) -> Vec<f64> {
        let mut sigmas = vec![self.time_offset_secs, self.readout_secs];
        sigmas.extend([self.rotation_rad; 3]);
        sigmas.extend([self.position_m; 3]);
        let parameters = calibration.camera.parameters();
        for (index, value) in parameters.iter().enumerate() {
            sigmas.push(match index {
                0 | 1 => self.focal * value,
                2 | 3 => self.principal_point_px,
                _ => self.distortion,
            });
        }
        debug_assert_eq!(sigmas.len(), TIMING_AND_PLACE + parameters.len());
        sigmas
    }
}

/// Adjusts all states of `log`. `camera` and `readout_secs` are the calibration that the odometry used last.
///
/// # Errors
/// Too little was logged, or it determines no solution.
pub fn adjust(
    log: &TrackLog,
    camera: &RigCamera,
    readout_secs: f64,
    model: &ImuModel,
    sigmas: &CalibrationSigmas,
) -> Result<Adjusted, AdjustmentError> {
    if log.images.len() > MAX_IMAGES {
        return Err(AdjustmentError::TooLong { images: log.images.len(), limit: MAX_IMAGES });
    }
    let mut imu = ImuBuffer::new(log.imu_rate_hz);
    for sample in &log.imu {
        // What is out of order was left out by the odometry, too.
        let _ = imu.push(*sample);
    }
    let calibration = Calibration {
        camera: camera.model.clone(),
        body_from_camera: camera.body_from_camera,
        clock_secs: 0.0,
        readout_secs,
    };
    let prior = CalibrationPrior { sigmas: sigmas.of(&calibration), mean: calibration.clone() };
    let recording = Recording { log, imu: &imu, model };
    let segment = initial::longest_segment(log, &imu, model, camera.time_offset);
    let mut work = Work { calibration, prior, clock_offset: camera.time_offset, guess: segment };
    // The longest segment first: it gives the calibration with which the rest is found.
    work.pass(&recording)?;
    work.guess = grow::outward(&recording, &work);
    for _ in 1..PASSES {
        if work.pass(&recording)?.0 {
            break;
        }
    }
    let clock_offset = work.clock_offset;
    let (_, problem, report) = work.pass(&recording)?;
    let system = optimise::solution(&problem).ok_or(AdjustmentError::Undetermined)?;
    let images = work.guess.images;
    Ok(result::collect(&recording, &Solution { problem, images, clock_offset, report, system }))
}

/// What was recorded.
struct Recording<'a> {
    log: &'a TrackLog,
    imu: &'a ImuBuffer,
    model: &'a ImuModel,
}

/// What is known so far.
struct Work {
    calibration: Calibration,
    prior: CalibrationPrior,
    /// What the states' instants are their images' stamps plus.
    clock_offset: Duration,
    guess: Guess,
}

impl Work {
    /// Adjusts all states of the guess; whether the clock was right.
    fn pass(
        &mut self,
        recording: &Recording<'_>,
    ) -> Result<(bool, Problem, OptimiseReport), AdjustmentError> {
        let mut problem = initial::build(recording, &self.calibration, self.prior.clone(), &self.guess, 0)?;
        if problem.landmarks.len() < MIN_LANDMARKS {
            return Err(AdjustmentError::FewLandmarks { landmarks: problem.landmarks.len() });
        }
        let report = optimise::optimise(&mut problem);
        let clock_secs = problem.calibration.clock_secs;
        let is_settled = clock_secs.abs() <= SETTLED_CLOCK_SECS;
        if is_settled {
            self.guess.states = problem.frames.iter().map(|f| f.body.state).collect();
            self.calibration = problem.calibration.clone();
        } else {
            self.clock_offset += Duration::from_secs_f64(clock_secs);
            self.guess = self.guess.at_corrected_clock(&problem);
            self.calibration = Calibration { clock_secs: 0.0, ..problem.calibration.clone() };
            self.prior.mean.clock_secs -= clock_secs;
        }
        Ok((is_settled, problem, report))
    }
}

/// Most logged images: about 15 minutes. System and factor take some 0.1 MB per image (landmarks of 5 s).
const MAX_IMAGES: usize = 5000;

/// Fewest landmarks of a recording.
const MIN_LANDMARKS: usize = 30;
