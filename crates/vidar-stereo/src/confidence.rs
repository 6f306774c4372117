//! Confidence: the probability that a depth is right to within [`TOLERANCE_RATIO`].
//!
//! A logistic function of a pixel's features, times a bound for its view: errors of poses, lens and clocks affect all
//! views of a chunk alike, so that views agree on a wrong depth. The bound follows from the correction of the poses
//! (`register`). If the residual after the correction is that of the matches' noise, the corrected poses are right,
//! however large the correction was; if it is larger, no poses explain the matches, and the remaining error may be as
//! large as the correction.
//!
//! The weights of both were fitted together by maximum likelihood, on pixels that a neighbour confirms and that lie off
//! the edges of the sensor's depth: half of the HoloLens room (weight 6), and rendered rooms and a corridor, unchanged
//! and with pose noise, time offset and miscalibration (weight 1 each). Calibration on other recordings, with the
//! commands: docs/benchmark/maps.md. Not modelled: an error of calibration that the poses absorb completely, such as a
//! focal length that is off by one percent.

use crate::config::StereoConfig;
use crate::consistency::Support;
use crate::estimate::Estimate;
use crate::prepare::PoseCorrection;

/// Relative depth error below which a depth counts as correct.
pub const TOLERANCE_RATIO: f32 = 0.03;

/// Features of a pixel from which its confidence is computed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PixelFeatures {
    /// Inverse depth, averaged over the views that agree, 1/m; NaN where there is none.
    pub rho: f32,
    /// Views that agree with its depth.
    pub agreeing: u8,
    /// Views that have a depth at its point.
    pub compared: u8,
    /// Root mean square of the relative differences of those that agree.
    pub rms_difference: f32,
    /// Matching cost, 0 (perfect) to 1 (none).
    pub cost: f32,
    /// How much worse the next best plane is after aggregation, in units of a full mismatch.
    pub margin: f32,
    /// Growth of the cost away from the winner, per squared pixel of shift.
    pub curvature: f32,
    /// Standard deviation of its window, in multiples of the noise.
    pub texture: f32,
    /// Shift of the pixel in the neighbour of the widest baseline when the depth changes by [`TOLERANCE_RATIO`], working pixels.
    pub resolution_px: f32,
    /// Shift of the view's matches by the correction of the poses, working pixels.
    pub shift_px: f32,
    /// Residual of the matches with the corrected poses, working pixels.
    pub residual_px: f32,
}

/// The features of pixel `i`.
pub(crate) fn pixel_features(
    estimate: &Estimate,
    i: usize,
    support: &Support,
    correction: &PoseCorrection,
    config: &StereoConfig,
) -> PixelFeatures {
    PixelFeatures {
        rho: support.rho,
        agreeing: support.agreeing,
        compared: support.compared,
        rms_difference: support.rms_difference,
        cost: estimate.cost[i],
        margin: estimate.margin[i],
        curvature: estimate.curvature[i],
        texture: estimate.texture[i] / config.noise_gray as f32,
        resolution_px: TOLERANCE_RATIO * support.rho / estimate.rho_per_px,
        shift_px: correction.shift_px,
        residual_px: correction.residual_px,
    }
}

/// Number of features.
const FEATURES: usize = 7;

/// Weights of the features, in their order.
const WEIGHTS: [f32; FEATURES] = [-0.856, 1.04, 3.06, 0.49, -0.809, 0.121, 0.193];

/// Residual at which the remaining pose error is about as large as the correction, working pixels. The noise of the
/// matches is 0.15 to 0.25; a larger residual is not explained by any poses.
const HALF_RESIDUAL_PX: f32 = 0.5;
/// Standard deviation of the remaining shift, per pixel of pose error.
const SHIFT_PER_POSE_ERROR: f32 = 1.425;
/// Standard deviation of the remaining relative error of depth in tolerances, per pixel of pose error: an error of scale,
/// which does not depend on the baseline.
const SCALE_PER_POSE_ERROR: f32 = 0.348;

