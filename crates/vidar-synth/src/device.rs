//! The recording device: lens, place of the camera, shutter, clocks, compression, and which calibration is written.
//!
//! The default is EuRoC's sensor: global shutter, one clock, lossless images, calibration given. The other settings
//! make recordings as phones, depth cameras and action cameras make them.

use crate::bounds::{ensure, within};
use crate::error::SynthError;
use serde::{Deserialize, Serialize};

/// The camera's projection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Lens {
    /// EuRoC's cam0 (radial-tangential), scaled to the image size.
    #[default]
    Euroc,
    /// A pinhole with radial-tangential distortion; all coefficients 0 is a plain pinhole.
    Radtan {
        /// Focal length in both directions, px, 8…20000.
        focal_px: f64,
        /// Principal point minus the image's centre, px, −500…500.
        centre_offset_px: [f64; 2],
        /// k1, k2, p1, p2 (OpenCV), −1…1.
        distortion: [f64; 4],
    },
    /// A fisheye (equidistant, Kannala and Brandt), as of action cameras.
    Equidistant {
        /// Focal length in both directions, px, 8…20000.
        focal_px: f64,
        /// Principal point minus the image's centre, px, −500…500.
        centre_offset_px: [f64; 2],
        /// k1 to k4 (OpenCV's fisheye), −1…1.
        distortion: [f64; 4],
    },
}

/// Where and how the camera is mounted on the body (IMU).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mount {
    /// EuRoC's cam0: body x up, z ahead.
    #[default]
    Euroc,
    /// cam0 of the TUM-VI rig: body z up, camera along −y.
    TumVi,
    /// A phone held in landscape, axes as Android defines them; misaligned by 1.5° (σ per axis) and with a lever arm
    /// of about 6 cm, both drawn from the seed.
    Phone,
    /// One of the 24 axis permutations with misalignment as `phone` and a lever arm of up to 5 cm per axis, drawn
    /// from the seed.
    AnyAxes,
}

/// How the IMU's samples are timed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImuTiming {
    /// Evenly spaced.
    #[default]
    Regular,
    /// Intervals vary by 5 % (σ) of the period; stamps are right; one row in 500 is written twice.
    Jittered,
    /// Gyroscope and accelerometer sample on their own clocks (rates 0.3 % apart); the file has a row for every sample
    /// of either, the other sensor linearly interpolated. About two rows per period, some only microseconds apart.
    Interleaved,
}

/// Which calibration is written beside the images. The true values are always in `truth.json`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CalibrationKind {
    /// Lens, `T_BS` and IMU noise as simulated. Readout and clock offset are not written.
    #[default]
    Given,
    /// A focal length with 1.5 % error (σ), principal point at the centre, no distortion, no `T_BS`, no IMU noise.
    Partial,
    /// No calibration files of camera and IMU.
    Absent,
}

/// How the sequence is recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceConfig {
    /// The camera's projection.
    pub lens: Lens,
    /// Where the camera is mounted.
    pub mount: Mount,
    /// Rolling shutter: time from the exposure of the first row to that of the last, s, 0…0.05; 0 is a global shutter.
    /// Row r of h is exposed at `t + (r/(h−1) − 1/2)·readout_secs`.
    pub readout_secs: f64,
    /// Image stamps are late by this, s, −0.15…0.15: stamp = time of the middle row + `stamp_delay_secs`.
    pub stamp_delay_secs: f64,
    /// Standard deviation of the stamps' errors about that, s, 0…0.02: of when an image arrives rather than when it was exposed. Two fifths of the variance are
    /// each image's own, the rest changes within a second, as exposure does.
    pub stamp_scatter_secs: f64,
    /// Standard deviation of each frame's time in periods, 0…0.3 (variable frame rate); stamps follow.
    pub frame_jitter: f64,
    /// Optical stabilisation: the share of the shake about the picture's axes that the lens takes back, 0…1, by up to 1.2° and without what is
    /// slower than a second.
    pub stabilisation: f64,
    /// Share of frames that are missing, 0…0.5.
    pub dropped_frames: f64,
    /// Share of frames that show the previous image again under a new stamp, 0…0.5.
    pub repeated_frames: f64,
    /// JPEG quality, 1…100; 0 writes lossless PNG.
    pub jpeg_quality: u8,
    /// How the IMU's samples are timed.
    pub imu_timing: ImuTiming,
    /// Gaps in the IMU's rows per minute, 0…60; each lasts 20 to 50 ms.
    pub imu_gaps_per_min: f64,
    /// Standard deviation of the gyroscope's and accelerometer's scale errors per axis, 0…0.05.
    pub imu_scale_sigma: f64,
    /// Written IMU noise densities are the true ones times this, 0.01…1000.
    pub stated_noise_factor: f64,
    /// Which calibration is written.
    pub calibration: CalibrationKind,
}

impl Default for DeviceConfig {
    fn default() -> Self {
        Self {
            lens: Lens::Euroc,
            mount: Mount::Euroc,
            readout_secs: 0.0,
            stamp_delay_secs: 0.0,
            stamp_scatter_secs: 0.0,
            frame_jitter: 0.0,
            stabilisation: 0.0,
            dropped_frames: 0.0,
            repeated_frames: 0.0,
            jpeg_quality: 0,
            imu_timing: ImuTiming::Regular,
            imu_gaps_per_min: 0.0,
            imu_scale_sigma: 0.0,
            stated_noise_factor: 1.0,
            calibration: CalibrationKind::Given,
        }
    }
}

impl DeviceConfig {
    pub(crate) fn validate(&self) -> Result<(), SynthError> {
        if let Lens::Radtan { focal_px, centre_offset_px, distortion }
        | Lens::Equidistant { focal_px, centre_offset_px, distortion } = self.lens
        {
            within("device.lens.focal_px", focal_px, 8.0, 20_000.0, "8 to 20000 px")?;
            for offset in centre_offset_px {
                within("device.lens.centre_offset_px", offset, -500.0, 500.0, "-500 to 500 px")?;
            }
            for k in distortion {
                within("device.lens.distortion", k, -1.0, 1.0, "-1 to 1")?;
            }
        }
        within("device.readout_secs", self.readout_secs, 0.0, 0.05, "0 to 0.05 s")?;
        within("device.stamp_delay_secs", self.stamp_delay_secs, -0.15, 0.15, "-0.15 to 0.15 s")?;
        within("device.stamp_scatter_secs", self.stamp_scatter_secs, 0.0, 0.02, "0 to 0.02 s")?;
        within("device.frame_jitter", self.frame_jitter, 0.0, 0.3, "0 to 0.3")?;
        within("device.stabilisation", self.stabilisation, 0.0, 1.0, "0 to 1")?;
        within("device.dropped_frames", self.dropped_frames, 0.0, 0.5, "0 to 0.5")?;
        within("device.repeated_frames", self.repeated_frames, 0.0, 0.5, "0 to 0.5")?;
        ensure(self.jpeg_quality <= 100, "device.jpeg_quality", "0 to 100", self.jpeg_quality)?;
        within("device.imu_gaps_per_min", self.imu_gaps_per_min, 0.0, 60.0, "0 to 60 per minute")?;
        within("device.imu_scale_sigma", self.imu_scale_sigma, 0.0, 0.05, "0 to 0.05")?;
        within("device.stated_noise_factor", self.stated_noise_factor, 0.01, 1000.0, "0.01 to 1000")
    }
}
