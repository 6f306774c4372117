//! An optical stabiliser: a lens that is shifted against the camera's shake, so that the picture moves less than the camera turns.

use crate::flight::FlightPath;
use nalgebra::Vector2;
use vidar_core::{LieGroup, So3};

/// What is slower than about this is not taken back, s.
const LEAK_SECS: f64 = 1.0;
/// How far the lens can go, rad.
const LIMIT_RAD: f64 = 0.021;
/// Time between known shifts, s.
const STEP_SECS: f64 = 0.002;
/// Time before the flight from which on the stabiliser works, s.
const BEFORE_SECS: f64 = 0.1;

/// The shifts of a flight's pictures.
pub(crate) struct Stabiliser {
    /// Every [`STEP_SECS`], in focal lengths.
    shifts: Vec<Vector2<f64>>,
}

impl Stabiliser {
    /// A stabiliser that takes `share` of the shake back, of a camera that is turned by `body_from_camera` on the body.
    pub(crate) fn new(path: &FlightPath, body_from_camera: &So3, share: f64) -> Self {
        let camera_from_body = body_from_camera.inverse();
        let count = ((path.duration_secs() + 2.0 * BEFORE_SECS) / STEP_SECS).ceil() as usize;
        let mut angle = Vector2::zeros();
        let shifts = (0..=count).map(|k| {
            let rate = camera_from_body.act(&path.state(k as f64 * STEP_SECS - BEFORE_SECS).angular_rate);
            // About the camera's x the picture moves down, about its y to the left.
            angle = angle * (-STEP_SECS / LEAK_SECS).exp() + Vector2::new(-rate.y, rate.x) * STEP_SECS;
            angle.map(|a: f64| -share * LIMIT_RAD * (a / LIMIT_RAD).tanh())
        });
        Self { shifts: shifts.collect() }
    }

    /// What the picture is shifted by at an instant, in focal lengths.
    pub(crate) fn shift(&self, secs: f64) -> Vector2<f64> {
        let at = ((secs + BEFORE_SECS) / STEP_SECS).clamp(0.0, (self.shifts.len() - 1) as f64);
        let before = (at as usize).min(self.shifts.len() - 2);
        self.shifts[before].lerp(&self.shifts[before + 1], at - before as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SynthConfig;
    use nalgebra::Vector3;
    use vidar_core::{BodyFrame, Se3, StampedPose, Timestamp, Trajectory};

    #[test]
    fn a_tremor_moves_the_picture_by_what_the_lens_leaves_of_it() {
        let config = SynthConfig { duration_secs: 4.0, ..SynthConfig::default() };
        let pose = |k: i64| {
            let phase = 0.06 * std::f64::consts::PI * k as f64;
            let turn = So3::exp(&(Vector3::new(phase.sin(), phase.cos(), 0.0) * 0.006));
            let time = Timestamp::from_nanos(k * 10_000_000);
            StampedPose { time, world_from_body: Se3::new(turn, Vector3::new(0.01 * k as f64, 0.0, 1.0)) }
        };
        let trembling = Trajectory::new(BodyFrame::Imu, (0..600).map(pose).collect()).unwrap();
        let path = FlightPath::from_trajectory(&trembling, &config).unwrap();
        let body_from_camera = config.body_from_camera().rotation;
        let moved = |share: f64| {
            let stabiliser = Stabiliser::new(&path, &body_from_camera, share);
            let step = |k: i32| {
                let (from, until) = (1.0 + 0.05 * f64::from(k), 1.05 + 0.05 * f64::from(k));
                let turn = |secs: f64| path.world_from_body(secs).rotation * body_from_camera;
                let ray = (turn(until).inverse() * turn(from)).act(&Vector3::z());
                (ray.xy() / ray.z + stabiliser.shift(until) - stabiliser.shift(from)).norm()
            };
            (0..40).map(step).sum::<f64>()
        };
        let left = [0.5, 0.8, 1.0].map(|share| moved(share) / moved(0.0));
        assert!((left[0] - 0.5).abs() < 0.1 && (left[1] - 0.2).abs() < 0.1 && left[2] < 0.15, "{left:?}");
    }
}
