//! Losses that let go of gross errors, as weights of iteratively reweighted least squares.

use serde::{Deserialize, Serialize};

/// A loss ρ(e) of the whitened error's length e.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kernel {
    /// ½ e²: every error counts in full.
    Quadratic,
    /// ½ k² ln(1 + e²/k²): grows without bound, pull fades as 1/e.
    Cauchy {
        /// Errors beyond this many standard deviations lose weight.
        k: f64,
    },
    /// ½ e² k²/(k² + e²) (Geman-McClure): bounded; a false loop cannot pull at all.
    GemanMcClure {
        /// Errors beyond this many standard deviations lose weight.
        k: f64,
    },
}

impl Kernel {
    /// ρ(e), from e².
    pub fn loss(self, squared: f64) -> f64 {
        match self {
            Self::Quadratic => 0.5 * squared,
            Self::Cauchy { k } => 0.5 * k * k * (squared / (k * k)).ln_1p(),
            Self::GemanMcClure { k } => 0.5 * squared * k * k / (k * k + squared),
        }
    }

    /// ρ'(e)/e, from e².
    pub fn weight(self, squared: f64) -> f64 {
        match self {
            Self::Quadratic => 1.0,
            Self::Cauchy { k } => 1.0 / (1.0 + squared / (k * k)),
            Self::GemanMcClure { k } => {
                let share = k * k / (k * k + squared);
                share * share
            }
        }
    }

    /// The same kernel with a wider shoulder: the start of a graduated descent.
    pub fn widened(self, by: f64) -> Self {
        match self {
            Self::Quadratic => Self::Quadratic,
            Self::Cauchy { k } => Self::Cauchy { k: k * by },
            Self::GemanMcClure { k } => Self::GemanMcClure { k: k * by },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_slope_of_the_loss() {
        for kernel in [Kernel::Quadratic, Kernel::Cauchy { k: 3.0 }, Kernel::GemanMcClure { k: 4.0 }] {
            for e in [0.1_f64, 1.0, 3.0, 10.0, 100.0] {
                let h = 1e-6 * e;
                let slope = (kernel.loss((e + h) * (e + h)) - kernel.loss((e - h) * (e - h))) / (2.0 * h);
                assert!((slope / e - kernel.weight(e * e)).abs() < 1e-6, "{kernel:?} {e}");
            }
        }
    }
}
