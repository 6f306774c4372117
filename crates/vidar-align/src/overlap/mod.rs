//! The similarity between two predictions of the same pixels, robust and independent of units.
//!
//! The reference fits an overlap with Huber's loss at 0.1 of whatever unit the chunk is in, and every outlier keeps
//! pulling. Here the residual is a share of depth, `r = |y − S x| / z_y`, which means the same in every gauge; the loss is
//! Huber's at 3 % until the fit stands, then Geman-McClure's with a width that follows the residuals themselves
//! (`k = 2.5 · 1.4826 · median(r) / 1.5`), so that gross errors end with no pull at all. Each step is the closed form of
//! [`crate::streaming::weighted_similarity`] with its symmetric ratio of spreads as scale.
//!
//! Pixels are taken by a fixed stratified pattern ([`SampledView`]), the same in every chunk that holds the frame: what must
//! be kept of a chunk is a few thousand depths per view. The error of an overlap is systematic (neighbours
//! share it), so a full fit is no better than a sampled one; [`OverlapFit::covariance`] counts one independent observation
//! per 14 × 14 pixels of one frame, widened three times, whatever the number of samples.

mod fit;
mod pairs;
mod sample;

pub(crate) use fit::evaluate_fit;
pub use fit::{OverlapConfig, OverlapFit, PointPairs, fit_overlap};
pub(crate) use pairs::{PATCH_PIXELS, pair_mapped};
pub use pairs::{pair_views, shared_views};
pub use sample::SampledView;

#[cfg(test)]
mod tests;
