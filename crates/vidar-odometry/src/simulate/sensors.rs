//! IMU measurements and tracks of a flight.

use super::course::Flight;
use super::random::Random;
use crate::imu::{Bias, NavState};
use crate::initialization::TrackObservation;
use nalgebra::{Matrix2, Vector2, Vector3};
use vidar_core::camera::RadTan;
use vidar_core::{
    AngularRate, CameraModel, FrameId, GRAVITY_MPS2, ImuNoise, ImuSample, LandmarkId, LensMotion, LieGroup,
    Pinhole, Se3, So3, SpecificForce, Timestamp,
};

/// What to simulate.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulationConfig {
    /// Everything random follows from it.
    pub seed: u64,
    /// IMU measurements per second.
    pub imu_rate_hz: f64,
    /// Frames per second.
    pub camera_rate_hz: f64,
    /// Noise of the IMU.
    pub noise: ImuNoise,
    /// Factor on noise, walks and first biases; 0 gives the exact motion.
    pub noise_scale: f64,
    /// Standard deviation of the first gyroscope bias, rad/s.
    pub gyro_bias_sigma: f64,
    /// Standard deviation of the first accelerometer bias, m/s².
    pub accel_bias_sigma: f64,
    /// Standard deviation of pixels, px.
    pub pixel_sigma: f64,
    /// Share of observations that are wrong (up to 30 px off).
    pub outlier_share: f64,
    /// Share of tracks that is lost from frame to frame.
    pub loss_share: f64,
    /// Tracks held at once.
    pub tracks: usize,
    /// Distance between the flight's box and the walls, m.
    pub wall_distance_m: f64,
    /// Points on the walls, and a fifth of them within the room.
    pub points: usize,
    /// How much later images are taken than their stamps say, s.
    pub time_offset_secs: f64,
    /// Strength of gravity, m/s².
    pub gravity_mps2: f64,
    /// Measurements of the gyroscope are the true rates times this, per axis, before bias and noise.
    pub gyro_scale: [f64; 3],
    /// The same of the accelerometer.
    pub accel_scale: [f64; 3],
    /// Mean and amplitude of `ln` of the focal length over the camera's: a lens that autofocus moves to and fro in 6 s.
    pub log_focal: [f64; 2],
    /// Amplitude of the image's shift, focal lengths: a stabilised lens that follows a tremor of two or three shakes a second.
    pub shift: f64,
    /// Standard deviation of the stamps' errors, s, each image's own.
    pub stamp_scatter_secs: f64,
}

impl SimulationConfig {
    /// How the lens has moved so long after the first frame.
    pub fn lens_at(&self, secs: f64) -> LensMotion {
        let [mean, amplitude] = self.log_focal;
        let wave = |hz: f64| (std::f64::consts::TAU * hz * secs).sin();
        LensMotion {
            log_focal: mean + amplitude * wave(1.0 / 6.0),
            shift: Vector2::new(wave(2.3), wave(3.1)) * self.shift,
            ..LensMotion::NONE
        }
    }
}

impl Default for SimulationConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            imu_rate_hz: 200.0,
            camera_rate_hz: 20.0,
            noise: ImuNoise::EUROC,
            noise_scale: 1.0,
            gyro_bias_sigma: 0.02,
            accel_bias_sigma: 0.05,
            pixel_sigma: 0.5,
            outlier_share: 0.02,
            loss_share: 0.02,
            tracks: 110,
            wall_distance_m: 2.0,
            points: 2500,
            time_offset_secs: 0.0,
            gravity_mps2: GRAVITY_MPS2,
            gyro_scale: [1.0; 3],
            accel_scale: [1.0; 3],
            log_focal: [0.0; 2],
            shift: 0.0,
            stamp_scatter_secs: 0.0,
        }
    }
}

/// One frame's truth and tracks.
#[derive(Clone, Debug)]
pub struct SimulatedFrame {
    /// Its number.
    pub id: FrameId,
    /// Its stamp.
    pub time: Timestamp,
    /// The truth when it was exposed, biases included.
    pub truth: NavState,
    /// What it sees. A track that was lost comes back under another name.
    pub observations: Vec<TrackObservation>,
}

/// Sensor data of a flight.
#[derive(Clone, Debug)]
pub struct Simulation {
    /// The camera: EuRoC's.
    pub camera: CameraModel,
    /// Its place on the body.
    pub body_from_camera: Se3,
    /// IMU measurements.
    pub imu_samples: Vec<ImuSample>,
    /// True biases of the IMU measurements.
    pub biases: Vec<Bias>,
    /// Frames.
    pub frames: Vec<SimulatedFrame>,
    /// Points in the world, and of every track the number of its point.
    points: Vec<Vector3<f64>>,
    point_of: Vec<usize>,
}

