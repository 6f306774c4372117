//! The odometry while it runs: predict, measure, smooth, choose keyframes, keep the window small.

use super::config::OdometryConfig;
use super::output::TrackSummary;
use super::stillness::ImageMotion;
use super::track::TrackRecord;
use super::track::{HostImage, Track, host_covariance, noisy_covariance, parallax, rotated_pixel};
use super::tracker::{Places, Prediction, TrackCounts, Tracker};
use crate::estimator::{Departure, Observation, OptimiseReport, Smoother, SmootherError};
use crate::frontend::{
    AlignmentPoint, AlignmentReference, ImageAligner, ImageAlignmentConfig, MotionPrediction,
    PixelMeasurement,
};
use crate::imu::{NavState, Preintegration};
use std::rc::Rc;
use vidar_core::{CameraModel, FrameId, LandmarkId, LieGroup, Se3, Timestamp};

/// Standard deviation of a motion that is only guessed, rad, and as a share of the scene's distance.
const GUESS_SIGMA_RAD: f64 = 0.1;

/// Recent frames that are held whether they are keyframes or not.
const RECENT_FRAMES: usize = 3;

/// Standard deviations of the velocity of a body that stands still, m/s, and of its motion from image to image, m and rad.
const STANDSTILL_SIGMA_MPS: f64 = 0.01;
const REST_SIGMA_M: f64 = 5e-4;
const REST_SIGMA_RAD: f64 = 2e-4;

/// Readings of a rest are put into the prior after this long, s.
const REST_FOLD_SECS: f64 = 1.0;

/// Mean chi-square per measurement (two degrees of freedom) up to which a young track's distance is believed.
const DISTANCE_GATE: f64 = 9.0;

/// A young track becomes a landmark when its distance is known to this share...
const PROMOTION_RELATIVE_STD: f64 = 0.25;
/// ... its parallax is at least this, rad ...
const PROMOTION_PARALLAX: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// ... and it was found in this many frames.
const PROMOTION_FOUND: u32 = 4;

/// A new keyframe is due when fewer than this share of the last one's landmarks are found ...
const KEYFRAME_SHARE: f64 = 0.6;
/// ... or the median parallax to it exceeds this, pixels at 460 px focal length ...
const KEYFRAME_PARALLAX_PX: f64 = 20.0;
/// ... or this time has passed, s; never before the third frame.
const KEYFRAME_SECS: f64 = 3.0;
const KEYFRAME_MIN_FRAMES: u32 = 3;

/// With fewer tracks than this, keyframes are this many frames apart.
const BLIND_TRACKS: usize = 10;
const BLIND_FRAMES: u32 = 10;

/// Keyframes that share less than this of their landmarks with the newest frame leave first.
const KEYFRAME_FORGOTTEN_SHARE: f64 = 0.1;

/// A frame that arrives.
pub(crate) struct Shot {
    pub host: Rc<HostImage>,
    /// In the clock of the IMU.
    pub time: Timestamp,
    /// Readings since the frame before.
    pub readings: Option<Preintegration>,
    /// Whether the IMU feels no motion.
    pub imu_still: bool,
}

/// What one image did.
#[derive(Debug, Default)]
pub(crate) struct Step {
    pub counts: TrackCounts,
    /// Mean squared misfit of the window's sightings per degree of freedom.
    pub chi2_per_dof: f64,
    /// Landmarks whose sighting in this image fits.
    pub fitting: usize,
    /// Landmarks whose sighting in this image contradicts the others.
    pub contradicting: usize,
    pub is_keyframe: bool,
    pub is_still: bool,
    /// This image began the state.
    pub just_started: bool,
    /// Keyframes that left the window, with their last poses.
    pub left: Vec<(FrameId, NavState)>,
}

