//! Robust losses, as weights of iteratively reweighted least squares.

/// A loss ρ(e) of the length e of a whitened error; `k` is in standard deviations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kernel {
    /// ½ e²: every error has full weight.
    Quadratic,
    /// ½ e² up to k, k (e − ½ k) beyond (Huber 1964): the influence of an error is bounded by k.
    Huber {
        /// Errors beyond this many standard deviations lose weight.
        k: f64,
    },
    /// ½ k² ln(1 + e²/k²) (Cauchy): grows without bound, the influence fades as 1/e.
    Cauchy {
        /// Errors beyond this many standard deviations lose weight.
        k: f64,
    },
    /// ½ e² k²/(k² + e²) (Geman and McClure 1985): bounded, so that a gross error has no influence at all.
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
            Self::Huber { k } if squared <= k * k => 0.5 * squared,
            Self::Huber { k } => k * (squared.sqrt() - 0.5 * k),
            Self::Cauchy { k } => 0.5 * k * k * (squared / (k * k)).ln_1p(),
            Self::GemanMcClure { k } => 0.5 * squared * k * k / (k * k + squared),
        }
    }

    /// ρ(e), from e ≥ 0.
    pub fn loss_of_length(self, e: f64) -> f64 {
        match self {
            Self::Huber { k } if e > k => k * (e - 0.5 * k),
            Self::Huber { .. } => 0.5 * e * e,
            other => other.loss(e * e),
        }
    }

    /// ρ'(e)/e, from e².
    pub fn weight(self, squared: f64) -> f64 {
        match self {
            Self::Quadratic => 1.0,
            // Most errors are small ones, which need no root.
            Self::Huber { k } if squared <= k * k => 1.0,
            Self::Huber { k } => k / squared.sqrt(),
            Self::Cauchy { k } => 1.0 / (1.0 + squared / (k * k)),
            Self::GemanMcClure { k } => {
                let share = k * k / (k * k + squared);
                share * share
            }
        }
    }

    /// ρ'(e)/e, from e ≥ 0.
    pub fn weight_of_length(self, e: f64) -> f64 {
        match self {
            Self::Huber { k } if e <= k => 1.0,
            Self::Huber { k } => k / e,
            other => other.weight(e * e),
        }
    }

    /// The same kernel with k multiplied by `by`: the first stages of graduated non-convexity.
    pub fn widened(self, by: f64) -> Self {
        match self {
            Self::Quadratic => Self::Quadratic,
            Self::Huber { k } => Self::Huber { k: k * by },
            Self::Cauchy { k } => Self::Cauchy { k: k * by },
            Self::GemanMcClure { k } => Self::GemanMcClure { k: k * by },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Kernel; 4] = [
        Kernel::Quadratic,
        Kernel::Huber { k: 1.5 },
        Kernel::Cauchy { k: 3.0 },
        Kernel::GemanMcClure { k: 4.0 },
    ];

    #[test]
    fn weights_are_the_slope_of_the_loss_over_the_error() {
        for kernel in ALL {
            for e in [0.1_f64, 1.0, 3.0, 10.0, 100.0] {
                let h = 1e-6 * e;
                let slope = (kernel.loss((e + h) * (e + h)) - kernel.loss((e - h) * (e - h))) / (2.0 * h);
                assert!((slope / e - kernel.weight(e * e)).abs() < 1e-6, "{kernel:?} {e}");
            }
        }
    }

    #[test]
    fn the_length_and_its_square_give_the_same_loss_and_weight() {
        for kernel in ALL {
            for e in [0.0_f64, 0.7, 1.5, 2.0, 50.0] {
                assert!((kernel.loss(e * e) - kernel.loss_of_length(e)).abs() <= 1e-12 * e, "{kernel:?} {e}");
                assert!((kernel.weight(e * e) - kernel.weight_of_length(e)).abs() < 1e-12, "{kernel:?} {e}");
            }
        }
    }

    #[test]
    fn a_widened_kernel_is_the_same_kernel_of_a_shorter_error() {
        for kernel in ALL {
            let (wide, narrow) = (kernel.widened(4.0).weight(64.0), kernel.weight(4.0));
            assert!((wide - narrow).abs() < 1e-15, "{kernel:?}: {wide} {narrow}");
        }
    }
}
