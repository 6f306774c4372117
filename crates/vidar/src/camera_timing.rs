//! Clock offset, rolling-shutter readout and rotation of the camera, found in a first pass over the beginning of a recording.
//!
//! Consumer recordings state none of them, and stamps that are 40 ms late or rows that take 25 ms make every odometry fail.
//! The pass takes the first half minute at most and stops as soon as the values are settled.

use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement};
use vidar_core::{LieGroup, SensorEvent, Warning};
use vidar_dataset::Recording;
use vidar_odometry::{CameraTiming, ImuUse, Odometry};

/// The stage's name in events.
pub(crate) const STAGE: &str = "camera timing";

/// Corrects `dataset`'s rig and `config`'s readout time where the images contradict the gyroscope, and says so.
///
/// # Errors
/// What the odometry refuses: its settings, the calibration, an image of another size.
pub(crate) fn settle(
    dataset: &mut Recording,
    config: &mut Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Option<Warning>, Error> {
    let stated = dataset.readout.map(|r| 1e3 * r.as_secs_f64());
    config.odometry.readout_ms = config.odometry.readout_ms.or(stated);
    let settings = &config.odometry;
    let is_known =
        !settings.align_timing || (settings.readout_ms.is_some() && !settings.estimate_time_offset);
    if is_known || settings.imu == ImuUse::Off || dataset.rig.imu.is_none() {
        return Ok(None);
    }
    let mut images = 0;
    let sensors =
        input::measurements(dataset, true).take_while(|_| !cancel.is_cancelled()).filter_map(|m| match m {
            Measurement::Event(event) => Some(event),
            // The pass that maps reports what cannot be read.
            Measurement::Stamp(_) | Measurement::Unreadable(..) => None,
        });
    let counted = sensors.inspect(|event| {
        if matches!(event, SensorEvent::Image(_)) {
            images += 1;
            events.emit(&Event::Progress { stage: STAGE, done: images, total: 0 });
        }
    });
    let timing = Odometry::find_timing(&dataset.rig, dataset.camera, settings, counted)?;
    // What half a minute shows is not to be given up for what the first seconds show.
    config.odometry.align_timing &= timing.sigmas_secs.is_none();
    if !timing.is_corrected {
        return Ok(None);
    }
    let Some(camera) = dataset.rig.cameras.get_mut(dataset.camera.index()) else { return Ok(None) };
    let turn = camera.body_from_camera.rotation.inverse() * timing.body_from_camera.rotation;
    timing.apply(camera, &mut config.odometry);
    Ok(Some(corrected(&timing, turn.angle_rad().to_degrees())))
}

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
