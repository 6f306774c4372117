//! The fixed-lag smoother: keyframes and recent frames with full inertial states, landmarks, and a square-root prior.
//!
//! Per image: [`Smoother::add_frame`] → observations → [`Smoother::optimise`] → [`Smoother::drop_frame`] of a recent
//! frame that is no keyframe, or [`Smoother::marginalise`] of a keyframe that leaves. A dropped frame's IMU measurements are
//! joined to its neighbour's, so nothing inertial is lost; a marginalised frame becomes part of the prior by QR
//! (Demmel et al., "Square root marginalization for sliding-window bundle adjustment", ICCV 2021), and whatever the
//! linearisation, shift and heading stay unobservable ([`Linearisation`] says how).
//!
//! Landmarks are a bearing and an inverse distance in their host keyframe; they are eliminated one by one (Schur) while
//! optimising, and by Householder reflections when they enter the prior.

mod config;
mod covariance;
mod delay;
mod dense;
mod error;
mod estimates;
mod evidence;
mod image_shift;
mod inertial;
mod linearise;
mod link;
mod marginalise;
mod optimise;
mod own_value;
mod prior;
mod products;
mod reprojection;
mod standstill;
mod system;
mod visual;
mod window;

pub use config::{Linearisation, SmootherConfig};
pub use covariance::CalibrationEstimate;
pub(crate) use covariance::d_relative_d_poses;
pub(crate) use dense::dot;
pub use error::SmootherError;
pub(crate) use evidence::FrameUnknown;
pub use inertial::GaugePriorSigmas;
pub(crate) use inertial::{
    Shift, Whitening, gauge_prior_at, jacobians as inertial_jacobians, residual as inertial_residual,
};
pub use marginalise::MarginalisationReport;
pub use optimise::{OptimiseReport, Outlier};
pub(crate) use products::product;
pub(crate) use visual::{bearing_plus, tangent_basis, whitening};
pub use window::{LandmarkEstimate, Observation};

use crate::imu::{NavState, Preintegration};
use nalgebra::{Matrix2, Vector2};
use prior::Prior;
use rustc_hash::FxHashMap;
use system::System;
use vidar_core::{CameraModel, FrameId, LandmarkId, Se3, Timestamp};
use window::{CalibrationState, Frame, GaugePrior, ImuFactor, Landmark, LandmarkObservation};

/// The smoother; see the module's head.
#[derive(Clone, Debug)]
pub struct Smoother {
    config: SmootherConfig,
    camera: CameraModel,
    calibration: CalibrationState,
    frames: Vec<Frame>,
    landmarks: Vec<Landmark>,
    /// Slots of `landmarks` that are free.
    free: Vec<usize>,
    slots: FxHashMap<LandmarkId, usize>,
    gauge_prior: Option<GaugePrior>,
    prior: Prior,
    system: System,
    spare: Vec<Preintegration>,
    workspace: marginalise::Workspace,
}

impl Smoother {
    /// An empty smoother for one camera on a body.
    ///
    /// # Errors
    /// A setting outside its range.
    pub fn new(
        config: SmootherConfig,
        camera: CameraModel,
        body_from_camera: Se3,
    ) -> Result<Self, SmootherError> {
        config.validate()?;
        let frames = config.max_frames + 1;
        let mut slots = FxHashMap::default();
        slots.reserve(1024);
        Ok(Self {
            camera,
            calibration: CalibrationState::new(body_from_camera),
            frames: Vec::with_capacity(frames),
            landmarks: Vec::with_capacity(512),
            free: Vec::with_capacity(512),
            slots,
            gauge_prior: None,
            prior: Prior::default(),
            system: System::with_capacity(18 * frames + window::CALIBRATION_DIM),
            spare: Vec::with_capacity(8),
            workspace: marginalise::Workspace::default(),
            config,
        })
    }

    /// Settings in force.
    pub fn config(&self) -> &SmootherConfig {
        &self.config
    }

    /// Begins with one frame, with `sigmas` the standard deviations of its `state`. Everything held before is discarded.
    ///
    /// # Errors
    /// A state that is not finite.
    pub fn start(
        &mut self,
        id: FrameId,
        time: Timestamp,
        state: NavState,
        sigmas: GaugePriorSigmas,
    ) -> Result<(), SmootherError> {
        self.start_about(id, time, state, state, sigmas)
    }

