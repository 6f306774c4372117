//! The odometry while it runs: predict, measure, smooth, choose keyframes, keep the window small.

mod image_prediction;
mod keyframes;
mod seeds;
mod standstill;

pub(crate) use seeds::{ASSUMED_LANDMARKS, ASSUMED_LOG_STD};

use super::search::{CameraPoses, Prediction};
use super::standstill::{ImageMotion, tracks_in};
use super::track::TrackRecord;
use super::track::{HostImage, Track, noisy_covariance};
use super::tracker::{TrackCounts, Tracker};
use crate::backend::{MarginalisationReport, Observation, OptimiseReport, Smoother, SmootherError};
use crate::config::OdometryConfig;
use crate::frontend::{ImageAligner, PixelMeasurement};
use crate::imu::{NavState, Preintegration};
use crate::pipeline::TrackSummary;
use crate::stages::{Stage, StageClock};
use standstill::{ZERO_MOTION_SIGMA_M, ZERO_MOTION_SIGMA_RAD, ZERO_VELOCITY_SIGMA_MPS};
use std::sync::Arc;
use vidar_core::{CameraModel, FrameId, LandmarkId, LieGroup, Se3, Timestamp};

/// A frame that arrives.
pub(crate) struct FrameInput {
    pub host: Arc<HostImage>,
    /// In the clock of the IMU.
    pub time: Timestamp,
    /// IMU measurements since the frame before.
    pub preintegration: Option<Preintegration>,
    /// Whether the IMU feels no motion.
    pub imu_still: bool,
}

/// What one image did.
#[derive(Debug, Default)]
pub(crate) struct StepReport {
    pub counts: TrackCounts,
    /// χ² of the window's observations per degree of freedom.
    pub chi2_per_dof: f64,
    /// Landmarks whose observation in this image fits.
    pub fitting: usize,
    /// Landmarks whose observation in this image contradicts the others.
    pub contradicting: usize,
    pub is_keyframe: bool,
    pub is_still: bool,
    /// This image began the state.
    pub just_started: bool,
    /// Keyframes that left the window, with their last poses.
    pub left: Vec<(FrameId, NavState)>,
}

impl StepReport {
    /// What became of the tracks, for the outside.
    pub fn summary(&self) -> TrackSummary {
        TrackSummary {
            landmarks_tried: self.counts.landmarks_tried,
            landmarks_found: self.counts.landmarks_found,
            seeds_tried: self.counts.seeds_tried,
            seeds_found: self.counts.seeds_found,
            contradicting: self.contradicting,
            chi2_per_dof: self.chi2_per_dof,
        }
    }
}

/// The running odometry.
#[derive(Debug)]
pub(crate) struct SlidingWindowOdometry {
    config: OdometryConfig,
    camera: CameraModel,
    pub smoother: Smoother,
    pub tracker: Tracker,
    /// Images of the keyframes held.
    hosts: Vec<Arc<HostImage>>,
    last: FrameId,
    last_host: Option<Arc<HostImage>>,
    /// Pose of the frame before the last.
    before_last: Option<Se3>,
    aligner: ImageAligner,
    last_keyframe: FrameId,
    frames_since_keyframe: u32,
    /// Landmarks that the last keyframe showed.
    keyframe_landmarks: usize,
    /// Whether landmarks have carried the state at any time.
    has_seen: bool,
    /// Typical inverse distance, 1/m.
    typical_inverse: f64,
    motion: ImageMotion,
    /// The frame since which the body stands still, and the time from which its IMU measurements are not yet in the prior.
    rest: Option<(FrameId, Timestamp)>,
    marginalisation: MarginalisationReport,
    report: OptimiseReport,
    scratch: Scratch,
}

/// Memory that is used again in every image.
#[derive(Debug, Default)]
struct Scratch {
    observations: Vec<(Se3, PixelMeasurement)>,
    promoted: Vec<LandmarkId>,
    values: Vec<f64>,
    frames: Vec<FrameId>,
    keyframes: Vec<FrameId>,
}

/// Poses of the frames that the smoother holds.
struct WindowPoses<'a>(&'a Smoother);

impl CameraPoses for WindowPoses<'_> {
    fn world_from_camera(&self, frame: FrameId) -> Option<Se3> {
        Some(self.0.state(frame)?.world_from_body * *self.0.body_from_camera())
    }
}

