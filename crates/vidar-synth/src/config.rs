//! What to simulate.

use crate::bounds::{ensure, within};
use crate::device::DeviceConfig;
use crate::error::SynthError;
use serde::{Deserialize, Serialize};
use vidar_core::ImuNoise;

/// Which kind of place the world is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneKind {
    /// A furnished room of 8 × 8 × 4 m, like EuRoC's Vicon room.
    #[default]
    Room,
    /// A machine hall of 20 × 15 × 7 m.
    Hall,
    /// A corridor of 30 × 3 × 3 m with doors and niches.
    Corridor,
}

/// How much places of one kind differ from seed to seed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variety {
    /// Size, light and style of the place are always the same; furniture, textures and pictures differ.
    #[default]
    Standard,
    /// Size, light, materials and kinds of furniture differ as well, windows and lamps may shine, walls may be bare:
    /// places to train networks on. Built-in flights shrink and grow with the place.
    Randomized,
    /// Randomized places of a home's size, with kitchens, set tables, desks and beds full of small objects. Whatever
    /// [`SceneKind`] is chosen, rooms have the size of a home's.
    Home,
}

/// Built-in flights; a trajectory file takes their place when one is given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FlightKind {
    /// Round the place looking outward (along a corridor: out and back), about 0.9 m/s. Sees nearly everything.
    #[default]
    Sweep,
    /// Round the place looking inward (along a corridor: looking ahead), about 1.1 m/s.
    Orbit,
    /// Figures of eight with roll, pitch and yaw, about 2 m/s, up to about 2 rad/s.
    Aggressive,
    /// A hand-held camera, mostly below 0.5 m/s: standing, turning on the spot, walking a few steps, swaying always.
    Handheld,
    /// A hand-held camera in lively use: brisk steps (up to 2 m/s for moments) and quick turns (up to 3 rad/s).
    HandheldLively,
}

/// How the sequence begins.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Start {
    /// The body sits still for `secs`, then lifts off smoothly.
    Static {
        /// Seconds of stillness, 0…60.
        secs: f64,
    },
    /// The body is already moving in the first frame.
    InFlight,
}

/// What to simulate. The default is the demo's room: small images, ten seconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SynthConfig {
    /// Everything random follows from it: same seed, same files. 0…2⁶³−1.
    pub seed: u64,
    /// Which kind of place.
    pub scene: SceneKind,
    /// How much places differ from seed to seed.
    pub variety: Variety,
    /// Which built-in flight; unused when a trajectory is given.
    pub flight: FlightKind,
    /// Whether the body first sits still. Visual-inertial odometry needs either kind tested.
    pub start: Start,
    /// Length of the sequence, s, 0.1…3600; a given trajectory may end it earlier.
    pub duration_secs: f64,
    /// Frames per second, 0.1…1000.
    pub camera_rate_hz: f64,
    /// IMU samples per second, 10…10000; at least the camera's rate.
    pub imu_rate_hz: f64,
    /// Columns of the images, 16…8192; EuRoC's cam0 (752 × 480, radial-tangential) is scaled to the size.
    pub width: usize,
    /// Rows of the images, 16…8192.
    pub height: usize,
    /// Exposure time, s, 0…0.1; the stamp is its middle. 0 renders without motion blur.
    pub exposure_secs: f64,
    /// Rays per pixel, 1…64, spread over the exposure and over the pixel's area.
    pub blur_samples: usize,
    /// Relative amplitude of the slow change of exposure, 0…0.9. 0.1 is a calm room, 0.3 a flight past windows.
    pub exposure_drift: f64,
    /// Standard deviation of the image noise at mid grey, grey levels of 255, 0…50 (half read, half shot noise).
    pub image_noise_sigma: f64,
    /// Darkening of the image's corners, 0 (none) … 1 (black).
    pub vignetting: f64,
    /// Data sheet of the IMU; its `rate_hz` is replaced by `imu_rate_hz`.
    pub imu_noise: ImuNoise,
    /// Factor on all IMU noise, bias walks and initial biases, 0…1000; 0 gives the exact motion.
    pub imu_noise_scale: f64,
    /// Standard deviation of the gyroscope's first bias, rad/s per axis, 0…1.
    pub initial_gyro_bias_rad_per_s: f64,
    /// Standard deviation of the accelerometer's first bias, m/s² per axis, 0…5.
    pub initial_accel_bias_m_per_s2: f64,
    /// Whether a depth image is written for every frame.
    pub depth: bool,
    /// Mean distance between neighbouring points of the reference cloud, m, 0.002…1.
    pub scan_spacing_m: f64,
    /// Standard deviation of the reference cloud along the surface normal, m, 0…0.1.
    pub scan_noise_m: f64,
    /// Pieces of furniture to try to place per 64 m² of floor (at most four times as many in large places), 0…1000;
    /// what does not fit beside the flight is left out.
    pub clutter: usize,
    /// Width of the Gaussian that smooths a given trajectory's jitter, s, 0…1. 0 passes through every pose.
    pub trajectory_smoothing_secs: f64,
    /// Share of walls, floor, ceiling and furniture without texture, 0…1.
    pub bare_share: f64,
    /// How the sequence is recorded: lens, mount, shutter, clocks, compression, calibration.
    pub device: DeviceConfig,
}