impl PixelFeatures {
    /// Constant, share of agreeing views, agreeing views (saturating), log of the margin, matching cost, log of how
    /// much the cost grows when the depth changes by the tolerance, log of the depth resolution.
    fn features(&self) -> [f32; FEATURES] {
        let (compared, agreeing) = (f32::from(self.compared.max(1)), f32::from(self.agreeing));
        [
            1.0,
            agreeing / compared,
            agreeing / (agreeing + 1.0),
            (self.margin.max(0.0) + 0.01).ln() + 3.0,
            self.cost,
            (self.curvature.max(0.0) * self.resolution_px.powi(2) + 0.003).ln(),
            (self.resolution_px + 0.01).ln(),
        ]
    }

    /// The probability that the depth is within [`TOLERANCE_RATIO`].
    pub fn confidence(&self) -> f32 {
        let z: f32 = self.features().iter().zip(&WEIGHTS).map(|(f, w)| f * w).sum();
        let p = self.pose_bound() / (1.0 + (-z).exp());
        if p.is_finite() { p } else { 0.0 }
    }

    /// The probability that the error by poses, lens and clocks alone is within the tolerance, for a normal distribution.
    fn pose_bound(&self) -> f32 {
        let residual = self.residual_px.max(0.02);
        let pose_error_px = self.shift_px * residual / residual.hypot(HALF_RESIDUAL_PX);
        let sigma = (SHIFT_PER_POSE_ERROR / self.resolution_px).hypot(SCALE_PER_POSE_ERROR) * pose_error_px;
        if !(sigma > 1e-4) {
            return 1.0;
        }
        let t = 1.0 / sigma;
        // P(|N(0,1)| < t), by the logistic approximation of the normal distribution (Bowling 2009), within 0.0002.
        let tail = 1.0 / (1.0 + (0.07056 * t * t * t + 1.5976 * t).exp());
        (1.0 - 2.0 * tail).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pixel of high confidence.
    fn good() -> PixelFeatures {
        PixelFeatures {
            rho: 0.5,
            agreeing: 4,
            compared: 4,
            rms_difference: 0.005,
            cost: 0.05,
            margin: 0.2,
            curvature: 0.1,
            texture: 10.0,
            resolution_px: 2.0,
            shift_px: 0.05,
            residual_px: 0.2,
        }
    }

    #[test]
    fn each_unfavourable_feature_lowers_confidence() {
        let high = good().confidence();
        assert!(high > 0.9, "{high}");
        for worse in [
            PixelFeatures { agreeing: 1, ..good() },
            PixelFeatures { agreeing: 2, compared: 2, ..good() },
            PixelFeatures { margin: 0.01, ..good() },
            PixelFeatures { cost: 0.5, ..good() },
            PixelFeatures { curvature: 0.0, ..good() },
            PixelFeatures { resolution_px: 0.5, ..good() },
            PixelFeatures { shift_px: 2.0, residual_px: 0.8, ..good() },
        ] {
            assert!(worse.confidence() < high, "{worse:?}");
        }
    }

    #[test]
    fn a_large_correction_lowers_confidence_only_with_a_large_residual() {
        let corrected = PixelFeatures { shift_px: 1.5, ..good() };
        let inconsistent = PixelFeatures { shift_px: 1.5, residual_px: 0.9, ..good() };
        let (right, off) = (corrected.confidence(), inconsistent.confidence());
        assert!(right > 0.8 && off < 0.7, "{right} {off}");
        // Poses taken as given: no bound.
        assert_eq!(PixelFeatures { shift_px: 0.0, residual_px: 0.0, ..good() }.pose_bound(), 1.0);
    }

    #[test]
    fn a_pixel_without_depth_has_no_confidence() {
        let none = PixelFeatures { rho: f32::NAN, resolution_px: f32::NAN, ..good() };
        assert_eq!(none.confidence(), 0.0);
    }
}
