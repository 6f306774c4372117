//! What the window holds.

use super::delay::Delay;
use super::image_shift::ImageShift;
use super::inertial::{GaugePriorSigmas, Whitening};
use super::visual::bearing_plus;
use crate::imu::{NavState, Preintegration, Vector15};
use nalgebra::{Matrix2, SVector, Vector2, Vector3};
use vidar_core::{FrameId, LandmarkId, LieGroup, Se3, So3, Timestamp};

/// Dimensions of the calibration: camera rotation, camera position, clock offset.
pub(crate) const CALIBRATION_DIM: usize = 7;

/// Place of the clock offset among them.
pub(crate) const OFFSET_AT: usize = 6;

/// Landmarks are held nearer than 10 km, so that the inverse distance stays on the right side of infinity.
pub(crate) const MIN_INVERSE_DISTANCE: f64 = 1e-4;

/// Landmarks are held farther than 5 cm.
pub(crate) const MAX_INVERSE_DISTANCE: f64 = 20.0;

/// What a frame sees of a landmark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// The frame.
    pub frame: FrameId,
    /// The landmark.
    pub landmark: LandmarkId,
    /// Where, in the (distorted) image, pixels.
    pub pixel: Vector2<f64>,
    /// Covariance of `pixel`, px². A wide ellipse along an edge makes an edgelet.
    pub covariance: Matrix2<f64>,
}

/// The estimate of a landmark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LandmarkEstimate {
    /// Its name.
    pub id: LandmarkId,
    /// Keyframe in whose camera it is expressed.
    pub host: FrameId,
    /// Unit direction in the host's camera.
    pub bearing: Vector3<f64>,
    /// Inverse of the distance from the host's camera, 1/m.
    pub inverse_distance: f64,
    /// Standard deviation of `inverse_distance` given the poses, 1/m; infinite before the first optimisation.
    pub inverse_distance_sigma: f64,
    /// Its place in the world, m.
    pub in_world: Vector3<f64>,
    /// Observations in the window, the host's included.
    pub observations: usize,
}

/// IMU measurements since the frame before.
#[derive(Clone, Debug)]
pub(crate) struct ImuFactor {
    pub(crate) preintegration: Preintegration,
    pub(crate) whitening: Whitening,
}

impl ImuFactor {
    pub(crate) fn new(preintegration: Preintegration) -> Self {
        let whitening = Whitening::of(&preintegration);
        Self { preintegration, whitening }
    }

