//! Flights with exact derivatives.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::{LieGroup, Se3, So3};

/// What the body does at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Pose of the body, world z up.
    pub world_from_body: Se3,
    /// Velocity in the world, m/s.
    pub velocity: Vector3<f64>,
    /// Acceleration in the world, m/s², gravity not included.
    pub acceleration: Vector3<f64>,
    /// Angular rate in the body's axes, rad/s.
    pub angular_rate: Vector3<f64>,
}

/// Anything that moves smoothly.
pub trait Flight {
    /// Motion at `secs` after the beginning.
    fn motion(&self, secs: f64) -> Motion;

    /// Length of the flight, s.
    fn duration_secs(&self) -> f64;
}

/// Built-in kinds of flight.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CourseKind {
    /// Figures of eight with roll, pitch and yaw.
    Eight,
    /// Straight on at constant speed, attitude constant: the scale cannot be seen.
    Straight,
    /// Turning on the spot: distances cannot be seen.
    Spin,
    /// Nothing moves.
    Still,
}

/// A built-in flight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Course {
    /// Which kind.
    pub kind: CourseKind,
    /// Length, s.
    pub secs: f64,
    /// Typical speed, m/s (of turning: rad/s).
    pub speed: f64,
    /// Shift of all phases, rad: another flight of the same kind.
    pub phase: f64,
}

/// A sine and its first two derivatives by time.
fn wave(amplitude: f64, rate: f64, phase: f64, t: f64) -> [f64; 3] {
    let (sin, cos) = (rate * t + phase).sin_cos();
    [amplitude * sin, amplitude * rate * cos, -amplitude * rate * rate * sin]
}

impl Course {
    fn position(&self, t: f64) -> [Vector3<f64>; 3] {
        match self.kind {
            CourseKind::Eight => {
                let w = self.speed / 2.6;
                let x = wave(1.7, w, self.phase, t);
                let y = wave(1.5, 2.0 * w, 2.0 * self.phase, t);
                let z = wave(0.4, 1.7 * w, self.phase + 0.3, t);
                std::array::from_fn(|k| Vector3::new(x[k], y[k], z[k]))
            }
            CourseKind::Straight => {
                let v = Vector3::new(0.8, 0.55, 0.1).normalize() * self.speed;
                [v * t, v, Vector3::zeros()]
            }
            CourseKind::Spin | CourseKind::Still => [Vector3::zeros(); 3],
        }
    }

    /// Yaw, pitch, roll of a body whose x is ahead and z up, with their rates.
    fn angles(&self, t: f64) -> [[f64; 3]; 3] {
        let p = self.phase;
        match self.kind {
            CourseKind::Eight => {
                let yaw = wave(1.1, 0.42 * self.speed, p, t);
                let turn = [0.25 * self.speed * t, 0.25 * self.speed, 0.0];
                let yaw = std::array::from_fn(|k| yaw[k] + turn[k]);
                [yaw, wave(0.2, 1.1 * self.speed, p, t), wave(0.22, 0.9 * self.speed, p + 0.4, t)]
            }
            CourseKind::Spin => {
                let yaw = wave(0.9, self.speed, p, t);
                [yaw, wave(0.25, 1.3 * self.speed, p + 1.0, t), wave(0.2, 1.7 * self.speed, p, t)]
            }
            CourseKind::Straight | CourseKind::Still => [[p, 0.0, 0.0], [0.05, 0.0, 0.0], [-0.04, 0.0, 0.0]],
        }
    }
}

impl Flight for Course {
    fn motion(&self, t: f64) -> Motion {
        let [position, velocity, acceleration] = self.position(t);
        let [yaw, pitch, roll] = self.angles(t);
        let about = |axis: Vector3<f64>, angle: f64| So3::exp(&(axis * angle));
        let ahead =
            about(Vector3::z(), yaw[0]) * about(Vector3::y(), pitch[0]) * about(Vector3::x(), roll[0]);
        // Body rate of R = Rz Ry Rx.
        let (sp, cp) = pitch[0].sin_cos();
        let (sr, cr) = roll[0].sin_cos();
        let rate = Vector3::new(
            roll[1] - yaw[1] * sp,
            pitch[1] * cr + yaw[1] * cp * sr,
            -pitch[1] * sr + yaw[1] * cp * cr,
        );
        // EuRoC's body: x up, y right, z ahead.
        let mounted = Matrix3::new(0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0);
        let mounted = So3::from_matrix(&mounted).unwrap_or(So3::IDENTITY);
        Motion {
            world_from_body: Se3::new(ahead * mounted, position),
            velocity,
            acceleration,
            angular_rate: mounted.inverse() * rate,
        }
    }

    fn duration_secs(&self) -> f64 {
        self.secs
    }
}
