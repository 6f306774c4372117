//! Looking for the calibration of a recording: which features are followed, what is taken as known, and what is refused.

use super::{ASSUMED_MOUNT, MissingCalibration, STAGE, size_of, too_uncertain};
use crate::camera_timing;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement};
use vidar_core::{AngularRate, ImuSample, SensorEvent, So3};
use vidar_dataset::Recording;
use vidar_odometry::calibration::{
    Calibration, CalibrationFailure, CalibrationLog, FeatureTracker, KnownCamera,
};

/// Finds everything, as if nothing were stated but how cameras of a known kind are mounted.
pub(super) fn everything(
    dataset: &Recording,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Calibration, Error> {
    let mount = assumed_mount(dataset);
    let known = KnownCamera { assumed_mount: mount.as_ref(), ..KnownCamera::default() };
    events.stage(STAGE, 0, || look(dataset, &known, STAGE, events, cancel))
}

/// Finds what is missing: with the lens where that is given.
pub(super) fn what_is_missing(
    missing: MissingCalibration,
    dataset: &Recording,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Calibration, Error> {
    let camera = dataset.rig.camera(dataset.camera).filter(|_| missing == MissingCalibration::Mount);
    let mount = assumed_mount(dataset);
    let lens = camera.map(|c| &c.model);
    let known = KnownCamera { lens, mount: None, assumed_mount: mount.as_ref() };
    events.stage(STAGE, 0, || look(dataset, &known, STAGE, events, cancel))
}

/// Clock and readout of a camera whose lens and place on the IMU are given, and the rotation where that is not the given one. `None` where the recording
/// does not show them.
pub(crate) fn of_given_camera(
    dataset: &Recording,
    events: &Events,
    cancel: &CancelToken,
) -> Option<Calibration> {
    let camera = dataset.rig.camera(dataset.camera)?;
    let mount = camera.body_from_camera.rotation;
    let known = KnownCamera { lens: Some(&camera.model), mount: Some(&mount), assumed_mount: None };
    let found = look(dataset, &known, camera_timing::STAGE, events, cancel).ok()?;
    let is_clock_shown = found.time_offset_secs.sigma < MOST_CLOCK_SIGMA_SECS;
    (is_clock_shown && too_uncertain(&found, true).is_none()).then_some(found)
}

/// Follows features through the recording and estimates, by what is known where nothing contradicts it.
fn look(
    dataset: &Recording,
    known: &KnownCamera<'_>,
    stage: &'static str,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Calibration, Error> {
    let refuse = |reason: &str| Error::NotCalibrated { name: dataset.name.clone(), reason: reason.into() };
    if dataset.imu.is_empty() {
        return Err(refuse("it has no gyroscope"));
    }
    let (width, height) = size_of(dataset);
    let mut tracker = FeatureTracker::new(width, height);
    let (mut log, mut opposite) = (CalibrationLog::default(), CalibrationLog::default());
    let mut done = 0;
    for measurement in input::measurements(dataset, true) {
        if cancel.is_cancelled() || log.is_full() {
            break;
        }
        match measurement {
            Measurement::Event(SensorEvent::Imu(sample)) => {
                log.add_gyro(&sample);
                opposite.add_gyro(&ImuSample { gyro: AngularRate(-sample.gyro.0), ..sample });
            }
            Measurement::Event(SensorEvent::Image(frame)) => {
                let features = tracker.push(frame.time, &frame.image).map_err(|e| refuse(&e.to_string()))?;
                if let Some(features) = features {
                    log.add_image(frame.time, features.iter().copied());
                    opposite.add_image(frame.time, features.into_iter());
                }
                done += 1;
                events.emit(&Event::Progress { stage, done, total: 0 });
            }
            // The pass that maps reports what cannot be read.
            Measurement::Event(_) | Measurement::Stamp(_) | Measurement::Unreadable(..) => {}
        }
    }
    let by = |lens| log.calibrate(width, height, &KnownCamera { lens, ..*known });
    let found = match known.lens.map(|lens| by(Some(lens))) {
        Some(Ok(found)) if agrees_with_its_lens(&found) => Ok(found),
        Some(held) => by(None).or(held),
        None => by(None),
    };
    let is_doubtful = match &found {
        Ok(found) => found.pixel_sigma > DOUBTFUL_PX,
        Err(failure) => *failure == CalibrationFailure::Unexplained,
    };
    let left = found.as_ref().map_or(f64::INFINITY, |found| found.pixel_sigma);
    if is_doubtful
        && let Ok(other) = opposite.calibrate(width, height, &KnownCamera::default())
        && other.pixel_sigma < DOUBTFUL_PX.min(LEFT_BY_THE_RIGHT_SIGNS * left)
    {
        return Err(refuse(&format!(
            "the gyroscope contradicts the images, and with the opposite signs it agrees with them to {:.2} px: its axes are not right-handed, or its \
             signs are those of turning the other way; turn the sign of the axis, or of all three, in its table",
            other.pixel_sigma
        )));
    }
    match found {
        Ok(found) if found.pixel_sigma > UNEXPLAINED_PX => {
            Err(refuse(reason(CalibrationFailure::Unexplained)))
        }
        found => found.map_err(|failure| refuse(reason(failure))),
    }
}

/// The odometry looks for a clock itself where no better one than this is found, s: a stabilised phone's was found to 11 ms, and 6 ms off, one that circles a room
/// to 60.
pub(super) const MOST_CLOCK_SIGMA_SECS: f64 = 0.015;

/// Whether what was found with a given lens explains the tracks with one near it.
fn agrees_with_its_lens(found: &Calibration) -> bool {
    found.off_given_lens.is_some_and(|off| off < MOST_OFF_LENS) && found.pixel_sigma < DOUBTFUL_PX
}

/// A given lens is not the recording's where the focal length goes this many of its standard deviations away.
const MOST_OFF_LENS: f64 = 2.0;

/// What a calibration leaves of the tracks, px, above which the gyroscope's signs are doubted: 0.1 to 0.2 in rendered recordings, 0.76 in the same
/// with one axis or all of them turned.
const DOUBTFUL_PX: f64 = 0.4;
/// What a calibration leaves that explains nothing, px: 38 recordings, real and rendered, stabilised and with stamps that scatter, leave 0.10 to 0.39.
const UNEXPLAINED_PX: f64 = 1.0;
/// The share of it that the opposite signs leave where these are the right ones: 0.16 in the same recordings. No rotation makes a left-handed
/// frame of a right-handed one, so that of two signs only one explains turns about several axes. They have to explain the images, too: of a camera that circled
/// the middle of a room neither did, and the opposite ones left 1.07 px.
const LEFT_BY_THE_RIGHT_SIGNS: f64 = 0.5;

fn reason(failure: CalibrationFailure) -> &'static str {
    match failure {
        CalibrationFailure::TooLittleData => {
            "fewer than two seconds of images with common features and gyroscope samples"
        }
        CalibrationFailure::TooLittleRotation => "the camera turns too little, or about one axis only",
        _ => "no camera explains the images by the gyroscope's rotations",
    }
}

/// The rotation body_from_camera of which a reader knows that cameras of this kind are mounted so.
pub(super) fn assumed_mount(dataset: &Recording) -> Option<So3> {
    let is_assumed = dataset.warnings.iter().any(|w| w.kind == ASSUMED_MOUNT);
    let camera = dataset.rig.camera(dataset.camera).filter(|_| is_assumed)?;
    Some(camera.body_from_camera.rotation)
}
