//! Keyframes as a visual-inertial odometry would report them, without running one.
//!
//! The body's steps from keyframe to keyframe are off by white noise, by a scale that walks slowly, and by a yaw that
//! walks (gravity holds roll and pitch); errors add up along the way. Landmarks are points of the true surface, seen
//! again while they stay in view, with depths that are off by an error of each point's own, by one of each keyframe,
//! and by the track's scale.

mod landmarks;

use crate::config::{ensure, within};
use crate::error::SynthError;
use crate::predict::TrueView;
use crate::random::{Gaussian, Purpose, stream};
use landmarks::Landmarks;
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::{
    GRAVITY_MPS2, Health, KeyframeId, LieGroup, NavState, OdometryKeyframe, PoseCovariance, Se3, So3,
};

/// Errors of a simulated odometry. The defaults (`factor` 1) are a good one: about 0.3 % of scale and 0.5 % of the way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryErrors {
    /// Factor on all errors of poses, and on their stated covariances, 0…100. 3 is a bad odometry.
    pub factor: f64,
    /// Stated standard deviations per true ones, 0.01…100; 1 is an honest odometry.
    pub stated_factor: f64,
    /// White error of each step, share of its length per axis, 0…1.
    pub step_share: f64,
    /// White error of each step whatever its length, m per axis, 0…1.
    pub step_floor_m: f64,
    /// Standard deviation of ln(scale) of the whole track, 0…1.
    pub scale_sigma: f64,
    /// Random walk of ln(scale), per step, 0…1.
    pub scale_walk: f64,
    /// Random walk of yaw, degrees per step, 0…30.
    pub yaw_deg: f64,
    /// Random walk of roll and pitch, degrees per step, 0…30.
    pub tilt_deg: f64,
    /// Landmarks per keyframe, 0…10 000.
    pub landmarks: usize,
    /// Standard deviation of a landmark's ln(depth), its own in all keyframes, 0…1.
    pub landmark_sigma: f64,
    /// Standard deviation of ln(depth) of all landmarks of one keyframe together, 0…1.
    pub landmark_frame_sigma: f64,
    /// Share of landmarks whose depth is far off, 0…1.
    pub landmark_outliers: f64,
}

impl Default for OdometryErrors {
    fn default() -> Self {
        Self {
            factor: 1.0,
            stated_factor: 1.0,
            step_share: 0.01,
            step_floor_m: 0.0005,
            scale_sigma: 0.003,
            scale_walk: 0.0006,
            yaw_deg: 0.06,
            tilt_deg: 0.01,
            landmarks: 120,
            landmark_sigma: 0.04,
            landmark_frame_sigma: 0.015,
            landmark_outliers: 0.12,
        }
    }
}

impl OdometryErrors {
    /// Checks every key against its domain.
    pub fn validate(&self) -> Result<(), SynthError> {
        within("odometry.factor", self.factor, 0.0, 100.0, "0 to 100")?;
        within("odometry.stated_factor", self.stated_factor, 0.01, 100.0, "0.01 to 100")?;
        within("odometry.step_share", self.step_share, 0.0, 1.0, "0 to 1")?;
        within("odometry.step_floor_m", self.step_floor_m, 0.0, 1.0, "0 to 1 m")?;
        within("odometry.scale_sigma", self.scale_sigma, 0.0, 1.0, "0 to 1")?;
        within("odometry.scale_walk", self.scale_walk, 0.0, 1.0, "0 to 1")?;
        within("odometry.yaw_deg", self.yaw_deg, 0.0, 30.0, "0 to 30°")?;
        within("odometry.tilt_deg", self.tilt_deg, 0.0, 30.0, "0 to 30°")?;
        ensure(self.landmarks <= 10_000, "odometry.landmarks", "0 to 10000", self.landmarks)?;
        within("odometry.landmark_sigma", self.landmark_sigma, 0.0, 1.0, "0 to 1")?;
        within("odometry.landmark_frame_sigma", self.landmark_frame_sigma, 0.0, 1.0, "0 to 1")?;
        within("odometry.landmark_outliers", self.landmark_outliers, 0.0, 1.0, "0 to 1")
    }
}

/// Smallest standard deviations that are stated: an odometry that claims to know exactly breaks whoever believes it.
const STATED_FLOOR: f64 = 1e-6;

