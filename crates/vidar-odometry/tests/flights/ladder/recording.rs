//! One small rendered flight, and what may be done to it.

use nalgebra::Vector3;
use std::sync::OnceLock;
use vidar_core::random::SplitMix64;
use vidar_core::{
    AngularRate, BodyFrame, CameraId, Duration, Frame, FrameId, FrameImage, Image, ImuSample, LieGroup, Rig,
    SensorEvent, SpecificForce, StampedPose, Timestamp, Trajectory,
};
use vidar_eval::{TrajectoryEvalConfig, TrajectoryReport, evaluate_trajectory};
use vidar_odometry::{Odometry, OdometryConfig, OdometryOutput, Status};
use vidar_synth::{FlightPath, Start, SynthConfig, SynthView, World, render_views, simulate_imu};

pub const EPOCH: Timestamp = Timestamp::from_nanos(1_600_000_000_000_000_000);
pub const RATE_HZ: i64 = 20;

/// A flight with everything a test may corrupt.
#[derive(Clone)]
pub struct Recording {
    pub rig: Rig,
    pub images: Vec<(Timestamp, Image<u8>)>,
    pub imu: Vec<ImuSample>,
    pub truth: Vec<StampedPose>,
    pub config: OdometryConfig,
}

pub fn recording() -> Recording {
    static ONCE: OnceLock<Recording> = OnceLock::new();
    ONCE.get_or_init(render).clone()
}

fn render() -> Recording {
    rendered(7.0, 0.0, 1)
}

/// A flight whose images are exposed for `exposure_secs`, in so many instants.
pub fn rendered(duration_secs: f64, exposure_secs: f64, instants: usize) -> Recording {
    rendered_from(Start::InFlight, duration_secs, exposure_secs, instants)
}

/// The same with a start of one's choice.
pub fn rendered_from(start: Start, duration_secs: f64, exposure_secs: f64, instants: usize) -> Recording {
    // A start from rest is also flown backwards, where a gyroscope bias would change its sign.
    let gyro_bias = if start == Start::InFlight { 0.02 } else { 0.0 };
    let config = SynthConfig {
        start,
        duration_secs,
        camera_rate_hz: RATE_HZ as f64,
        initial_gyro_bias_rad_per_s: gyro_bias,
        initial_accel_bias_m_per_s2: 0.05,
        ..SynthConfig::default()
    };
    let flight = FlightPath::built_in(&config).unwrap();
    rendered_along(&flight, &config, exposure_secs, instants)
}

/// The built-in flight after `rest_secs` at rest and two seconds in which the body creeps along it at a hundredth of its speed.
/// A hand trembles all along: three times a second by `tremor_m`.
pub fn rendered_after_creeping(duration_secs: f64, rest_secs: f64, tremor_m: f64) -> Recording {
    let config = SynthConfig {
        duration_secs,
        camera_rate_hz: RATE_HZ as f64,
        initial_accel_bias_m_per_s2: 0.05,
        ..SynthConfig::default()
    };
    let flight = FlightPath::built_in(&config).unwrap();
    let ramp = |secs: f64| (secs.clamp(0.0, 1.0) * std::f64::consts::FRAC_PI_2).sin().powi(2);
    let speed = |secs: f64| 0.01 * ramp(2.0 * (secs - rest_secs)) + 0.99 * ramp(secs - rest_secs - 2.0);
    let mut along = 0.0;
    let poses = (0..=((duration_secs + 1.0) * 100.0) as i64).map(|k| {
        let secs = k as f64 / 100.0;
        let mut world_from_body = flight.world_from_body(along);
        let phase = 6.0 * std::f64::consts::PI * secs;
        world_from_body.translation += Vector3::new(phase.sin(), phase.cos(), 0.0) * tremor_m;
        along += 0.01 * speed(secs);
        StampedPose { time: EPOCH + Duration::from_millis(10 * k), world_from_body }
    });
    let path = Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap();
    rendered_along(&FlightPath::new(&config, Some(&path)).unwrap(), &config, 0.0, 1)
}

