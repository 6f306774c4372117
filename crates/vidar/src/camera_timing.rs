//! Clock offset, rolling-shutter readout and rotation of the camera, found in a first pass over the beginning of a recording.
//!
//! Consumer recordings state none of them, and stamps that are 40 ms late or rows that take 25 ms make every odometry fail.
//!
//! 1. The recording is calibrated as one without calibration is, with lens and mount held near the given ones.
//! 2. Where that does not show the clock, an odometry looks for it in the first half minute.
//!
//! A recording that was calibrated from itself has step 2 alone, and only where that calibration does not know the clock.

use crate::calibrate::{self, CONTRADICTING_SIGMAS};
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement};
use vidar_core::{LieGroup, SensorEvent, Warning};
use vidar_dataset::{CalibrationSource, Recording};
use vidar_odometry::bundle_adjustment::ImagePrior;
use vidar_odometry::{CameraTiming, ImuUse, Odometry};

/// The stage's name in events.
pub(crate) const STAGE: &str = "camera timing";

/// What was settled, beside what `settle` corrects.
#[derive(Debug, Default)]
pub(crate) struct Settled {
    /// That says what was corrected.
    pub warning: Option<Warning>,
    /// What images have of their own.
    pub images: ImagePrior,
}

/// Corrects `dataset`'s rig and `config`'s readout time where the images contradict the gyroscope, and says so.
///
/// # Errors
/// What the odometry refuses: its settings, the calibration, an image of another size.
pub(crate) fn settle(
    dataset: &mut Recording,
    config: &mut Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Settled, Error> {
    let stated = dataset.readout.map(|r| 1e3 * r.as_secs_f64());
    config.odometry.readout_ms = config.odometry.readout_ms.or(stated);
    let settings = &config.odometry;
    let is_known =
        !settings.align_timing || (settings.readout_ms.is_some() && !settings.estimate_time_offset);
    if is_known || settings.imu == ImuUse::Off || dataset.rig.imu.is_none() {
        return Ok(Settled::default());
    }
    let given = Given { dataset, config, events, cancel };
    // What was found from the recording is not found once more.
    let is_given = dataset.calibration != CalibrationSource::Recording;
    let (timing, images) = match is_given.then(|| given.calibrated()).flatten() {
        Some(found) => found,
        None => (given.searched()?, ImagePrior::default()),
    };
    // What half a minute shows is not to be given up for what the first seconds show.
    config.odometry.align_timing &= timing.sigmas_secs.is_none();
    let nothing = Settled { warning: None, images };
    if !timing.is_corrected {
        return Ok(nothing);
    }
    let Some(camera) = dataset.rig.cameras.get_mut(dataset.camera.index()) else { return Ok(nothing) };
    let turn = camera.body_from_camera.rotation.inverse() * timing.body_from_camera.rotation;
    timing.apply(camera, &mut config.odometry);
    Ok(Settled { warning: Some(corrected(&timing, turn.angle_rad().to_degrees())), images })
}

/// A recording with the values that were given.
struct Given<'a> {
    dataset: &'a Recording,
    config: &'a Config,
    events: &'a Events,
    cancel: &'a CancelToken,
}

impl Given<'_> {
    /// What an odometry finds in the first half minute.
    fn searched(&self) -> Result<CameraTiming, Error> {
        let Self { dataset, config, events, cancel } = *self;
        let mut images = 0;
        let sensors = input::measurements(dataset, true).take_while(|_| !cancel.is_cancelled()).filter_map(
            |m| match m {
                Measurement::Event(event) => Some(event),
                // The pass that maps reports what cannot be read.
                Measurement::Stamp(_) | Measurement::Unreadable(..) => None,
            },
        );
        let counted = sensors.inspect(|event| {
            if matches!(event, SensorEvent::Image(_)) {
                images += 1;
                events.emit(&Event::Progress { stage: STAGE, done: images, total: 0 });
            }
        });
        Ok(Odometry::find_timing(&dataset.rig, dataset.camera, &config.odometry, counted)?)
    }

    /// What the calibration of a recording finds with the given lens and mount.
    fn calibrated(&self) -> Option<(CameraTiming, ImagePrior)> {
        let Self { dataset, config, events, cancel } = *self;
        let found = calibrate::of_given_camera(dataset, events, cancel)?;
        let camera = dataset.rig.camera(dataset.camera)?;
        let settings = &config.odometry;
        let (clock, given_secs) = (found.time_offset_secs, camera.time_offset.as_secs_f64());
        let is_other_clock = settings.estimate_time_offset
            && (clock.value - given_secs).abs() > (CONTRADICTING_SIGMAS * clock.sigma).max(MIN_OFFSET_SECS);
        let found_readout_ms =
            if found.readout_secs.is_observable { calibrate::used_readout_ms(&found) } else { 0.0 };
        let readout_ms = settings.readout_ms.unwrap_or(found_readout_ms);
        let turn = (camera.body_from_camera.rotation.inverse() * found.body_from_camera).angle_rad();
        let is_turned = turn > (CONTRADICTING_SIGMAS * found.rotation_sigma()).max(MIN_ROTATION_RAD);
        let mut body_from_camera = camera.body_from_camera;
        if is_turned {
            body_from_camera.rotation = found.body_from_camera;
        }
        let timing = CameraTiming {
            time_offset_secs: if is_other_clock { clock.value } else { given_secs },
            readout_secs: 1e-3 * readout_ms,
            body_from_camera,
            sigmas_secs: Some((clock.sigma, found.readout_secs.sigma)),
            is_corrected: is_other_clock || is_turned || settings.readout_ms.is_none() && readout_ms > 0.0,
        };
        Some((timing, calibrate::image_prior(&found, settings)))
    }
}

/// Contradicted values are corrected where they differ from the given ones by this much.
const MIN_OFFSET_SECS: f64 = 0.002;
const MIN_ROTATION_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;

fn corrected(timing: &CameraTiming, turn_deg: f64) -> Warning {
    let (offset_sigma, readout_sigma) = timing.sigmas_secs.unwrap_or((f64::NAN, f64::NAN));
    let mut message = format!(
        "image stamps are corrected by {:+.1} ms (σ {:.1} ms)",
        1e3 * timing.time_offset_secs,
        1e3 * offset_sigma
    );
    if timing.readout_secs > 0.0 {
        message += &format!(
            ", the rolling shutter takes {:.1} ms (σ {:.1} ms) from first to last row",
            1e3 * timing.readout_secs,
            1e3 * readout_sigma
        );
    }
    if turn_deg > 0.01 {
        message += &format!(", the camera is turned by {turn_deg:.1}° against its given rotation");
    }
    Warning::new("camera-timing", message).hint(
        "found from image and gyroscope; odometry.readout_ms and the calibration's time offset state them",
    )
}
