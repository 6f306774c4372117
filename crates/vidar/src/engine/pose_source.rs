//! Where poses of images come from: visual-inertial odometry, or a given trajectory.

use super::{FrameStamp, FrameState};
use crate::error::Error;
use crate::input::trajectory::{MetricTrajectory, TrajectorySource};
use crate::quality::{TrackQuality, carrier_in_view};
use vidar_core::{
    CameraId, Duration, OdometryKeyframe, RevisedPose, Rig, Se3, SensorEvent, Timestamp, Warning,
};
use vidar_odometry::{ImuUse, Joined, Odometry, OdometryConfig, OdometryOutput, SavedMap, Status, Tracking};

/// What a pose source reports of one image. Images are reported in the order of time; one may be left out.
#[derive(Clone, Debug)]
pub enum PoseReport {
    /// The image has a pose.
    Posed {
        /// The pose.
        state: FrameState,
        /// The keyframe that the image became in the odometry, if it did.
        keyframe: Option<Box<OdometryKeyframe>>,
        /// Earlier keyframes whose poses were estimated again.
        revised: Vec<RevisedPose>,
        /// The same by an adjustment that settles the scale: what was mapped by them moves with them.
        settled: Vec<RevisedPose>,
        /// Two segments that this image shows to be of one world.
        joined: Option<Joined>,
    },
    /// The image has none.
    NotPosed {
        /// When it was taken.
        time: Timestamp,
    },
}

impl PoseReport {
    /// Of an image whose segment and `world_from_camera`, where it has them, are known before and stay.
    pub fn known(
        stamp: &FrameStamp,
        pose: Option<(u32, Se3)>,
        keyframe: Option<Box<OdometryKeyframe>>,
    ) -> Self {
        let FrameStamp { frame_id, time, .. } = *stamp;
        match pose {
            Some((segment, world_from_camera)) => Self::Posed {
                state: FrameState { frame_id, time, segment, world_from_camera },
                keyframe,
                revised: Vec::new(),
                settled: Vec::new(),
                joined: None,
            },
            None => Self::NotPosed { time },
        }
    }
}

/// Where the poses of images come from.
pub trait PoseSource {
    /// What it is.
    fn source(&self) -> TrajectorySource;
    /// Whether it works on pixels and IMU samples, so that every event must be pushed whole.
    fn needs_sensors(&self) -> bool;
    /// Takes a sensor measurement; reports the images whose poses it decides.
    ///
    /// # Errors
    /// The measurement does not fit the calibration.
    fn push(&mut self, event: SensorEvent) -> Result<Vec<PoseReport>, Error>;
    /// Takes an image of which only the time is known.
    fn push_stamp(&mut self, stamp: &FrameStamp) -> Vec<PoseReport>;
    /// Reports the images that still waited.
    fn finish(&mut self) -> Vec<PoseReport>;
    /// What there is to report at the end.
    fn warnings(&self) -> Vec<Warning>;
    /// Why there are no metric poses.
    fn why_no_pose(&self) -> String;
    /// What it says of its poses, where it estimates them.
    fn quality(&self) -> Option<&TrackQuality> {
        None
    }
}

/// Poses of a trajectory that was given: external, or ground truth.
pub struct GivenPoses {
    trajectory: MetricTrajectory,
    /// The trajectory's clock is the IMU's: `t_imu = t_camera + offset`.
    camera_to_imu: Duration,
    max_gap: Duration,
}

impl GivenPoses {
    /// Poses of `trajectory`, interpolated across gaps of at most `max_gap`.
    pub fn new(trajectory: MetricTrajectory, camera_to_imu: Duration, max_gap: Duration) -> Self {
        Self { trajectory, camera_to_imu, max_gap }
    }

    /// The camera's pose when an image was taken.
    pub fn pose_at(&self, time: Timestamp) -> Option<Se3> {
        self.trajectory.camera_trajectory.interpolate(time + self.camera_to_imu, self.max_gap)
    }
}

impl PoseSource for GivenPoses {
    fn source(&self) -> TrajectorySource {
        self.trajectory.source.clone()
    }

    fn needs_sensors(&self) -> bool {
        false
    }