impl Step {
    /// What became of the tracks, for the outside.
    pub fn summary(&self) -> TrackSummary {
        TrackSummary {
            landmarks_tried: self.counts.landmarks_tried,
            landmarks_found: self.counts.landmarks_found,
            young_tried: self.counts.young_tried,
            young_found: self.counts.young_found,
            contradicting: self.contradicting,
            chi2_per_dof: self.chi2_per_dof,
        }
    }
}

/// The running odometry.
#[derive(Debug)]
pub(crate) struct Running {
    config: OdometryConfig,
    camera: CameraModel,
    pub smoother: Smoother,
    pub tracker: Tracker,
    /// Images of the keyframes held.
    hosts: Vec<Rc<HostImage>>,
    last: FrameId,
    last_host: Option<Rc<HostImage>>,
    /// Pose of the frame before the last.
    before_last: Option<Se3>,
    aligner: ImageAligner,
    last_keyframe: FrameId,
    frames_since_keyframe: u32,
    /// Landmarks that the last keyframe showed.
    keyframe_landmarks: usize,
    /// Typical inverse distance, 1/m.
    typical_inverse: f64,
    motion: ImageMotion,
    /// The frame since which the body stands still, and the time from which its readings are not yet in the prior.
    rest: Option<(FrameId, Timestamp)>,
    departure: Departure,
    report: OptimiseReport,
    scratch: Scratch,
}

/// Memory that is used again in every image.
#[derive(Debug, Default)]
struct Scratch {
    sightings: Vec<(Se3, PixelMeasurement)>,
    promoted: Vec<LandmarkId>,
    values: Vec<f64>,
    frames: Vec<FrameId>,
    keyframes: Vec<FrameId>,
}

/// Poses of the frames that the smoother holds.
struct Held<'a>(&'a Smoother);

impl Places for Held<'_> {
    fn world_from_camera(&self, frame: FrameId) -> Option<Se3> {
        Some(self.0.state(frame)?.world_from_body * *self.0.body_from_camera())
    }
}

impl Running {
    /// Takes over a smoother that holds at least one frame; `hosts` are the images of its keyframes.
    pub fn new(
        config: OdometryConfig,
        smoother: Smoother,
        tracker: Tracker,
        hosts: Vec<Rc<HostImage>>,
        typical_inverse: f64,
    ) -> Option<Self> {
        let (last, ..) = smoother.newest()?;
        let last_keyframe = smoother.keyframes().next_back().unwrap_or(last);
        let camera = smoother.camera().clone();
        let mut tracker = tracker;
        // Tracks go on from the hosts that the smoother's landmarks have.
        tracker.tracks.retain_mut(|track| {
            track.is_landmark = smoother.landmark(track.id).is_some();
            track.seen.clear();
            !track.is_landmark || follow_host(track, &smoother, &hosts, &camera)
        });
        let keyframe_landmarks = tracker.tracks.iter().filter(|t| t.is_landmark).count();
        Some(Self {
            config,
            camera,
            smoother,
            tracker,
            hosts,
            last,
            last_host: None,
            before_last: None,
            aligner: ImageAligner::new(ImageAlignmentConfig::default()),
            last_keyframe,
            frames_since_keyframe: 0,
            keyframe_landmarks,
            typical_inverse,
            motion: ImageMotion::default(),
            rest: None,
            departure: Departure::default(),
            report: OptimiseReport::default(),
            scratch: Scratch::default(),
        })
    }

    /// The newest state.
    pub fn state(&self) -> Option<NavState> {
        self.smoother.newest().map(|(_, _, state)| *state)
    }

    /// All tracks as the newest image shows them.
    pub fn records(&self) -> Vec<TrackRecord> {
        let seen = self.tracker.tracks.iter().filter_map(|t| Some((t, t.measured?.pixel)));
        seen.map(|(track, pixel)| {
            let landmark = self.smoother.landmark(track.id);
            let inverse_distance = landmark.map_or_else(
                || [track.distance.mean, track.distance.variance.sqrt()],
                |l| [l.inverse_distance, l.inverse_distance_sigma],
            );
            let expected = self.smoother.predict_pixel(self.last, track.id);
            TrackRecord {
                id: track.id,
                level: track.feature.level,
                is_landmark: track.is_landmark,
                pixel,
                residual: expected.map(|e| pixel - e),
                inverse_distance,
            }
        })
        .collect()
    }

