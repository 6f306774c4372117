//! Visual-inertial bundle adjustment of a whole recording, after its end.
//!
//! The odometry estimates every state from what came before it, with a window of a few seconds. Once the recording has ended,
//! one adjustment over all logged images with every IMU measurement between them gives better states, and states for
//! the images before the start: poses, velocities, biases, landmarks and, where asked for, the camera's calibration
//! (clock, readout, place on the body, intrinsics) are estimated together; scale and gravity are part of it, because states are
//! metric and z is up. Segments that the odometry had to leave apart are joined by the IMU where the gap is short. The sensors' gains
//! and their noise are estimated, too, and what comes into view again gives loop constraints.
//!
//! [`adjust`] is the way through: the odometry's longest segment → outward over images without a state, and over other segments
//! → all together → again with the noise that the residuals show → again with loops → covariance → a state for every image.

mod delays;
mod envelope;
#[cfg(test)]
mod example;
mod findings;
mod grow;
mod image_evidence;
mod image_prior;
mod image_unknowns;
mod inertial;
mod initial;
mod keyframes;
mod landmark;
mod linearise;
mod log;
mod loops;
mod newest;
mod noise;
mod observation;
mod optimise;
mod problem;
mod progress;
mod reprojections;
mod result;
mod scale_step;
mod sigmas;
mod single_landmark;
mod system;
mod thin;

pub use findings::AdjustmentFinding;
pub use image_evidence::{Focus, IMAGE_SHIFT_RAD, STAMP_SCATTER_SECS};
pub(crate) use image_evidence::{HARMFUL_DELAY, HARMFUL_SHIFT};
pub use image_prior::ImagePrior;
pub(crate) use inertial::ImuGain;
pub use log::TrackLog;
pub(crate) use log::{LoggedState, TrackKey};
pub(crate) use newest::{NewestState, newest_state};
pub use progress::{AdjustmentStage, Progress};
pub use result::{Adjusted, AdjustedCalibration, AdjustedImu, AdjustmentReport};
pub use sigmas::{CalibrationSigmas, UNKNOWN_LEVER_M};

use crate::imu::{Bias, ImuBuffer, ImuModel, StepNoise};
use envelope::Envelope;
use image_evidence::FoundImages;
use initial::Guess;
use loops::Closed;
use noise::WeighedImu;
use observation::{POSITION, ROTATION, SensorCalibration};
use optimise::OptimiseReport;
use problem::{CalibrationPrior, Problem};
use progress::Watch;
use std::ops::ControlFlow;
use system::System;
use vidar_core::{Duration, RigCamera, Se3};

/// Adjustments of all states at most: another one follows where the clock was corrected.
const PASSES: usize = 3;
/// The same where the clock still moves. Between the instant of a state and that of its row motion is extrapolated, which holds for some ms of a hand's
/// tremor: a clock that an orbit had hidden, 68 ms off, came nearer by 1 to 7 ms a pass. Of states that do not settle it says nothing.
const CLOCK_PASSES: usize = 10;

/// Corrections of the clock below this are left in the row times, s.
const SETTLED_CLOCK_SECS: f64 = 2e-4;

/// The solution with what belongs to it.
struct Solution {
    /// The segment in whose world the states are.
    segment: u32,
    problem: Problem,
    /// Which images of the log the states belong to.
    images: Vec<usize>,
    /// What the states' instants are their images' stamps plus.
    clock_offset: Duration,
    report: OptimiseReport,
    /// Mean squared inertial residual, whitened with the noise as given.
    inertial_chi2_per_dof: f64,
    /// The loop constraints.
    closed: Closed,
    /// The IMU's noise as the residuals show it.
    weighed: WeighedImu,
    system: System,
    /// Covariance within the system's envelope.
    covariance: Envelope,
    /// What lens and clock do from image to image.
    of_images: FoundImages,
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
    /// The solution is not determined.
    #[error("the adjustment's solution is not determined by the measurements")]
    Undetermined,
    /// The caller broke it off.
    #[error("the adjustment was cancelled")]
    Cancelled,
}

/// What was recorded, and what is known of the sensors.
#[derive(Clone, Copy, Debug)]
pub struct AdjustmentInput<'a> {
    /// Tracks, IMU measurements and states.
    pub log: &'a TrackLog,
    /// The calibration that the odometry used last.
    pub camera: &'a RigCamera,
    /// The readout that the odometry used last, s.
    pub readout_secs: f64,
    /// Place of the camera on the body as it was given, which the result is compared with.
    pub given_body_from_camera: Se3,
    /// The IMU's model to begin with.
    pub model: ImuModel,
    /// Densities below which the noise is not taken for less.
    pub data_sheet: StepNoise,
    /// What may change.
    pub sigmas: &'a CalibrationSigmas,
}

