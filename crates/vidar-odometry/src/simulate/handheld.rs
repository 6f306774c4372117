//! A hand-held camera with an unknown calibration, as feature tracks and gyroscope samples.

use super::random::Random;
use crate::calibration::LensModel;
use nalgebra::{Matrix3, Vector2, Vector3};
use vidar_core::{
    AngularRate, ImuSample, LandmarkId, LieGroup, So3, SpecificForce, Timestamp, camera::Pixel,
};

/// Steps of the exact motion, s.
const STEP_SECS: f64 = 1e-3;
/// Features that are followed at a time.
const FEATURES: usize = 160;
/// Time between images, s.
const IMAGE_SECS: f64 = 0.1;
/// Gyroscope samples a second.
const GYRO_HZ: f64 = 200.0;
/// A stabiliser takes back what is faster than about this, s.
const STABILISED_SECS: f64 = 0.7;
/// And by so much at most, rad.
const STABILISED_RAD: f64 = 0.02;

/// What is true of one recording.
#[derive(Clone, Debug)]
pub struct Handheld {
    /// Columns and rows.
    pub size: (usize, usize),
    /// Focal length, pixels.
    pub focal: f64,
    /// The kind of lens.
    pub lens: LensModel,
    /// Its first and second radial coefficient.
    pub radial: [f64; 2],
    /// Principal point, pixels.
    pub centre: Vector2<f64>,
    /// `t_imu = stamp + offset`, s.
    pub offset_secs: f64,
    /// First to last row, s.
    pub readout_secs: f64,
    /// Rotation of the camera on the body.
    pub body_from_camera: So3,
    /// Position of the camera on the body, m.
    pub lever_arm: Vector3<f64>,
    /// Gyroscope bias, rad/s, and relative scale errors.
    pub bias: Vector3<f64>,
    /// Relative errors of the gyroscope's scale.
    pub scale: Vector3<f64>,
    /// White noise, rad/s/√Hz.
    pub gyro_noise: f64,
    /// Standard deviation of a feature's position, pixels.
    pub pixel_noise: f64,
    /// Share of observations that are wrong.
    pub outliers: f64,
    /// Root mean square of the angular rate, rad/s.
    pub turning: f64,
    /// The body's axis about which it turns most, and the share that the two others have.
    pub main_axis: (usize, f64),
    /// Root mean square of the velocity, m/s.
    pub moving: f64,
    /// Share of the shake about the picture's axes that a stabiliser takes back by a shift of the lens.
    pub stabilisation: f64,
    /// Length, s.
    pub secs: f64,
    /// Seed of everything random in it.
    pub seed: u64,
}

/// What it recorded.
#[derive(Clone, Debug, Default)]
pub struct HandheldRecording {
    /// Gyroscope samples; the accelerometer is zero.
    pub samples: Vec<ImuSample>,
    /// Stamps and features.
    pub images: Vec<(Timestamp, Vec<(LandmarkId, Pixel)>)>,
}

/// A sum of sines per axis.
struct Waves(Vec<(Vector3<f64>, f64, Vector3<f64>)>);

impl Waves {
    fn new(random: &mut Random, rms: f64, low_hz: f64, high_hz: f64) -> Self {
        const COUNT: usize = 5;
        let each = rms * (2.0 / (3.0 * COUNT as f64)).sqrt();
        let wave = |k: usize, random: &mut Random| {
            let share = (k as f64 + random.uniform()) / COUNT as f64;
            let hz = low_hz * (high_hz / low_hz).powf(share);
            let amplitude = Vector3::from_fn(|_, _| each * random.between(0.4, 1.6));
            let phase = Vector3::from_fn(|_, _| random.between(0.0, 6.3));
            (amplitude, 2.0 * std::f64::consts::PI * hz, phase)
        };
        Self((0..COUNT).map(|k| wave(k, random)).collect())
    }

    fn at(&self, t: f64) -> Vector3<f64> {
        let wave = |(a, w, p): &(Vector3<f64>, f64, Vector3<f64>)| a.zip_map(p, |a, p| a * (w * t + p).sin());
        self.0.iter().map(wave).sum()
    }

    /// The sines whose derivative these are.
    fn integral_at(&self, t: f64) -> Vector3<f64> {
        let wave =
            |(a, w, p): &(Vector3<f64>, f64, Vector3<f64>)| a.zip_map(p, |a, p| -a / w * (w * t + p).cos());
        self.0.iter().map(wave).sum()
    }
}