impl Default for SynthConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            scene: SceneKind::Room,
            variety: Variety::Standard,
            flight: FlightKind::Sweep,
            start: Start::InFlight,
            duration_secs: 10.0,
            camera_rate_hz: 10.0,
            imu_rate_hz: 200.0,
            width: 376,
            height: 240,
            exposure_secs: 0.004,
            blur_samples: 3,
            exposure_drift: 0.08,
            image_noise_sigma: 1.5,
            vignetting: 0.15,
            imu_noise: ImuNoise::EUROC,
            imu_noise_scale: 1.0,
            initial_gyro_bias_rad_per_s: 0.02,
            initial_accel_bias_m_per_s2: 0.05,
            depth: true,
            scan_spacing_m: 0.02,
            scan_noise_m: 0.0,
            clutter: 45,
            trajectory_smoothing_secs: 0.06,
            bare_share: 0.0,
            device: DeviceConfig::default(),
        }
    }
}

impl SynthConfig {
    /// The demo's room: 376 × 240 at 10 Hz, a second of stillness and ten of flight.
    pub fn demo() -> Self {
        Self { start: Start::Static { secs: 1.0 }, duration_secs: 11.0, ..Self::default() }
    }

    /// As EuRoC's recordings: 752 × 480 at 20 Hz, IMU at 200 Hz with data-sheet noise, 60 s after a static start.
    pub fn euroc() -> Self {
        Self {
            start: Start::Static { secs: 3.0 },
            duration_secs: 60.0,
            camera_rate_hz: 20.0,
            width: 752,
            height: 480,
            exposure_secs: 0.008,
            blur_samples: 5,
            exposure_drift: 0.15,
            image_noise_sigma: 2.0,
            initial_gyro_bias_rad_per_s: 0.05,
            initial_accel_bias_m_per_s2: 0.1,
            scan_spacing_m: 0.01,
            ..Self::default()
        }
    }

