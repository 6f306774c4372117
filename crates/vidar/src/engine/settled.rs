//! A scale that the odometry settles on the way: the track takes the poses of its keyframes, and the map moves with them (decision 38).

use super::track::Segment;
use super::{Engine, FrameState};
use std::collections::BTreeMap;
use std::sync::Arc;
use vidar_core::{KeyframeId, LieGroup, OdometryKeyframe, RevisedPose, Se3, Timestamp};

/// Keyframes on either side whose way tells how much longer lengths became about a keyframe when the scale was settled.
const NEAR: usize = 4;

impl Engine<'_> {
    /// The segment of this state, which comes next, takes the poses that its keyframes have by a scale that is settled with it; what was
    /// mapped of them moves with them.
    pub(super) fn settle(&mut self, state: &FrameState, settled: &[RevisedPose]) {
        if let Some(segment) = self.track.segments.get_mut(&state.segment) {
            segment.settle(state.time, settled);
        }
        let (Some(world), Some(track)) = (&mut self.world, self.track.longest()) else { return };
        if world.segment != Some(track.id) {
            return;
        }
        let mut moved = Vec::new();
        for keyframe in &mut world.keyframes {
            let Some(frame) = track.frame(keyframe.stamp.frame_id) else { continue };
            keyframe.world_from_camera = Some(frame.world_from_camera);
            // Its landmarks are put where one instant would have seen them again.
            (keyframe.warp, keyframe.odometry) = (None, frame.odometry.clone());
            moved.push((frame.stamp.frame_id, frame.world_from_camera));
        }
        world.aligner.revise(&moved);
        world.is_resettled = true;
    }
}

impl Segment {
    /// Keyframes of the odometry take the poses `settled`, and frames between two of them move with both. What comes at `now` stays.
    fn settle(&mut self, now: Timestamp, settled: &[RevisedPose]) {
        let settled: BTreeMap<KeyframeId, Se3> =
            settled.iter().map(|s| (s.id, s.world_from_camera)).collect();
        let before: Vec<Se3> = self.odometry.iter().map(|k| k.world_from_camera).collect();
        let pose = |k: &Arc<OdometryKeyframe>| *settled.get(&k.id).unwrap_or(&k.world_from_camera);
        let after: Vec<Se3> = self.odometry.iter().map(pose).collect();
        let mut moves: Vec<(Timestamp, Se3)> = Vec::with_capacity(self.odometry.len() + 1);
        let mut moved_keyframes: BTreeMap<KeyframeId, Arc<OdometryKeyframe>> = BTreeMap::new();
        for (i, keyframe) in self.odometry.iter_mut().enumerate() {
            let to = after[i] * before[i].inverse();
            moves.push((keyframe.state.time, to));
            if settled.contains_key(&keyframe.id) {
                let near = i.saturating_sub(NEAR)..(i + NEAR + 1).min(after.len());
                let scale = path_m(&after[near.clone()]) / path_m(&before[near]);
                settle_keyframe(Arc::make_mut(keyframe), &to, scale);
                moved_keyframes.insert(keyframe.id, keyframe.clone());
            }
        }
        moves.push((now, Se3::IDENTITY));
        for frame in &mut self.frames {
            frame.world_from_camera = moved(&moves, frame.stamp.time, &frame.world_from_camera);
            if let Some(own) = &mut frame.odometry
                && let Some(keyframe) = moved_keyframes.get(&own.id)
            {
                own.clone_from(keyframe);
            }
        }
        if let Some((time, pose)) = &mut self.last {
            *pose = moved(&moves, *time, pose);
        }
    }
}

/// Length of the path along poses, m.
fn path_m(poses: &[Se3]) -> f64 {
    poses.windows(2).map(|p| (p[1].translation - p[0].translation).norm()).sum()
}

/// Moves a keyframe, and makes what it says of lengths `scale` times as long.
fn settle_keyframe(keyframe: &mut OdometryKeyframe, to_from_before: &Se3, scale: f64) {
    keyframe.world_from_camera = *to_from_before * keyframe.world_from_camera;
    keyframe.state.world_from_body = *to_from_before * keyframe.state.world_from_body;
    if scale.is_finite() && scale > 0.0 {
        let velocity = &mut keyframe.state.velocity_in_world;
        *velocity = to_from_before.rotation.act(velocity) * scale;
        for landmark in &mut keyframe.landmarks {
            landmark.inverse_depth /= scale;
            landmark.inverse_depth_std /= scale;
        }
    }
}

/// A pose at a time, moved as the poses before and after it are.
fn moved(moves: &[(Timestamp, Se3)], time: Timestamp, pose: &Se3) -> Se3 {
    let at = moves.partition_point(|(t, _)| *t <= time);
    match (at.checked_sub(1).map(|at| &moves[at]), moves.get(at)) {
        (Some((before, first)), Some((after, second))) => {
            let share = (time - *before).nanos() as f64 / (*after - *before).nanos() as f64;
            (*first * *pose).interpolate(&(*second * *pose), share)
        }
        (Some((_, only)), None) | (None, Some((_, only))) => *only * *pose,
        (None, None) => *pose,
    }
}