impl Handheld {
    /// The draw of a seed: focal length 0.6 to 1.2 widths, k1 −0.3 to 0.1, clock ±100 ms, readout 0 to 33 ms, any axis
    /// permutation with some degrees more, a consumer gyroscope, 20 s of turning and moving by hand.
    pub fn draw(seed: u64) -> Self {
        let mut r = Random::new(seed);
        let (width, height) = (640.0, 480.0);
        let focal = r.between(0.6, 1.2) * width;
        let k2 = r.between(-0.03, 0.06);
        // A lens whose image folds back within the frame does not exist.
        let corner = 0.5 * f64::hypot(width, height) / focal;
        let mut k1 = r.between(-0.3, 0.1);
        while !is_one_to_one(k1, k2, corner) {
            k1 *= 0.8;
        }
        let near = So3::exp(&(r.normal3() * 0.05));
        Self {
            size: (640, 480),
            focal,
            lens: LensModel::RadTan,
            radial: [k1, k2],
            centre: Vector2::new(319.5 + 0.01 * width * r.normal(), 239.5 + 0.01 * width * r.normal()),
            offset_secs: r.between(-0.1, 0.1),
            readout_secs: r.between(0.0, 0.033),
            body_from_camera: axis_permutation(&mut r) * near,
            lever_arm: r.normal3() * 0.03,
            bias: r.normal3() * 0.02,
            scale: r.normal3() * 0.005,
            gyro_noise: 5e-4,
            pixel_noise: r.between(0.3, 0.7),
            outliers: r.between(0.05, 0.1),
            turning: r.between(0.3, 1.2),
            main_axis: (0, 1.0),
            moving: r.between(0.05, 0.5),
            stabilisation: 0.0,
            secs: 20.0,
            seed,
        }
    }

    /// The same with an action camera's fisheye: 100° to 140° over the width.
    pub fn draw_fisheye(seed: u64) -> Self {
        let narrow = Self::draw(seed);
        let mut r = Random::new(seed ^ 0xf15e);
        Self {
            focal: 640.0 / r.between(100.0, 140.0_f64).to_radians(),
            lens: LensModel::Equidistant,
            radial: [r.between(-0.02, 0.06), r.between(-0.01, 0.01)],
            ..narrow
        }
    }

    /// Records.
    pub fn record(&self) -> HandheldRecording {
        let mut r = Random::new(self.seed ^ 0x5eed);
        let waves = Waves::new(&mut r, self.turning, 0.12, 2.0);
        let (main, others) = self.main_axis;
        let shares = Vector3::from_fn(|axis, _| if axis == main { 1.0 } else { others });
        let rates = |t: f64| waves.at(t).component_mul(&shares);
        let velocities = Waves::new(&mut r, self.moving, 0.08, 1.5);
        let begin = -0.6;
        let steps = ((self.secs + 1.2) / STEP_SECS) as usize;
        let mut turn = So3::IDENTITY;
        let mut orientations = Vec::with_capacity(steps);
        let camera_from_body = self.body_from_camera.inverse();
        let mut shake = Vector2::zeros();
        let mut shifts = Vec::with_capacity(steps);
        for k in 0..steps {
            orientations.push(turn);
            shifts
                .push(shake.map(|a: f64| STABILISED_RAD * (a / STABILISED_RAD).tanh()) * self.stabilisation);
            let step = rates(begin + (k as f64 + 0.5) * STEP_SECS) * STEP_SECS;
            turn = turn * So3::exp(&step);
            // About the camera's x the picture moves down, about its y to the left.
            let seen = camera_from_body * step;
            shake = shake * (-STEP_SECS / STABILISED_SECS).exp() + Vector2::new(seen.y, -seen.x);
        }
        let step_of = |t: f64| ((t - begin) / STEP_SECS).clamp(0.0, steps as f64 - 1.0);
        let orientation = |t: f64| {
            let at = step_of(t);
            let k = at as usize;
            orientations[k] * So3::exp(&(rates(t) * ((at - k as f64) * STEP_SECS)))
        };
        // The body turns about a joint behind it, as a hand does.
        let joint = r.normal3() * 0.12;
        let centre = Vector3::from_fn(|_, _| r.between(-0.4, 0.4));
        let camera = |t: f64| {
            let world_from_body = orientation(t);
            let position = centre + velocities.integral_at(t) + world_from_body * (joint + self.lever_arm);
            (world_from_body * self.body_from_camera, position, shifts[step_of(t) as usize])
        };
        let points = room(&mut r);
        let mut out = HandheldRecording::default();
        let noise = self.gyro_noise * GYRO_HZ.sqrt();
        for k in 0..((self.secs + 1.0) * GYRO_HZ) as usize {
            let t = -0.5 + k as f64 / GYRO_HZ;
            let rate = rates(t);
            let measured = rate - rate.component_mul(&self.scale) + self.bias + r.normal3() * noise;
            out.samples.push(ImuSample {
                time: stamp(t),
                gyro: AngularRate(measured),
                accel: SpecificForce(Vector3::zeros()),
            });
        }
        self.follow(&mut r, &points, &camera, &mut out);
        out
    }