/// Adjusts all states of a log. `tell` is asked before every iteration whether to go on.
///
/// # Errors
/// Too little was logged, it determines no solution, or `tell` broke it off.
pub fn adjust(
    input: &AdjustmentInput<'_>,
    tell: &mut dyn FnMut(Progress) -> ControlFlow<()>,
) -> Result<Adjusted, AdjustmentError> {
    let thinned = thin::bounded(input.log);
    let log: &TrackLog = &thinned;
    let mut watch = Watch::new(log.images.len(), tell);
    let imu = log.imu();
    let recording = Measurements { log, imu: &imu, model: &input.model };
    let (segment, guess) = initial::longest_segment(log, &imu, &input.model, input.camera.time_offset);
    let mut work = Work::new(input, guess);
    // The longest segment first: it gives the calibration with which the rest is found.
    work.pass(&recording, &mut watch)?;
    watch.stage(AdjustmentStage::Outward, work.guess.images.len());
    work.guess = grow::outward(&recording, &work, &mut watch)?;
    watch.stage(AdjustmentStage::Together, work.guess.images.len());
    let mut passed = work.pass(&recording, &mut watch)?;
    let mut passes = 1;
    while passes < if passed.is_settled || !passed.has_converged() { PASSES } else { CLOCK_PASSES } {
        // One lens for all where it moves puts the camera elsewhere: the place is not judged by that.
        let system = optimise::solution(&passed.problem).ok_or(AdjustmentError::Undetermined)?;
        let is_moving = work.doubt_images(&passed.problem, &system);
        let is_doubted = is_moving || work.doubt_given(&passed.problem, &system);
        if passed.is_settled && !is_doubted {
            break;
        }
        passed = work.pass(&recording, &mut watch)?;
        // What an image has of its own is found once.
        passes += usize::from(!is_moving);
    }
    watch.stage(AdjustmentStage::Weighted, work.guess.images.len());
    let inertial_chi2_per_dof = optimise::inertial_chi2_per_dof(&passed.problem);
    let mut weighed = weigh(input, &mut passed, &mut watch)?;
    // With noise that is taken for several times as large as it is, a lever arm that is 10 cm off was no contradiction.
    let system = optimise::solution(&passed.problem).ok_or(AdjustmentError::Undetermined)?;
    if work.doubt_images(&passed.problem, &system) || work.doubt_given(&passed.problem, &system) {
        passed = work.pass(&recording, &mut watch)?;
        weighed = weigh(input, &mut passed, &mut watch)?;
    }
    watch.stage(AdjustmentStage::Loops, work.guess.images.len());
    let closed = loops::close(&mut passed.problem, &mut passed.report, log, &passed.images, &mut watch)?;
    let Passed { mut problem, images, report, clock_offset, .. } = passed;
    let system = optimise::solution(&problem).ok_or(AdjustmentError::Undetermined)?;
    let covariance = system.factor.inverse(problem.calibration_offset());
    let of_images = image_evidence::centre(&mut problem, &system);
    let solution = Solution {
        segment,
        problem,
        images,
        clock_offset,
        report,
        inertial_chi2_per_dof,
        closed,
        weighed,
        system,
        covariance,
        of_images,
    };
    let corrected = imu.multiplied(&solution.problem.calibration.gain);
    let recording = Measurements { imu: &corrected, model: &solution.weighed.model, ..recording };
    Ok(result::collect(input, &recording, &solution))
}

/// Adjusts again with the IMU's noise as the residuals show it, until that is settled.
fn weigh(
    input: &AdjustmentInput<'_>,
    passed: &mut Passed,
    watch: &mut Watch<'_>,
) -> Result<WeighedImu, AdjustmentError> {
    let Passed { problem, report, .. } = passed;
    let mut weighed = WeighedImu { model: input.model, is_told: [false; 2] };
    for _ in 0..WEIGHINGS {
        let covariance = noise::covariance(problem).ok_or(AdjustmentError::Undetermined)?;
        let before = weighed.model;
        weighed = noise::reweighed(&before, &noise::components(problem, &covariance), &input.data_sheet);
        let model = &weighed.model;
        if noise::largest_change(&before, model) < SETTLED_NOISE {
            break;
        }
        problem.frames.iter_mut().filter_map(|f| f.inertial.as_mut()).for_each(|i| i.reweigh(model));
        optimise::finish(problem, report, watch)?;
    }
    Ok(weighed)
}

/// What was recorded.
#[derive(Clone, Copy)]
struct Measurements<'a> {
    log: &'a TrackLog,
    imu: &'a ImuBuffer,
    model: &'a ImuModel,
}

