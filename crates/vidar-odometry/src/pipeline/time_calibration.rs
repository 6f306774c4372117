//! Clock offset, rolling-shutter readout and camera rotation as used by the odometry: the given values until feature
//! tracks and gyroscope contradict them.

use crate::config::OdometryConfig;
use crate::deferred::Deferred;
use crate::gyro_alignment::{Alignment, Guess, GyroAlignmentLog};
use vidar_core::{Duration, ImuSample, LandmarkId, LieGroup, RigCamera, Se3, So3, Timestamp, camera::Pixel};
use vidar_solve::statistics::median_upper;

/// Differences from the values in use below which nothing is corrected, besides three standard deviations: the backend
/// estimates a clock offset of some milliseconds by itself, and a readout of 4 ms moves a pixel by less than one at 1 rad/s.
const MIN_OFFSET_SECS: f64 = 0.004;
const MIN_READOUT_SECS: f64 = 0.004;
/// No shutter takes longer: what a wrong camera explains by a longer one is its error. The bound of `readout_ms`.
const MAX_READOUT_SECS: f64 = 0.05;
const MIN_ROTATION_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// A running state is given up only for differences this many times larger.
const TRACKING_FACTOR: f64 = 2.5;

/// Standard deviations from which a solution is used at all, and from which no better one is needed.
const USABLE_OFFSET_SECS: f64 = 0.004;
const SETTLED_OFFSET_SECS: f64 = 0.0015;
const SETTLED_READOUT_SECS: f64 = 0.003;

/// Solutions this far apart in time, s, share half of their images at most: what they differ by beyond their standard deviations was not in these.
const APART_SECS: f64 = 2.5;

/// Largest mean squared whitened residual of a solution that explains the tracks.
const MAX_CHI2_PER_DOF: f64 = 3.0;

/// Time of the recording until the solution of an attempt is taken over, s; that of a short stretch has half the images.
const SOLVING_SECS: f64 = 0.5;
const SOLVING_SHORT_SECS: f64 = 0.3;
/// Time between attempts, s: the first ones hurry. Later ones come as often as half of what they look at is new.
const PAUSE_SECS: f64 = 0.5;
const LATER_PAUSE_SECS: f64 = 2.0;
const HURRIED_ATTEMPTS: usize = 8;

/// Attempts after which the values in use stay.
const MAX_ATTEMPTS: usize = 40;

/// New values, where they differ from those in use.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Correction {
    /// `t_imu = stamp + offset`, s.
    pub offset_secs: f64,
    pub readout_secs: f64,
    /// Rotation of the camera on the body, where it is far from the given one.
    pub body_from_camera: Option<So3>,
}

/// Clock, readout and rotation of a camera as the odometry uses them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraTiming {
    /// What to add to image stamps to get the IMU's time of the centre row, s.
    pub time_offset_secs: f64,
    /// Time from the first to the last row, s; 0 is a global shutter.
    pub readout_secs: f64,
    /// Pose of the camera on the body; its rotation is corrected where tracks and gyroscope contradict the given one.
    pub body_from_camera: Se3,
    /// Standard deviations of offset and readout, s: of the corrected ones, else of what was estimated beside them; `None` as long as nothing was.
    pub sigmas_secs: Option<(f64, f64)>,
    /// Whether any of them differs from the given one.
    pub is_corrected: bool,
}

impl CameraTiming {
    /// Puts the values into the camera's calibration and the odometry's settings.
    pub fn apply(&self, camera: &mut RigCamera, config: &mut OdometryConfig) {
        camera.time_offset = Duration::from_secs_f64(self.time_offset_secs);
        camera.body_from_camera = self.body_from_camera;
        config.readout_ms = Some(1e3 * self.readout_secs);
    }
}

