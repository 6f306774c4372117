//! Confidence: the probability that a depth is right to within [`TOLERANCE_RATIO`].
//!
//! A logistic function of a pixel's features, times a bound for its view: errors of poses, lens and clocks affect all
//! views of a chunk alike, so that views agree on a wrong depth. The bound follows from the correction of the poses
//! (`register`). If the residual after the correction is that of the matches' noise, the corrected poses are right,
//! however large the correction was; if it is larger, no poses explain the matches, and the remaining error may be as
//! large as the correction.
//!
//! The weights of both were fitted together by maximum likelihood, on pixels that a neighbour confirms and that lie off
//! the edges of the sensor's depth: half of the HoloLens room, and rendered rooms and a corridor, unchanged and with pose
//! noise, time offset and miscalibration. Each of the eleven sets has the same weight, and the features are those of the
//! code as it is (`examples/evaluate_views/fit_confidence.sh` makes them and fits). Calibration on other recordings:
//! docs/benchmark/maps.md. Not modelled: an error of calibration that the poses absorb completely, such as a
//! focal length that is off by one percent.

use crate::config::StereoConfig;
use crate::consistency::Support;
use crate::elementary::{exp, ln};
use crate::estimate::Estimate;
use crate::prepare::PoseCorrection;
use vidar_core::simd::kernel;

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
    let agreeing = support.agreeing[i];
    PixelFeatures {
        rho: support.rho[i],
        agreeing: agreeing as u8,
        compared: support.compared[i] as u8,
        rms_difference: (support.squares[i] / agreeing.max(1.0)).sqrt(),
        cost: estimate.cost[i],
        margin: estimate.margin[i],
        curvature: estimate.curvature[i],
        texture: estimate.texture[i] / config.noise_gray as f32,
        resolution_px: TOLERANCE_RATIO * support.rho[i] / estimate.rho_per_px,
        shift_px: correction.shift_px,
        residual_px: correction.residual_px,
    }
}

/// The inverse depths of a view that are at least so confident, and their confidence; NaN and 0 elsewhere.
pub(crate) fn confident(
    estimate: &Estimate,
    support: &Support,
    correction: &PoseCorrection,
    min_confidence: f32,
) -> (Vec<f32>, Vec<f32>) {
    let (mut rho, mut confidence) = (vec![f32::NAN; support.rho.len()], vec![0.0; support.rho.len()]);
    let view = ViewBound::new(correction);
    fill(estimate, support, &view, min_confidence, &mut rho, &mut confidence);
    (rho, confidence)
}

kernel! {
    fn fill(
        estimate: &Estimate,
        support: &Support,
        view: &ViewBound,
        min_confidence: f32,
        rho: &mut [f32],
        confidence: &mut [f32],
    ) {
        keep_confident(estimate, support, view, min_confidence, rho, confidence);
    }
}

#[inline(always)]
fn keep_confident(
    estimate: &Estimate,
    support: &Support,
    view: &ViewBound,
    min_confidence: f32,
    rho: &mut [f32],
    confidence: &mut [f32],
) {
    let n = rho.len();
    let (rho, confidence, own) = (&mut rho[..n], &mut confidence[..n], &support.rho[..n]);
    let (agreeing, compared) = (&support.agreeing[..n], &support.compared[..n]);
    let (margin, cost, curvature) = (&estimate.margin[..n], &estimate.cost[..n], &estimate.curvature[..n]);
    let px_per_rho = TOLERANCE_RATIO / estimate.rho_per_px;
    for i in 0..n {
        let resolution_px = px_per_rho * own[i];
        let evidence = evidence(agreeing[i], compared[i], margin[i], cost[i], curvature[i], resolution_px);
        let p = view.bound(resolution_px) / (1.0 + exp(-evidence));
        // A pixel without depth fails the first comparison.
        let kept = (own[i] > 0.0) & (p >= min_confidence) & (agreeing[i] > 0.0);
        rho[i] = if kept { own[i] } else { f32::NAN };
        confidence[i] = if kept { p } else { 0.0 };
    }
}

/// Number of features.
const FEATURES: usize = 7;