    /// One image: the road from its pixels to a smoothed state.
    pub fn step(&mut self, shot: Shot) -> Result<Step, SmootherError> {
        let frame = shot.host.frame;
        let last_state = self.state().unwrap_or(NavState::REST);
        let predicted = shot.readings.as_ref().map_or(last_state, |r| r.predict(&last_state));
        let mut step = Step::default();
        let image = shot.host.clone();

        let believed = shot.readings.as_ref().is_some_and(|r| !r.is_saturated());
        let predicted = if believed { predicted } else { self.predict_by_image(&shot.host, &last_state) };
        self.smoother.add_frame(frame, shot.time, predicted, shot.readings)?;
        step.counts = self.measure(&shot.host, shot.time, &last_state, &predicted);
        step.is_still = self.motion.update(&self.tracker.tracks, frame, shot.time) && shot.imu_still;
        if step.is_still {
            self.smoother.add_standstill(frame, STANDSTILL_SIGMA_MPS)?;
            if self.rest.is_some() {
                self.smoother.add_rest(frame, REST_SIGMA_M, REST_SIGMA_RAD)?;
            }
        }
        self.observe(frame);
        self.smoother.optimise_into(self.config.iterations, &mut self.report);
        step.chi2_per_dof = self.report.chi2_per_dof;
        step.contradicting = self.remove_outliers(frame);
        step.fitting = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        self.know_young_tracks(frame)?;

        step.is_keyframe = match step.is_still {
            // The first frame of a rest stands for all of it.
            true => self.rest.is_none(),
            false => self.keyframe_is_due(frame, shot.time),
        };
        if step.is_keyframe {
            self.make_keyframe(shot.host)?;
        }
        self.last = frame;
        self.rest_or_move(&step, shot.time)?;
        self.last_host = Some(image);
        self.before_last = Some(last_state.world_from_body);
        self.thin_window(&mut step)?;
        Ok(step)
    }

    /// The body stands at the newest frame, which is a keyframe.
    pub fn stand(&mut self, time: Timestamp) {
        self.rest = Some((self.last, time));
        self.motion.stand(&self.tracker.tracks, self.last, time);
    }

    /// Holds a rest of any length by its first frame and the newest one.
    fn rest_or_move(&mut self, step: &Step, time: Timestamp) -> Result<(), SmootherError> {
        if !step.is_still {
            self.rest = None;
            return Ok(());
        }
        let Some((first, folded)) = self.rest else {
            self.rest = Some((self.last, time));
            return Ok(());
        };
        let (newest, between) = (self.last, self.smoother.frames().rev().nth(1));
        if let Some(between) = between.filter(|b| *b != first) {
            self.smoother.drop_frame(between, &mut self.departure)?;
        }
        if (time - folded).as_secs_f64() < REST_FOLD_SECS {
            return Ok(());
        }
        if let Some(stays) = self.smoother.rest_in_place(&mut self.departure)? {
            self.last = stays;
            for track in self.tracker.tracks.iter_mut().filter(|t| t.last_frame == newest) {
                track.last_frame = stays;
                track.seen.retain(|(frame, _)| *frame != newest);
            }
        }
        self.rest = Some((first, time));
        Ok(())
    }

