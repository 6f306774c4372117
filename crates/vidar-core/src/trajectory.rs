//! Time-ordered poses of a named frame of the rig.

use crate::id::CameraId;
use crate::lie::{LieGroup, Se3};
use crate::rig::Rig;
use crate::time::{Duration, Timestamp};
use std::fmt;
use thiserror::Error;

/// The frame of the rig that a trajectory describes. It is explicit, because confusing two frames changes an ATE by
/// the lever arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BodyFrame {
    /// The IMU, which is the body frame.
    Imu,
    /// A camera of the rig.
    Camera(CameraId),
    /// Another tracked object whose pose on the rig is unknown (a prism, a marker set).
    Other,
}

impl fmt::Display for BodyFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Imu => f.write_str("body"),
            Self::Camera(id) => write!(f, "camera{id}"),
            Self::Other => f.write_str("tracked-object"),
        }
    }
}

/// A pose and its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Time of the pose.
    pub time: Timestamp,
    /// Pose of the trajectory's body in the world.
    pub world_from_body: Se3,
}

/// Poses of one body, strictly increasing in time, all finite.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    body: BodyFrame,
    poses: Vec<StampedPose>,
}

/// Why poses do not form a trajectory.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// Time does not increase.
    #[error("pose {index} at {time} s is not after the one before it at {previous} s")]
    NotIncreasing {
        /// Which pose.
        index: usize,
        /// Its time.
        time: Timestamp,
        /// The time before.
        previous: Timestamp,
    },
    /// A pose holds a value that is not finite.
    #[error("pose {index} at {time} s is not finite")]
    NotFinite {
        /// Which pose.
        index: usize,
        /// Its time.
        time: Timestamp,
    },
    /// The rig has no such camera.
    #[error("the rig has no camera {0}")]
    NoSuchCamera(CameraId),
    /// The pose of this body on the rig is unknown.
    #[error("poses of a {0} cannot be expressed in another frame of the rig")]
    UnknownBody(BodyFrame),
}

impl Trajectory {
    /// Takes poses of `body`, which must be finite and strictly increasing in time.
    pub fn new(body: BodyFrame, poses: Vec<StampedPose>) -> Result<Self, TrajectoryError> {
        for (index, pose) in poses.iter().enumerate() {
            if !pose.world_from_body.is_finite() {
                return Err(TrajectoryError::NotFinite { index, time: pose.time });
            }
            if index > 0 && pose.time <= poses[index - 1].time {
                let previous = poses[index - 1].time;
                return Err(TrajectoryError::NotIncreasing { index, time: pose.time, previous });
            }
        }
        Ok(Self { body, poses })
    }

    /// The frame whose poses these are.
    pub fn body(&self) -> BodyFrame {
        self.body
    }

    /// The poses in the order of time.
    pub fn poses(&self) -> &[StampedPose] {
        &self.poses
    }

    /// Number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is no pose.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Time of the first and the last pose.
    pub fn time_range(&self) -> Option<(Timestamp, Timestamp)> {
        Some((self.poses.first()?.time, self.poses.last()?.time))
    }

    /// Length of the path, metres.
    pub fn path_length_m(&self) -> f64 {
        self.poses
            .windows(2)
            .map(|w| (w[1].world_from_body.translation - w[0].world_from_body.translation).norm())
            .sum()
    }

    /// The pose at `time`, on the geodesic between its neighbours.
    ///
    /// `None` outside the trajectory, or where the neighbours lie further apart than `max_gap`.
    pub fn interpolate(&self, time: Timestamp, max_gap: Duration) -> Option<Se3> {
        let after = self.poses.partition_point(|p| p.time < time);
        let next = self.poses.get(after)?;
        if next.time == time {
            return Some(next.world_from_body);
        }
        let previous = self.poses.get(after.checked_sub(1)?)?;
        let span = next.time - previous.time;
        if span > max_gap {
            return None;
        }
        let share = (time - previous.time).nanos() as f64 / span.nanos() as f64;
        Some(previous.world_from_body.interpolate(&next.world_from_body, share))
    }

    /// The pose nearest in time to `time`, if within `max_difference`.
    pub fn nearest(&self, time: Timestamp, max_difference: Duration) -> Option<&StampedPose> {
        let after = self.poses.partition_point(|p| p.time < time);
        let candidates = [after.checked_sub(1), Some(after)];
        candidates
            .into_iter()
            .flatten()
            .filter_map(|i| self.poses.get(i))
            .min_by_key(|p| (p.time - time).abs())
            .filter(|p| (p.time - time).abs() <= max_difference)
    }

    /// The same motion expressed for another frame of `rig`.
    pub fn in_frame(&self, target: BodyFrame, rig: &Rig) -> Result<Self, TrajectoryError> {
        if target == self.body {
            return Ok(self.clone());
        }
        let body_from_target = body_from(target, rig)?;
        let body_from_source = body_from(self.body, rig)?;
        let source_from_target = body_from_source.inverse() * body_from_target;
        let poses = self
            .poses
            .iter()
            .map(|p| StampedPose { time: p.time, world_from_body: p.world_from_body * source_from_target })
            .collect();
        Ok(Self { body: target, poses })
    }
}

fn body_from(frame: BodyFrame, rig: &Rig) -> Result<Se3, TrajectoryError> {
    match frame {
        BodyFrame::Imu => Ok(Se3::IDENTITY),
        BodyFrame::Camera(id) => {
            rig.camera(id).map(|c| c.body_from_camera).ok_or(TrajectoryError::NoSuchCamera(id))
        }
        BodyFrame::Other => Err(TrajectoryError::UnknownBody(frame)),
    }
}
