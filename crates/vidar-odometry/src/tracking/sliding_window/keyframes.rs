//! Which frames become keyframes, and which keyframes leave.

use super::{SlidingWindowOdometry, StepReport, WindowPoses, follow_host};
use crate::backend::SmootherError;
use crate::tracking::CameraPoses;
use crate::tracking::{HostImage, MIN_CORNERS, rotated_pixel};
use std::sync::Arc;
use vidar_core::{FrameId, LieGroup, Timestamp};
use vidar_solve::statistics::median_upper;

/// Recent frames that are held whether they are keyframes or not.
const RECENT_FRAMES: usize = 3;

/// A new keyframe is due when fewer than this share of the last one's landmarks are found ...
const KEYFRAME_SHARE: f64 = 0.6;
/// ... or the median parallax to it exceeds this, pixels at 460 px focal length ...
const KEYFRAME_PARALLAX_PX: f64 = 20.0;
/// ... or this time has passed, s; never before the third frame.
const KEYFRAME_SECS: f64 = 3.0;
const KEYFRAME_MIN_FRAMES: u32 = 3;

/// With fewer tracks than this, keyframes are this many frames apart, unless the image shows so many corners that tracks can begin.
const BLIND_TRACKS: usize = 10;
const BLIND_FRAMES: u32 = 10;

/// Keyframes that share less than this of their landmarks with the newest frame leave first.
const KEYFRAME_FORGOTTEN_SHARE: f64 = 0.1;

impl SlidingWindowOdometry {
    pub(super) fn keyframe_is_due(&mut self, image: &HostImage, time: Timestamp) -> bool {
        let frame = image.frame;
        self.frames_since_keyframe += 1;
        let tracked = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        let seeds = self.tracker.tracks.iter().filter(|t| !t.is_landmark && t.measured.is_some()).count();
        let since =
            self.smoother.time(self.last_keyframe).map_or(f64::INFINITY, |t| (time - t).as_secs_f64());
        self.has_seen |= tracked >= BLIND_TRACKS;
        if since > KEYFRAME_SECS {
            return true;
        }
        if self.frames_since_keyframe < KEYFRAME_MIN_FRAMES {
            return false;
        }
        if tracked + seeds < BLIND_TRACKS && self.frames_since_keyframe < BLIND_FRAMES {
            // With nothing to see more keyframes would only push out those that know the scene. A state that has not seen anything yet waits, too:
            // its tracks may fail for a clock that is not known, and would fail again.
            return self.has_seen && self.tracker.corners(image) >= MIN_CORNERS;
        }
        let few = (tracked as f64) < KEYFRAME_SHARE * self.keyframe_landmarks as f64
            || tracked + seeds < self.config.max_landmarks / 2;
        few || self.median_parallax_px(frame) > KEYFRAME_PARALLAX_PX * self.focal_px() / 460.0
    }

    fn focal_px(&self) -> f64 {
        self.camera.intrinsics().fx
    }

    /// Median motion of pixels since the last keyframe that no rotation explains.
    fn median_parallax_px(&mut self, frame: FrameId) -> f64 {
        let held = WindowPoses(&self.smoother);
        let places = (held.world_from_camera(frame), held.world_from_camera(self.last_keyframe));
        let (Some(current), Some(keyframe)) = places else { return f64::INFINITY };
        let current_from_keyframe = current.inverse() * keyframe;
        let (moved, camera) = (&mut self.scratch.values, &self.camera);
        moved.clear();
        moved.extend(self.tracker.tracks.iter().filter_map(|t| {
            let (measured, then) = (t.measured?, t.keyframe_pixel?);
            Some((measured.pixel - rotated_pixel(camera, &then, &current_from_keyframe)?).norm())
        }));
        median_upper(moved).unwrap_or(f64::INFINITY)
    }

    /// Marks the newest frame a keyframe and starts tracks in it.
    pub(super) fn make_keyframe(&mut self, host: Arc<HostImage>) -> Result<(), SmootherError> {
        self.smoother.mark_keyframe(host.frame)?;
        self.last_keyframe = host.frame;
        self.frames_since_keyframe = 0;
        self.update_typical_distance(host.frame);
        for track in &mut self.tracker.tracks {
            track.keyframe_pixel = track.measured.map(|m| m.pixel);
        }
        let held = self.tracker.tracks.iter().filter(|t| t.measured.is_some()).count();
        let limit = (2 * self.config.max_landmarks).saturating_sub(held);
        self.tracker.detect(&host, limit, self.typical_inverse);
        self.keyframe_landmarks =
            self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        self.hosts.push(host);
        Ok(())
    }