    /// The pose without an IMU: the last motion goes on, and the last image's patches correct it.
    fn predict_by_image(&mut self, host: &Rc<HostImage>, last: &NavState) -> NavState {
        let body_from_camera = *self.smoother.body_from_camera();
        let last_from_before = self.before_last.map_or(Se3::IDENTITY, |b| b.inverse() * last.world_from_body);
        let mut predicted = NavState { world_from_body: last.world_from_body * last_from_before, ..*last };
        let Some(reference) = self.last_host.clone() else { return predicted };
        let world_from_last = last.world_from_body * body_from_camera;
        let last_from_world = world_from_last.inverse();
        let points: Vec<AlignmentPoint> = self
            .tracker
            .tracks
            .iter()
            .filter(|t| t.is_landmark && t.last_frame == self.last)
            .filter_map(|t| {
                let distance = last_from_world.act(&self.smoother.landmark(t.id)?.in_world).norm();
                let bearing = self.camera.unproject(&t.last_pixel)?;
                Some(AlignmentPoint { pixel: t.last_pixel, bearing, inverse_distance: 1.0 / distance })
            })
            .collect();
        let motion = (predicted.world_from_body * body_from_camera).inverse() * world_from_last;
        let loose = [GUESS_SIGMA_RAD, GUESS_SIGMA_RAD, GUESS_SIGMA_RAD];
        let far = GUESS_SIGMA_RAD / self.typical_inverse;
        let sigmas = nalgebra::Vector6::new(loose[0], loose[1], loose[2], far, far, far);
        let prediction = MotionPrediction {
            current_from_anchor: motion,
            information: nalgebra::Matrix6::from_diagonal(&sigmas.map(|s| 1.0 / (s * s))),
        };
        let references = [AlignmentReference {
            pyramid: &reference.pyramid,
            anchor_from_reference: Se3::IDENTITY,
            points: &points,
        }];
        let found = self.aligner.align(&self.camera, &references, &host.pyramid, &prediction);
        if found.converged {
            let world_from_camera = world_from_last * found.current_from_anchor.inverse();
            predicted.world_from_body = world_from_camera * body_from_camera.inverse();
        }
        predicted
    }

    /// Measures all tracks from the predicted pose.
    fn measure(
        &mut self,
        host: &Rc<HostImage>,
        time: Timestamp,
        last: &NavState,
        predicted: &NavState,
    ) -> TrackCounts {
        let body_from_camera = *self.smoother.body_from_camera();
        let world_from_current = predicted.world_from_body * body_from_camera;
        let world_from_last = last.world_from_body * body_from_camera;
        let prediction = Prediction {
            places: &Held(&self.smoother),
            world_from_current,
            current_from_last: world_from_current.inverse() * world_from_last,
            has_translation: true,
            last: self.last,
            secs: self.smoother.time(self.last).map_or(0.0, |t| (time - t).as_secs_f64()),
        };
        self.tracker.measure(&host.pyramid, host.frame, &prediction)
    }

    /// Tells the smoother where the image shows its landmarks.
    fn observe(&mut self, frame: FrameId) {
        let noise = self.config.pixel_noise_px;
        for track in self.tracker.tracks.iter_mut().filter(|t| t.is_landmark) {
            let Some(measured) = &track.measured else { continue };
            let seen = observation(frame, track.id, measured, noise);
            if self.smoother.add_observation(&seen).is_err() {
                track.measured = None;
                track.missed += 1;
            }
        }
    }

    /// Takes sightings back that do not fit; a landmark that keeps misfitting goes. How many of the newest frame's.
    fn remove_outliers(&mut self, frame: FrameId) -> usize {
        let mut in_newest = 0;
        for outlier in &self.report.outliers {
            self.smoother.remove_observation(outlier.frame, outlier.landmark);
            if outlier.frame == frame {
                in_newest += 1;
                self.tracker.reject(outlier.landmark);
            }
            let sightings = self.smoother.landmark(outlier.landmark).map_or(0, |l| l.sightings);
            if sightings < 3 {
                self.smoother.remove_landmark(outlier.landmark);
                self.tracker.tracks.retain(|t| t.id != outlier.landmark);
            }
        }
        in_newest
    }