/// Nanoseconds of the first stamp: like real recordings, far from zero.
const EPOCH_NANOS: i64 = 1_400_000_000_000_000_000;

/// Tells the stream of the stamps' errors apart from that of everything else.
const STAMPS: u64 = 0x5354_414d_5053;

fn stamp(secs: f64) -> Timestamp {
    Timestamp::from_nanos(EPOCH_NANOS + (secs * 1e9).round() as i64)
}

impl Simulation {
    /// EuRoC's cam0.
    pub fn camera() -> CameraModel {
        let pinhole = Pinhole { fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375, width: 752, height: 480 };
        match RadTan::new(pinhole, [-0.283_408_11, 0.073_959_07, 0.000_193_59, 1.761_871_14e-5]) {
            Ok(model) => CameraModel::RadTan(model),
            Err(_) => CameraModel::Pinhole(pinhole),
        }
    }

    /// A camera that looks along the body's z, a hand's breadth off the IMU, slightly askew as real ones are.
    pub fn body_from_camera() -> Se3 {
        let quarter = So3::exp(&(Vector3::z() * std::f64::consts::FRAC_PI_2));
        let askew = So3::exp(&Vector3::new(0.004, -0.026, 0.015));
        Se3::new(quarter * askew, Vector3::new(-0.022, -0.065, 0.010))
    }

    /// Flies `flight` from `from_secs` for `secs`.
    pub fn new(flight: &impl Flight, from_secs: f64, secs: f64, config: &SimulationConfig) -> Self {
        let secs = secs.min(flight.duration_secs() - from_secs);
        let mut random = Random::new(config.seed);
        let (imu_samples, biases) = simulate_imu(flight, from_secs, secs, config, &mut random);
        let points = scatter_points(flight, config, &mut random);
        let (camera, body_from_camera) = (Self::camera(), Self::body_from_camera());
        let frames = (secs * config.camera_rate_hz + 1e-6).floor() as usize;
        let mut tracker = Tracker { names: vec![None; points.len()], point_of: Vec::new() };
        let mut stamps = Random::new(config.seed ^ STAMPS);
        let mut all = Vec::with_capacity(frames);
        for k in 0..frames {
            let at = k as f64 / config.camera_rate_hz;
            let late = config.time_offset_secs + config.stamp_scatter_secs * stamps.normal();
            let exposed = (at + late).max(0.0);
            let motion = flight.motion(from_secs + exposed);
            let bias = biases[((exposed * config.imu_rate_hz).round() as usize).min(biases.len() - 1)];
            let truth = NavState { world_from_body: motion.world_from_body, velocity: motion.velocity, bias };
            let camera_from_world = (motion.world_from_body * body_from_camera).inverse();
            let lens = config.lens_at(at);
            let seen = |point: &Vector3<f64>| {
                let q = camera_from_world.act(point);
                // The distortion folds back far outside the image.
                if q.z < 0.3 || q.xy().norm() > 1.2 * q.z {
                    return None;
                }
                let pixel = lens.shown(&camera, &camera.project(&q)?, 0.0);
                camera.contains(&pixel, 8.0).then_some(pixel)
            };
            let observations = tracker.look(&points, seen, config, &mut random);
            all.push(SimulatedFrame { id: FrameId(k as u32), time: stamp(at), truth, observations });
        }
        let point_of = tracker.point_of;
        Self { camera, body_from_camera, imu_samples, biases, frames: all, points, point_of }
    }

    /// Where the point of a track is in the world, m.
    pub fn point(&self, track: LandmarkId) -> Option<Vector3<f64>> {
        self.points.get(*self.point_of.get(track.index())?).copied()
    }
}