    pub(crate) fn follow(&mut self, state: &NavState) {
        if self.preintegration.follow(&state.bias) {
            self.whitening = Whitening::of(&self.preintegration);
        }
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Frame {
    pub(crate) id: FrameId,
    pub(crate) time: Timestamp,
    /// Clock offset that `time` and the IMU measurements up to it are cut with, s.
    pub(crate) clock_secs: f64,
    pub(crate) keyframe: bool,
    pub(crate) state: NavState,
    /// Linearisation point of the parts that are in the prior.
    pub(crate) linearised: NavState,
    /// `state = linearised ⊞ step` for the parts in the prior.
    pub(crate) step: Vector15,
    pub(crate) pose_in_prior: bool,
    pub(crate) motion_in_prior: bool,
    pub(crate) imu_factor: Option<ImuFactor>,
    pub(crate) standstill_sigma: Option<f64>,
    pub(crate) delay: Delay,
    pub(crate) image_shift: ImageShift,
    /// What is known of the motion since the frame before: that there was none.
    pub(crate) zero_motion: Option<super::standstill::ZeroMotionFactor>,
}

impl Frame {
    pub(crate) fn new(id: FrameId, time: Timestamp, state: NavState, imu_factor: Option<ImuFactor>) -> Self {
        Self {
            id,
            time,
            clock_secs: 0.0,
            keyframe: false,
            state,
            linearised: state,
            step: Vector15::zeros(),
            pose_in_prior: false,
            motion_in_prior: false,
            imu_factor,
            standstill_sigma: None,
            delay: Delay::default(),
            image_shift: ImageShift::default(),
            zero_motion: None,
        }
    }

    /// The state at which derivatives are taken.
    pub(crate) fn at(&self, first_estimates: bool) -> NavState {
        let mut state = self.state;
        if first_estimates && self.pose_in_prior {
            state.world_from_body = self.linearised.world_from_body;
        }
        if first_estimates && self.motion_in_prior {
            state.velocity = self.linearised.velocity;
            state.bias = self.linearised.bias;
        }
        state
    }

    pub(crate) fn enter_prior(&mut self, pose: bool, motion: bool) {
        if pose && !self.pose_in_prior {
            self.pose_in_prior = true;
            self.linearised.world_from_body = self.state.world_from_body;
            self.step.fixed_rows_mut::<6>(0).fill(0.0);
        }
        if motion && !self.motion_in_prior {
            self.motion_in_prior = true;
            self.linearised.velocity = self.state.velocity;
            self.linearised.bias = self.state.bias;
            self.step.fixed_rows_mut::<9>(6).fill(0.0);
        }
    }

    pub(crate) fn apply(&mut self, pose: &SVector<f64, 6>, motion: &SVector<f64, 9>) {
        let three = |v: &[f64], at: usize| Vector3::new(v[at], v[at + 1], v[at + 2]);
        let moved = |from: &Se3, step: &[f64]| {
            Se3::new(from.rotation * So3::exp(&three(step, 0)), from.translation + three(step, 3))
        };
        if self.pose_in_prior {
            let mut step = self.step.fixed_rows_mut::<6>(0);
            step += pose;
            self.state.world_from_body = moved(&self.linearised.world_from_body, &self.step.as_slice()[..6]);
        } else {
            self.state.world_from_body = moved(&self.state.world_from_body, pose.as_slice());
        }
        let m = motion.as_slice();
        if self.motion_in_prior {
            let mut step = self.step.fixed_rows_mut::<9>(6);
            step += motion;
            let m = &self.step.as_slice()[6..];
            self.state.velocity = self.linearised.velocity + three(m, 0);
            self.state.bias.gyro = self.linearised.bias.gyro + three(m, 3);
            self.state.bias.accel = self.linearised.bias.accel + three(m, 6);
        } else {
            self.state.velocity += three(m, 0);
            self.state.bias.gyro += three(m, 3);
            self.state.bias.accel += three(m, 6);
        }
    }
}

/// One observation, with the frame by its place in the window.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LandmarkObservation {
    pub(crate) frame: usize,
    /// Where the image shows it.
    pub(crate) seen: Vector2<f64>,
    /// Where a camera would that is turned as the image is shifted; the same where no image is.
    pub(crate) pixel: Vector2<f64>,
    pub(crate) whitening: Matrix2<f64>,
    /// Squared whitened residual at the last linearisation.
    pub(crate) chi2: f64,
}

/// What is assumed of a distance before any parallax tells it: its inverse (1/m) is log-normal, with this median and
/// standard deviation of the logarithm. On a normal prior of the inverse, a far scene would explain any drift at next to no cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DistancePrior {
    pub(crate) median: f64,
    pub(crate) log_sigma: f64,
}

