//! Confidence: the probability that a depth is right to within [`TOLERANCE_RATIO`].
//!
//! A logistic function of what is known about a pixel, fitted by maximum likelihood, half and half, to 20 frames of a
//! HoloLens room with sensor depth and to three rendered scenes (board, slanted wall, straight wall; noise of 8, 12
//! and 4 grey levels). A test checks it on rendered scenes that had no part in the fit.
//!
//! Poses that are a centimetre off make every pixel worse than that can know, so `pose_cap` bounds it by how far the
//! poses had to be corrected. Said and held (share within 3 % of the sensor) at the defaults, 32 views each:
//!
//! - HoloLens room: 0.46 → 0.48, 0.55 → 0.61, 0.65 → 0.69, 0.75 → 0.78, 0.86 → 0.84, 0.95 → 0.92;
//! - 7-Scenes kitchen, whose images, poses and lens agree badly: 0.35 → 0.44, 0.45 → 0.48, 0.55 → 0.40, 0.65 → 0.35,
//!   0.75 → 0.48, 0.85 → 0.58, 0.93 → 0.66.
//!
//! On data of the latter kind the upper half says too much: errors of calibration move all views alike, and no view
//! shows them. Neither is held out: HoloLens frames are among the fit, and `REMAINING_SHARE` was chosen on both.

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
const WEIGHTS: [f32; FEATURES] = [-1.83, 2.4, 1.15, 0.85, 0.84, 0.2, -0.11];

impl Evidence {
    /// Constant, share of agreeing views, agreeing views (saturating), log of the margin, matching cost, log of the
    /// texture, log of the depth resolution.
    fn features(&self) -> [f32; FEATURES] {
        let (asked, agreeing) = (f32::from(self.asked.max(1)), f32::from(self.agreeing));
        [
            1.0,
            agreeing / asked,
            agreeing / (agreeing + 1.0),
            (self.margin.max(0.0) + 0.01).ln() + 3.0,
            self.cost,
            (self.texture + 0.1).ln(),
            (self.resolution_px + 0.01).ln(),
        ]
    }

    /// The probability that the depth is within [`TOLERANCE_RATIO`].
    pub fn confidence(&self) -> f32 {
        let z: f32 = self.features().iter().zip(&WEIGHTS).map(|(f, w)| f * w).sum();
        let p = 1.0 / (1.0 + (-z).exp());
        if p.is_finite() { p * pose_cap(self.shift_px, TOLERANCE_RATIO / self.resolution_px) } else { 0.0 }
    }
}

/// Share of the correction of the poses that is taken to remain in them. With all of it, the HoloLens room stays honest
/// and the 7-Scenes kitchen comes nearest to it; 0.4 changed little.
const REMAINING_SHARE: f32 = 1.0;

/// Upper bound that the poses set: the probability of an error within [`TOLERANCE_RATIO`], if what is left of their
/// errors shifts pixels by a normally distributed part of what was corrected. `ratio_per_px` is the relative change
/// of depth that shifts a pixel by one.
fn pose_cap(shift_px: f32, ratio_per_px: f32) -> f32 {
    let sigma = REMAINING_SHARE * shift_px * ratio_per_px;
    if !(sigma > 0.0) {
        return 1.0;
    }
    let t = TOLERANCE_RATIO / sigma;
    // P(|N(0,1)| < t), by the logistic approximation of the normal distribution (Bowling 2009), within 0.0002.
    let tail = 1.0 / (1.0 + (0.07056 * t * t * t + 1.5976 * t).exp());
    (1.0 - 2.0 * tail).clamp(0.0, 1.0)
}