fn simulate_imu(
    flight: &impl Flight,
    from_secs: f64,
    secs: f64,
    config: &SimulationConfig,
    random: &mut Random,
) -> (Vec<ImuSample>, Vec<Bias>) {
    let (scale, noise) = (config.noise_scale, &config.noise);
    let root_rate = config.imu_rate_hz.sqrt();
    let secs = secs + 2.0 * config.time_offset_secs.max(0.0) + 6.0 * config.stamp_scatter_secs;
    let count = (secs * config.imu_rate_hz + 1e-6).floor() as usize + 2;
    let mut bias = Bias {
        gyro: random.normal3() * (scale * config.gyro_bias_sigma),
        accel: random.normal3() * (scale * config.accel_bias_sigma),
    };
    let [gyro_scale, accel_scale] = [config.gyro_scale, config.accel_scale].map(Vector3::from);
    let (mut imu_samples, mut biases) = (Vec::with_capacity(count), Vec::with_capacity(count));
    for k in 0..count {
        let at = k as f64 / config.imu_rate_hz;
        let motion = flight.motion(from_secs + at);
        let gravity = Vector3::new(0.0, 0.0, -config.gravity_mps2);
        let force = motion.world_from_body.rotation.inverse() * (motion.acceleration - gravity);
        let gyro_noise = random.normal3() * (scale * noise.gyro_noise_density * root_rate);
        let accel_noise = random.normal3() * (scale * noise.accel_noise_density * root_rate);
        imu_samples.push(ImuSample {
            time: stamp(at),
            gyro: AngularRate(motion.angular_rate.component_mul(&gyro_scale) + bias.gyro + gyro_noise),
            accel: SpecificForce(force.component_mul(&accel_scale) + bias.accel + accel_noise),
        });
        biases.push(bias);
        bias.gyro += random.normal3() * (scale * noise.gyro_random_walk / root_rate);
        bias.accel += random.normal3() * (scale * noise.accel_random_walk / root_rate);
    }
    (imu_samples, biases)
}

/// Points on the walls of a room round the flight, and some within.
fn scatter_points(flight: &impl Flight, config: &SimulationConfig, random: &mut Random) -> Vec<Vector3<f64>> {
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    let steps = (flight.duration_secs() / 0.1).ceil().max(1.0) as usize;
    for k in 0..=steps {
        let at = flight.motion(flight.duration_secs() * k as f64 / steps as f64).world_from_body.translation;
        low = low.inf(&at);
        high = high.sup(&at);
    }
    let margin = Vector3::repeat(config.wall_distance_m);
    let (low, high) = (low - margin, high + margin);
    let size = high - low;
    let areas = [size.y * size.z, size.x * size.z, size.x * size.y];
    let total: f64 = areas.iter().sum();
    let inside = |random: &mut Random| {
        Vector3::new(
            random.between(low.x, high.x),
            random.between(low.y, high.y),
            random.between(low.z, high.z),
        )
    };
    let mut points = Vec::with_capacity(config.points);
    for k in 0..config.points {
        let mut point = inside(random);
        if k % 6 != 0 {
            let mut pick = random.uniform() * total;
            let mut axis = 0;
            while axis < 2 && pick > areas[axis] {
                pick -= areas[axis];
                axis += 1;
            }
            point[axis] = if random.uniform() < 0.5 { low[axis] } else { high[axis] };
        }
        points.push(point);
    }
    points
}

/// Gives tracks their names.
struct Tracker {
    names: Vec<Option<LandmarkId>>,
    /// Points of all names given so far.
    point_of: Vec<usize>,
}

impl Tracker {
    fn look(
        &mut self,
        points: &[Vector3<f64>],
        seen: impl Fn(&Vector3<f64>) -> Option<Vector2<f64>>,
        config: &SimulationConfig,
        random: &mut Random,
    ) -> Vec<TrackObservation> {
        let mut observations = Vec::with_capacity(config.tracks);
        let mut fresh = Vec::new();
        for (k, point) in points.iter().enumerate() {
            match (seen(point), self.names[k]) {
                (Some(pixel), Some(name)) => {
                    if random.uniform() < config.loss_share {
                        self.names[k] = None;
                    } else {
                        observations.push((name, pixel));
                    }
                }
                (Some(pixel), None) => fresh.push((k, pixel)),
                (None, _) => self.names[k] = None,
            }
        }
        while observations.len() < config.tracks && !fresh.is_empty() {
            let pick = ((random.uniform() * fresh.len() as f64) as usize).min(fresh.len() - 1);
            let (k, pixel) = fresh.swap_remove(pick);
            let name = LandmarkId(self.point_of.len() as u32);
            self.point_of.push(k);
            self.names[k] = Some(name);
            observations.push((name, pixel));
        }
        let variance = config.pixel_sigma.max(1e-3).powi(2);
        let mut measured = |(landmark, pixel): (LandmarkId, Vector2<f64>)| {
            let mut error = Vector2::new(random.normal(), random.normal()) * config.pixel_sigma;
            if random.uniform() < config.outlier_share {
                error = Vector2::new(random.between(-30.0, 30.0), random.between(-30.0, 30.0));
            }
            TrackObservation { landmark, pixel: pixel + error, covariance: Matrix2::identity() * variance }
        };
        observations.into_iter().map(&mut measured).collect()
    }
}
