//! From a path to a recording, its poses and its images.

mod poses;
pub(crate) mod trajectory;

pub(crate) use poses::not_evaluated;
pub use poses::{PosePlan, truth_in_camera, truth_in_imu};
pub use trajectory::{MetricTrajectory, TrajectorySource};

use crate::config::Config;
use crate::engine::{FrameStamp, GivenPoses, ImageSource};
use crate::error::Error;
use crate::imu_noise;
use crate::masks::Masks;
use crate::quality::TrackQuality;
use crate::verdict::ScaleSource;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use vidar_core::{CameraId, Duration, Frame, FrameImage, Image, SensorEvent, Trajectory, Warning};
use vidar_dataset::{CalibrationSource, DatasetError, ImageEntry, OpenOptions, Recording};
use vidar_odometry::bundle_adjustment::Adjusted;

/// SHA-256 of what a recording consists of.
pub(crate) fn fingerprint(dataset: &Recording) -> Result<String, Error> {
    let mut hash = Sha256::new();
    dataset.write_fingerprint(&mut hash)?;
    Ok(vidar_hub::hex(&hash.finalize()))
}

/// A recording as the engine takes it: IMU samples and images in the order of time, the next images decoded ahead of their turn.
/// An image that cannot be read comes as its time alone, with a warning.
pub enum Measurement {
    /// A measurement, whole.
    Event(SensorEvent),
    /// An image whose pixels are not needed.
    Stamp(FrameStamp),
    /// An image whose pixels cannot be read.
    Unreadable(FrameStamp, DatasetError),
}

/// The measurements of a recording; without `sensors` only the times of its images.
pub fn measurements(dataset: &Recording, sensors: bool) -> impl Iterator<Item = Measurement> + '_ {
    let mut imu = if sensors { dataset.imu.as_slice() } else { &[] }.iter().peekable();
    let mut images = dataset.images.iter().peekable();
    let mut pixels = dataset.images_ahead(dataset.images.iter());
    std::iter::from_fn(move || {
        let image_time = images.peek().map(|i| i.time);
        // At equal times the IMU comes first.
        if let Some(sample) = imu.next_if(|s| image_time.is_none_or(|t| s.time <= t)) {
            return Some(Measurement::Event(SensorEvent::Imu(*sample)));
        }
        let entry = images.next()?;
        let stamp = stamp_of(entry);
        if !sensors {
            return Some(Measurement::Stamp(stamp));
        }
        Some(match pixels.next().map_or_else(|| dataset.load_image(entry), |(_, image)| image) {
            Ok(image) => {
                let FrameStamp { frame_id: id, time, camera } = stamp;
                Measurement::Event(SensorEvent::Image(Frame { id, time, camera, image }))
            }
            Err(error) => Measurement::Unreadable(stamp, error),
        })
    })
}

/// An image of the recording without its pixels.
pub fn stamp_of(entry: &ImageEntry) -> FrameStamp {
    FrameStamp { frame_id: entry.frame_id, time: entry.time, camera: entry.camera }
}

/// Reads a recording's images again when the engine needs their pixels.
pub struct ImageFiles<'a>(pub &'a Recording, pub Option<&'a Masks>);

impl ImageSource for ImageFiles<'_> {
    fn image(&self, stamp: &FrameStamp) -> Result<FrameImage, Warning> {
        let missing = || {
            let message = format!("the recording has no image {}", stamp.frame_id);
            Warning::degraded("image-unreadable", message)
        };
        let place = self.0.images.binary_search_by_key(&stamp.time, |i| i.time);
        let is_it = |entry: &&ImageEntry| entry.frame_id == stamp.frame_id;
        let entry = place.ok().and_then(|i| self.0.images.get(i)).filter(is_it);
        let entry = entry.or_else(|| self.0.images.iter().find(is_it)).ok_or_else(missing)?;
        self.0
            .load_image(entry)
            .map_err(|e| Warning::degraded("image-unreadable", e.to_string()).at(&entry.location))
    }

    fn mask(&self, stamp: &FrameStamp) -> Result<Option<Image<bool>>, Warning> {
        let Some(masks) = self.1 else { return Ok(None) };
        masks.load(stamp.frame_id).map_err(|e| Warning::degraded("mask-unreadable", e.to_string()))
    }
}