    fn update_typical_distance(&mut self, frame: FrameId) {
        let Some(world_from_camera) = WindowPoses(&self.smoother).world_from_camera(frame) else { return };
        let camera_from_world = world_from_camera.inverse();
        let mut distances: Vec<f64> = self
            .tracker
            .tracks
            .iter()
            .filter(|t| t.is_landmark && t.measured.is_some())
            .filter_map(|t| Some(camera_from_world.act(&self.smoother.landmark(t.id)?.in_world).norm()))
            .collect();
        if let Some(median) = median_upper(&mut distances).filter(|_| distances.len() >= 10) {
            self.typical_inverse = 1.0 / median.clamp(0.1, 100.0);
        }
    }

    /// Drops frames and keyframes that are too many.
    pub(super) fn reduce_window(&mut self, step: &mut StepReport) -> Result<(), SmootherError> {
        let (mut frames, mut keyframes) =
            (std::mem::take(&mut self.scratch.frames), std::mem::take(&mut self.scratch.keyframes));
        frames.clear();
        keyframes.clear();
        frames.extend(self.smoother.frames());
        keyframes.extend(self.smoother.keyframes());
        let recent_from = frames.len().saturating_sub(RECENT_FRAMES);
        for frame in &frames[..recent_from] {
            if !keyframes.contains(frame) {
                self.smoother.drop_frame(*frame, &mut self.marginalisation)?;
            }
        }
        if keyframes.len() > self.config.max_keyframes
            && let Some(leaving) = self.keyframe_to_remove(&keyframes)
        {
            step.left.extend(self.smoother.state(leaving).map(|s| (leaving, *s)));
            self.smoother.marginalise(leaving, &mut self.marginalisation)?;
            self.hosts.retain(|h| h.frame != leaving);
            self.follow_new_hosts(leaving);
        }
        (self.scratch.frames, self.scratch.keyframes) = (frames, keyframes);
        Ok(())
    }

    /// Landmarks of a keyframe that left live on with a newer host; their patches are taken from there.
    fn follow_new_hosts(&mut self, left: FrameId) {
        let (smoother, hosts, camera) = (&self.smoother, &self.hosts, &self.camera);
        self.tracker.tracks.retain_mut(|track| {
            if track.host.frame != left {
                return true;
            }
            track.is_landmark && follow_host(track, smoother, hosts, camera)
        });
    }

    /// The keyframe that is needed least: one that the newest repeats (a rest that began again: keyframes that saw motion know the scale, those at rest do not),
    /// one that shows little of what is seen now, else by the distance score of Engel, Koltun, Cremers, "Direct Sparse Odometry", 2016, section 3.1;
    /// of the last two the two newest stay.
    fn keyframe_to_remove(&self, keyframes: &[FrameId]) -> Option<FrameId> {
        if let Some(repeated) = self.smoother.repeated_keyframe(self.typical_inverse) {
            return Some(repeated);
        }
        let candidates = &keyframes[..keyframes.len().saturating_sub(2)];
        let newest = self.last;
        let forgotten = candidates.iter().find(|k| {
            let (mut seen, mut shared) = (0_usize, 0_usize);
            for landmark in self.smoother.seen_by(**k) {
                seen += 1;
                shared += usize::from(self.smoother.sees(newest, landmark));
            }
            (shared as f64) < KEYFRAME_FORGOTTEN_SHARE * seen as f64 || seen == 0
        });
        if let Some(forgotten) = forgotten {
            return Some(*forgotten);
        }
        let place = |f: &FrameId| self.smoother.state(*f).map(|s| s.world_from_body.translation);
        let here = place(&newest)?;
        let score = |k: &FrameId| {
            let at = place(k)?;
            let crowd: f64 = keyframes
                .iter()
                .filter(|o| *o != k)
                .filter_map(|o| Some(1.0 / ((place(o)? - at).norm() + 1e-3)))
                .sum();
            Some((at - here).norm().sqrt() * crowd)
        };
        let mut best: Option<(f64, FrameId)> = None;
        for keyframe in candidates {
            let Some(score) = score(keyframe) else { continue };
            if best.is_none_or(|(most, _)| score > most) {
                best = Some((score, *keyframe));
            }
        }
        best.map(|(_, keyframe)| keyframe)
    }
}
