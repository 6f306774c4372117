//! A hand-held camera: a person stands, turns on the spot, walks a few steps, and the hand always sways.

use super::smooth_step;
use crate::config::{FlightKind, SceneKind, SynthConfig};
use crate::random::{Gaussian, Purpose, stream};
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::PI;
use vidar_core::{Se3, So3};

/// Height of the camera above the floor, m.
const HEIGHT_M: f64 = 1.45;

/// Distance of the camera from the person's axis, m: turning on the spot moves the camera by it.
const REACH_M: f64 = 0.25;

/// Time for which the path is planned, s; beyond it the person stands.
const PLANNED_SECS: f64 = 3700.0;

/// How lively the person is.
struct Temper {
    /// Mean walking speed, m/s.
    walk_mps: [f64; 2],
    /// Mean rate of turning, rad/s.
    turn_rad_per_s: [f64; 2],
    /// Seconds of standing.
    stand_secs: [f64; 2],
    /// Amplitude of the hand's sway, m and rad.
    sway_m: f64,
    sway_rad: f64,
    /// Frequencies of the sway, Hz.
    sway_hz: [f64; 2],
    /// Height of a step's bounce, m.
    bounce_m: f64,
}

const SLOW: Temper = Temper {
    walk_mps: [0.12, 0.26],
    turn_rad_per_s: [0.25, 0.6],
    stand_secs: [0.8, 2.5],
    sway_m: 0.02,
    sway_rad: 0.03,
    sway_hz: [0.15, 0.9],
    bounce_m: 0.006,
};

const LIVELY: Temper = Temper {
    walk_mps: [0.5, 0.9],
    turn_rad_per_s: [0.6, 1.3],
    stand_secs: [0.1, 0.6],
    sway_m: 0.05,
    sway_rad: 0.07,
    sway_hz: [0.3, 1.6],
    bounce_m: 0.02,
};

/// From one posture to the next.
struct Phase {
    begin_secs: f64,
    end_secs: f64,
    from: Posture,
    to: Posture,
    steps_per_sec: f64,
}

/// Where the person stands and looks.
#[derive(Clone, Copy)]
struct Posture {
    position: [f64; 2],
    yaw: f64,
    pitch: f64,
}

/// One wave of the sway: angular frequency (rad/s), phase and amplitude (relative).
type Wave = [f64; 3];

/// A hand-held path of the camera.
pub(super) struct Handheld {
    phases: Vec<Phase>,
    /// Of x, y, z (m) and yaw, pitch, roll (rad).
    sway: [[Wave; 4]; 6],
    temper: &'static Temper,
}

impl Handheld {
    /// The path of `config`, or none if its flight is not a hand-held one.
    pub(super) fn new(config: &SynthConfig) -> Option<Self> {
        let temper = match config.flight {
            FlightKind::Handheld => &SLOW,
            FlightKind::HandheldLively => &LIVELY,
            FlightKind::Sweep | FlightKind::Orbit | FlightKind::Aggressive => return None,
        };
        let mut random = Gaussian::new(stream(config.seed, Purpose::Handheld));
        let size = crate::extent::room_size(config);
        // Near the middle, so that furniture may stand along the walls; a corridor is walked along.
        let across = if config.scene == SceneKind::Corridor { 0.08 } else { 0.24 };
        let half = [(0.24 * size.x).min(6.0), across * size.y];
        let sway = std::array::from_fn(|_| {
            std::array::from_fn(|k| {
                let [low, high] = temper.sway_hz;
                // The fourth wave is a tremor.
                let hz =
                    if k < 3 { between(&mut random, [low, high]) } else { between(&mut random, [3.0, 4.5]) };
                let amplitude = if k < 3 { between(&mut random, [0.3, 0.7]) } else { 0.02 };
                [2.0 * PI * hz, 2.0 * PI * random.uniform(), amplitude]
            })
        });
        Some(Self { phases: plan(temper, half, &mut random), sway, temper })
    }

