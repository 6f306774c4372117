//! How much more probable the window's measurements are with an unknown that every image has of its own.

use super::{Smoother, dot};
use crate::config::OdometryConfig;

/// An unknown that every frame of the window may have, with its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum FrameUnknown {
    /// How much later than its stamp the image was exposed.
    Delay { sigma_secs: f64 },
    /// How far a stabiliser shifts the image.
    ImageShift { sigma_rad: f64 },
}

impl FrameUnknown {
    /// `ln` of the prior's standard deviations of one frame.
    fn log_sigmas(self) -> f64 {
        match self {
            Self::Delay { sigma_secs } => sigma_secs.ln(),
            Self::ImageShift { sigma_rad } => 2.0 * sigma_rad.ln(),
        }
    }
}

/// The quadratic approximation of the cost: what its minimum is lower by, and half the logarithm of its determinant.
struct Fit {
    decrease: f64,
    half_log_det: f64,
}

impl Smoother {
    /// From now on every image's stamp is off, and every image shifted, by what the settings say, standard deviations. What is in the prior stays.
    pub(crate) fn set_image_unknowns(&mut self, config: &OdometryConfig) {
        let settings = config.smoother();
        self.config.stamp_scatter_ms = settings.stamp_scatter_ms;
        self.config.image_shift_deg = settings.image_shift_deg;
        self.system.factorised = false;
    }

    /// Logarithm of how many times more probable the window's measurements are with the unknown than without it (Laplace's approximation at the present
    /// states). `None` where the window has it already, or a system is singular.
    pub(crate) fn log_evidence(&mut self, unknown: FrameUnknown) -> Option<f64> {
        let has_it = match unknown {
            FrameUnknown::Delay { .. } => self.config.delay_sigma().is_some(),
            FrameUnknown::ImageShift { .. } => self.config.image_shift_sigma().is_some(),
        };
        if has_it {
            return None;
        }
        let without = self.fit();
        let as_set = (self.config.stamp_scatter_ms, self.config.image_shift_deg);
        match unknown {
            FrameUnknown::Delay { sigma_secs } => self.config.stamp_scatter_ms = 1e3 * sigma_secs,
            FrameUnknown::ImageShift { sigma_rad } => self.config.image_shift_deg = sigma_rad.to_degrees(),
        }
        self.system.factorised = false;
        let with = self.fit();
        (self.config.stamp_scatter_ms, self.config.image_shift_deg) = as_set;
        self.system.factorised = false;
        let (without, with) = without.zip(with)?;
        let occam =
            with.half_log_det - without.half_log_det + self.frames.len() as f64 * unknown.log_sigmas();
        Some(with.decrease - without.decrease - occam)
    }

    fn fit(&mut self) -> Option<Fit> {
        self.factorise()?;
        let cholesky = &self.system.cholesky;
        let mut whitened = self.system.gradient.clone();
        cholesky.forward(&mut whitened);
        Some(Fit { decrease: 0.5 * dot(&whitened, &whitened), half_log_det: cholesky.half_log_det() })
    }
}
