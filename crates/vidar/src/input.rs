//! From a path to images with metric poses.

use crate::config::{Config, PoseSource};
use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::keyframes::PosedFrame;
use crate::odometry::Tracked;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{BodyFrame, CameraId, Duration, Se3, Trajectory, Warning};
use vidar_dataset::{Dataset, ImageEntry, OpenOptions};

/// Where the metric poses of a run came from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "source", rename_all = "kebab-case")]
pub enum AnchorSource {
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

impl std::fmt::Display for AnchorSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::External { file } => write!(f, "external trajectory {file}"),
            Self::GroundTruth => f.write_str("ground truth (upper bound)"),
            Self::Odometry => f.write_str("odometry of camera and IMU"),
        }
    }
}

/// The metric trajectory that everything is placed by, told of the camera in use.
#[derive(Clone, Debug)]
pub struct MetricAnchor {
    /// Where it came from.
    pub source: AnchorSource,
    /// Poses of the camera in use.
    pub camera_trajectory: Trajectory,
    /// What there is to say of it.
    pub warnings: Vec<Warning>,
    /// All that the odometry said, where the poses are its.
    pub tracked: Option<Arc<Tracked>>,
}

/// Opens the recording with all of its images between start and end: odometry wants every one, whatever
/// `input.stride` leaves for depth.
pub fn open_every_image(path: &Path, options: &OpenOptions, config: &Config) -> Result<Dataset, Error> {
    let mut config = config.clone();
    config.input.stride = 1;
    open_dataset(path, options, &config)
}

/// The images that `input.stride` leaves.
pub fn strided(dataset: &Dataset, config: &Config) -> Vec<ImageEntry> {
    dataset.images.iter().step_by(config.input.stride.max(1)).cloned().collect()
}

/// Applies the configuration's part of the options and opens the dataset.
pub fn open_dataset(path: &Path, options: &OpenOptions, config: &Config) -> Result<Dataset, Error> {
    let mut options = options.clone();
    options.camera = CameraId(config.input.camera);
    options.stride = config.input.stride;
    options.start = Some(Duration::from_secs_f64(config.input.start_secs)).filter(|d| *d > Duration::ZERO);
    options.end = Some(Duration::from_secs_f64(config.input.end_secs)).filter(|d| *d > Duration::ZERO);
    Ok(vidar_dataset::open(path, &options)?)
}

