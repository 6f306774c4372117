//! What the odometry made of a whole recording, as poses for the engine.

use super::{NEVER_STARTED, Tracked};
use crate::engine::{FrameStamp, PoseReport, PoseSource};
use crate::error::Error;
use crate::input::TrajectorySource;
use crate::quality::TrackQuality;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use vidar_core::{CameraId, FrameId, NavState, OdometryKeyframe, Rig, Se3, SensorEvent, Warning};

/// Metric poses of the images of a recording: the adjusted ones where all states were adjusted together after the end, else
/// those of the live odometry with its last word on every keyframe.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct TrackedPoses {
    /// Segment and `world_from_camera` of every image that has a state.
    poses: BTreeMap<FrameId, (u32, Se3)>,
    keyframes: BTreeMap<FrameId, OdometryKeyframe>,
    warnings: Vec<Warning>,
    why_no_pose: Option<String>,
    quality: TrackQuality,
}

impl TrackedPoses {
    /// The states of what was tracked with a camera on `rig`.
    pub(crate) fn new(tracked: &Tracked, rig: &Rig, camera: CameraId) -> Self {
        let mut warnings = tracked.warnings();
        // The engine says what is done about it.
        warnings.retain(|w| w.kind != NEVER_STARTED);
        let why_no_pose = match tracked.with_imu {
            true => tracked.why_not_started(),
            false => {
                Some("odometry.imu is \"off\", or the recording has no IMU: lengths are not metres".into())
            }
        };
        let common = Self { warnings, why_no_pose, quality: tracked.quality.clone(), ..Self::default() };
        let by_frame = |keyframes: &[OdometryKeyframe]| -> BTreeMap<FrameId, OdometryKeyframe> {
            keyframes.iter().map(|k| (k.frame_id, k.clone())).collect()
        };
        if let Some(adjusted) = &tracked.adjusted {
            let place = adjusted.calibration.body_from_camera;
            let posed =
                |(id, state): &(FrameId, NavState)| (*id, (adjusted.segment, state.world_from_body * place));
            return Self {
                poses: adjusted.images.iter().map(posed).collect(),
                keyframes: by_frame(&adjusted.keyframes),
                ..common
            };
        }
        if !tracked.with_imu {
            return common;
        }
        let place = rig.camera(camera).map_or(Se3::IDENTITY, |c| c.body_from_camera);
        let mut poses: BTreeMap<FrameId, (u32, Se3)> = tracked
            .frames
            .iter()
            .filter_map(|f| Some((f.output.frame_id, f.output.tracking()?)))
            .map(|(id, t)| (id, (t.segment, t.state.world_from_body * place)))
            .collect();
        // A keyframe's pose went on being estimated after its image.
        poses.extend(tracked.keyframes.iter().map(|k| (k.frame_id, (k.segment, k.world_from_camera))));
        Self { poses, keyframes: by_frame(&tracked.keyframes), ..common }
    }
}

impl PoseSource for TrackedPoses {
    fn source(&self) -> TrajectorySource {
        TrajectorySource::Odometry
    }

    fn needs_sensors(&self) -> bool {
        false
    }

    fn push(&mut self, event: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        let SensorEvent::Image(frame) = event else { return Ok(Vec::new()) };
        Ok(self.push_stamp(&FrameStamp { frame_id: frame.id, time: frame.time, camera: frame.camera }))
    }

    fn push_stamp(&mut self, stamp: &FrameStamp) -> Vec<PoseReport> {
        let pose = self.poses.get(&stamp.frame_id).copied();
        let keyframe = pose.and_then(|_| self.keyframes.remove(&stamp.frame_id)).map(Box::new);
        vec![PoseReport::known(stamp, pose, keyframe)]
    }

    fn finish(&mut self) -> Vec<PoseReport> {
        Vec::new()
    }

    fn warnings(&self) -> Vec<Warning> {
        self.warnings.clone()
    }

    fn why_no_pose(&self) -> String {
        self.why_no_pose.clone().unwrap_or_else(|| "it got no image".into())
    }

    fn quality(&self) -> Option<&TrackQuality> {
        Some(&self.quality)
    }
}