/// What is known so far.
struct Work {
    calibration: SensorCalibration,
    prior: CalibrationPrior,
    /// What the states' instants are their images' stamps plus.
    clock_offset: Duration,
    guess: Guess,
}

/// An adjustment of all states.
struct Passed {
    problem: Problem,
    /// Which images of the log the states belong to.
    images: Vec<usize>,
    report: OptimiseReport,
    /// What the states' instants are their images' stamps plus.
    clock_offset: Duration,
    /// Whether the clock was right.
    is_settled: bool,
}

impl Passed {
    fn has_converged(&self) -> bool {
        self.report.iterations < optimise::MOST_ITERATIONS
    }
}

impl Work {
    /// With the calibration as it was used last.
    fn new(input: &AdjustmentInput<'_>, guess: Guess) -> Self {
        let calibration = SensorCalibration {
            camera: input.camera.model.clone(),
            body_from_camera: input.camera.body_from_camera,
            clock_secs: 0.0,
            readout_secs: input.readout_secs,
            gain: ImuGain::default(),
        };
        let prior = CalibrationPrior {
            sigmas: input.sigmas.of(&calibration),
            mean: calibration.clone(),
            image: input.sigmas.images,
        };
        Self { calibration, prior, clock_offset: input.camera.time_offset, guess }
    }

    /// Adjusts all states of the guess.
    fn pass(
        &mut self,
        recording: &Measurements<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<Passed, AdjustmentError> {
        let (clock_offset, images) = (self.clock_offset, self.guess.images.clone());
        let mut problem = initial::build(recording, &self.calibration, self.prior.clone(), &self.guess, 0)?;
        // The guess tells where the world is. Its biases come from the same measurements: held, they would count twice.
        problem.gauge.1.bias = Bias::ZERO;
        if problem.landmarks.len() < MIN_LANDMARKS {
            return Err(AdjustmentError::FewLandmarks { landmarks: problem.landmarks.len() });
        }
        let report = optimise::optimise(&mut problem, watch)?;
        let clock_secs = problem.calibration.clock_secs;
        let is_settled = clock_secs.abs() <= SETTLED_CLOCK_SECS;
        if is_settled {
            self.guess.states = problem.frames.iter().map(|f| f.body.state).collect();
            self.calibration = problem.calibration.clone();
        } else {
            self.clock_offset += Duration::from_secs_f64(clock_secs);
            self.guess = self.guess.at_corrected_clock(&problem, recording.imu);
            self.calibration = SensorCalibration { clock_secs: 0.0, ..problem.calibration.clone() };
            self.prior.mean.clock_secs -= clock_secs;
        }
        Ok(Passed { problem, images, report, clock_offset, is_settled })
    }

    /// Where the recording shows that the lens moves or stamps scatter, every image gets unknowns of its own; whether that is new.
    fn doubt_images(&mut self, problem: &Problem, system: &System) -> bool {
        let moves = image_evidence::moves(problem, system);
        self.prior.image = moves.unwrap_or(self.prior.image);
        moves.is_some()
    }

    /// Where the recording contradicts the place of the camera that was given, its prior is widened, so that it no longer pulls;
    /// whether it was.
    fn doubt_given(&mut self, problem: &Problem, system: &System) -> bool {
        let covariance = system.factor.inverse(problem.calibration_offset());
        let departures = findings::departures(problem, &covariance);
        let mut widened = false;
        for (at, widest) in [(ROTATION, WIDE_ROTATION_RAD), (POSITION, WIDE_POSITION_M)] {
            let sigmas = &mut self.prior.sigmas[at..at + 3];
            if sigmas[0] > 0.0 && sigmas[0] < widest && departures.contradicts(at) {
                sigmas.fill(widest);
                widened = true;
            }
        }
        widened
    }
}

/// Most adjustments with noise as the residuals show it. Where vision is weak, most of the inertial residuals go into the unknowns,
/// and an estimate of the noise goes part of the way only.
const WEIGHINGS: usize = 8;

/// Relative change of the densities from which they are settled: standard deviations of the result follow them.
const SETTLED_NOISE: f64 = 0.05;

/// Standard deviations of a place that was given and is not believed any more.
const WIDE_ROTATION_RAD: f64 = 0.1;
const WIDE_POSITION_M: f64 = 0.3;

/// Largest mean squared whitened inertial residual, and largest share of observations left out, of a solution in which camera
/// and IMU agree. Healthy recordings have 0.04 to 0.7 (the stated noise is inflated) and 0.1 to 3 %.
const MAX_INERTIAL_CHI2: f64 = 3.0;
const MAX_REJECTED_SHARE: f64 = 0.2;

/// Fewest landmarks of a recording.
const MIN_LANDMARKS: usize = 30;