/// Weights of the features, in their order.
const WEIGHTS: [f32; FEATURES] = [-0.055, 2.972, 1.244, 0.376, -0.831, 0.203, -0.193];

/// Residual at which the remaining pose error is about as large as the correction, working pixels. The noise of the
/// matches is 0.1 to 0.2; a larger residual is not explained by any poses.
const HALF_RESIDUAL_PX: f32 = 0.5;
/// Standard deviation of the remaining shift, per pixel of pose error.
const SHIFT_PER_POSE_ERROR: f32 = 1.970;
/// Standard deviation of the remaining relative error of depth in tolerances, per pixel of pose error: an error of scale,
/// which does not depend on the baseline.
const SCALE_PER_POSE_ERROR: f32 = 0.545;

/// Weighted sum of a pixel's features: constant, share of agreeing views, agreeing views (saturating), log of the margin,
/// matching cost, log of how much the cost grows when the depth changes by the tolerance, log of the depth resolution.
#[inline(always)]
fn evidence(agreeing: f32, compared: f32, margin: f32, cost: f32, curvature: f32, resolution_px: f32) -> f32 {
    let growth = at_least_zero(curvature) * resolution_px * resolution_px;
    let features = [
        1.0,
        agreeing / if compared > 1.0 { compared } else { 1.0 },
        agreeing / (agreeing + 1.0),
        ln(at_least_zero(margin) + 0.01) + 3.0,
        cost,
        ln(growth + 0.003),
        ln(at_least_zero(resolution_px) + 0.01),
    ];
    let mut sum = 0.0;
    for i in 0..FEATURES {
        sum += features[i] * WEIGHTS[i];
    }
    sum
}

/// `value`, or zero for a negative one and NaN.
#[inline(always)]
fn at_least_zero(value: f32) -> f32 {
    if value > 0.0 { value } else { 0.0 }
}

/// The probability that the error by poses, lens and clocks alone is within the tolerance, for a normal distribution.
struct ViewBound {
    /// Squares of the standard deviations of the remaining error: of the shift, px², and of the relative depth error in
    /// tolerances.
    shift: f32,
    scale: f32,
}

impl ViewBound {
    fn new(correction: &PoseCorrection) -> Self {
        let residual = correction.residual_px.max(0.02);
        let pose_error_px =
            correction.shift_px * residual / (residual * residual + HALF_RESIDUAL_PX.powi(2)).sqrt();
        let square = |per_pose_error: f32| (per_pose_error * pose_error_px).powi(2);
        Self { shift: square(SHIFT_PER_POSE_ERROR), scale: square(SCALE_PER_POSE_ERROR) }
    }

    #[inline(always)]
    fn bound(&self, resolution_px: f32) -> f32 {
        let sigma = (self.shift / (resolution_px * resolution_px) + self.scale).sqrt();
        let t = 1.0 / if sigma > 1e-4 { sigma } else { 1e-4 };
        // P(|N(0,1)| < t), by the logistic approximation of the normal distribution (Bowling 2009), within 0.0002.
        let tail = 1.0 / (1.0 + exp(0.07056 * t * t * t + 1.5976 * t));
        1.0 - 2.0 * tail
    }
}

impl PixelFeatures {
    /// The probability that the depth is within [`TOLERANCE_RATIO`].
    pub fn confidence(&self) -> f32 {
        if !(self.rho > 0.0 && self.resolution_px > 0.0) {
            return 0.0;
        }
        let correction = PoseCorrection { shift_px: self.shift_px, residual_px: self.residual_px };
        let evidence = evidence(
            f32::from(self.agreeing),
            f32::from(self.compared),
            self.margin,
            self.cost,
            self.curvature,
            self.resolution_px,
        );
        ViewBound::new(&correction).bound(self.resolution_px) / (1.0 + exp(-evidence))
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
        let as_given = ViewBound::new(&PoseCorrection::default());
        assert_eq!(as_given.bound(good().resolution_px), 1.0);
    }

    #[test]
    fn a_pixel_without_depth_has_no_confidence() {
        let none = PixelFeatures { rho: f32::NAN, resolution_px: f32::NAN, ..good() };
        assert_eq!(none.confidence(), 0.0);
    }
}