fn rendered_along(
    flight: &FlightPath,
    config: &SynthConfig,
    exposure_secs: f64,
    instants: usize,
) -> Recording {
    let world = World::build(config, flight).unwrap();
    let camera = vidar_synth::euroc_camera(config.width, config.height).unwrap();
    let count = (config.duration_secs * RATE_HZ as f64) as i64;
    let times: Vec<Timestamp> =
        (0..count).map(|k| EPOCH + Duration::from_millis(k * 1000 / RATE_HZ)).collect();
    let secs = |t: &Timestamp| (*t - EPOCH).as_secs_f64();
    let body_from_camera = vidar_synth::euroc_body_from_camera();
    let middle = 0.5 * (instants as f64 - 1.0);
    let views: Vec<SynthView> = times
        .iter()
        .flat_map(|t| (0..instants).map(move |k| (t, (k as f64 - middle) / instants as f64 * exposure_secs)))
        .map(|(t, shift)| SynthView {
            world_from_camera: flight.world_from_body(secs(t) + shift) * body_from_camera,
            camera: camera.clone(),
        })
        .collect();
    let rendered = render_views(&world, &views, 1).unwrap();
    let gray: Vec<Image<u8>> = rendered.iter().map(|v| v.image.to_gray8()).collect();
    let images = gray.chunks(instants).enumerate();
    let images = images.map(|(k, c)| (times[k], add_noise(&mean(c), 1.5, k as u64))).collect();
    let truth = times
        .iter()
        .map(|t| StampedPose { time: *t, world_from_body: flight.world_from_body(secs(t)) })
        .collect();
    let rig = vidar_synth::euroc_rig(config.width, config.height).unwrap();
    let imu = simulate_imu(flight, config).samples;
    Recording { rig, images, imu, truth, config: OdometryConfig::default() }
}

fn mean(images: &[Image<u8>]) -> Image<u8> {
    let n = images.len() as u32;
    let at = |x, y| (images.iter().map(|i| u32::from(i[(x, y)])).sum::<u32>() + n / 2) / n;
    Image::from_fn(images[0].width(), images[0].height(), |x, y| at(x, y) as u8)
}

/// What the clean flight gives.
pub fn clean_outputs() -> &'static [OdometryOutput] {
    static ONCE: OnceLock<Vec<OdometryOutput>> = OnceLock::new();
    ONCE.get_or_init(|| recording().run())
}

/// Noise of standard deviation `sigma` grey levels, always the same for one `seed`. By a generator of its own (Marsaglia's xorshift): the
/// figures of the ladder were measured with it.
pub fn add_noise(image: &Image<u8>, sigma: f64, seed: u64) -> Image<u8> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut uniform = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1_u64 << 53) as f64
    };
    // Four uniforms make a fair bell of variance 1/3.
    image.map(|&p| {
        let bell: f64 = (0..4).map(|_| uniform() - 0.5).sum();
        (f64::from(p) + bell * sigma * 3.0_f64.sqrt()).round().clamp(0.0, 255.0) as u8
    })
}

impl Recording {
    /// All events in the order of time, IMU measurements first.
    pub fn events(&self) -> Vec<SensorEvent> {
        let mut events: Vec<SensorEvent> = self.imu.iter().map(|s| SensorEvent::Imu(*s)).collect();
        events.extend(self.images.iter().enumerate().map(|(k, (time, image))| {
            SensorEvent::Image(Frame {
                id: FrameId(k as u32),
                time: *time,
                camera: CameraId(0),
                image: FrameImage::Gray8(image.clone()),
            })
        }));
        events.sort_by_key(|e| (e.time(), matches!(e, SensorEvent::Image(_))));
        events
    }

    pub fn run(&self) -> Vec<OdometryOutput> {
        self.run_events(self.events()).0
    }

    pub fn run_events(&self, events: Vec<SensorEvent>) -> (Vec<OdometryOutput>, Odometry) {
        let mut odometry = Odometry::new(&self.rig, CameraId(0), &self.config).unwrap();
        let mut outputs: Vec<OdometryOutput> =
            events.into_iter().filter_map(|e| odometry.push(e).unwrap()).collect();
        outputs.extend(odometry.finish());
        (outputs, odometry)
    }

