//! From a path to a recording, its poses and its images.

use crate::config::{Config, PoseSource as PoseChoice};
use crate::engine::{FrameStamp, GivenPoses, ImageSource, OdometryPoses, PoseSource};
use crate::error::Error;
use crate::imu_noise;
use crate::masks::Masks;
use crate::odometry::EarlierMap;
use crate::quality::TrackQuality;
use crate::verdict::ScaleSource;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use vidar_align::CouplingMode;
use vidar_core::{
    BodyFrame, CameraId, Duration, Frame, FrameImage, Image, SensorEvent, StampedPose, Trajectory, Warning,
};
use vidar_dataset::{CalibrationSource, DatasetError, ImageEntry, OpenOptions, Recording};
use vidar_odometry::bundle_adjustment::Adjusted;

/// Where the metric poses of a run come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "source", rename_all = "kebab-case")]
pub enum TrajectorySource {
    /// A trajectory that the user gave.
    External {
        /// Which file.
        file: String,
    },
    /// The dataset's ground truth: scores made with it are an upper bound.
    GroundTruth,
    /// Odometry of the recording's own camera and IMU.
    Odometry,
}

impl std::fmt::Display for TrajectorySource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::External { file } => write!(f, "external trajectory {file}"),
            Self::GroundTruth => f.write_str("ground truth (upper bound)"),
            Self::Odometry => f.write_str("odometry of camera and IMU"),
        }
    }
}

/// A metric trajectory of the camera in use.
#[derive(Clone, Debug)]
pub struct MetricTrajectory {
    /// Where it came from.
    pub source: TrajectorySource,
    /// Poses of the camera in use, m.
    pub camera_trajectory: Trajectory,
}

/// Where a run takes its poses from, decided before anything is tracked.
#[derive(Clone, Debug)]
pub enum PosePlan {
    /// Nowhere: the coupling needs none.
    None,
    /// A given trajectory.
    Given(MetricTrajectory),
    /// Odometry; where it gives none, the fallback.
    Odometry {
        /// Ground truth, where `input.poses` is `auto` and there is any.
        fallback: Option<MetricTrajectory>,
    },
}

impl PosePlan {
    /// What the configuration asks for, of what the recording has.
    ///
    /// # Errors
    /// [`Error::NoMetricTrajectory`] where the coupling needs poses and there are none; a calibration that is only guessed.
    pub fn new(dataset: &Recording, config: &Config) -> Result<Self, Error> {
        let mode = config.coupling.mode;
        let choice = match mode {
            CouplingMode::GroundTruth => PoseChoice::GroundTruth,
            _ => config.input.poses,
        };
        let external = dataset
            .external_trajectory
            .as_ref()
            .map(|t| (&t.trajectory, TrajectorySource::External { file: t.source.display().to_string() }));
        let truth = dataset.ground_truth.as_ref().map(|t| (t, TrajectorySource::GroundTruth));
        let in_use = |(trajectory, source): (&Trajectory, TrajectorySource)| {
            Ok::<_, Error>(MetricTrajectory { source, camera_trajectory: in_camera(trajectory, dataset)? })
        };
        // Odometry of a guessed camera leads nowhere; what is not metric does without.
        let is_usable = mode.uses_pose_priors() || dataset.calibration != CalibrationSource::Guessed;
        let has_imu = dataset.rig.imu.is_some() && !dataset.imu.is_empty() && is_usable;
        let given = match choice {
            PoseChoice::Odometry if is_usable => return Ok(Self::Odometry { fallback: None }),
            PoseChoice::Odometry => None,
            PoseChoice::Auto if external.is_none() && has_imu => {
                return Ok(Self::Odometry { fallback: truth.map(in_use).transpose()? });
            }
            PoseChoice::External => external,
            PoseChoice::GroundTruth => truth,
            PoseChoice::Auto => external.or(truth),
        };
        match given {
            Some(given) => in_use(given).map(Self::Given),
            None if mode.uses_pose_priors() => Err(Error::NoMetricTrajectory { name: dataset.name.clone() }),
            None => Ok(Self::None),
        }
    }