    fn push(&mut self, event: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        Ok(match event {
            SensorEvent::Image(frame) => {
                let stamp = FrameStamp { frame_id: frame.id, time: frame.time, camera: frame.camera };
                self.push_stamp(&stamp)
            }
            _ => Vec::new(),
        })
    }

    fn push_stamp(&mut self, stamp: &FrameStamp) -> Vec<PoseReport> {
        vec![PoseReport::known(stamp, self.pose_at(stamp.time).map(|pose| (0, pose)), None)]
    }

    fn finish(&mut self) -> Vec<PoseReport> {
        Vec::new()
    }

    fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    fn why_no_pose(&self) -> String {
        "no image was taken within the given trajectory".into()
    }
}

/// Poses of the recording's own camera and IMU.
pub struct OdometryPoses {
    odometry: Odometry,
    body_from_camera: Se3,
    is_metric: bool,
    has_state: bool,
    /// Times and reasons of losses.
    lost: Vec<(Timestamp, String)>,
    quality: TrackQuality,
}

impl OdometryPoses {
    /// Odometry of one camera of the rig, which looks for itself in `map`.
    ///
    /// # Errors
    /// Settings or calibration that the odometry refuses.
    pub fn new(
        rig: &Rig,
        camera: CameraId,
        config: &OdometryConfig,
        map: Option<&SavedMap>,
    ) -> Result<Self, Error> {
        let mut odometry = Odometry::new(rig, camera, config)?;
        if let Some(map) = map {
            odometry = odometry.with_map(map);
        }
        let body_from_camera = rig.camera(camera).map_or(Se3::IDENTITY, |c| c.body_from_camera);
        let is_metric = config.imu != ImuUse::Off && rig.imu.is_some();
        Ok(Self {
            odometry,
            body_from_camera,
            is_metric,
            has_state: false,
            lost: Vec::new(),
            quality: TrackQuality::default(),
        })
    }

    fn report(&mut self, output: OdometryOutput) -> PoseReport {
        let (frame_id, time) = (output.frame_id, output.time);
        self.quality.add(&output);
        match output.status {
            Status::Tracking(tracking) if self.is_metric => {
                self.has_state = true;
                let world_from_camera = tracking.state.world_from_body * self.body_from_camera;
                let state = FrameState { frame_id, time, segment: tracking.segment, world_from_camera };
                let Tracking { keyframe, revised, settled, joined, .. } = *tracking;
                PoseReport::Posed { state, keyframe, revised, settled, joined }
            }
            Status::Tracking(_) => PoseReport::NotPosed { time },
            Status::Lost(reason) => {
                self.lost.push((time, reason.to_string()));
                PoseReport::NotPosed { time }
            }
            Status::Waiting(_) => PoseReport::NotPosed { time },
        }
    }
}

impl PoseSource for OdometryPoses {
    fn source(&self) -> TrajectorySource {
        TrajectorySource::Odometry
    }

    fn needs_sensors(&self) -> bool {
        true
    }

    fn push(&mut self, event: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        let output = self.odometry.push(event)?;
        Ok(output.map(|o| self.report(o)).into_iter().collect())
    }

    fn push_stamp(&mut self, _: &FrameStamp) -> Vec<PoseReport> {
        Vec::new()
    }

    fn finish(&mut self) -> Vec<PoseReport> {
        self.odometry.finish().into_iter().map(|o| self.report(o)).collect()
    }

    fn warnings(&self) -> Vec<Warning> {
        let hint = "only the longest segment is mapped; `vidar odometry` writes every image's state";
        let lost = |(time, reason): &(Timestamp, String)| {
            Warning::degraded("track-lost", format!("at {time} s: {reason}")).hint(hint)
        };
        let carrier = carrier_in_view(self.odometry.carrier_share());
        self.lost.iter().map(lost).chain(self.quality.warning()).chain(carrier).collect()
    }

    fn why_no_pose(&self) -> String {
        match self.is_metric {
            false => "odometry.imu is \"off\", or the recording has no IMU: lengths are not metres".into(),
            _ if self.has_state => "it lost track after one image".into(),
            _ => self.quality.why_not_started().unwrap_or_else(|| "it got no image".into()),
        }
    }

    fn quality(&self) -> Option<&TrackQuality> {
        Some(&self.quality)
    }
}