    fn follow(
        &self,
        r: &mut Random,
        points: &[Vector3<f64>],
        camera: &impl Fn(f64) -> (So3, Vector3<f64>, Vector2<f64>),
        out: &mut HandheldRecording,
    ) {
        /// A point that is followed, and how far it slides a frame where the tracker is wrong.
        struct Followed {
            point: usize,
            id: u32,
            slide: Vector2<f64>,
            slid: Vector2<f64>,
        }
        let mut followed: Vec<Followed> = Vec::new();
        let mut next_id = 0;
        for k in 0..(self.secs / IMAGE_SECS) as usize {
            let secs = k as f64 * IMAGE_SECS + r.between(-0.003, 0.003);
            let seen = |p: usize| self.pixel(&points[p], secs + self.offset_secs, camera);
            followed.retain(|f| seen(f.point).is_some());
            followed.retain(|_| r.uniform() > 0.02);
            for _ in 0..4 * FEATURES {
                if followed.len() >= FEATURES {
                    break;
                }
                let point = (r.uniform() * points.len() as f64) as usize;
                if followed.iter().all(|f| f.point != point) && seen(point).is_some() {
                    let slides = r.uniform() < 0.5 * self.outliers;
                    let slide =
                        if slides { Vector2::new(r.normal(), r.normal()) * 2.0 } else { Vector2::zeros() };
                    followed.push(Followed { point, id: next_id, slide, slid: Vector2::zeros() });
                    next_id += 1;
                }
            }
            let mut features = Vec::with_capacity(followed.len());
            for f in &mut followed {
                let Some(pixel) = seen(f.point) else { continue };
                f.slid += f.slide;
                let mut error = Vector2::new(r.normal(), r.normal()) * self.pixel_noise;
                if r.uniform() < 0.5 * self.outliers {
                    error += Vector2::new(r.normal(), r.normal()) * 15.0;
                }
                features.push((LandmarkId(f.id), pixel + f.slid + error));
            }
            out.images.push((stamp(secs), features));
        }
    }

    /// Where a point shows at the time of the centre row on the gyroscope's clock, by a camera's orientation, position and shift (focal lengths).
    fn pixel(
        &self,
        point: &Vector3<f64>,
        secs: f64,
        camera: &impl Fn(f64) -> (So3, Vector3<f64>, Vector2<f64>),
    ) -> Option<Pixel> {
        let (width, height) = (self.size.0 as f64, self.size.1 as f64);
        let mut late = 0.0;
        let mut pixel = Vector2::zeros();
        for _ in 0..4 {
            let (world_from_camera, position, shift) = camera(secs + late);
            let p = world_from_camera.inverse() * (point - position);
            let [k1, k2] = self.radial;
            let is_pinhole = self.lens == LensModel::RadTan;
            if p.norm() < 0.2 || is_pinhole && (p.z < 0.2 || !is_one_to_one(k1, k2, p.xy().norm() / p.z)) {
                return None;
            }
            pixel = self.centre + self.lens.project(self.focal, self.radial, &p)?.at + shift * self.focal;
            late = (pixel.y / (height - 1.0) - 0.5) * self.readout_secs;
        }
        let inside = pixel.x > 8.0 && pixel.y > 8.0 && pixel.x < width - 9.0 && pixel.y < height - 9.0;
        inside.then_some(pixel)
    }
}

fn is_one_to_one(k1: f64, k2: f64, radius: f64) -> bool {
    (0..=20).all(|k| {
        let r2 = (radius * f64::from(k) / 20.0).powi(2);
        1.0 + r2 * (3.0 * k1 + r2 * 5.0 * k2) > 0.25
    })
}

/// Points on the walls of a room of 5 × 4 × 2.6 m and on things in it.
fn room(r: &mut Random) -> Vec<Vector3<f64>> {
    let half = Vector3::new(2.5, 2.0, 1.3);
    let mut points = Vec::new();
    for k in 0..4000 {
        let mut p = Vector3::from_fn(|_, _| r.between(-1.0, 1.0));
        let axis = k % 3;
        p[axis] = p[axis].signum();
        let depth = if k % 4 == 0 { r.between(0.45, 0.9) } else { 1.0 };
        points.push(p.component_mul(&half) * depth);
    }
    points
}

/// One of the 24 rotations that map axes to axes.
fn axis_permutation(r: &mut Random) -> So3 {
    loop {
        let first = (r.uniform() * 6.0) as usize;
        let second = (r.uniform() * 6.0) as usize;
        if first % 3 == second % 3 {
            continue;
        }
        let axis = |k: usize| {
            let mut v = Vector3::zeros();
            v[k % 3] = if k < 3 { 1.0 } else { -1.0 };
            v
        };
        let (x, y) = (axis(first), axis(second));
        let matrix = Matrix3::from_columns(&[x, y, x.cross(&y)]);
        return So3::from_matrix(&matrix).unwrap_or(So3::IDENTITY);
    }
}

fn stamp(secs: f64) -> Timestamp {
    Timestamp::from_nanos(10_000_000_000 + (secs * 1e9).round() as i64)
}