/// The values in use and what they are checked with.
#[derive(Debug)]
pub(crate) struct TimeCalibration {
    log: GyroAlignmentLog,
    /// Readout time in use, s.
    pub readout_secs: f64,
    estimates_offset: bool,
    estimates_readout: bool,
    /// Standard deviations of offset and readout in use, s; zero for given values.
    used_sigmas: (f64, f64),
    /// Standard deviations of the newest solution, s.
    estimated: Option<(f64, f64)>,
    attempts: usize,
    is_settled: bool,
    /// What attempts found so far, by the time of the last image.
    earlier: Vec<(Timestamp, Alignment)>,
    /// The attempt that is being solved, and whether from a short stretch.
    solving: Option<(Deferred<Option<Alignment>>, bool)>,
}

impl TimeCalibration {
    /// What the settings say is known is not estimated.
    pub fn new(config: &OdometryConfig) -> Self {
        let readout_secs = config.readout_ms.map(|ms| ms * 1e-3);
        let estimates_offset = config.estimate_time_offset;
        Self {
            log: GyroAlignmentLog::default(),
            readout_secs: readout_secs.unwrap_or(0.0),
            estimates_offset,
            estimates_readout: readout_secs.is_none(),
            used_sigmas: (0.0, 0.0),
            estimated: None,
            attempts: 0,
            is_settled: !config.align_timing || (!estimates_offset && readout_secs.is_some()),
            earlier: Vec::new(),
            solving: None,
        }
    }

    pub fn add_gyro(&mut self, sample: &ImuSample) {
        if !self.is_settled() {
            self.log.add_gyro(sample);
        }
    }

    /// Takes the features of an image as it shows them, with its own stamp; `fixed` ones turned out to move with the camera.
    pub fn add_image(
        &mut self,
        stamp: Timestamp,
        features: impl Iterator<Item = (LandmarkId, Pixel)>,
        fixed: &[LandmarkId],
    ) {
        if !self.is_settled() {
            self.log.leave_out(fixed);
            self.log.add_image(stamp, features);
        }
    }

    /// What is in use for `camera`, whose clock offset is `offset_secs`.
    pub fn timing(&self, camera: &RigCamera, offset_secs: f64) -> CameraTiming {
        let is_corrected = self.used_sigmas.0 > 0.0;
        CameraTiming {
            time_offset_secs: offset_secs,
            readout_secs: self.readout_secs,
            body_from_camera: camera.body_from_camera,
            sigmas_secs: if is_corrected { Some(self.used_sigmas) } else { self.estimated },
            is_corrected,
        }
    }

    /// Whether another solution would bring little.
    pub fn is_settled(&self) -> bool {
        self.is_settled || self.attempts >= MAX_ATTEMPTS
    }

    /// Forgets the images: tracks get new names.
    pub fn forget_tracks(&mut self) {
        self.log.forget_images();
    }

    /// Forgets all measurements: a saturated gyroscope integrates to a wrong rotation.
    pub fn forget(&mut self) {
        self.log = GyroAlignmentLog::default();
        self.earlier.clear();
        self.solving = None;
    }

    /// A correction of `camera`, whose clock offset in use is `offset_secs`, where one is called for with an image stamped `now`, or
    /// after the last one (`None`). `is_tracking`: there is a state that it would end.
    pub fn correction(
        &mut self,
        camera: &RigCamera,
        offset_secs: f64,
        is_tracking: bool,
        now: Option<Timestamp>,
    ) -> Option<Correction> {
        if self.is_settled() {
            return None;
        }
        let due = self.solving.take_if(|(s, _)| now.is_none_or(|now| s.is_due(now)));
        // A state is not given up for what half the images say: on a slow hand that was twice as far off.
        let due = due.filter(|(_, is_short)| !(*is_short && is_tracking));
        if let Some(found) = due.and_then(|(solving, _)| solving.result()).flatten() {
            let found = self.doubted(found);
            return self.take(&found, camera, offset_secs, is_tracking);
        }
        if let (None, Some(now)) = (&self.solving, now) {
            self.begin(camera, offset_secs, is_tracking, now);
        }
        None
    }

