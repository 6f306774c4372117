//! Built-in flights: analytic courses through the scene.

use super::smooth_step;
use crate::config::{FlightKind, SceneKind, SynthConfig, Variety};
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::PI;
use vidar_core::{Se3, So3};

/// Height of the body's origin above the floor while it sits, m: on a small stand.
const REST_HEIGHT_M: f64 = 0.45;

/// A course through a scene (any flight that is not hand-held) whose floor is centred on the origin.
pub(super) struct Course {
    kind: FlightKind,
    corridor: bool,
    /// Half axes of the ellipse that is flown, m.
    half: [f64; 2],
    height_m: f64,
    height_swing_m: f64,
    /// Radians of the ellipse per second.
    rate: f64,
    /// Where on the ellipse the flight begins.
    phase: f64,
}

impl Course {
    pub(super) fn new(config: &SynthConfig) -> Self {
        let (half, height_m) = match (config.scene, config.flight) {
            (SceneKind::Room, FlightKind::Sweep) => ([1.5, 1.5], 1.6),
            (SceneKind::Room, FlightKind::Orbit) => ([2.3, 2.2], 1.8),
            (SceneKind::Room, _) => ([1.7, 1.6], 1.7),
            (SceneKind::Hall, FlightKind::Sweep) => ([5.5, 3.5], 2.2),
            (SceneKind::Hall, FlightKind::Orbit) => ([6.0, 4.2], 2.6),
            (SceneKind::Hall, _) => ([4.0, 3.0], 2.6),
            (SceneKind::Corridor, FlightKind::Aggressive) => ([8.0, 0.3], 1.5),
            (SceneKind::Corridor, _) => ([11.0, 0.35], 1.5),
        };
        // A randomized place is smaller or larger than a standard one, and the flight with it.
        let grown = crate::extent::room_size(config).component_div(&crate::extent::room_size(&SynthConfig {
            variety: Variety::Standard,
            ..config.clone()
        }));
        let half = [half[0] * grown.x, half[1] * grown.y];
        let height_m = height_m * grown.z;
        let speed = match config.flight {
            FlightKind::Sweep => 0.9,
            FlightKind::Orbit => 1.1,
            _ => 2.0,
        };
        let corridor = config.scene == SceneKind::Corridor;
        let mean_radius = if corridor { half[0] } else { 0.5 * (half[0] + half[1]) };
        // Where the flight begins depends on the seed, so that seeds see the scene in different order.
        let phase = if corridor { 0.35 } else { 2.0 * PI * ((config.seed as f64 * 0.618_033_988_75) % 1.0) };
        // A figure of eight is longer than its ellipse.
        let stretch = if config.flight == FlightKind::Aggressive && !corridor { 1.6 } else { 1.0 };
        let rate = speed / (mean_radius * stretch);
        let usual_swing_m = if config.scene == SceneKind::Hall { 0.5 } else { 0.3 };
        let height_swing_m = usual_swing_m * grown.z.min(1.0);
        Self { kind: config.flight, corridor, half, height_m, height_swing_m, rate, phase }
    }

    /// Pose at `secs` on the course, `lift` of the way (0…1) from the ground to the course.
    pub(super) fn world_from_body(&self, secs: f64, lift: f64) -> Se3 {
        let a = self.phase + self.rate * secs;
        let (position, yaw) = if self.corridor { self.in_corridor(a, secs) } else { self.in_room(a, secs) };
        let z = REST_HEIGHT_M + (position.z - REST_HEIGHT_M) * lift;
        let position = Vector3::new(position.x, position.y, z);
        let (pitch, roll) = match self.kind {
            FlightKind::Aggressive => (0.06 + 0.22 * (2.9 * secs).sin(), 0.28 * (2.1 * secs + 0.4).sin()),
            _ => (0.10 + 0.16 * (0.9 * secs).sin(), 0.05 * (1.3 * secs + 0.7).sin()),
        };
        // Near the ground the body is level.
        Se3::new(attitude(yaw, pitch * lift, roll * lift), position)
    }

    fn in_room(&self, a: f64, secs: f64) -> (Vector3<f64>, f64) {
        let [half_x, half_y] = self.half;
        match self.kind {
            FlightKind::Sweep => {
                let z = self.height_m + self.height_swing_m * (2.0 * a + 0.5).sin();
                (Vector3::new(half_x * a.cos(), half_y * a.sin(), z), a + 0.3 * (0.8 * secs).sin())
            }
            FlightKind::Orbit => {
                let z = self.height_m + self.height_swing_m * (1.5 * a).sin();
                (Vector3::new(half_x * a.cos(), half_y * a.sin(), z), a + PI + 0.25 * (0.7 * secs).sin())
            }
            _ => {
                let z = self.height_m + 1.4 * self.height_swing_m * (1.7 * a + 0.3).sin();
                let position = Vector3::new(half_x * a.sin(), half_y * (2.0 * a).sin(), z);
                (position, 0.6 * a + 1.1 * (1.1 * secs).sin())
            }
        }
    }

    fn in_corridor(&self, a: f64, secs: f64) -> (Vector3<f64>, f64) {
        let [half_x, half_y] = self.half;
        let weave = match self.kind {
            FlightKind::Aggressive => (0.3 * half_y / self.half[1]) * (1.9 * secs).sin(),
            _ => half_y * (0.8 * secs).sin(),
        };
        let z = self.height_m + self.height_swing_m * (0.7 * secs + 0.5).sin();
        // Out and back; the body turns round over the last stretch before each end.
        let turns = (a / PI).floor();
        let turning = PI * (turns + smooth_step(((a / PI - turns) - 0.8) / 0.2));
        let glance = match self.kind {
            FlightKind::Sweep => 0.75 * (0.75 * secs).sin(),
            FlightKind::Orbit => 0.15 * (0.6 * secs).sin(),
            _ => 0.8 * (1.4 * secs).sin(),
        };
        (Vector3::new(-half_x * a.cos(), weave, z), turning + glance)
    }
}

/// Attitude of EuRoC's body (x up, y right, z ahead): `yaw` of the view about the world's z from the world's x,
/// `pitch` downward, `roll` about the view; radians.
fn attitude(yaw: f64, pitch: f64, roll: f64) -> So3 {
    // Columns: the body's axes in the world at zero angles, up = +z, right = −y, ahead = +x.
    let level = Matrix3::new(0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0);
    let level = So3::from_matrix(&level).unwrap_or(So3::IDENTITY);
    let about_z = So3::from_axis_angle(&Vector3::z(), yaw);
    let about_y = So3::from_axis_angle(&Vector3::y(), pitch);
    let about_x = So3::from_axis_angle(&Vector3::x(), roll);
    about_z * about_y * about_x * level
}
