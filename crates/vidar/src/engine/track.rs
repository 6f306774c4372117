//! Track: every image gets a metric pose, by visual-inertial odometry or from a given trajectory.

use super::{FrameStamp, FrameState, PoseReport, PoseSource};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use vidar_core::remap::{ImageWarp, RowMotion};
use vidar_core::{Duration, FrameId, LensMotion, LieGroup, OdometryKeyframe, Se3, Timestamp};
use vidar_odometry::Joined;
use vidar_solve::statistics::median_upper;

/// A frame with its metric pose.
#[derive(Clone, Debug)]
pub struct PosedFrame {
    /// The image.
    pub stamp: FrameStamp,
    /// Pose of its camera, m.
    pub world_from_camera: Se3,
    /// The odometry's keyframe of the image, if it is one.
    pub odometry: Option<Arc<OdometryKeyframe>>,
}

/// A span of images whose poses share one world.
#[derive(Debug)]
pub struct Segment {
    /// Its number.
    pub id: u32,
    /// Images with a pose of their own.
    pub images: usize,
    /// Candidates for keyframes, in the order of time.
    pub frames: Vec<PosedFrame>,
    /// Every keyframe of the odometry, in the order of time.
    pub odometry: Vec<Arc<OdometryKeyframe>>,
    pub(super) last: Option<(Timestamp, Se3)>,
}

/// Longest span over which a camera's motion is taken: two images at 10 Hz.
const MAX_MOTION_SPAN: Duration = Duration::from_millis(210);
/// Time within which the odometry's keyframes tell the depth of what an image shows.
const SAME_SCENE: Duration = Duration::from_millis(1000);

impl Segment {
    /// How a frame's image differs from what the calibrated camera would show at one instant; none where it does not.
    pub fn image_warp(&self, frame: FrameId, readout: Duration) -> Option<ImageWarp> {
        let time = self.frame(frame)?.stamp.time;
        let rows = if readout > Duration::ZERO { self.row_motion(frame, readout) } else { None };
        let lens = self.lens(time);
        (rows.is_some() || lens != LensMotion::NONE).then_some(ImageWarp { rows, lens })
    }

    /// How the lens had moved at a time, linear between the odometry's keyframes.
    fn lens(&self, time: Timestamp) -> LensMotion {
        let after = self.odometry.partition_point(|k| k.state.time < time);
        let at = |k: usize| self.odometry.get(k).map(|k| (k.state.time, k.lens));
        match (after.checked_sub(1).and_then(at), at(after)) {
            (Some((from, before)), Some((until, next))) => {
                before.towards(&next, (time - from).as_secs_f64() / (until - from).as_secs_f64())
            }
            (one, other) => one.or(other).map_or(LensMotion::NONE, |(_, lens)| lens),
        }
    }

    /// How the rows of a frame were read, by the poses of the frames before and after it, and by the landmarks of the odometry's
    /// nearest keyframe. None where the frames are far apart.
    fn row_motion(&self, frame: FrameId, readout: Duration) -> Option<RowMotion> {
        let at = self.index(frame)?;
        let own = &self.frames[at];
        let (before, after) = (&self.frames[at.saturating_sub(1)], self.frames.get(at + 1).unwrap_or(own));
        let span = after.stamp.time - before.stamp.time;
        if span <= Duration::ZERO || span > MAX_MOTION_SPAN {
            return None;
        }
        let turned = before.world_from_camera.rotation.inverse() * after.world_from_camera.rotation;
        let moved = after.world_from_camera.translation - before.world_from_camera.translation;
        Some(RowMotion {
            // Turning about one axis between the two, the frame between them has the same rate in its own axes.
            turn_rad_per_s: turned.log() / span.as_secs_f64(),
            velocity_m_per_s: own.world_from_camera.rotation.inverse() * moved / span.as_secs_f64(),
            inverse_depth: self.inverse_depth(own.stamp.time),
            readout_secs: readout.as_secs_f64(),
        })
    }

    /// A frame of it.
    pub fn frame(&self, frame: FrameId) -> Option<&PosedFrame> {
        self.index(frame).map(|at| &self.frames[at])
    }

    fn index(&self, frame: FrameId) -> Option<usize> {
        self.frames.binary_search_by_key(&frame, |f| f.stamp.frame_id).ok()
    }

    /// Median inverse depth of the landmarks near a time, 1/m; zero without any.
    fn inverse_depth(&self, time: Timestamp) -> f64 {
        let distance = |k: &&Arc<OdometryKeyframe>| (k.state.time - time).nanos().abs();
        let nearest = self.odometry.iter().min_by_key(distance);
        let near = nearest.filter(|k| distance(k) <= SAME_SCENE.nanos());
        let mut inverse: Vec<f64> =
            near.map_or_else(Vec::new, |k| k.landmarks.iter().map(|l| l.inverse_depth).collect());
        median_upper(&mut inverse).filter(|rho| *rho > 0.0).unwrap_or(0.0)
    }
}