    /// As [`Smoother::start`], with a first guess that differs from the mean of the gauge prior, `reference`.
    ///
    /// # Errors
    /// A state that is not finite.
    pub fn start_about(
        &mut self,
        id: FrameId,
        time: Timestamp,
        guess: NavState,
        reference: NavState,
        sigmas: GaugePriorSigmas,
    ) -> Result<(), SmootherError> {
        if !guess.is_finite() || !reference.is_finite() {
            return Err(SmootherError::BadState(id));
        }
        self.clear();
        self.system.factorised = false;
        self.frames.push(Frame::new(id, time, guess, None));
        self.gauge_prior = Some(GaugePrior { frame: 0, reference, sigmas });
        Ok(())
    }

    /// Forgets all frames, landmarks and the prior; calibration stays.
    pub fn clear(&mut self) {
        for frame in self.frames.drain(..) {
            self.spare.extend(frame.imu_factor.map(|imu_factor| imu_factor.preintegration));
        }
        self.free.clear();
        self.slots.clear();
        self.landmarks.clear();
        self.gauge_prior = None;
        self.prior.clear();
    }

    /// Adds the next frame with a first guess of its state. `time` is its image's stamp plus
    /// [`Smoother::next_frame_offset`]; `IMU measurements` run from the newest frame's time to this one's;
    /// without them the frame hangs on its images alone (and its velocity and biases are left as given).
    ///
    /// # Errors
    /// A full window, a frame that is not later than the newest, a state that is not finite.
    pub fn add_frame(
        &mut self,
        id: FrameId,
        time: Timestamp,
        state: NavState,
        preintegration: Option<Preintegration>,
    ) -> Result<(), SmootherError> {
        if !state.is_finite() {
            return Err(SmootherError::BadState(id));
        }
        if self.frames.len() >= self.config.max_frames {
            return Err(SmootherError::Full { held: self.frames.len() });
        }
        if let Some(newest) = self.frames.last().filter(|f| f.time >= time) {
            return Err(SmootherError::NotNext { id, time, newest: newest.time });
        }
        self.system.factorised = false;
        let clock_secs = self.next_frame_offset().as_secs_f64();
        let image_shift = image_shift::ImageShift::new(self.next_image_shift(preintegration.as_ref()));
        let frame = Frame::new(id, time, state, preintegration.map(ImuFactor::new));
        self.frames.push(Frame { clock_secs, image_shift, ..frame });
        Ok(())
    }

    /// Makes a frame a keyframe: only keyframes host landmarks, and only [`Smoother::marginalise`] removes them.
    ///
    /// # Errors
    /// A frame that the window does not hold.
    pub fn mark_keyframe(&mut self, id: FrameId) -> Result<(), SmootherError> {
        let at = self.index(id)?;
        self.frames[at].keyframe = true;
        Ok(())
    }

    /// Says that the body stands still at a frame, up to `sigma_mps` per axis.
    ///
    /// # Errors
    /// A frame that the window does not hold.
    pub fn add_zero_velocity(&mut self, id: FrameId, sigma_mps: f64) -> Result<(), SmootherError> {
        let at = self.index(id)?;
        self.system.factorised = false;
        self.frames[at].standstill_sigma = (sigma_mps > 0.0 && sigma_mps.is_finite()).then_some(sigma_mps);
        Ok(())
    }

    /// Adds a landmark hosted by `host.frame`, seen there at `host.pixel` with `host.covariance`, at `1 /
    /// inverse_distance` metres along the ray.
    ///
    /// # Errors
    /// A host that the window does not hold, a landmark that exists, measurements that are of no use.
    pub fn add_landmark(&mut self, host: &Observation, inverse_distance: f64) -> Result<(), SmootherError> {
        let bad = |what, found: String| SmootherError::BadMeasurement {
            what,
            landmark: host.landmark,
            frame: host.frame,
            found,
        };
        let frame = self.index(host.frame)?;
        if self.slots.contains_key(&host.landmark) {
            return Err(SmootherError::Twice { landmark: host.landmark, frame: host.frame });
        }
        let observation = self.observation(host, frame)?;
        let bearing = self.camera.unproject(&host.pixel).ok_or_else(|| {
            bad("pixel", format!("({:.2}, {:.2}) has no bearing", host.pixel.x, host.pixel.y))
        })?;
        if !inverse_distance.is_finite() {
            return Err(bad("inverse distance", inverse_distance.to_string()));
        }
        let rho = inverse_distance.max(window::MIN_INVERSE_DISTANCE);
        let slot = self.free.pop().unwrap_or_else(|| {
            self.landmarks.push(Landmark::empty());
            self.landmarks.len() - 1
        });
        self.landmarks[slot].begin(host.landmark, observation, bearing, rho);
        self.slots.insert(host.landmark, slot);
        Ok(())
    }