    /// Checks every key against its domain.
    pub fn validate(&self) -> Result<(), SynthError> {
        let seed_limit = i64::MAX as u64; // TOML integers are signed.
        ensure(self.seed <= seed_limit, "seed", "0 to 2^63-1", self.seed)?;
        within("duration_secs", self.duration_secs, 0.1, 3600.0, "0.1 to 3600 s")?;
        within("camera_rate_hz", self.camera_rate_hz, 0.1, 1000.0, "0.1 to 1000 Hz")?;
        within("imu_rate_hz", self.imu_rate_hz, 10.0, 10_000.0, "10 to 10000 Hz")?;
        let imu_is_faster = self.imu_rate_hz >= self.camera_rate_hz;
        ensure(imu_is_faster, "imu_rate_hz", "at least camera_rate_hz", self.imu_rate_hz)?;
        ensure((16..=8192).contains(&self.width), "width", "16 to 8192 pixels", self.width)?;
        ensure((16..=8192).contains(&self.height), "height", "16 to 8192 pixels", self.height)?;
        within("exposure_secs", self.exposure_secs, 0.0, 0.1, "0 to 0.1 s")?;
        let shutter_fits = self.exposure_secs * self.camera_rate_hz <= 1.0;
        ensure(shutter_fits, "exposure_secs", "at most 1/camera_rate_hz", self.exposure_secs)?;
        ensure((1..=64).contains(&self.blur_samples), "blur_samples", "1 to 64", self.blur_samples)?;
        within("exposure_drift", self.exposure_drift, 0.0, 0.9, "0 to 0.9")?;
        within("image_noise_sigma", self.image_noise_sigma, 0.0, 50.0, "0 to 50 grey levels")?;
        within("vignetting", self.vignetting, 0.0, 1.0, "0 to 1")?;
        let noise = &self.imu_noise;
        for (key, value) in [
            ("imu_noise.gyro_noise_density", noise.gyro_noise_density),
            ("imu_noise.gyro_random_walk", noise.gyro_random_walk),
            ("imu_noise.accel_noise_density", noise.accel_noise_density),
            ("imu_noise.accel_random_walk", noise.accel_random_walk),
        ] {
            within(key, value, 0.0, 10.0, "0 to 10")?;
        }
        within("imu_noise_scale", self.imu_noise_scale, 0.0, 1000.0, "0 to 1000")?;
        within("initial_gyro_bias_rad_per_s", self.initial_gyro_bias_rad_per_s, 0.0, 1.0, "0 to 1 rad/s")?;
        within("initial_accel_bias_m_per_s2", self.initial_accel_bias_m_per_s2, 0.0, 5.0, "0 to 5 m/s²")?;
        within("scan_spacing_m", self.scan_spacing_m, 0.002, 1.0, "0.002 to 1 m")?;
        within("scan_noise_m", self.scan_noise_m, 0.0, 0.1, "0 to 0.1 m")?;
        ensure(self.clutter <= 1000, "clutter", "0 to 1000", self.clutter)?;
        within("trajectory_smoothing_secs", self.trajectory_smoothing_secs, 0.0, 1.0, "0 to 1 s")?;
        within("bare_share", self.bare_share, 0.0, 1.0, "0 to 1")?;
        self.device.validate()?;
        if let Start::Static { secs } = self.start {
            within("start.static.secs", secs, 0.0, 60.0, "0 to 60 s")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid() {
        SynthConfig::default().validate().unwrap();
        for name in crate::PRESETS {
            let config = SynthConfig::preset(name).unwrap();
            config.validate().unwrap();
            config.camera().unwrap();
        }
    }

    #[test]
    fn each_bad_key_is_named() {
        type Corrupt = fn(&mut SynthConfig);
        let cases: [(&str, Corrupt); 14] = [
            ("seed", |c| c.seed = u64::MAX),
            ("duration_secs", |c| c.duration_secs = 0.0),
            ("camera_rate_hz", |c| c.camera_rate_hz = f64::NAN),
            ("imu_rate_hz", |c| (c.imu_rate_hz, c.camera_rate_hz) = (20.0, 30.0)),
            ("width", |c| c.width = 3),
            ("height", |c| c.height = 100_000),
            ("exposure_secs", |c| (c.exposure_secs, c.camera_rate_hz) = (0.02, 60.0)),
            ("blur_samples", |c| c.blur_samples = 0),
            ("exposure_drift", |c| c.exposure_drift = -0.1),
            ("imu_noise.gyro_random_walk", |c| c.imu_noise.gyro_random_walk = f64::INFINITY),
            ("scan_spacing_m", |c| c.scan_spacing_m = 0.0),
            ("scan_noise_m", |c| c.scan_noise_m = 1.0),
            ("clutter", |c| c.clutter = 1_000_000),
            ("start.static.secs", |c| c.start = Start::Static { secs: -1.0 }),
        ];
        for (name, corrupt) in cases {
            let mut config = SynthConfig::default();
            corrupt(&mut config);
            match config.validate() {
                Err(SynthError::BadConfig { key, .. }) => assert_eq!(key, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }

    #[test]
    fn toml_round_trip_keeps_every_key_and_refuses_unknown_ones() {
        let still = SynthConfig { start: Start::Static { secs: 2.5 }, ..SynthConfig::euroc() };
        for config in [still, SynthConfig::phone_slow()] {
            let text = toml::to_string(&config).unwrap();
            assert_eq!(toml::from_str::<SynthConfig>(&text).unwrap(), config);
        }
        assert!(toml::from_str::<SynthConfig>("widht = 3").is_err());
    }
}
