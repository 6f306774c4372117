//! Select keyframes, as frames come: by motion where poses are known, by time where they are not.

use super::cut::ChunkRule;
use super::events::{FrameStamp, MapKeyframe};
use super::track::PosedFrame;
use vidar_align::keyframe_selection::{KeyframeConfig, KeyframeSelector, select_by_motion, select_by_time};
use vidar_core::{Se3, Timestamp};

/// Selects keyframes of one world.
#[derive(Debug)]
pub struct Selection {
    config: KeyframeConfig,
    by_motion: KeyframeSelector,
    /// Whether frames that the odometry made keyframes are selected wherever they are: their landmarks determine a chunk's
    /// scale.
    prefers_odometry: bool,
    /// Frames offered so far, and the last keyframe among those without a pose.
    offered: usize,
    last_unposed: Option<usize>,
}

impl Selection {
    /// No frame yet.
    pub fn new(config: &KeyframeConfig, prefers_odometry: bool) -> Self {
        let by_motion = KeyframeSelector::new(config);
        Self { config: config.clone(), by_motion, prefers_odometry, offered: 0, last_unposed: None }
    }

    /// New keyframes among all posed frames so far. A limit on their number is a property of the whole sequence: then there
    /// are none before `is_complete`.
    pub fn among_posed(
        &mut self,
        frames: &[PosedFrame],
        rule: &ChunkRule,
        is_complete: bool,
    ) -> Vec<MapKeyframe> {
        let keyframe = |f: &PosedFrame| MapKeyframe {
            stamp: f.stamp,
            world_from_camera: Some(f.world_from_camera),
            warp: None,
            odometry: f.odometry.clone(),
        };
        let is_preferred = |f: &PosedFrame| self.prefers_odometry && f.odometry.is_some();
        let is_limited = self.config.max_count > 0;
        if is_limited && !is_complete && !rule.is_prescribed() {
            return Vec::new();
        }
        let fresh = &frames[self.offered.min(frames.len())..];
        self.offered = frames.len();
        if rule.is_prescribed() {
            return fresh.iter().filter(|f| rule.prescribes(f.stamp.frame_id)).map(keyframe).collect();
        }
        if is_limited {
            let poses: Vec<Se3> = fresh.iter().map(|f| f.world_from_camera).collect();
            let chosen = select_by_motion(&poses, |i| is_preferred(&fresh[i]), &self.config);
            return chosen.into_iter().map(|i| keyframe(&fresh[i])).collect();
        }
        let by_motion = &mut self.by_motion;
        let prefers_odometry = self.prefers_odometry;
        let is_selected =
            |f: &&PosedFrame| by_motion.push(&f.world_from_camera, prefers_odometry && f.odometry.is_some());
        fresh.iter().filter(is_selected).map(keyframe).collect()
    }

    /// New keyframes among all frames so far, which have no poses.
    pub fn among_unposed(
        &mut self,
        frames: &[FrameStamp],
        rule: &ChunkRule,
        is_complete: bool,
    ) -> Vec<MapKeyframe> {
        let keyframe = |stamp: &FrameStamp| MapKeyframe {
            stamp: *stamp,
            world_from_camera: None,
            warp: None,
            odometry: None,
        };
        if self.config.max_count > 0 && !is_complete && !rule.is_prescribed() {
            return Vec::new();
        }
        let fresh = &frames[self.offered.min(frames.len())..];
        self.offered = frames.len();
        if rule.is_prescribed() {
            return fresh.iter().filter(|f| rule.prescribes(f.frame_id)).map(keyframe).collect();
        }
        // The first frame is always selected: from the last keyframe on, it is that one again.
        let first = self.last_unposed.unwrap_or(0);
        let times: Vec<Timestamp> = frames[first..].iter().map(|f| f.time).collect();
        let chosen = select_by_time(&times, &self.config).into_iter().map(|i| first + i);
        let chosen: Vec<usize> = chosen.filter(|i| self.last_unposed.is_none_or(|last| *i > last)).collect();
        self.last_unposed = chosen.last().copied().or(self.last_unposed);
        chosen.into_iter().map(|i| keyframe(&frames[i])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::{CameraId, FrameId};

    fn posed(i: u32) -> PosedFrame {
        let stamp = FrameStamp {
            frame_id: FrameId(i),
            time: Timestamp::from_nanos(i64::from(i) * 50_000_000),
            camera: CameraId(0),
        };
        let world_from_camera = Se3::from_translation(Vector3::new(f64::from(i) * 0.0401, 0.0, 0.0));
        PosedFrame { stamp, world_from_camera, odometry: None }
    }

    fn ids(keyframes: Vec<MapKeyframe>) -> Vec<u32> {
        keyframes.into_iter().map(|k| k.stamp.frame_id.0).collect()
    }

    /// Keyframes as frames come one by one, the last one at the end.
    fn one_by_one(config: &KeyframeConfig, rule: &ChunkRule, is_posed: bool) -> Vec<u32> {
        let frames: Vec<PosedFrame> = (0..40).map(posed).collect();
        let stamps: Vec<FrameStamp> = frames.iter().map(|f| f.stamp).collect();
        let mut selection = Selection::new(config, true);
        let add = |n: usize| match is_posed {
            true => ids(selection.among_posed(&frames[..n], rule, n == 40)),
            false => ids(selection.among_unposed(&stamps[..n], rule, n == 40)),
        };
        (1..=40).flat_map(add).collect()
    }

    #[test]
    fn keyframes_selected_as_frames_come_are_those_of_the_whole_sequence() {
        let rule = ChunkRule::WithContext { size: 4, context: 2 };
        for max_count in [0, 5] {
            let config = KeyframeConfig { min_translation_m: 0.1, max_count, ..KeyframeConfig::default() };
            let poses: Vec<Se3> = (0..40).map(|i| posed(i).world_from_camera).collect();
            let times: Vec<Timestamp> = (0..40).map(|i| posed(i).stamp.time).collect();
            let as_ids = |chosen: Vec<usize>| chosen.into_iter().map(|i| i as u32).collect::<Vec<_>>();
            let by_motion = as_ids(select_by_motion(&poses, |_| false, &config));
            assert_eq!(one_by_one(&config, &rule, true), by_motion, "{max_count}");
            let by_time = as_ids(select_by_time(&times, &config));
            assert_eq!(one_by_one(&config, &rule, false), by_time, "{max_count}");
        }
    }

    #[test]
    fn a_recording_prescribes_its_keyframes() {
        let rule = ChunkRule::Prescribed(vec![vec![FrameId(3), FrameId(4)], vec![FrameId(4), FrameId(9)]]);
        let config = KeyframeConfig { max_count: 1, ..KeyframeConfig::default() };
        assert_eq!(one_by_one(&config, &rule, true), [3, 4, 9]);
        assert_eq!(one_by_one(&config, &rule, false), [3, 4, 9]);
    }
}