    /// Pose of the camera when the person has gone `path_secs` along the plan; `secs` is the time by which the hand
    /// sways, by its full amount when `ease` is 1 and by a tenth of it when `ease` is 0.
    pub(super) fn world_from_camera(&self, path_secs: f64, secs: f64, ease: f64) -> Se3 {
        let at = self.phases.partition_point(|p| p.end_secs <= path_secs).min(self.phases.len() - 1);
        let Phase { begin_secs, end_secs, from, to, steps_per_sec } = &self.phases[at];
        let x = (path_secs - begin_secs) / (end_secs - begin_secs);
        let part = smooth_step(x);
        let mix = |a: f64, b: f64| a + (b - a) * part;
        // Steps fade in and out with the walk.
        let stride = smooth_step(4.0 * x) * smooth_step(4.0 * (1.0 - x));
        let bounce =
            self.temper.bounce_m * stride * (2.0 * PI * steps_per_sec * (path_secs - begin_secs)).sin();
        let scale = 0.1 + 0.9 * ease;
        let sway = self.sway.map(|waves| {
            scale * waves.iter().map(|[rate, phase, size]| size * (rate * secs + phase).sin()).sum::<f64>()
        });
        let (metres, radians) = (self.temper.sway_m, self.temper.sway_rad);
        let yaw = mix(from.yaw, to.yaw) + radians * sway[3];
        let pitch = mix(from.pitch, to.pitch) + radians * sway[4];
        let roll = 0.7 * radians * sway[5];
        let person = Vector3::new(
            mix(from.position[0], to.position[0]),
            mix(from.position[1], to.position[1]),
            HEIGHT_M + bounce,
        );
        let reach = Vector3::new(yaw.cos(), yaw.sin(), 0.0) * REACH_M;
        let hand = Vector3::new(sway[0], sway[1], 0.7 * sway[2]) * metres;
        Se3::new(attitude(yaw, pitch, roll), person + reach + hand)
    }
}

fn between<R: rand::Rng>(random: &mut Gaussian<R>, [low, high]: [f64; 2]) -> f64 {
    low + (high - low) * random.uniform()
}

/// Standing, turning and walking within `half` metres of the floor's centre.
fn plan<R: rand::Rng>(temper: &Temper, half: [f64; 2], random: &mut Gaussian<R>) -> Vec<Phase> {
    let place = |random: &mut Gaussian<R>| half.map(|h| between(random, [-h, h]));
    let look = |random: &mut Gaussian<R>| between(random, [-0.1, 0.35]);
    let position = place(random);
    let mut here = Posture { position, yaw: between(random, [-PI, PI]), pitch: look(random) };
    let mut phases: Vec<Phase> = Vec::new();
    let mut now = 0.0;
    while now < PLANNED_SECS {
        let choice = random.uniform();
        let (to, secs, walks) = if choice < 0.25 {
            (here, between(random, temper.stand_secs), false)
        } else if choice < 0.55 {
            // On the spot, to either side.
            let side = if random.uniform() < 0.5 { 1.0 } else { -1.0 };
            let turn = side * between(random, [0.6, 2.6]);
            let to = Posture { yaw: here.yaw + turn, pitch: look(random), ..here };
            (to, turn.abs() / between(random, temper.turn_rad_per_s), false)
        } else {
            let position = place(random);
            let [dx, dy] = [position[0] - here.position[0], position[1] - here.position[1]];
            let way = dx.hypot(dy);
            // Looking ahead or aside, never turning faster than by the temper's rate.
            let speed = between(random, temper.walk_mps);
            let rate = between(random, temper.turn_rad_per_s);
            let wanted = dy.atan2(dx) + between(random, [-0.9, 0.9]) - here.yaw;
            let turn = wanted - 2.0 * PI * (wanted / (2.0 * PI)).round();
            let to = Posture { position, yaw: here.yaw + turn, pitch: look(random) };
            (to, (way / speed).max(turn.abs() / rate), true)
        };
        let secs = secs.max(0.3);
        let steps_per_sec = if walks { between(random, [1.3, 1.9]) } else { 0.0 };
        phases.push(Phase { begin_secs: now, end_secs: now + secs, from: here, to, steps_per_sec });
        (here, now) = (to, now + secs);
    }
    phases
}

/// Attitude of the camera (x right, y down, z ahead): `yaw` about the world's z from its x, `pitch` downward, `roll`
/// about the view; radians.
fn attitude(yaw: f64, pitch: f64, roll: f64) -> So3 {
    let level = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let level = So3::from_matrix(&level).unwrap_or(So3::IDENTITY);
    let about_z = So3::from_axis_angle(&Vector3::z(), yaw);
    let about_y = So3::from_axis_angle(&Vector3::y(), pitch);
    let about_x = So3::from_axis_angle(&Vector3::x(), roll);
    about_z * about_y * about_x * level
}