    /// Assumes that the inverse distance of a landmark of which no parallax is known yet is `median` (1/m), its logarithm up to `log_sigma`.
    ///
    /// A landmark of which nothing else is known this way says that a body whose images show no parallax does not move far
    /// (undelayed initialisation: Civera, Davison, Montiel, "Inverse depth parametrization for monocular SLAM", 2008).
    pub(crate) fn assume_distance(&mut self, landmark: LandmarkId, median: f64, log_sigma: f64) {
        if let Some(&slot) = self.slots.get(&landmark) {
            self.system.factorised = false;
            let valid = log_sigma > 0.0 && median > 0.0;
            self.landmarks[slot].prior = valid.then_some(window::DistancePrior { median, log_sigma });
        }
    }

    /// Adds what a frame sees of a landmark.
    ///
    /// # Errors
    /// A frame or landmark that is unknown, a second observation in one frame, measurements that are of no use.
    pub fn add_observation(&mut self, seen: &Observation) -> Result<(), SmootherError> {
        let frame = self.index(seen.frame)?;
        let slot = *self.slots.get(&seen.landmark).ok_or(SmootherError::NoSuchLandmark(seen.landmark))?;
        if self.landmarks[slot].sees(frame) {
            return Err(SmootherError::Twice { landmark: seen.landmark, frame: seen.frame });
        }
        let observation = self.observation(seen, frame)?;
        self.system.factorised = false;
        self.landmarks[slot].insert(observation);
        Ok(())
    }

    /// Takes back what a frame saw of a landmark; says whether there was anything. The host's observation stays.
    pub fn remove_observation(&mut self, frame: FrameId, landmark: LandmarkId) -> bool {
        let (Ok(frame), Some(&slot)) = (self.index(frame), self.slots.get(&landmark)) else { return false };
        let observations = &mut self.landmarks[slot].observations;
        let before = observations.len();
        observations.retain(|s| s.frame != frame);
        self.system.factorised = false;
        observations.len() < before
    }

    /// Forgets a landmark; says whether there was one. What is in the prior of it stays.
    pub fn remove_landmark(&mut self, landmark: LandmarkId) -> bool {
        let Some(slot) = self.slots.remove(&landmark) else { return false };
        self.system.factorised = false;
        self.landmarks[slot].end();
        self.free.push(slot);
        true
    }

    fn observation(&self, seen: &Observation, frame: usize) -> Result<LandmarkObservation, SmootherError> {
        let bad = |what, found: String| SmootherError::BadMeasurement {
            what,
            landmark: seen.landmark,
            frame: seen.frame,
            found,
        };
        let finite = |v: &Vector2<f64>| v.x.is_finite() && v.y.is_finite();
        if !finite(&seen.pixel) {
            return Err(bad("pixel", format!("({}, {})", seen.pixel.x, seen.pixel.y)));
        }
        let whitening = whitening(&seen.covariance).ok_or_else(|| {
            let c: &Matrix2<f64> = &seen.covariance;
            bad("covariance", format!("[{} {}; {} {}]", c[(0, 0)], c[(0, 1)], c[(1, 0)], c[(1, 1)]))
        })?;
        Ok(LandmarkObservation { frame, seen: seen.pixel, pixel: seen.pixel, whitening, chi2: 0.0 })
    }

    fn index(&self, id: FrameId) -> Result<usize, SmootherError> {
        self.frames.iter().position(|f| f.id == id).ok_or(SmootherError::NoSuchFrame(id))
    }
}

#[cfg(test)]
mod tests;
