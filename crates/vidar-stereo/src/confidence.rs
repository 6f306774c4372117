//! Confidence: the probability that a depth is right to within [`TOLERANCE_RATIO`].
//!
//! A logistic function of what is known about a pixel, times a bound for its view: poses, lens and clocks move all
//! views of a chunk alike, so that they agree and are wrong together. What tells of it is how the correction of the
//! poses (`register`) went. A correction after which the matches fit to their noise was right, however large it was;
//! one that leaves more than that was partly a bend to fit what no poses explain, and then as much as was corrected
//! may be left.
//!
//! Weights of both were fitted together by maximum likelihood, on pixels that a neighbour confirms and that lie off the
//! edges of the sensor's depth: half of the HoloLens room (weight 6), and rendered rooms and a corridor, as they are
//! and with jittering, late and miscalibrated cameras (weight 1 each). BENCHMARK.md has what it says and what holds on
//! recordings that had no part in it, with the commands. What it cannot know: an error of calibration that poses absorb
//! completely, such as a focal length that is off by a percent.

use crate::config::StereoConfig;
use crate::consistency::Support;
use crate::estimate::Estimate;
use crate::register::Misfit;

/// Relative depth error that counts as right.
pub const TOLERANCE_RATIO: f32 = 0.03;

/// What is known about a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Evidence {
    /// Inverse depth, averaged over the views that agree, 1/m; NaN where nothing was found.
    pub rho: f32,
    /// Views that agree with its depth.
    pub agreeing: u8,
    /// Views that have a depth where its point falls.
    pub asked: u8,
    /// Root mean square of the relative differences of those that agree.
    pub spread: f32,
    /// Matching cost, 0 (perfect) to 1 (none).
    pub cost: f32,
    /// How much worse the next best plane is after aggregation, in units of a full mismatch.
    pub margin: f32,
    /// Growth of the cost away from the winner, per squared pixel of shift.
    pub curvature: f32,
    /// Standard deviation of its window, in multiples of the noise.
    pub texture: f32,
    /// Shift of the widest neighbour's pixel when the depth changes by [`TOLERANCE_RATIO`], working pixels.
    pub resolution_px: f32,
    /// By how much the correction of the poses shifted what the view shares with others, working pixels.
    pub shift_px: f32,
    /// What is left between matches and corrected poses, working pixels.
    pub residual_px: f32,
}

/// The evidence of pixel `i`.
pub(crate) fn evidence(
    estimate: &Estimate,
    i: usize,
    support: &Support,
    misfit: &Misfit,
    config: &StereoConfig,
) -> Evidence {
    Evidence {
        rho: support.rho,
        agreeing: support.agreeing,
        asked: support.asked,
        spread: support.spread,
        cost: estimate.cost[i],
        margin: estimate.margin[i],
        curvature: estimate.curvature[i],
        texture: estimate.texture[i] / config.noise_gray as f32,
        resolution_px: TOLERANCE_RATIO * support.rho / estimate.rho_per_px,
        shift_px: misfit.shift_px,
        residual_px: misfit.residual_px,
    }
}

/// Number of features.
const FEATURES: usize = 7;

/// Weights of the features, in their order.
const WEIGHTS: [f32; FEATURES] = [-0.856, 1.04, 3.06, 0.49, -0.809, 0.121, 0.193];

/// Residual at which about as much as the correction of the poses remains in them as errors, working pixels. Matches
/// alone are good to 0.15 to 0.25; what is above that is not explained by any poses.
const HALF_RESIDUAL_PX: f32 = 0.5;
/// Remaining shift, per pixel of misfit.
const SHIFT_PER_MISFIT: f32 = 1.425;
/// Remaining relative error of depth in tolerances, per pixel of misfit: what scales the scene, however wide the
/// baseline.
const SCALE_PER_MISFIT: f32 = 0.348;

impl Evidence {
    /// Constant, share of agreeing views, agreeing views (saturating), log of the margin, matching cost, log of how
    /// much the cost grows when the depth changes by the tolerance, log of the depth resolution.
    fn features(&self) -> [f32; FEATURES] {
        let (asked, agreeing) = (f32::from(self.asked.max(1)), f32::from(self.agreeing));
        [
            1.0,
            agreeing / asked,
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

    /// The probability of an error within the tolerance by poses, lens and clocks alone, were they normally distributed.
    fn pose_bound(&self) -> f32 {
        // A correction that leaves only the noise of the matches was right; one that leaves more was partly a bend.
        let residual = self.residual_px.max(0.02);
        let misfit = self.shift_px * residual / residual.hypot(HALF_RESIDUAL_PX);
        let sigma = (SHIFT_PER_MISFIT / self.resolution_px).hypot(SCALE_PER_MISFIT) * misfit;
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

    /// A pixel as good ones are.
    fn good() -> Evidence {
        Evidence {
            rho: 0.5,
            agreeing: 4,
            asked: 4,
            spread: 0.005,
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
    fn each_reason_to_doubt_lowers_confidence() {
        let sure = good().confidence();
        assert!(sure > 0.9, "{sure}");
        for worse in [
            Evidence { agreeing: 1, ..good() },
            Evidence { agreeing: 2, asked: 2, ..good() },
            Evidence { margin: 0.01, ..good() },
            Evidence { cost: 0.5, ..good() },
            Evidence { curvature: 0.0, ..good() },
            Evidence { resolution_px: 0.5, ..good() },
            Evidence { shift_px: 2.0, residual_px: 0.8, ..good() },
        ] {
            assert!(worse.confidence() < sure, "{worse:?}");
        }
    }

    #[test]
    fn a_large_correction_is_held_against_the_poses_only_where_matches_stay_off() {
        let corrected = Evidence { shift_px: 1.5, ..good() };
        let bent = Evidence { shift_px: 1.5, residual_px: 0.9, ..good() };
        let (right, off) = (corrected.confidence(), bent.confidence());
        assert!(right > 0.8 && off < 0.7, "{right} {off}");
        // Poses as given: nothing is known of them.
        assert_eq!(Evidence { shift_px: 0.0, residual_px: 0.0, ..good() }.pose_bound(), 1.0);
    }

    #[test]
    fn evidence_without_depth_has_no_confidence() {
        let none = Evidence { rho: f32::NAN, resolution_px: f32::NAN, ..good() };
        assert_eq!(none.confidence(), 0.0);
    }
}
