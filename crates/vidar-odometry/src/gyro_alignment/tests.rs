//! A camera with a rolling shutter and a late clock looks at points in a room.

use super::*;
use rand::{Rng, SeedableRng};
use vidar_core::{AngularRate, LieGroup, Pinhole, SpecificForce};

struct Truth {
    offset_secs: f64,
    readout_secs: f64,
    body_from_camera: So3,
    bias: Vector3<f64>,
    /// Factor on the motion: 1 is a lively hand (1 rad/s), 0.25 a slow one.
    liveliness: f64,
    translates: bool,
    /// Nearest points, m.
    nearest_m: f64,
    /// From the point about which the body turns, an elbow, in body axes, m.
    arm: Vector3<f64>,
}

fn camera() -> CameraModel {
    CameraModel::Pinhole(Pinhole::new(500.0, 500.0, 319.5, 239.5, 640, 480).unwrap())
}

impl Truth {
    fn rate(&self, t: f64) -> Vector3<f64> {
        Vector3::new((1.9 * t).sin(), 1.2 * (2.7 * t + 1.0).cos(), 0.7 * (1.3 * t).sin()) * self.liveliness
    }

    fn position(&self, t: f64) -> Vector3<f64> {
        let to_and_fro = Vector3::new((1.1 * t).sin(), 0.6 * (1.7 * t).cos(), 0.3 * (0.9 * t).sin());
        if self.translates { to_and_fro * (0.4 * self.liveliness) } else { Vector3::zeros() }
    }

    /// world_from_body on a fine grid of 0.5 ms, from −0.5 s.
    fn orientations(&self) -> Vec<So3> {
        let mut turn = So3::IDENTITY;
        let step = 5e-4;
        (0..14_000)
            .map(|k| {
                let now = turn;
                turn = turn * So3::exp(&(self.rate(-0.5 + (f64::from(k) + 0.5) * step) * step));
                now
            })
            .collect()
    }

    fn log(&self, seed: u64) -> GyroAlignmentLog {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let grid = self.orientations();
        let turn_at = |t: f64| grid[((t + 0.5) / 5e-4).round() as usize];
        let points: Vec<Vector3<f64>> = (0..500)
            .map(|_| {
                Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0_f64)).normalize()
                    * rng.random_range(self.nearest_m..3.3 * self.nearest_m)
            })
            .collect();
        let mut log = GyroAlignmentLog::default();
        for k in 0..1150 {
            let t = -0.45 + f64::from(k) * 0.005;
            let noise = Vector3::from_fn(|_, _| rng.random_range(-0.01..0.01));
            log.add_gyro(&ImuSample {
                time: Timestamp::from_nanos(1_000_000_000 + (t * 1e9) as i64),
                gyro: AngularRate(self.rate(t) + self.bias + noise),
                accel: SpecificForce(Vector3::zeros()),
            });
        }
        for k in 0..100 {
            let stamp = f64::from(k) * 0.05;
            let time = stamp + self.offset_secs;
            let mut seen = Vec::new();
            for (id, point) in points.iter().enumerate() {
                let mut secs = 0.0;
                let mut pixel = None;
                for _ in 0..6 {
                    let world_from_body = turn_at(time + secs);
                    let world_from_camera = world_from_body * self.body_from_camera;
                    let at = self.position(time + secs) + world_from_body.act(&self.arm);
                    pixel = camera()
                        .project(&(world_from_camera.inverse() * (point - at)))
                        .filter(|p| camera().contains(p, 5.0));
                    let Some(p) = pixel else { break };
                    secs = (p.y / 479.0 - 0.5) * self.readout_secs;
                }
                let noise = nalgebra::Vector2::from_fn(|_, _| rng.random_range(-0.6..0.6));
                seen.extend(pixel.map(|p| (LandmarkId(id as u32), p + noise)));
            }
            log.add_image(Timestamp::from_nanos(1_000_000_000 + (stamp * 1e9) as i64), seen.into_iter());
        }
        log
    }

    fn guess(&self) -> Guess {
        let body_from_camera = self.body_from_camera * So3::exp(&Vector3::new(0.03, -0.02, 0.03));
        Guess { body_from_camera, offset_secs: 0.0, readout_secs: 0.0, search: true }
    }

    fn check(&self, offset_ms: f64, readout_ms: f64, rotation_deg: f64) {
        for seed in 0..4 {
            let found =
                self.log(seed).next_problem(&camera(), &self.guess(), 0.5, true).unwrap().solve().unwrap();
            let offset = (found.offset_secs - self.offset_secs) * 1e3;
            let readout = (found.readout_secs - self.readout_secs) * 1e3;
            let turn = (self.body_from_camera.inverse() * found.body_from_camera).angle_rad().to_degrees();
            assert!(offset.abs() < offset_ms, "clock off by {offset} ms: {found:?}");
            assert!(readout.abs() < readout_ms, "readout off by {readout} ms: {found:?}");
            assert!(turn < rotation_deg, "rotation off by {turn} degrees: {found:?}");
            assert!(offset.abs() < 4e3 * found.offset_sigma, "offset beyond 4 sigma: {found:?}");
            assert!(readout.abs() < 4e3 * found.readout_sigma, "readout beyond 4 sigma: {found:?}");
        }
    }
}

