//! From radiance to grey levels: exposure that drifts, vignetting, sensor noise, eight bits.

use crate::config::SynthConfig;
use crate::random::{Gaussian, Purpose, stream};
use rand::Rng;
use std::f64::consts::PI;

/// Grey level at which `image_noise_sigma` holds.
const MID_GREY: f64 = 128.0;

/// The camera's electronics over a whole sequence.
pub(crate) struct Photometry {
    seed: u64,
    sigma: f64,
    drift: f64,
    vignetting: f64,
    width: usize,
    height: usize,
    /// Rate (rad/s) and phase of each slow wave of the exposure.
    waves: [[f64; 2]; 3],
}

impl Photometry {
    pub(crate) fn new(config: &SynthConfig) -> Self {
        let mut rng = stream(config.seed, Purpose::Exposure);
        let waves = [14.0, 6.5, 2.9].map(|period_secs: f64| {
            let rate = 2.0 * PI / (period_secs * (0.8 + 0.4 * rng.random::<f64>()));
            [rate, 2.0 * PI * rng.random::<f64>()]
        });
        Self {
            seed: config.seed,
            sigma: config.image_noise_sigma,
            drift: config.exposure_drift,
            vignetting: config.vignetting,
            width: config.width,
            height: config.height,
            waves,
        }
    }

    /// Gain of the exposure at `secs`, within 1 ± drift.
    pub(crate) fn gain(&self, secs: f64) -> f64 {
        let [a, b, c] = self.waves.map(|[rate, phase]| (rate * secs + phase).sin());
        1.0 + self.drift * (0.55 * a + 0.3 * b + 0.15 * c)
    }

    /// The 8-bit image of `radiance` (0…1) of frame `index` at `secs`.
    pub(crate) fn develop(&self, radiance: &[f32], index: usize, secs: f64) -> Vec<u8> {
        let mut random = Gaussian::new(stream(self.seed, Purpose::Frame(index)));
        let gain = 255.0 * self.gain(secs);
        let (cx, cy) = (0.5 * (self.width as f64 - 1.0), 0.5 * (self.height as f64 - 1.0));
        let corner = cx * cx + cy * cy;
        // Read noise and shot noise each give half of the variance at mid grey.
        let (read, shot) = (0.5 * self.sigma * self.sigma, 0.5 * self.sigma * self.sigma / MID_GREY);
        let pixel = |(i, &radiance): (usize, &f32)| {
            let (x, y) = ((i % self.width) as f64 - cx, (i / self.width) as f64 - cy);
            let shade = 1.0 - self.vignetting * (x * x + y * y) / corner;
            let signal = f64::from(radiance) * gain * shade;
            let noise = if self.sigma > 0.0 { random.next() * (read + shot * signal).sqrt() } else { 0.0 };
            (signal + noise).round().clamp(0.0, 255.0) as u8
        };
        radiance.iter().enumerate().map(pixel).collect()
    }
}