    /// Where poses come from, as far as it is known before tracking.
    pub fn source(&self) -> Option<TrajectorySource> {
        match self {
            Self::None => None,
            Self::Given(trajectory) => Some(trajectory.source.clone()),
            Self::Odometry { .. } => Some(TrajectorySource::Odometry),
        }
    }

    /// The given trajectory as a source of poses.
    pub fn given(&self, dataset: &Recording, config: &Config) -> Option<GivenPoses> {
        match self {
            Self::Given(trajectory) => Some(given_poses(trajectory, dataset, config)),
            Self::None | Self::Odometry { .. } => None,
        }
    }

    /// The trajectory that serves where the odometry gives no pose.
    pub fn fallback(&self, dataset: &Recording, config: &Config) -> Option<GivenPoses> {
        match self {
            Self::Odometry { fallback: Some(trajectory) } => Some(given_poses(trajectory, dataset, config)),
            Self::None | Self::Given(_) | Self::Odometry { fallback: None } => None,
        }
    }

    /// Whether they come from the recording's own camera and IMU.
    pub fn is_odometry(&self) -> bool {
        matches!(self, Self::Odometry { .. })
    }

    /// Sources of poses for the engine: the one that is planned, and its fallback.
    ///
    /// # Errors
    /// Settings or calibration that the odometry refuses.
    #[allow(clippy::type_complexity)] // two sources of one kind, named by their place in `EngineSetup`
    pub fn open(
        &self,
        dataset: &Recording,
        config: &Config,
    ) -> Result<(Option<Box<dyn PoseSource>>, Option<Box<dyn PoseSource>>), Error> {
        let boxed = |poses: GivenPoses| Box::new(poses) as Box<dyn PoseSource>;
        Ok(match self {
            Self::None => (None, None),
            Self::Given(trajectory) => (Some(boxed(given_poses(trajectory, dataset, config))), None),
            Self::Odometry { fallback } => {
                let earlier = EarlierMap::of(config)?;
                let map = earlier.as_ref().map(|earlier| &earlier.map);
                let odometry = OdometryPoses::new(&dataset.rig, dataset.camera, &config.odometry, map)?;
                let fallback = fallback.as_ref().map(|t| boxed(given_poses(t, dataset, config)));
                (Some(Box::new(odometry)), fallback)
            }
        })
    }
}

fn given_poses(trajectory: &MetricTrajectory, dataset: &Recording, config: &Config) -> GivenPoses {
    // Poses are in the IMU's clock: t_imu = t_camera + offset.
    let offset = dataset.rig.camera(dataset.camera).map_or(Duration::ZERO, |c| c.time_offset);
    GivenPoses::new(trajectory.clone(), offset, Duration::from_secs_f64(config.input.max_pose_gap_secs))
}

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

/// Ground truth of the camera in use at the images' stamps, where its place on the rig is known.
pub fn truth_in_camera(dataset: &Recording) -> Option<Trajectory> {
    let truth = dataset.ground_truth.as_ref().and_then(|t| in_camera(t, dataset).ok())?;
    in_image_clock(&truth, dataset)
}

/// A trajectory in the IMU's clock, as ground truth is, with the stamps that images of these times have.
pub fn in_image_clock(trajectory: &Trajectory, dataset: &Recording) -> Option<Trajectory> {
    let offset = dataset.rig.camera(dataset.camera).map_or(Duration::ZERO, |c| c.time_offset);
    let stamped = |p: &StampedPose| StampedPose { time: p.time - offset, ..*p };
    Trajectory::new(trajectory.body(), trajectory.poses().iter().map(stamped).collect()).ok()
}

fn in_camera(trajectory: &Trajectory, dataset: &Recording) -> Result<Trajectory, Error> {
    Ok(trajectory.in_frame(BodyFrame::Camera(dataset.camera), &dataset.rig)?)
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
