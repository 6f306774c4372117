//! All tracks of the odometry: predicted, measured, gated, detected, dropped.

use super::fixed_parts::FixedParts;
use super::search::{self, BORDER_PX, Found, Prediction, is_known};
use super::track::{HostImage, InverseDistance, Measurer, Track, rotated_pixel, unknown_distance};
use crate::frontend::{Detection, Detector, DetectorConfig, Feature, MatchFailure, OccupancyGrid};
use nalgebra::Vector2;
use std::sync::Arc;
use vidar_core::{CameraModel, FrameId, LandmarkId, LieGroup, Se3};

/// Frames in a row without being found after which a track without and with known distance is given up.
const MAX_MISSED_SEED: u32 = 1;
const MAX_MISSED_KNOWN: u32 = 3;

/// Observations of a seed that there is room for without asking: as many as a window holds frames.
const SEEN_FRAMES: usize = 24;

/// Fewest corners of an image in which tracks begin that are to carry a state.
pub(crate) const MIN_CORNERS: usize = 40;

/// What happened to the tracks in one image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct TrackCounts {
    pub landmarks_tried: usize,
    pub landmarks_found: usize,
    pub seeds_tried: usize,
    pub seeds_found: usize,
}

/// Holds and measures tracks.
#[derive(Debug)]
pub(crate) struct Tracker {
    camera: CameraModel,
    pub tracks: Vec<Track>,
    measurer: Measurer,
    detector: Detector,
    grid: OccupancyGrid,
    fixed_parts: FixedParts,
    /// Tracks that ended in the newest image because they move with the camera.
    pub fixed: Vec<LandmarkId>,
    /// Whether fewer than half of the tracks were where the newest image was predicted to show them.
    is_astray: bool,
    found: Vec<Result<Found, MatchFailure>>,
    detections: Vec<Detection>,
    next_id: u32,
}

impl Tracker {
    pub fn new(camera: CameraModel, noise_gray: f64) -> Self {
        let detector = Detector::new(DetectorConfig::default());
        let grid = detector.grid(camera.width(), camera.height());
        Self {
            fixed_parts: FixedParts::new(&grid, camera.width()),
            fixed: Vec::new(),
            is_astray: false,
            found: Vec::new(),
            camera,
            tracks: Vec::new(),
            measurer: Measurer::new(noise_gray),
            detector,
            grid,
            detections: Vec::new(),
            next_id: 0,
        }
    }

    /// A tracker without tracks that knows which parts of the image are fixed.
    pub fn another(&self) -> Self {
        let fresh = Self::new(self.camera.clone(), self.measurer.noise_gray());
        Self { fixed_parts: self.fixed_parts.clone(), ..fresh }
    }

    /// Share of the image that shows what moves with the camera, the largest at a time.
    pub fn fixed_share(&self) -> f64 {
        self.fixed_parts.share()
    }

    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// Measures every track in `current`; tracks that are lost for good are dropped. Measurements are those of a global
    /// shutter at the image's time.
    pub fn measure(&mut self, current: &HostImage, prediction: &Prediction<'_>) -> TrackCounts {
        let frame = current.frame;
        let (tracks, found) = (&mut self.tracks, &mut self.found);
        self.is_astray =
            search::find_all(&self.camera, &mut self.measurer, tracks, current, prediction, found);
        let mut counts = TrackCounts::default();
        let mut found = self.found.iter();
        self.tracks.retain_mut(|track| {
            if prediction.poses.world_from_camera(track.host.frame).is_none() {
                found.next();
                return false;
            }
            let (tried, count) = if track.is_landmark {
                (&mut counts.landmarks_tried, &mut counts.landmarks_found)
            } else {
                (&mut counts.seeds_tried, &mut counts.seeds_found)
            };
            *tried += 1;
            match found.next() {
                Some(&Ok(Found { pixel, measurement, .. })) => {
                    *count += 1;
                    track.last_pixel = pixel;
                    track.last_global_pixel = measurement.pixel;
                    track.last_frame = frame;
                    if !track.is_landmark {
                        track.observations.push((frame, measurement));
                    }
                    track.found += 1;
                    track.missed = 0;
                    track.measured = Some(measurement);
                    track.moved_px = track.moved_px.max((pixel - track.feature.pixel).norm());
                    true
                }
                failed => {
                    track.measured = None;
                    track.missed += 1;
                    let limit = if is_known(&track.distance, prediction.has_translation) {
                        MAX_MISSED_KNOWN
                    } else {
                        MAX_MISSED_SEED
                    };
                    track.missed < limit && !matches!(failed, Some(Err(MatchFailure::OutsideImage)))
                }
            }
        });
        self.end_fixed(frame, prediction);
        counts
    }

