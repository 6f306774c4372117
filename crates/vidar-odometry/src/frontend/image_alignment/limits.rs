//! When an alignment starts, ends and believes its patches.

/// Coarsest pyramid level of an alignment, where the image has it: a pixel there is sixteen of the image, so that a start far
/// off finds its way.
pub(super) const COARSEST_LEVEL: usize = 4;

/// Most steps on one level; bounds the time of an alignment that does not settle.
pub(super) const MAX_ITERATIONS: usize = 10;

/// Mean motion of the patches below which a level has settled, pixels of that level: the result is a prediction, and features
/// are measured on their own afterwards.
pub(super) const MIN_STEP_PX: f64 = 0.02;

/// Residual, in units of the median patch's, at which a patch counts one quarter.
pub(super) const OUTLIER_RATIO: f64 = 3.0;

/// Fewest patches that must be seen: the motion has six unknowns and each reference two, and wrong patches must be outvoted.
pub(super) const MIN_PATCHES: usize = 10;

/// Least change of contrast that an exposure is fitted to; its inverse is the largest.
pub(super) const MIN_GAIN: f64 = 0.2;

/// Noise that residuals have at least, grey levels: rounding alone leaves 0.3.
pub(super) const MIN_NOISE_GRAY: f64 = 0.5;

/// Growth of the cost that weights alone may cause.
pub(super) const COST_SLACK: f64 = 1.02;
