//! Ready-made configurations of ordinary recordings.

use crate::config::{FlightKind, Start, SynthConfig};
use crate::device::{DeviceConfig, Lens, Mount};
use vidar_core::ImuNoise;

/// Names of all presets, as [`SynthConfig::preset`] takes them.
pub const PRESETS: [&str; 6] = ["demo", "euroc", "phone-slow", "phone-fast", "realsense", "tumvi"];

/// A consumer IMU, pessimistically: what phones and depth cameras have.
const CONSUMER_IMU: ImuNoise = ImuNoise {
    gyro_noise_density: 5e-4,
    gyro_random_walk: 2e-5,
    accel_noise_density: 5e-3,
    accel_random_walk: 1e-3,
    ..ImuNoise::EUROC
};

/// The BMI160 of the TUM-VI rig (Schubert et al., "The TUM VI benchmark", IROS 2018).
const TUM_VI_IMU: ImuNoise = ImuNoise {
    gyro_noise_density: 1.6e-4,
    gyro_random_walk: 2.2e-6,
    accel_noise_density: 2.8e-3,
    accel_random_walk: 8.6e-5,
    ..ImuNoise::EUROC
};

impl SynthConfig {
    /// The preset `name` of [`PRESETS`].
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "demo" => Some(Self::demo()),
            "euroc" => Some(Self::euroc()),
            "phone-slow" => Some(Self::phone_slow()),
            "phone-fast" => Some(Self::phone_fast()),
            "realsense" => Some(Self::realsense()),
            "tumvi" => Some(Self::tumvi()),
            _ => None,
        }
    }

    /// At another image size; a lens given in pixels is scaled with the width.
    #[must_use]
    pub fn resized(self, width: usize, height: usize) -> Self {
        let scale = width as f64 / self.width as f64;
        let mut lens = self.device.lens;
        if let Lens::Radtan { focal_px, centre_offset_px, .. }
        | Lens::Equidistant { focal_px, centre_offset_px, .. } = &mut lens
        {
            *focal_px *= scale;
            centre_offset_px.iter_mut().for_each(|offset| *offset *= scale);
        }
        Self { width, height, device: DeviceConfig { lens, ..self.device }, ..self }
    }

    /// What hand-held recordings of 30 s at 640 × 480 have in common: consumer IMU, noise, changing exposure.
    fn ordinary() -> Self {
        Self {
            flight: FlightKind::Handheld,
            start: Start::InFlight,
            duration_secs: 30.0,
            camera_rate_hz: 30.0,
            width: 640,
            height: 480,
            exposure_secs: 0.01,
            exposure_drift: 0.3,
            image_noise_sigma: 3.0,
            vignetting: 0.25,
            imu_noise: CONSUMER_IMU,
            initial_gyro_bias_rad_per_s: 0.01,
            initial_accel_bias_m_per_s2: 0.1,
            depth: false,
            scan_spacing_m: 0.05,
            device: DeviceConfig {
                frame_jitter: 0.01,
                jpeg_quality: 80,
                imu_scale_sigma: 0.005,
                ..DeviceConfig::default()
            },
            ..Self::default()
        }
    }

    /// A phone held in landscape by a calm hand: rolling shutter of 30 ms, stamps 25 ms late.
    pub fn phone_slow() -> Self {
        let ordinary = Self::ordinary();
        let distortion = [0.06, -0.10, 0.000_5, -0.000_3];
        let device = DeviceConfig {
            lens: Lens::Radtan { focal_px: 487.0, centre_offset_px: [3.1, -4.2], distortion },
            mount: Mount::Phone,
            readout_secs: 0.030,
            stamp_delay_secs: 0.025,
            ..ordinary.device
        };
        Self { seed: 11, device, ..ordinary }
    }

    /// A phone in lively use among bare walls: rolling shutter of 22 ms, stamps 35 ms early.
    pub fn phone_fast() -> Self {
        let ordinary = Self::ordinary();
        let distortion = [0.05, -0.08, -0.000_4, 0.000_6];
        let device = DeviceConfig {
            lens: Lens::Radtan { focal_px: 519.5, centre_offset_px: [-2.4, 5.0], distortion },
            mount: Mount::Phone,
            readout_secs: 0.022,
            stamp_delay_secs: -0.035,
            ..ordinary.device
        };
        let flight = FlightKind::HandheldLively;
        Self { seed: 12, flight, bare_share: 0.33, exposure_secs: 0.008, device, ..ordinary }
    }

    /// A depth camera's colour sensor in a slow hand, nearly still for 3 s first: rolling shutter of 24 ms, stamps 44 ms
    /// late, lossless images.
    pub fn realsense() -> Self {
        let ordinary = Self::ordinary();
        let device = DeviceConfig {
            lens: Lens::Radtan { focal_px: 453.0, centre_offset_px: [1.2, 2.3], distortion: [0.0; 4] },
            mount: Mount::AnyAxes,
            readout_secs: 0.024,
            stamp_delay_secs: 0.044,
            jpeg_quality: 0,
            ..ordinary.device
        };
        let start = Start::Static { secs: 3.0 };
        Self { seed: 13, start, camera_rate_hz: 20.0, image_noise_sigma: 2.5, device, ..ordinary }
    }

    /// Along a trajectory of the TUM-VI rig's IMU, which must be given: global shutter, one clock, the rig's mount and
    /// IMU, a plain lens in place of the fisheye.
    pub fn tumvi() -> Self {
        let distortion = [-0.12, 0.05, 0.0, 0.0];
        let device = DeviceConfig {
            lens: Lens::Radtan { focal_px: 380.0, centre_offset_px: [1.0, -1.0], distortion },
            mount: Mount::TumVi,
            ..DeviceConfig::default()
        };
        Self {
            seed: 14,
            camera_rate_hz: 20.0,
            exposure_secs: 0.006,
            imu_noise: TUM_VI_IMU,
            trajectory_smoothing_secs: 0.03,
            device,
            ..Self::ordinary()
        }
    }
}