fn lively() -> Truth {
    Truth {
        offset_secs: -0.035,
        readout_secs: 0.022,
        body_from_camera: So3::exp(&Vector3::new(0.1, 1.5, -0.3)),
        bias: Vector3::new(0.02, -0.01, 0.015),
        liveliness: 1.0,
        translates: true,
        nearest_m: 1.5,
        arm: Vector3::zeros(),
    }
}

#[test]
fn a_late_clock_and_a_rolling_shutter_are_found_in_lively_motion() {
    lively().check(1.0, 1.5, 0.6);
}

#[test]
fn a_slow_hand_gives_the_clock_within_some_milliseconds() {
    Truth { offset_secs: 0.044, readout_secs: 0.03, liveliness: 0.25, ..lively() }.check(3.0, 8.0, 4.0);
}

#[test]
fn turning_about_an_elbow_near_walls_does_not_bias_clock_and_readout() {
    // The velocity changes while an image is read out, always with the rate. With one direction of translation for all rows: 0.7 ms, 1.3 ms, 0.4 degrees.
    let arm = Vector3::new(0.1, 0.4, 0.2);
    Truth { liveliness: 3.0, nearest_m: 0.7, arm, ..lively() }.check(0.4, 0.8, 0.3);
}

/// The first `secs` of a log's images.
fn shortened(mut log: GyroAlignmentLog, secs: f64) -> GyroAlignmentLog {
    let first = log.images[0].0;
    log.images.retain(|(stamp, _)| (*stamp - first).as_secs_f64() <= secs + 1e-6);
    log
}

#[test]
fn a_lively_hand_shows_its_clock_in_less_than_a_second_and_a_slower_one_says_how_badly() {
    for (liveliness, largest_sigma) in [(1.0, 0.05), (4.0, 0.008)] {
        let truth = Truth { liveliness, ..lively() };
        for seed in 0..4 {
            let problem =
                shortened(truth.log(seed), 0.75).next_problem(&camera(), &truth.guess(), 0.5, true).unwrap();
            assert!(problem.is_short());
            let found = problem.solve().unwrap();
            let off = found.offset_secs - truth.offset_secs;
            assert!(off.abs() < 4.0 * found.offset_sigma, "{found:?}");
            assert!(found.offset_sigma < largest_sigma, "{found:?}");
        }
    }
}

#[test]
fn a_slow_hand_is_not_asked_before_it_has_shown_enough() {
    let slow = Truth { liveliness: 0.1, ..lively() };
    assert!(shortened(slow.log(1), 1.4).next_problem(&camera(), &slow.guess(), 0.5, true).is_none());
    let lively = lively();
    assert!(shortened(lively.log(1), 1.4).next_problem(&camera(), &lively.guess(), 0.5, false).is_none());
    assert!(shortened(slow.log(1), 1.6).next_problem(&camera(), &slow.guess(), 0.5, true).is_some());
}

#[test]
fn turning_on_the_spot_is_enough() {
    Truth { translates: false, ..lively() }.check(1.0, 1.5, 0.6);
}

#[test]
fn a_global_shutter_and_a_true_clock_are_left_as_they_are() {
    Truth { offset_secs: 0.0, readout_secs: 0.0, ..lively() }.check(1.0, 1.5, 0.6);
}

#[test]
fn a_body_at_rest_gives_no_alignment() {
    let rest = Truth { liveliness: 0.01, ..lively() };
    assert!(rest.log(1).next_problem(&camera(), &rest.guess(), 0.5, true).is_none());
}