    /// Ends tracks that move with the camera: they stay while at least half as many that began in the same image have moved. Where nearly all stay, the
    /// body is at rest and the gyroscope's bias seems to turn it: a rendered flight that began on the ground lost two fifths of its picture.
    fn end_fixed(&mut self, frame: FrameId, prediction: &Prediction<'_>) {
        self.fixed.clear();
        let stays = |t: &Track| t.measured.is_some() && FixedParts::stays(t.moved_px);
        let should_move = |t: &Track| {
            let world_from_host = prediction.poses.world_from_camera(t.host.frame)?;
            let current_from_host = prediction.world_from_current.inverse() * world_from_host;
            Some(self.fixed_parts.should_move(by_turn_px(&self.camera, t, &current_from_host)))
        };
        for track in self.tracks.iter().filter(|t| stays(t) && should_move(t) == Some(true)) {
            let beside = || self.tracks.iter().filter(|t| t.host.frame == track.host.frame);
            let moved = beside().filter(|t| FixedParts::moves(t.moved_px)).count();
            if 2 * moved >= beside().filter(|t| stays(t)).count() {
                self.fixed.push(track.id);
            }
        }
        for id in &self.fixed {
            let Some(at) = self.tracks.iter().position(|t| t.id == *id) else { continue };
            let track = self.tracks.remove(at);
            self.fixed_parts.add(&self.grid, &track.last_pixel, frame);
        }
    }

    /// Forgets that `id` was found in this image, as if it had been missed.
    pub fn reject(&mut self, id: LandmarkId) {
        if let Some(track) = self.tracks.iter_mut().find(|t| t.id == id) {
            track.measured = None;
            track.missed += 1;
        }
    }

    /// How many tracks could begin in an image, if there were none.
    pub fn corners(&mut self, image: &HostImage) -> usize {
        self.grid.clear();
        self.fixed_parts.take(&mut self.grid, image.frame);
        self.detector.detect(&image.pyramid, &self.grid, &mut self.detections);
        self.detections.len()
    }

    /// Starts tracks in the free cells of `host`, at most `limit`, with distances as `typical_inverse`.
    pub fn detect(&mut self, host: &Arc<HostImage>, limit: usize, typical_inverse: f64) -> usize {
        self.grid.clear();
        for track in self.tracks.iter().filter(|t| t.measured.is_some()) {
            self.grid.take(&track.last_pixel);
        }
        self.fixed_parts.take(&mut self.grid, host.frame);
        let drift = self.common_drift();
        let mut detections = std::mem::take(&mut self.detections);
        self.detector.detect(&host.pyramid, &self.grid, &mut detections);
        let before = self.tracks.len();
        for detection in detections.iter() {
            if self.tracks.len() - before >= limit {
                break;
            }
            if !self.camera.contains(&detection.pixel, BORDER_PX) {
                continue;
            }
            let global_pixel = host.shutter.remove_motion(&self.camera, &detection.pixel, typical_inverse);
            let feature = Feature::new(&self.camera, detection.pixel, detection.level, detection.kind)
                .and_then(|f| f.with_global_pixel(&self.camera, global_pixel));
            let Some(feature) = feature else { continue };
            let track = self.fresh_track(host, feature, unknown_distance(typical_inverse));
            self.tracks.push(Track { drift, ..track });
        }
        self.detections = detections;
        self.tracks.len() - before
    }

    /// What the predictions of the newest image's tracks were off by in common, pixels per second: a translation past what is near, a stabiliser that takes turns
    /// back.
    fn common_drift(&self) -> Vector2<f64> {
        if !self.is_astray {
            return Vector2::zeros();
        }
        let measured = self.tracks.iter().filter(|t| t.measured.is_some() && t.drift != Vector2::zeros());
        search::median(measured.map(|t| t.drift)).unwrap_or_default()
    }

    fn fresh_track(&mut self, host: &Arc<HostImage>, feature: Feature, distance: InverseDistance) -> Track {
        let id = LandmarkId(self.next_id);
        self.next_id = self.next_id.wrapping_add(1);
        Track {
            id,
            host: host.clone(),
            feature,
            distance,
            is_landmark: false,
            last_pixel: feature.pixel,
            last_global_pixel: feature.global_pixel,
            last_frame: host.frame,
            moved_px: 0.0,
            drift: Vector2::zeros(),
            keyframe_pixel: Some(feature.global_pixel),
            observations: Vec::with_capacity(SEEN_FRAMES),
            found: 1,
            missed: 0,
            measured: None,
        }
    }
}