/// The poses of all images so far, by segment.
#[derive(Debug, Default)]
pub struct Track {
    /// Candidates whose pose is not decided yet.
    waiting: VecDeque<FrameStamp>,
    pub(super) segments: BTreeMap<u32, Segment>,
    max_gap: Duration,
    /// Candidates without a pose.
    pub without_pose: usize,
}

impl Track {
    /// No image yet. An image that the odometry could not use gets a pose between two others at most `max_gap` apart.
    pub fn new(max_gap: Duration) -> Self {
        Self { max_gap, ..Self::default() }
    }

    /// An image that may become a keyframe.
    pub fn add_candidate(&mut self, stamp: FrameStamp) {
        self.waiting.push_back(stamp);
    }

    /// Takes a report; candidates up to its time get their poses.
    pub fn add(&mut self, report: PoseReport) -> Option<FrameState> {
        match report {
            PoseReport::NotPosed { time } => {
                while self.waiting.front().is_some_and(|w| w.time <= time) {
                    self.waiting.pop_front();
                    self.without_pose += 1;
                }
                None
            }
            PoseReport::Posed { state, keyframe, joined, .. } => {
                joined.iter().for_each(|joined| self.join(joined));
                self.add_pose(state, keyframe.map(|k| Arc::new(*k)));
                Some(state)
            }
        }
    }

    /// One segment becomes part of another.
    fn join(&mut self, joined: &Joined) {
        let Some(mut segment) = self.segments.remove(&joined.segment) else { return };
        let moved = |pose: &mut Se3| *pose = joined.into_from_segment * *pose;
        for frame in &mut segment.frames {
            moved(&mut frame.world_from_camera);
            frame.odometry.iter_mut().for_each(|k| joined.apply_to_keyframe(Arc::make_mut(k)));
        }
        segment.odometry.iter_mut().for_each(|k| joined.apply_to_keyframe(Arc::make_mut(k)));
        segment.last.iter_mut().for_each(|(_, pose)| moved(pose));
        segment.id = joined.into;
        let Some(into) = self.segments.get_mut(&joined.into) else {
            self.segments.insert(joined.into, segment);
            return;
        };
        into.images += segment.images;
        into.frames.extend(segment.frames);
        into.frames.sort_by_key(|f| f.stamp.time);
        into.odometry.extend(segment.odometry);
        into.odometry.sort_by_key(|k| k.state.time);
        into.last = [into.last, segment.last].into_iter().flatten().max_by_key(|(time, _)| *time);
    }

    fn add_pose(&mut self, state: FrameState, keyframe: Option<Arc<OdometryKeyframe>>) {
        let FrameState { frame_id, time, segment, world_from_camera } = state;
        let segment = self.segments.entry(segment).or_insert_with(|| Segment {
            id: segment,
            images: 0,
            frames: Vec::new(),
            odometry: Vec::new(),
            last: None,
        });
        segment.images += 1;
        segment.odometry.extend(keyframe.clone());
        while let Some(stamp) = self.waiting.front().copied().filter(|w| w.time <= time) {
            self.waiting.pop_front();
            let is_this = stamp.frame_id == frame_id;
            let pose = match is_this {
                true => Some(world_from_camera),
                false => between(segment.last, (time, world_from_camera), stamp.time, self.max_gap),
            };
            match pose {
                Some(world_from_camera) => segment.frames.push(PosedFrame {
                    stamp,
                    world_from_camera,
                    odometry: keyframe.clone().filter(|_| is_this),
                }),
                None => self.without_pose += 1,
            }
        }
        segment.last = Some((time, world_from_camera));
    }

    /// No further report will come.
    pub fn finish(&mut self) {
        self.without_pose += self.waiting.len();
        self.waiting.clear();
    }

    /// The segment with the most images, the first of equally long ones; none below two images.
    pub fn longest(&self) -> Option<&Segment> {
        let longest = self.segments.values().max_by_key(|s| (s.images, std::cmp::Reverse(s.id)));
        longest.filter(|s| s.images >= 2)
    }
}

/// The frames of the longest segment that `poses`, which need no sensors, give these candidates.
pub fn longest_posed(
    poses: &mut dyn PoseSource,
    candidates: &[FrameStamp],
    max_gap: Duration,
) -> Vec<PosedFrame> {
    let mut track = Track::new(max_gap);
    for stamp in candidates {
        track.add_candidate(*stamp);
        for report in poses.push_stamp(stamp) {
            track.add(report);
        }
    }
    track.finish();
    track.longest().map_or_else(Vec::new, |s| s.frames.clone())
}

