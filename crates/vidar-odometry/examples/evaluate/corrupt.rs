//! Makes a recording worse while it is read.

use crate::{Failure, Options};
use vidar_core::camera::RadTan;
use vidar_core::{CameraModel, FrameImage, Image, ImuNoise, SensorEvent};
use vidar_odometry::simulate::Random;

/// What corrupts a recording while it is read.
pub struct Corruptor {
    random: Random,
    image_noise: f64,
    /// Standard deviations per IMU sample: rad/s, m/s².
    imu_noise: [f64; 2],
    halve: bool,
}

impl Corruptor {
    pub fn new(options: &Options, noise: Option<ImuNoise>) -> Self {
        // Variances add up: what is missing to FACTOR times the data sheet's.
        let more = (options.imu_noise * options.imu_noise - 1.0).max(0.0).sqrt();
        let per_sample = |density: f64, n: &ImuNoise| more * density * n.rate_hz.sqrt();
        let imu_noise = noise.map_or([0.0; 2], |n| {
            [per_sample(n.gyro_noise_density, &n), per_sample(n.accel_noise_density, &n)]
        });
        Self { random: Random::new(7), image_noise: options.image_noise, imu_noise, halve: options.halve }
    }

    pub fn corrupt(&mut self, event: &mut SensorEvent) {
        match event {
            SensorEvent::Imu(sample) => {
                let [gyro, accel] = self.imu_noise;
                for k in 0..3 {
                    sample.gyro.0[k] += gyro * self.random.normal();
                    sample.accel.0[k] += accel * self.random.normal();
                }
            }
            SensorEvent::Image(frame) if self.halve || self.image_noise > 0.0 => {
                let mut gray = frame.image.to_gray8();
                if self.halve {
                    gray = halved(&gray);
                }
                let (random, sigma) = (&mut self.random, self.image_noise);
                if sigma > 0.0 {
                    gray = gray
                        .map(|&p| (f64::from(p) + sigma * random.normal()).round().clamp(0.0, 255.0) as u8);
                }
                frame.image = FrameImage::Gray8(gray);
            }
            _ => {}
        }
    }
}

fn halved(image: &Image<u8>) -> Image<u8> {
    let at = |x: usize, y: usize| u32::from(image[(x, y)]);
    Image::from_fn(image.width() / 2, image.height() / 2, |x, y| {
        let (x, y) = (2 * x, 2 * y);
        ((at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1) + 2) / 4) as u8
    })
}

/// The camera of halved images; of distorted ones only radtan's, which EuRoC has.
pub fn halved_camera(model: &CameraModel) -> Result<CameraModel, Failure> {
    let k = model.intrinsics();
    let half = k.resized(k.width / 2, k.height / 2)?;
    match model {
        CameraModel::Pinhole(_) => Ok(CameraModel::Pinhole(half)),
        CameraModel::RadTan(m) => Ok(CameraModel::RadTan(RadTan::with_k3(half, m.distortion, m.k3)?)),
        other => Err(format!("--halve does not know {}", other.name()).into()),
    }
}