    /// Estimates the distances of young tracks and hands those that are known well enough to the smoother.
    fn know_young_tracks(&mut self, frame: FrameId) -> Result<(), SmootherError> {
        let held = Held(&self.smoother);
        let Some(world_from_current) = held.world_from_camera(frame) else { return Ok(()) };
        let measured = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        let mut room = self.config.max_landmarks.saturating_sub(measured);
        let (scratch, camera) = (&mut self.scratch.sightings, &self.camera);
        let mut promoted = std::mem::take(&mut self.scratch.promoted);
        promoted.clear();
        self.tracker.tracks.retain_mut(|track| {
            if track.is_landmark || track.measured.is_none() {
                return true;
            }
            let Some(world_from_host) = held.world_from_camera(track.host.frame) else { return false };
            track.seen.retain(|(f, _)| held.0.state(*f).is_some());
            scratch.clear();
            scratch.extend(
                track
                    .seen
                    .iter()
                    .filter_map(|(f, m)| Some((held.world_from_camera(*f)?.inverse() * world_from_host, *m))),
            );
            let prior = super::track::unknown_distance(self.typical_inverse);
            let Some(belief) = prior.updated(camera, &track.feature, scratch, DISTANCE_GATE) else {
                return false;
            };
            track.distance = belief;
            let current_from_host = world_from_current.inverse() * world_from_host;
            let apart = parallax(&track.feature, belief.mean, &current_from_host);
            let known = belief.relative_std() < PROMOTION_RELATIVE_STD && apart > PROMOTION_PARALLAX;
            if known && track.found >= PROMOTION_FOUND && room > 0 {
                room -= 1;
                track.is_landmark = true;
                promoted.push(track.id);
            }
            true
        });
        for id in &promoted {
            self.hand_over(*id)?;
        }
        self.scratch.promoted = promoted;
        Ok(())
    }

    /// Makes a track a landmark of the smoother, with all that the window's frames saw of it.
    fn hand_over(&mut self, id: LandmarkId) -> Result<(), SmootherError> {
        let Some(at) = self.tracker.tracks.iter().position(|t| t.id == id) else { return Ok(()) };
        let track = &self.tracker.tracks[at];
        let host = Observation {
            frame: track.host.frame,
            landmark: id,
            pixel: track.feature.pixel,
            covariance: host_covariance(track),
        };
        self.smoother.add_landmark(&host, track.distance.mean)?;
        for (frame, measured) in &track.seen {
            let seen = observation(*frame, id, measured, self.config.pixel_noise_px);
            if *frame != track.host.frame && self.smoother.add_observation(&seen).is_err() {
                // A sighting of no use; the others remain.
                continue;
            }
        }
        self.tracker.tracks[at].seen.clear();
        Ok(())
    }

    /// Memory of readings that are not needed any more.
    pub fn spare_readings(&mut self) -> Option<Preintegration> {
        self.smoother.take_spare()
    }

    fn keyframe_is_due(&mut self, frame: FrameId, time: Timestamp) -> bool {
        self.frames_since_keyframe += 1;
        let tracked = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        let young = self.tracker.tracks.iter().filter(|t| !t.is_landmark && t.measured.is_some()).count();
        let since =
            self.smoother.time(self.last_keyframe).map_or(f64::INFINITY, |t| (time - t).as_secs_f64());
        if since > KEYFRAME_SECS {
            return true;
        }
        if self.frames_since_keyframe < KEYFRAME_MIN_FRAMES {
            return false;
        }
        if tracked + young < BLIND_TRACKS && self.frames_since_keyframe < BLIND_FRAMES {
            // Nothing to see: more keyframes would only push out those that know the scene.
            return false;
        }
        let few = (tracked as f64) < KEYFRAME_SHARE * self.keyframe_landmarks as f64
            || tracked + young < self.config.max_landmarks / 2;
        few || self.median_parallax_px(frame) > KEYFRAME_PARALLAX_PX * self.focal_px() / 460.0
    }

    fn focal_px(&self) -> f64 {
        self.camera.intrinsics().fx
    }