/// How far the camera's turn alone moves a track from where it began, pixels.
fn by_turn_px(camera: &CameraModel, track: &Track, current_from_host: &Se3) -> f64 {
    let began = &track.feature.global_pixel;
    rotated_pixel(camera, began, current_from_host).map_or(0.0, |turned| (turned - began).norm())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::{Pyramid, testbed};
    use crate::gyro_alignment::RollingShutter;
    use crate::tracking::CameraPoses;
    use vidar_core::Image;

    /// Rows from here on show the carrier.
    const CARRIER_FROM: usize = 180;

    /// Poses of the views by number, turns alone.
    struct Turns(Vec<Se3>);

    impl CameraPoses for Turns {
        fn world_from_camera(&self, frame: FrameId) -> Option<Se3> {
            self.0.get(frame.index()).copied()
        }
    }

    /// A view whose lower quarter is the same in all of them, or is that of the world.
    fn host(view: usize, with_carrier: bool) -> Arc<HostImage> {
        let image = &testbed::scene().views[view].image;
        let painted = |x: usize, y: usize| ((x / 6 * 7919 + y / 6 * 104_729) % 31 * 7) as u8;
        let image = Image::from_fn(image.width(), image.height(), |x, y| {
            if with_carrier && y >= CARRIER_FROM { painted(x, y) } else { image[(x, y)] }
        });
        let pyramid = Pyramid::of(&image, testbed::LEVELS);
        Arc::new(HostImage { frame: FrameId(view as u32), pyramid, shutter: RollingShutter::default() })
    }

    /// Measures all tracks in image `view`, `secs` after the one before; how many ended as fixed.
    fn measure(tracker: &mut Tracker, poses: &Turns, view: usize, image: &HostImage, secs: f64) -> usize {
        let prediction = Prediction {
            poses,
            world_from_current: poses.0[view],
            current_from_last: poses.0[view].inverse() * poses.0[view - 1],
            has_translation: false,
            may_be_stabilised: true,
            last: FrameId(view as u32 - 1),
            secs,
        };
        tracker.measure(image, &prediction);
        tracker.fixed.len()
    }

    /// Follows all views by their turns; the tracker, and how many tracks ended as fixed.
    fn followed(with_carrier: bool) -> (Tracker, usize) {
        let scene = testbed::scene();
        let turn = |v: &testbed::View| Se3::new(v.world_from_camera.rotation, nalgebra::Vector3::zeros());
        let poses = Turns(scene.views.iter().map(turn).collect());
        let mut tracker = Tracker::new(scene.camera.clone(), 3.0);
        let begun = tracker.detect(&host(0, with_carrier), 400, 0.4);
        assert!(begun > MIN_CORNERS, "{begun}");
        let mut fixed = 0;
        for view in 1..scene.views.len() {
            let secs = testbed::OFFSETS_SECS[view] - testbed::OFFSETS_SECS[view - 1];
            fixed += measure(&mut tracker, &poses, view, &host(view, with_carrier), secs);
        }
        (tracker, fixed)
    }

    #[test]
    fn what_moves_with_the_camera_is_neither_followed_nor_begun_again() {
        let on_carrier = |t: &&Track| t.last_pixel.y > CARRIER_FROM as f64 + 4.0;
        let (mut tracker, fixed) = followed(true);
        assert!(fixed > 10, "{fixed}");
        let last = host(testbed::OFFSETS_SECS.len() - 1, true);
        let left = tracker.tracks.iter().filter(on_carrier).count();
        tracker.detect(&last, 400, 0.4);
        let again = tracker.tracks.iter().filter(on_carrier).count() - left;
        assert!(left * 5 < fixed, "{left} of {fixed} still followed");
        assert!(again * 2 < fixed, "{again} begun again in {fixed} cells");
        assert!(tracker.tracks.iter().filter(|t| !on_carrier(t)).count() > 30);

        let (_, fixed) = followed(false);
        assert_eq!(fixed, 0, "of the world");
    }

    #[test]
    fn a_body_at_rest_with_a_biased_gyroscope_shows_the_world() {
        let scene = testbed::scene();
        let turn = |k: usize| LieGroup::exp(&nalgebra::Vector3::new(0.0, 0.02 * k as f64, 0.0));
        let poses = Turns((0..6).map(|k| Se3::new(turn(k), nalgebra::Vector3::zeros())).collect());
        let mut tracker = Tracker::new(scene.camera.clone(), 3.0);
        let begun = tracker.detect(&host(0, false), 400, 0.4);
        for k in 1..6 {
            let mut again = Arc::into_inner(host(0, false)).unwrap();
            again.frame = FrameId(k as u32);
            assert_eq!(measure(&mut tracker, &poses, k, &again, 0.05), 0);
        }
        assert!(tracker.tracks.len() * 2 > begun, "{} of {begun}", tracker.tracks.len());
    }
}