impl DistancePrior {
    /// Whitened residual at `rho`, and its derivative.
    pub(crate) fn residual(&self, rho: f64) -> (f64, f64) {
        ((rho / self.median).ln() / self.log_sigma, 1.0 / (rho * self.log_sigma))
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Landmark {
    pub(crate) id: LandmarkId,
    pub(crate) alive: bool,
    pub(crate) host: LandmarkObservation,
    pub(crate) bearing: Vector3<f64>,
    pub(crate) rho: f64,
    pub(crate) rho_sigma: f64,
    pub(crate) prior: Option<DistancePrior>,
    /// Observations in other frames, in the order of frames.
    pub(crate) observations: Vec<LandmarkObservation>,
}

impl Landmark {
    /// A landmark with room for observations.
    pub(crate) fn empty() -> Self {
        Self { observations: Vec::with_capacity(24), ..Self::placeholder() }
    }

    /// A landmark without memory, to stand in for another for a moment.
    pub(crate) fn placeholder() -> Self {
        let host = LandmarkObservation {
            frame: 0,
            seen: Vector2::zeros(),
            pixel: Vector2::zeros(),
            whitening: Matrix2::identity(),
            chi2: 0.0,
        };
        Self {
            id: LandmarkId(0),
            alive: false,
            host,
            bearing: Vector3::z(),
            rho: 1.0,
            rho_sigma: f64::INFINITY,
            prior: None,
            observations: Vec::new(),
        }
    }

    pub(crate) fn begin(
        &mut self,
        id: LandmarkId,
        host: LandmarkObservation,
        bearing: Vector3<f64>,
        rho: f64,
    ) {
        self.id = id;
        self.alive = true;
        self.host = host;
        self.bearing = bearing;
        self.rho = rho;
        self.rho_sigma = f64::INFINITY;
        self.prior = None;
        self.observations.clear();
    }

    pub(crate) fn end(&mut self) {
        self.alive = false;
        self.observations.clear();
    }

    pub(crate) fn sees(&self, frame: usize) -> bool {
        self.host.frame == frame || self.observations.iter().any(|s| s.frame == frame)
    }

    pub(crate) fn insert(&mut self, observation: LandmarkObservation) {
        let at = self.observations.partition_point(|s| s.frame < observation.frame);
        self.observations.insert(at, observation);
    }

    pub(crate) fn apply(&mut self, step: &Vector3<f64>) {
        self.bearing = bearing_plus(&self.bearing, &Vector2::new(step.x, step.y));
        self.rho = (self.rho + step.z).clamp(MIN_INVERSE_DISTANCE, MAX_INVERSE_DISTANCE);
    }

    pub(crate) fn in_world(&self, frames: &[Frame], body_from_camera: &Se3) -> Vector3<f64> {
        let world_from_camera = frames[self.host.frame].state.world_from_body * *body_from_camera;
        world_from_camera.act(&(self.bearing / self.rho))
    }

    pub(crate) fn estimate(&self, frames: &[Frame], body_from_camera: &Se3) -> LandmarkEstimate {
        LandmarkEstimate {
            id: self.id,
            host: frames[self.host.frame].id,
            bearing: self.bearing,
            inverse_distance: self.rho,
            inverse_distance_sigma: self.rho_sigma,
            in_world: self.in_world(frames, body_from_camera),
            observations: self.observations.len() + 1,
        }
    }
}

/// What is known of the first frame, as long as it is in the window.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GaugePrior {
    pub(crate) frame: usize,
    pub(crate) reference: NavState,
    pub(crate) sigmas: GaugePriorSigmas,
}

/// The camera's place on the body and its clock, with linearisation point and step once they are in the prior.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CalibrationState {
    pub(crate) body_from_camera: Se3,
    pub(crate) time_offset_secs: f64,
    /// As given, the centre of the calibration's own prior.
    pub(crate) given: Se3,
    pub(crate) linearised: Se3,
    pub(crate) linearised_offset_secs: f64,
    pub(crate) step: SVector<f64, CALIBRATION_DIM>,
    pub(crate) in_prior: bool,
}

impl CalibrationState {
    pub(crate) fn new(body_from_camera: Se3) -> Self {
        Self {
            body_from_camera,
            time_offset_secs: 0.0,
            given: body_from_camera,
            linearised: body_from_camera,
            linearised_offset_secs: 0.0,
            step: SVector::zeros(),
            in_prior: false,
        }
    }

    pub(crate) fn at(&self, first_estimates: bool) -> Se3 {
        if first_estimates && self.in_prior { self.linearised } else { self.body_from_camera }
    }

    pub(crate) fn enter_prior(&mut self) {
        if !self.in_prior {
            self.in_prior = true;
            self.linearised = self.body_from_camera;
            self.linearised_offset_secs = self.time_offset_secs;
            self.step.fill(0.0);
        }
    }

    pub(crate) fn relinearise(&mut self) {
        self.linearised = self.body_from_camera;
        self.linearised_offset_secs = self.time_offset_secs;
        self.step.fill(0.0);
    }

    pub(crate) fn apply(&mut self, step: &SVector<f64, CALIBRATION_DIM>) {
        let (from, from_secs, step) = if self.in_prior {
            self.step += step;
            (self.linearised, self.linearised_offset_secs, self.step)
        } else {
            (self.body_from_camera, self.time_offset_secs, *step)
        };
        self.body_from_camera = Se3::new(
            from.rotation * So3::exp(&Vector3::new(step[0], step[1], step[2])),
            from.translation + Vector3::new(step[3], step[4], step[5]),
        );
        self.time_offset_secs = from_secs + step[6];
    }

    /// Difference to the given calibration, in the order of `step`.
    pub(crate) fn minus_given(&self) -> SVector<f64, CALIBRATION_DIM> {
        let turn = (self.given.rotation.inverse() * self.body_from_camera.rotation).log();
        let shift = self.body_from_camera.translation - self.given.translation;
        SVector::from([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z, self.time_offset_secs])
    }
}