/// Opens the recording with all of its images between start and end: the odometry uses every one,
/// whatever `input.stride` leaves for depth.
pub fn open_every_image(path: &Path, options: &OpenOptions, config: &Config) -> Result<Recording, Error> {
    let mut dataset = vidar_dataset::open(path, &options_of(options, config))?;
    imu_noise::settle(&mut dataset);
    Ok(dataset)
}

/// The same for a live run, which looks at nothing before it comes, but for the beginning: only that shows the noise of the IMU.
pub(crate) fn open_for_live(path: &Path, options: &OpenOptions, config: &Config) -> Result<Recording, Error> {
    let mut dataset = vidar_dataset::open(path, &options_of(options, config))?;
    imu_noise::settle_of_opening(&mut dataset);
    Ok(dataset)
}

/// The options with the configuration's part of them, for all images.
pub(crate) fn options_of(options: &OpenOptions, config: &Config) -> OpenOptions {
    let mut options = options.clone();
    options.camera = CameraId(config.input.camera);
    options.stride = 1;
    options.start = Some(Duration::from_secs_f64(config.input.start_secs)).filter(|d| *d > Duration::ZERO);
    options.end = Some(Duration::from_secs_f64(config.input.end_secs)).filter(|d| *d > Duration::ZERO);
    options
}

/// Where image times are invented, an interval of time between keyframes means nothing: every image is one.
pub fn use_every_untimed_image(dataset: &Recording, config: &mut Config) -> Option<Warning> {
    if !dataset.times_are_invented {
        return None;
    }
    // Shorter than any interval of invented times.
    config.keyframes.unposed_interval_secs = 1e-6;
    let message = format!(
        "the {} images have no times: where no poses select keyframes, every image is one",
        dataset.images.len()
    );
    let hint = "--stride N takes every N-th of a video; --timestamps FILE gives the times";
    Some(Warning::new("every-image-used", message).hint(hint))
}

/// The images that `input.stride` leaves.
pub fn strided(dataset: &Recording, config: &Config) -> Vec<ImageEntry> {
    dataset.images.iter().step_by(config.input.stride.max(1)).cloned().collect()
}

/// Applies the configuration's part of the options and opens the dataset.
pub fn open_dataset(path: &Path, options: &OpenOptions, config: &Config) -> Result<Recording, Error> {
    let options = OpenOptions { stride: config.input.stride, ..options_of(options, config) };
    let mut dataset = vidar_dataset::open(path, &options)?;
    imu_noise::settle(&mut dataset);
    Ok(dataset)
}

/// Whether the adjustment of a recording that calibrated itself leaves so much of the IMU that its calibration may be wrong.
pub(crate) fn leaves_calibration_unchecked(dataset: &Recording, adjusted: &Adjusted) -> bool {
    dataset.calibration == CalibrationSource::Recording
        && adjusted.report.inertial_chi2_per_dof > MAX_SELF_CALIBRATED_CHI2
}

/// σ(ln s) of what the estimate of the scale does not see.
#[derive(Clone, Copy, Debug)]
pub struct UnseenScale {
    /// Of the accelerometer's gain and the lever arm.
    sensors: f64,
    /// Of a calibration that nothing has checked.
    calibration: f64,
    /// Whether the recording calibrated itself.
    is_self_calibrated: bool,
}

/// What an adjustment from a recording's own calibration leaves of the IMU where both are right, at most: 0.034 to 0.063 in 23 rendered recordings,
/// 0.51 in the one whose focal length stayed 4.6 % off (phone-slow-906, ln s 0.15 at σ 0.03). Vibration leaves as much (0.6 on MH_01), which cannot
/// be told apart.
const MAX_SELF_CALIBRATED_CHI2: f64 = 0.25;

impl UnseenScale {
    /// As configured, and at least what the accelerometer is off at rest.
    pub fn of(dataset: &Recording, config: &Config) -> Self {
        let at_rest = vidar_dataset::gain_error_at_rest(&dataset.imu).map_or(0.0, f64::abs);
        // Gravity itself differs by 0.3 % on Earth, which says nothing of the gain.
        let at_rest = if at_rest > 0.01 { at_rest } else { 0.0 };
        Self {
            sensors: config.input.imu_scale_std.max(at_rest),
            calibration: config.input.calibration_scale_std,
            is_self_calibrated: dataset.calibration == CalibrationSource::Recording,
        }
    }