    /// Begins to solve for what the log holds.
    fn begin(&mut self, camera: &RigCamera, offset_secs: f64, is_tracking: bool, now: Timestamp) {
        let guess = Guess {
            body_from_camera: camera.body_from_camera.rotation,
            offset_secs,
            readout_secs: self.readout_secs,
            // Until something was found, the clock may be anywhere.
            search: self.attempts.is_multiple_of(4)
                || (self.estimated.is_none() && self.attempts < HURRIED_ATTEMPTS),
        };
        let pause = if self.attempts < HURRIED_ATTEMPTS { PAUSE_SECS } else { LATER_PAUSE_SECS };
        if let Some(problem) = self.log.next_problem(&camera.model, &guess, pause, !is_tracking) {
            let secs = if problem.is_short() { SOLVING_SHORT_SECS } else { SOLVING_SECS };
            let due = now + Duration::from_secs_f64(secs);
            let is_short = problem.is_short();
            self.solving = Some((Deferred::begin(due, move || problem.solve()), is_short));
        }
    }

    /// A solution whose standard deviations are widened by how far solutions of other images are from it (the median, since one may have
    /// missed the clock's basin). Where it explains its images it is compared with later ones, too.
    fn doubted(&mut self, found: Alignment) -> Alignment {
        let Some(now) = self.log.last_attempt() else { return found };
        let apart = |(time, _): &&(Timestamp, Alignment)| (now - *time).as_secs_f64() >= APART_SECS;
        let others: Vec<Alignment> = self.earlier.iter().filter(apart).map(|(_, a)| *a).collect();
        if found.chi2_per_dof < MAX_CHI2_PER_DOF {
            self.earlier.push((now, found));
        }
        Alignment {
            offset_sigma: found.offset_sigma * excess(&found, &others, |a| (a.offset_secs, a.offset_sigma)),
            readout_sigma: found.readout_sigma
                * excess(&found, &others, |a| (a.readout_secs, a.readout_sigma)),
            ..found
        }
    }

    fn take(
        &mut self,
        found: &Alignment,
        camera: &RigCamera,
        offset_secs: f64,
        is_tracking: bool,
    ) -> Option<Correction> {
        self.attempts += 1;
        let is_usable = found.offset_sigma < USABLE_OFFSET_SECS && found.chi2_per_dof < MAX_CHI2_PER_DOF;
        if !is_usable {
            return None;
        }
        self.estimated = Some((found.offset_sigma, found.readout_sigma));
        let correction = self.compare(found, camera, offset_secs, is_tracking);
        if correction.is_none() {
            self.is_settled =
                found.offset_sigma < SETTLED_OFFSET_SECS && found.readout_sigma < SETTLED_READOUT_SECS;
        }
        if let Some(correction) = &correction {
            self.readout_secs = correction.readout_secs;
            self.used_sigmas = (found.offset_sigma, found.readout_sigma);
        }
        correction
    }

    fn compare(
        &self,
        found: &Alignment,
        camera: &RigCamera,
        offset_secs: f64,
        is_tracking: bool,
    ) -> Option<Correction> {
        // A running state is worth more than some milliseconds, which its backend estimates by itself.
        let least = if is_tracking { TRACKING_FACTOR } else { 1.0 };
        let differs = |a: f64, b: f64, sigma: f64, used_sigma: f64, floor: f64| {
            (a - b).abs() > (3.0 * sigma.hypot(used_sigma)).max(floor)
        };
        let readout_secs = likelier_readout(found.readout_secs, found.readout_sigma);
        let offset = self.estimates_offset
            && differs(
                found.offset_secs,
                offset_secs,
                found.offset_sigma,
                self.used_sigmas.0,
                least * MIN_OFFSET_SECS,
            );
        let readout = self.estimates_readout
            && differs(
                readout_secs,
                self.readout_secs,
                found.readout_sigma,
                self.used_sigmas.1,
                least * MIN_READOUT_SECS,
            );
        let turn = (camera.body_from_camera.rotation.inverse() * found.body_from_camera).angle_rad();
        let rotation = turn > (4.0 * found.rotation_sigma).max(least * MIN_ROTATION_RAD);
        (offset || readout || rotation).then_some(Correction {
            offset_secs: if self.estimates_offset { found.offset_secs } else { offset_secs },
            readout_secs: if self.estimates_readout { readout_secs } else { self.readout_secs },
            body_from_camera: rotation.then_some(found.body_from_camera),
        })
    }
}