    /// Evaluates the poses that were reported as metric, all of one segment.
    pub fn evaluate(&self, outputs: &[OdometryOutput]) -> TrajectoryReport {
        let poses: Vec<StampedPose> = outputs
            .iter()
            .filter_map(|o| Some((o.time, o.tracking().filter(|t| t.health.is_metric())?)))
            .map(|(time, t)| StampedPose { time, world_from_body: t.state.world_from_body })
            .collect();
        let segments: Vec<u32> = outputs.iter().filter_map(|o| Some(o.tracking()?.segment)).collect();
        assert!(segments.windows(2).all(|w| w[0] == w[1]), "one segment: {segments:?}");
        let estimate = Trajectory::new(BodyFrame::Imu, poses).unwrap();
        let truth = Trajectory::new(BodyFrame::Imu, self.truth.clone()).unwrap();
        evaluate_trajectory(&estimate, &truth, &TrajectoryEvalConfig::default()).unwrap()
    }

    /// Error of the metric poses after the best rigid motion, and the share of images with one; with `--nocapture` also
    /// the row of the table in `BENCHMARK.md` that is called `rung`.
    pub fn error_and_share(&self, rung: &str, outputs: &[OdometryOutput]) -> (f64, f64) {
        let report = self.evaluate(outputs);
        let error = report.ate_se3_m.unwrap().rmse;
        let share = report.estimate_poses as f64 / self.images.len() as f64;
        let scale = report.scale_error.unwrap_or(f64::NAN);
        let first = outputs.iter().find(|o| o.health().is_metric()).map_or(f64::NAN, |o| self.secs(o));
        eprintln!(
            "| {rung} | {error:.4} | {scale:.4} | {:.0} % | {first:.2} | {} |",
            100.0 * share,
            lost(outputs).len()
        );
        (error, share)
    }

    /// Seconds from the first image to that of an output.
    fn secs(&self, output: &OdometryOutput) -> f64 {
        (output.time - self.images[0].0).as_secs_f64()
    }
}

pub fn lost(outputs: &[OdometryOutput]) -> Vec<String> {
    let reason = |o: &OdometryOutput| match &o.status {
        Status::Lost(reason) => Some(reason.to_string()),
        _ => None,
    };
    outputs.iter().filter_map(reason).collect()
}

/// Whether every pose reported as healthy and metric is within `limit_m` of the truth after the best rigid motion.
pub fn within(rung: &str, recording: &Recording, outputs: &[OdometryOutput], limit_m: f64) {
    let (ate, share) = recording.error_and_share(rung, outputs);
    assert!(ate < limit_m, "{rung}: {ate} m of {limit_m} m, {share} of the images");
}

impl Recording {
    /// Nothing but rest: the first image again and again at 10 Hz, with fresh noise.
    pub fn standing(&self, secs: i64) -> Self {
        let mut standing = self.clone();
        let picture = &self.images[0].1;
        standing.images = (0..secs * 10)
            .map(|k| (EPOCH + Duration::from_millis(100 * k), add_noise(picture, 1.5, k as u64)))
            .collect();
        let up = self.truth[0].world_from_body.rotation.inverse() * Vector3::new(0.0, 0.0, 9.81);
        standing.imu = (0..secs * 200)
            .map(|k| sample_at_rest(EPOCH + Duration::from_millis(5 * k), &up, k as u64))
            .collect();
        standing
    }
}

/// What an IMU measures at rest, with a gyroscope bias of 0.01 rad/s about x.
pub fn sample_at_rest(time: Timestamp, up_in_body: &Vector3<f64>, seed: u64) -> ImuSample {
    let mut random = SplitMix64::new(seed);
    let mut noise = || random.uniform() - 0.5;
    let gyro = Vector3::from_fn(|_, _| 0.008 * noise()) + Vector3::new(0.01, 0.0, 0.0);
    let accel = up_in_body + Vector3::from_fn(|_, _| 0.1 * noise());
    ImuSample { time, gyro: AngularRate(gyro), accel: SpecificForce(accel) }
}