/// The pose between two others, if they are close enough in time.
fn between(
    before: Option<(Timestamp, Se3)>,
    after: (Timestamp, Se3),
    time: Timestamp,
    max_gap: Duration,
) -> Option<Se3> {
    let (start, from) = before?;
    let span = after.0 - start;
    if span > max_gap || span <= Duration::ZERO || time < start {
        return None;
    }
    Some(from.interpolate(&after.1, (time - start).nanos() as f64 / span.nanos() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector2, Vector3};
    use vidar_core::CameraId;

    fn stamp(i: u32) -> FrameStamp {
        let time = Timestamp::from_nanos(i64::from(i) * 100_000_000);
        FrameStamp { frame_id: FrameId(i), time, camera: CameraId(0) }
    }

    fn posed(i: u32, segment: u32) -> PoseReport {
        let world_from_camera = Se3::from_translation(Vector3::new(f64::from(i), 0.0, 0.0));
        PoseReport::known(&stamp(i), Some((segment, world_from_camera)), None)
    }

    #[test]
    fn the_longest_segment_is_the_track_and_the_first_of_two_equal_ones() {
        let mut track = Track::new(Duration::from_millis(500));
        (0..10).for_each(|i| track.add_candidate(stamp(i)));
        assert!(track.longest().is_none());
        for i in 0..4 {
            track.add(posed(i, 0));
        }
        track.add(PoseReport::NotPosed { time: stamp(4).time });
        for i in 5..9 {
            track.add(posed(i, 1));
        }
        assert_eq!(track.longest().unwrap().id, 0);
        track.add(posed(9, 1));
        let longest = track.longest().unwrap();
        let ids: Vec<u32> = longest.frames.iter().map(|f| f.stamp.frame_id.0).collect();
        assert_eq!((longest.id, ids, track.without_pose), (1, vec![5, 6, 7, 8, 9], 1));
    }

    #[test]
    fn the_rows_of_a_frame_were_read_as_its_neighbours_say() {
        let rate = Vector3::new(0.2, -0.5, 0.1);
        let frame = |i: u32| {
            let secs = f64::from(i) * 0.1;
            let rotation = vidar_core::So3::exp(&(rate * secs));
            let translation = Vector3::new(0.3 * secs, 0.0, 0.0);
            PosedFrame { stamp: stamp(i), world_from_camera: Se3::new(rotation, translation), odometry: None }
        };
        let frames: Vec<PosedFrame> = [0, 1, 2, 7].into_iter().map(frame).collect();
        let segment = Segment { id: 0, images: 4, frames, odometry: Vec::new(), last: None };
        let motion = segment.row_motion(FrameId(1), Duration::from_millis(20)).unwrap();
        assert!((motion.turn_rad_per_s - rate).norm() < 1e-9, "{motion:?}");
        let velocity = segment.frames[1].world_from_camera.rotation * motion.velocity_m_per_s;
        assert!((velocity - Vector3::new(0.3, 0.0, 0.0)).norm() < 1e-9, "{motion:?}");
        assert_eq!((motion.readout_secs, motion.inverse_depth), (0.02, 0.0));
        // Half a second says nothing of a hand.
        assert!(segment.row_motion(FrameId(2), Duration::from_millis(20)).is_none());
        assert!(segment.row_motion(FrameId(5), Duration::from_millis(20)).is_none());
    }

    #[test]
    fn the_lens_of_a_frame_is_between_where_it_is_in_the_keyframes_around_it() {
        let lens = |share: f64| LensMotion {
            log_focal: share,
            shift: Vector2::new(-share, 0.5 * share),
            ..LensMotion::NONE
        };
        let keyframe = |i: u32, share: f64| {
            Arc::new(OdometryKeyframe { lens: lens(share), ..crate::engine::tests::settled::keyframe(i) })
        };
        let frames = [0, 1, 2, 4, 5].map(|i| PosedFrame {
            stamp: FrameStamp { time: keyframe(i, 0.0).state.time, ..stamp(i) },
            world_from_camera: Se3::IDENTITY,
            odometry: None,
        });
        let odometry = vec![keyframe(1, 0.004), keyframe(4, 0.010)];
        let mut segment = Segment { id: 0, images: 5, frames: frames.into(), odometry, last: None };
        let of = |segment: &Segment, i: u32| segment.image_warp(FrameId(i), Duration::ZERO);
        for (i, expected) in [(0, 0.004), (1, 0.004), (2, 0.006), (4, 0.010), (5, 0.010)] {
            let found = of(&segment, i).unwrap();
            let off = found.lens.shift - lens(expected).shift;
            assert!((found.lens.log_focal - expected).abs() < 1e-12 && off.norm() < 1e-12, "{i}: {found:?}");
            assert!(found.rows.is_none(), "{i}: {found:?}");
        }
        segment.odometry.iter_mut().for_each(|k| Arc::make_mut(k).lens = LensMotion::NONE);
        assert_eq!(of(&segment, 2), None);
    }

    #[test]
    fn an_image_that_the_source_left_out_gets_the_pose_between_its_neighbours_unless_the_gap_is_long() {
        let mut track = Track::new(Duration::from_millis(250));
        (0..8).for_each(|i| track.add_candidate(stamp(i)));
        for i in [0, 1, 3, 7] {
            track.add(posed(i, 0));
        }
        track.finish();
        let x: Vec<f64> =
            track.longest().unwrap().frames.iter().map(|f| f.world_from_camera.translation.x).collect();
        assert_eq!(x.len(), 5);
        assert!((x[2] - 2.0).abs() < 1e-9 && x[4] == 7.0, "{x:?}");
        assert_eq!(track.without_pose, 3);
    }
}