/// The readout found where a rolling shutter of any readout up to [`MAX_READOUT_SECS`] explains it better than a global one, else 0: the Bayes
/// factor of the two, which asks for 1.2 standard deviations where they are 9 ms and for 2.3 where they are 1.5 ms, and for one at least.
fn likelier_readout(found_secs: f64, sigma: f64) -> f64 {
    let occam = MAX_READOUT_SECS / (sigma * std::f64::consts::TAU.sqrt());
    let is_rolling =
        found_secs > MIN_READOUT_SECS && (found_secs / sigma).powi(2) > (2.0 * occam.ln()).max(1.0);
    if is_rolling { found_secs.min(MAX_READOUT_SECS) } else { 0.0 }
}

/// Median distance of `others` from a solution over the standard deviation of their difference, at least 1.
fn excess(found: &Alignment, others: &[Alignment], value: fn(&Alignment) -> (f64, f64)) -> f64 {
    let (at, sigma) = value(found);
    let mut distances: Vec<f64> =
        others.iter().map(value).map(|(x, s)| (x - at).abs() / sigma.hypot(s)).collect();
    median_upper(&mut distances).map_or(1.0, |d| d.max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alignment(offset_ms: f64, sigma_ms: f64) -> Alignment {
        Alignment {
            offset_secs: 1e-3 * offset_ms,
            readout_secs: 0.0,
            body_from_camera: So3::IDENTITY,
            offset_sigma: 1e-3 * sigma_ms,
            readout_sigma: 1e-3,
            rotation_sigma: 0.01,
            chi2_per_dof: 1.0,
        }
    }

    #[test]
    fn clocks_that_contradict_each_other_are_known_less_well_and_one_outlier_is_not_heard() {
        let clock = |a: &Alignment| (a.offset_secs, a.offset_sigma);
        let agree = [alignment(10.0, 1.0), alignment(11.0, 1.0), alignment(60.0, 1.0)];
        assert_eq!(excess(&alignment(10.5, 1.0), &agree, clock), 1.0);
        // As a slow circle was: 4 ms each, and 40 ms apart.
        let differ = [alignment(-107.0, 7.0), alignment(-40.0, 7.0), alignment(-37.0, 7.0)];
        let factor = excess(&alignment(-83.0, 4.0), &differ, clock);
        assert!((43.0 / 7.0_f64.hypot(4.0) - factor).abs() < 1e-9, "{factor}");
        assert_eq!(excess(&alignment(0.0, 1.0), &[], clock), 1.0);
    }

    #[test]
    fn a_readout_that_is_likelier_than_none_is_used_though_it_is_not_known_well() {
        assert_eq!(likelier_readout(0.026, 0.009), 0.026);
        assert_eq!(likelier_readout(0.009, 0.009), 0.0);
        assert_eq!(likelier_readout(0.025, 0.03), 0.0);
        assert_eq!(likelier_readout(0.006, 0.003), 0.006);
        assert_eq!(likelier_readout(0.0055, 0.003), 0.0);
        assert_eq!(likelier_readout(0.0035, 0.0005), 0.0, "too little to matter");
        assert_eq!(likelier_readout(-0.01, 0.002), 0.0);
        assert_eq!(likelier_readout(0.06, 0.002), MAX_READOUT_SECS);
    }

    #[test]
    fn what_is_known_or_was_looked_for_is_not_looked_for_again() {
        let looks = |config: &OdometryConfig| !TimeCalibration::new(config).is_settled();
        let unknown = OdometryConfig::default();
        assert!(looks(&unknown));
        assert!(
            looks(&OdometryConfig { readout_ms: Some(0.0), ..unknown.clone() }),
            "the clock is not known"
        );
        let known = OdometryConfig { readout_ms: Some(0.0), estimate_time_offset: false, ..unknown.clone() };
        assert!(!looks(&known));
        assert!(!looks(&OdometryConfig { align_timing: false, ..unknown }));
    }
}