/// The keyframes `views` as an odometry with `errors` reports them, in the order of time, of a camera at
/// `body_from_camera`.
///
/// The first keyframe is at its true pose. Deterministic by `seed`.
///
/// # Errors
/// A key of `errors` outside its domain.
pub fn simulate_odometry(
    views: &[TrueView],
    body_from_camera: &Se3,
    errors: &OdometryErrors,
    seed: u64,
) -> Result<Vec<OdometryKeyframe>, SynthError> {
    errors.validate()?;
    let mut random = Gaussian::new(stream(seed, Purpose::Odometry));
    let mut landmarks = Landmarks::new(errors, seed);
    let camera_from_body = body_from_camera.inverse();
    let bodies: Vec<Se3> = views.iter().map(|v| v.world_from_camera * camera_from_body).collect();
    let mut log_scale = errors.factor * errors.scale_sigma * random.next();
    let mut world_from_body = bodies.first().copied().unwrap_or(Se3::IDENTITY);
    // Of the body's tangent, about its own axes.
    let mut covariance = PoseCovariance::zeros();
    let mut keyframes: Vec<OdometryKeyframe> = Vec::with_capacity(views.len());
    for (k, view) in views.iter().enumerate() {
        let mut previous = None;
        if k > 0 {
            let step = bodies[k - 1].inverse() * bodies[k];
            log_scale += errors.factor * errors.scale_walk * random.next();
            let error = StepError::draw(&step, &world_from_body.rotation, errors, &mut random);
            let rotation = step.rotation * So3::exp(&error.turn);
            let reported = Se3::new(rotation, step.translation * log_scale.exp() + error.slip);
            world_from_body = world_from_body * reported;
            let transport = reported.inverse().adjoint();
            covariance = transport * covariance * transport.transpose() + error.covariance;
            previous = Some((KeyframeId(k as u32 - 1), error.covariance));
        }
        let velocity_in_world = velocity(views, &bodies, k) * log_scale.exp();
        keyframes.push(OdometryKeyframe {
            id: KeyframeId(k as u32),
            frame_id: view.frame_id,
            segment: 0,
            state: NavState {
                time: view.time,
                world_from_body,
                velocity_in_world,
                ..NavState::at_rest(view.time)
            },
            world_from_camera: world_from_body * *body_from_camera,
            pose_covariance: in_world_axes(&covariance, &world_from_body.rotation),
            previous,
            gravity_in_world: Vector3::new(0.0, 0.0, -GRAVITY_MPS2),
            scale_std: scale_std(errors, k),
            health: Health::Ok,
            landmarks: landmarks.seen(view, log_scale.exp()),
        });
    }
    Ok(keyframes)
}

fn scale_std(errors: &OdometryErrors, steps: usize) -> f64 {
    let variance = errors.scale_sigma.powi(2) + errors.scale_walk.powi(2) * steps as f64;
    (errors.factor * errors.stated_factor * variance.sqrt()).max(STATED_FLOOR)
}

/// What one step is off by, in the axes of the later body.
struct StepError {
    turn: Vector3<f64>,
    /// In the axes of the earlier body.
    slip: Vector3<f64>,
    covariance: PoseCovariance,
}

impl StepError {
    fn draw<R: rand::Rng>(
        step: &Se3,
        world_from_earlier: &So3,
        errors: &OdometryErrors,
        random: &mut Gaussian<R>,
    ) -> Self {
        let factor = errors.factor;
        let length = step.translation.norm();
        let slip_sigma = factor * errors.step_share * length;
        let floor = factor * errors.step_floor_m;
        let slip = random.vector() * slip_sigma + random.vector() * floor;
        // Roll, pitch and yaw are about the world's axes.
        let sigmas =
            Vector3::new(errors.tilt_deg, errors.tilt_deg, errors.yaw_deg).map(|d| factor * d.to_radians());
        let later_from_world = (*world_from_earlier * step.rotation).inverse();
        let turn = later_from_world * random.vector().component_mul(&sigmas);
        let stated = errors.stated_factor;
        let floored = |sigma: f64| (stated * sigma).max(STATED_FLOOR).powi(2);
        let rotation = later_from_world.matrix();
        let turn_covariance = rotation * Matrix3::from_diagonal(&sigmas.map(floored)) * rotation.transpose();
        // The scale acts along the step; its uncertainty is part of the step's.
        let along = step.rotation.inverse() * step.translation * (factor * errors.scale_sigma * stated);
        let slip_covariance =
            Matrix3::identity() * floored(slip_sigma.hypot(floor)) + along * along.transpose();
        let mut covariance = PoseCovariance::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn_covariance);
        covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&slip_covariance);
        Self { turn, slip, covariance }
    }
}

/// A pose covariance of the body's own axes with the position in the world's axes.
fn in_world_axes(covariance: &PoseCovariance, world_from_body: &So3) -> PoseCovariance {
    let mut turn = PoseCovariance::identity();
    turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&world_from_body.matrix());
    turn * covariance * turn.transpose()
}

/// Velocity of the body by the keyframes around it, m/s.
fn velocity(views: &[TrueView], bodies: &[Se3], k: usize) -> Vector3<f64> {
    let (a, b) = (k.saturating_sub(1), (k + 1).min(views.len() - 1));
    let secs = (views[b].time - views[a].time).as_secs_f64();
    if secs > 0.0 { (bodies[b].translation - bodies[a].translation) / secs } else { Vector3::zeros() }
}

#[cfg(test)]
mod tests;