    /// The scale of a trajectory: the adjustment estimates the calibration, too; the live one takes it as given. An adjustment
    /// that leaves camera and IMU apart has not checked a calibration that came from the same recording.
    pub fn source(&self, quality: &TrackQuality) -> ScaleSource {
        let is_unchecked = quality
            .inertial_chi2()
            .is_none_or(|left| self.is_self_calibrated && left > MAX_SELF_CALIBRATED_CHI2);
        ScaleSource::Odometry {
            stated: quality.scale_std(),
            unseen: self.sensors,
            unchecked: is_unchecked.then_some(self.calibration),
        }
    }
}

/// Refuses a given trajectory that no image was taken within.
pub fn require_overlap(
    images: &[ImageEntry],
    poses: &GivenPoses,
    trajectory: &Trajectory,
) -> Result<(), Error> {
    if images.is_empty() || images.iter().any(|i| poses.pose_at(i.time).is_some()) {
        return Ok(());
    }
    let times = trajectory.time_range();
    let slip = images.first().zip(times).and_then(|(image, (pose, _))| unit_slip(image.time, pose));
    let images = range(images.first().map(|i| i.time).zip(images.last().map(|i| i.time)));
    Err(Error::NoOverlap { images, poses: range(times), slip })
}

/// Two clocks that differ by a factor of about 10³, 10⁶ or 10⁹ are one clock in two units.
fn unit_slip(image: vidar_core::Timestamp, pose: vidar_core::Timestamp) -> Option<&'static str> {
    let ratio =
        (image.nanos().unsigned_abs().max(1) as f64 / pose.nanos().unsigned_abs().max(1) as f64).log10();
    // Recordings last hours, clocks count years: a tenth of a decade is far more than a recording's length.
    let near = |decades: f64| (ratio.abs() - decades).abs() < 0.1;
    let known = [
        (3.0, "one clock is about 1000 times the other, as seconds and milliseconds are"),
        (6.0, "one clock is about 10^6 times the other, as seconds and microseconds are"),
        (9.0, "one clock is about 10^9 times the other, as seconds and nanoseconds are"),
    ];
    known.into_iter().find(|(decades, _)| near(*decades)).map(|(_, words)| words)
}

/// Whether a run needs the camera's calibration: depth alone comes with a camera of the network's, in a unit of its own.
pub(crate) fn needs_calibration(config: &Config) -> bool {
    config.coupling.mode.uses_pose_priors()
}

/// Refuses a camera that is only guessed: it would bend every surface and still look metric.
pub fn require_calibration(dataset: &Recording) -> Result<(), Error> {
    match dataset.calibration {
        CalibrationSource::Guessed if dataset.imu.is_empty() && dataset.external_trajectory.is_none() => {
            Err(Error::ImagesAlone { name: dataset.name.clone() })
        }
        CalibrationSource::Guessed => Err(Error::NoCalibration { name: dataset.name.clone() }),
        _ => Ok(()),
    }
}

fn range(times: Option<(vidar_core::Timestamp, vidar_core::Timestamp)>) -> String {
    times.map_or_else(|| "nothing".to_owned(), |(first, last)| format!("{first} to {last} s"))
}

/// A path made absolute for the manifest, as far as the system can.
pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// The name of the recording at `path`, for the run folder.
pub fn name_of(path: &Path) -> String {
    let absolute = absolute(path);
    let parts: Vec<String> = absolute
        .components()
        .filter_map(|c| match c {
            std::path::Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
            _ => None,
        })
        .collect();
    // `…/MH_01/mav0` has the name MH_01.
    let meaningful = parts.iter().rev().find(|p| !["mav0", "cam0", "data"].contains(&p.as_str()));
    meaningful.cloned().unwrap_or_else(|| "run".into())
}

#[cfg(test)]
mod tests {
    use super::unit_slip;
    use vidar_core::Timestamp;

    #[test]
    fn clocks_of_two_units_are_recognised_and_other_clocks_are_not() {
        let at = Timestamp::from_nanos;
        let now = 1_600_000_000_000_000_000;
        assert!(unit_slip(at(now), at(now / 1000)).is_some_and(|w| w.contains("milliseconds")));
        assert!(unit_slip(at(now / 1_000_000), at(now)).is_some_and(|w| w.contains("microseconds")));
        assert!(unit_slip(at(now), at(now / 1_000_000_000)).is_some_and(|w| w.contains("nanoseconds")));
        assert!(unit_slip(at(now), at(now + 3_600_000_000_000)).is_none());
        assert!(unit_slip(at(now), at(5_000_000_000)).is_none());
        assert!(unit_slip(at(0), at(0)).is_none());
    }
}