impl SlidingWindowOdometry {
    /// Takes over a smoother; `hosts` are the images of its keyframes.
    ///
    /// # Errors
    /// A smoother that holds no frame.
    pub fn new(
        config: OdometryConfig,
        smoother: Smoother,
        tracker: Tracker,
        hosts: Vec<Arc<HostImage>>,
        typical_inverse: f64,
    ) -> Result<Self, SmootherError> {
        let (last, ..) = smoother.newest().ok_or(SmootherError::Empty)?;
        let last_keyframe = smoother.keyframes().next_back().unwrap_or(last);
        let camera = smoother.camera().clone();
        let mut tracker = tracker;
        // Tracks go on from the hosts that the smoother's landmarks have.
        tracker.tracks.retain_mut(|track| {
            track.is_landmark = smoother.landmark(track.id).is_some();
            track.observations.clear();
            !track.is_landmark || follow_host(track, &smoother, &hosts, &camera)
        });
        let keyframe_landmarks = tracker.tracks.iter().filter(|t| t.is_landmark).count();
        Ok(Self {
            config,
            camera,
            smoother,
            tracker,
            hosts,
            last,
            last_host: None,
            before_last: None,
            aligner: ImageAligner::new(ImageAligner::FINEST_LEVEL),
            last_keyframe,
            frames_since_keyframe: 0,
            keyframe_landmarks,
            has_seen: false,
            typical_inverse,
            motion: ImageMotion::default(),
            rest: None,
            marginalisation: MarginalisationReport::default(),
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

    /// One image: from its pixels to an estimated state.
    pub fn step(&mut self, input: FrameInput, clock: &mut StageClock) -> Result<StepReport, SmootherError> {
        let frame = input.host.frame;
        let last_state = self.state().unwrap_or(NavState::REST);
        let predicted = input.preintegration.as_ref().map_or(last_state, |r| self.smoother.predict(r));
        let mut step = StepReport::default();
        let image = input.host.clone();

        let is_valid_imu = input.preintegration.as_ref().is_some_and(|r| !r.is_saturated());
        let predicted =
            if is_valid_imu { predicted } else { self.predict_by_image(&input.host, &last_state) };
        self.smoother.add_frame(frame, input.time, predicted, input.preintegration)?;
        clock.lap(Stage::Predict);
        step.counts = self.measure(&input.host, input.time, &last_state, &predicted);
        for fixed in &self.tracker.fixed {
            self.smoother.remove_landmark(*fixed);
        }
        step.is_still =
            self.motion.update(tracks_in(&self.tracker.tracks, frame), input.time) && input.imu_still;
        if step.is_still {
            self.smoother.add_zero_velocity(frame, ZERO_VELOCITY_SIGMA_MPS)?;
            if self.rest.is_some() {
                self.smoother.add_zero_motion(frame, ZERO_MOTION_SIGMA_M, ZERO_MOTION_SIGMA_RAD)?;
            }
        }
        self.observe(frame);
        if !step.is_still {
            self.assume_distances()?;
        }
        clock.lap(Stage::Match);
        self.smoother.optimise_into(self.config.iterations, &mut self.report);
        step.chi2_per_dof = self.report.chi2_per_dof;
        step.contradicting = self.remove_outliers(frame);
        step.fitting = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        clock.lap(Stage::Smooth);
        self.update_seeds(frame)?;
        clock.lap(Stage::Distances);

        step.is_keyframe = match step.is_still {
            // The first frame of a rest stands for all of it.
            true => self.rest.is_none(),
            false => self.keyframe_is_due(&input.host, input.time),
        };
        if step.is_keyframe {
            self.make_keyframe(input.host)?;
        }
        clock.lap(Stage::Keyframe);
        self.last = frame;
        self.update_standstill(&step, input.time)?;
        self.last_host = Some(image);
        self.before_last = Some(last_state.world_from_body);
        self.reduce_window(&mut step)?;
        clock.lap(Stage::Marginalise);
        Ok(step)
    }

    /// Measures all tracks from the predicted pose.
    fn measure(
        &mut self,
        host: &Arc<HostImage>,
        time: Timestamp,
        last: &NavState,
        predicted: &NavState,
    ) -> TrackCounts {
        let body_from_camera = *self.smoother.body_from_camera();
        let world_from_current = predicted.world_from_body * body_from_camera;
        let world_from_last = last.world_from_body * body_from_camera;
        let prediction = Prediction {
            poses: &WindowPoses(&self.smoother),
            world_from_current,
            current_from_last: world_from_current.inverse() * world_from_last,
            has_translation: true,
            may_be_stabilised: self.smoother.shifts_images(),
            last: self.last,
            secs: self.smoother.time(self.last).map_or(0.0, |t| (time - t).as_secs_f64()),
        };
        self.tracker.measure(host, &prediction)
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

    /// Takes observations back that do not fit; a landmark that keeps being an outlier goes. How many of the newest frame's.
    fn remove_outliers(&mut self, frame: FrameId) -> usize {
        let mut in_newest = 0;
        for outlier in &self.report.outliers {
            self.smoother.remove_observation(outlier.frame, outlier.landmark);
            if outlier.frame == frame {
                in_newest += 1;
                self.tracker.reject(outlier.landmark);
            }
            let observations = self.smoother.landmark(outlier.landmark).map_or(0, |l| l.observations);
            if observations < 3 {
                self.smoother.remove_landmark(outlier.landmark);
                self.tracker.tracks.retain(|t| t.id != outlier.landmark);
            }
        }
        in_newest
    }

    /// Memory of IMU measurements that are not needed any more.
    pub fn spare_preintegration(&mut self) -> Option<Preintegration> {
        self.smoother.take_spare()
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
    hosts: &[Arc<HostImage>],
    camera: &CameraModel,
) -> bool {
    let Some(landmark) = smoother.landmark(track.id) else { return false };
    let Some(host) = hosts.iter().find(|h| h.frame == landmark.host) else { return false };
    let Some(pixel) = camera.project(&landmark.bearing) else { return false };
    let shown = host.shutter.add_motion(camera, &pixel, landmark.inverse_distance);
    let feature = crate::frontend::Feature::new(camera, shown, track.feature.level, track.feature.kind)
        .and_then(|f| f.with_global_pixel(camera, pixel));
    let Some(feature) = feature else { return false };
    track.host = host.clone();
    track.feature = feature;
    track.distance.mean = landmark.inverse_distance;
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Pinhole;

    #[test]
    fn a_smoother_without_a_frame_is_refused() {
        let camera = CameraModel::Pinhole(Pinhole::new(458.0, 457.0, 367.0, 248.0, 752, 480).unwrap());
        let config = OdometryConfig::default();
        let smoother = Smoother::new(config.smoother(), camera.clone(), Se3::IDENTITY).unwrap();
        let tracker = Tracker::new(camera, 3.0);
        let refused = SlidingWindowOdometry::new(config, smoother, tracker, Vec::new(), 0.4);
        assert_eq!(refused.unwrap_err(), SmootherError::Empty);
    }
}