    /// Median motion of pixels since the last keyframe that no rotation explains.
    fn median_parallax_px(&mut self, frame: FrameId) -> f64 {
        let held = Held(&self.smoother);
        let places = (held.world_from_camera(frame), held.world_from_camera(self.last_keyframe));
        let (Some(current), Some(keyframe)) = places else { return f64::INFINITY };
        let current_from_keyframe = current.inverse() * keyframe;
        let (moved, camera) = (&mut self.scratch.values, &self.camera);
        moved.clear();
        moved.extend(self.tracker.tracks.iter().filter_map(|t| {
            let (measured, then) = (t.measured?, t.keyframe_pixel?);
            Some((measured.pixel - rotated_pixel(camera, &then, &current_from_keyframe)?).norm())
        }));
        if moved.is_empty() {
            return f64::INFINITY;
        }
        let middle = moved.len() / 2;
        *moved.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// Marks the newest frame a keyframe and starts tracks in it.
    fn make_keyframe(&mut self, host: Rc<HostImage>) -> Result<(), SmootherError> {
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
        let Some(world_from_camera) = Held(&self.smoother).world_from_camera(frame) else { return };
        let camera_from_world = world_from_camera.inverse();
        let mut distances: Vec<f64> = self
            .tracker
            .tracks
            .iter()
            .filter(|t| t.is_landmark && t.measured.is_some())
            .filter_map(|t| Some(camera_from_world.act(&self.smoother.landmark(t.id)?.in_world).norm()))
            .collect();
        if distances.len() >= 10 {
            let middle = distances.len() / 2;
            let median = *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
            self.typical_inverse = 1.0 / median.clamp(0.1, 100.0);
        }
    }

    /// Drops frames and keyframes that are too many.
    fn thin_window(&mut self, step: &mut Step) -> Result<(), SmootherError> {
        let (mut frames, mut keyframes) =
            (std::mem::take(&mut self.scratch.frames), std::mem::take(&mut self.scratch.keyframes));
        frames.clear();
        keyframes.clear();
        frames.extend(self.smoother.frames());
        keyframes.extend(self.smoother.keyframes());
        let recent_from = frames.len().saturating_sub(RECENT_FRAMES);
        for frame in &frames[..recent_from] {
            if !keyframes.contains(frame) {
                self.smoother.drop_frame(*frame, &mut self.departure)?;
            }
        }
        if keyframes.len() > self.config.max_keyframes
            && let Some(leaving) = self.keyframe_to_remove(&keyframes)
        {
            step.left.extend(self.smoother.state(leaving).map(|s| (leaving, *s)));
            self.smoother.marginalise(leaving, &mut self.departure)?;
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

    /// The keyframe that is needed least: one that shows little of what is seen now, else by the distance score of
    /// Engel, Koltun, Cremers, "Direct Sparse Odometry", 2016, section 3.1; the two newest stay.
    fn keyframe_to_remove(&self, keyframes: &[FrameId]) -> Option<FrameId> {
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

/// A measurement as the smoother takes it.
fn observation(
    frame: FrameId,
    landmark: LandmarkId,
    measured: &PixelMeasurement,
    noise_px: f64,
) -> Observation {
    Observation { frame, landmark, pixel: measured.pixel, covariance: noisy_covariance(measured, noise_px) }
}

/// Lets a track continue with the host that the smoother gave its landmark.
fn follow_host(
    track: &mut Track,
    smoother: &Smoother,
    hosts: &[Rc<HostImage>],
    camera: &CameraModel,
) -> bool {
    let Some(landmark) = smoother.landmark(track.id) else { return false };
    let Some(host) = hosts.iter().find(|h| h.frame == landmark.host) else { return false };
    let Some(pixel) = camera.project(&landmark.bearing) else { return false };
    let Some(feature) = crate::frontend::Feature::new(camera, pixel, track.feature.level, track.feature.kind)
    else {
        return false;
    };
    track.host = host.clone();
    track.feature = feature;
    track.distance.mean = landmark.inverse_distance;
    true
}