/// The metric trajectory that the configuration asks for.
pub fn metric_anchor(
    dataset: &Dataset,
    config: &Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<MetricAnchor, Error> {
    let external =
        dataset.anchor.as_ref().map(|a| (&a.trajectory, AnchorSource::External { file: shown(&a.source) }));
    let truth = dataset.ground_truth.as_ref().map(|t| (t, AnchorSource::GroundTruth));
    let given = |chosen: Option<(&Trajectory, AnchorSource)>| {
        let (trajectory, source) = chosen.ok_or_else(|| Error::NoAnchor { name: dataset.name.clone() })?;
        let camera_trajectory = in_camera(trajectory, dataset)?;
        Ok(MetricAnchor { source, camera_trajectory, warnings: Vec::new(), tracked: None })
    };
    let has_imu = dataset.rig.imu.is_some() && !dataset.imu.is_empty();
    match config.input.poses {
        PoseSource::External => given(external),
        PoseSource::GroundTruth => given(truth),
        PoseSource::Odometry => odometry_anchor(dataset, config, events, cancel),
        PoseSource::Auto if external.is_some() => given(external),
        PoseSource::Auto if has_imu => match odometry_anchor(dataset, config, events, cancel) {
            Err(Error::NoOdometry { reason, .. }) if truth.is_some() => {
                let mut anchor = given(truth)?;
                let message =
                    format!("the odometry never gave a metric pose ({reason}): ground truth is used");
                let hint = "scores are an upper bound; --set input.poses=odometry refuses to do without";
                anchor.warnings.push(Warning::new("odometry-not-used", message).hint(hint));
                Ok(anchor)
            }
            other => other,
        },
        PoseSource::Auto => given(truth),
    }
}

/// The longest span that the odometry tracked in metres.
fn odometry_anchor(
    dataset: &Dataset,
    config: &Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<MetricAnchor, Error> {
    require_calibration(dataset)?;
    let total = dataset.images.len();
    let tracked = events
        .stage("odometry", total, || crate::odometry::track(dataset, config, events, cancel))
        .map(Arc::new)?;
    let trajectory = tracked.longest_segment().filter(|_| tracked.is_metric);
    let trajectory = trajectory.ok_or_else(|| Error::NoOdometry {
        name: dataset.name.clone(),
        reason: tracked.why_not_started().unwrap_or_else(|| "it is told to leave the IMU out".into()),
    })?;
    let camera_trajectory = in_camera(&trajectory, dataset)?;
    let warnings = tracked.warnings();
    Ok(MetricAnchor { source: AnchorSource::Odometry, camera_trajectory, warnings, tracked: Some(tracked) })
}

/// Ground truth told of the camera in use, if there is any that can be.
pub fn truth_in_camera(dataset: &Dataset) -> Option<Trajectory> {
    dataset.ground_truth.as_ref().and_then(|t| in_camera(t, dataset).ok())
}

fn in_camera(trajectory: &Trajectory, dataset: &Dataset) -> Result<Trajectory, Error> {
    Ok(trajectory.in_frame(BodyFrame::Camera(dataset.camera), &dataset.rig)?)
}

/// Every image that has a pose. Images outside the trajectory are counted in a warning; none at all is an error.
pub fn posed_frames(
    dataset: &Dataset,
    images: &[ImageEntry],
    anchor: &MetricAnchor,
    config: &Config,
) -> Result<(Vec<PosedFrame>, Vec<Warning>), Error> {
    let pose_of = poses_at(dataset, anchor, config);
    let posed =
        |image: &ImageEntry| Some(PosedFrame { image: image.clone(), world_from_camera: pose_of(image)? });
    let frames: Vec<PosedFrame> = images.iter().filter_map(posed).collect();
    if frames.is_empty() {
        let poses = anchor.camera_trajectory.time_range();
        let slip = images.first().zip(poses).and_then(|(image, (pose, _))| unit_slip(image.time, pose));
        let images = range(images.first().map(|i| i.time).zip(images.last().map(|i| i.time)));
        return Err(Error::NoOverlap { images, poses: range(poses), slip });
    }
    let missing = images.len() - frames.len();
    let mut warnings = Vec::new();
    if missing > 0 {
        let message = format!("{missing} of {} images have no pose and are left out", images.len());
        warnings.push(
            Warning::new("images-without-pose", message)
                .hint("they lie outside the trajectory, or in a gap longer than input.max_pose_gap_secs"),
        );
    }
    Ok((frames, warnings))
}

/// The anchor's pose of the camera when an image was taken.
pub fn poses_at<'a>(
    dataset: &Dataset,
    anchor: &'a MetricAnchor,
    config: &Config,
) -> impl Fn(&ImageEntry) -> Option<Se3> + 'a {
    let max_gap = Duration::from_secs_f64(config.input.max_pose_gap_secs);
    let offset = dataset.rig.camera(dataset.camera).map_or(Duration::ZERO, |c| c.time_offset);
    // Poses are in the IMU's clock: t_imu = t_camera + offset.
    move |image| anchor.camera_trajectory.interpolate(image.time + offset, max_gap)
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

/// Refuses a camera that is only guessed: it would bend every surface and still look metric.
pub fn require_calibration(dataset: &Dataset) -> Result<(), Error> {
    match dataset.calibration {
        vidar_dataset::CalibrationSource::Guessed => Err(Error::NoCalibration { name: dataset.name.clone() }),
        _ => Ok(()),
    }
}

fn range(times: Option<(vidar_core::Timestamp, vidar_core::Timestamp)>) -> String {
    times.map_or_else(|| "nothing".to_owned(), |(first, last)| format!("{first} to {last} s"))
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// A path made absolute for the manifest, as far as the system can.
pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
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
