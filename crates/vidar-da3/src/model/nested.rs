//! The nested model (DA3, nested): an any-view network scaled to metres by a metric one.
//!
//! The metric network's depth is canonical: times focal/300 (pixels) it is in metres. On pixels that are not sky, whose
//! confidence is at least the median, the any-view depth d is scaled by `s = Σ m d / Σ d²` over all views together;
//! translations too. Sky becomes the 0.99 quantile of the rest, at most 200 m, with confidence 1.

use crate::error::Da3Error;
use crate::sky::{is_open, quantile, sampled};
use nalgebra::{Matrix3, Matrix4};

/// Focal length, pixels, at which canonical depth is in metres.
pub const CANONICAL_FOCAL: f64 = 300.0;
const MIN_OPEN_PIXELS: usize = 10;
const MIN_METRIC_DEPTH: f32 = 0.01;
const MIN_DEPTH: f32 = 1e-3;
const MIN_SUM: f64 = 1e-12;
const FAR_QUANTILE: f64 = 0.99;
const MAX_SKY_DEPTH: f64 = 200.0;

/// Both networks' outputs, all views one after the other.
pub(crate) struct Nested<'a> {
    /// Any-view depth, `[views, H, W]`.
    pub depth: &'a mut [f32],
    /// Its confidence.
    pub confidence: &'a mut [f32],
    /// Predicted poses.
    pub camera_from_world: &'a mut [Matrix4<f64>],
    /// Predicted intrinsics, pixels.
    pub intrinsics: &'a [Matrix3<f64>],
    /// Canonical depth of the metric network.
    pub canonical: &'a [f32],
    /// Its sky.
    pub sky: &'a [f32],
}

/// Metres per unit of canonical depth.
pub fn metres_per_canonical(intrinsics: &Matrix3<f64>) -> f64 {
    f64::midpoint(intrinsics[(0, 0)], intrinsics[(1, 1)]) / CANONICAL_FOCAL
}

/// Scales depth and poses to metres in place; returns the scale.
pub(crate) fn scale_to_metres(nested: Nested<'_>) -> Result<f64, Da3Error> {
    let Nested { depth, confidence, camera_from_world, intrinsics, canonical, sky } = nested;
    let area = depth.len() / intrinsics.len().max(1);
    let factors: Vec<f32> = intrinsics.iter().map(|k| metres_per_canonical(k) as f32).collect();
    let metric: Vec<f32> = canonical.iter().enumerate().map(|(i, d)| d * factors[i / area.max(1)]).collect();
    let open = |values: &[f32]| -> Vec<f32> {
        values.iter().zip(sky).filter(|(_, s)| is_open(**s)).map(|(v, _)| *v).collect()
    };
    let open_confidence = open(confidence);
    if open_confidence.len() <= MIN_OPEN_PIXELS {
        let reason = format!("only {} pixels are not sky", open_confidence.len());
        return Err(Da3Error::Degenerate { step: "metric scale", reason });
    }
    let median = quantile(sampled(open_confidence), 0.5) as f32;
    let (mut product, mut square) = (0.0f64, 0.0f64);
    for i in 0..depth.len() {
        let is_used = confidence[i] >= median
            && is_open(sky[i])
            && metric[i] > MIN_METRIC_DEPTH
            && depth[i] > MIN_DEPTH;
        if is_used {
            product += f64::from(metric[i]) * f64::from(depth[i]);
            square += f64::from(depth[i]) * f64::from(depth[i]);
        }
    }
    let scale = product / square.max(MIN_SUM);
    depth.iter_mut().for_each(|d| *d = (f64::from(*d) * scale) as f32);
    for camera in camera_from_world {
        camera.fixed_view_mut::<3, 1>(0, 3).scale_mut(scale);
    }
    let far = quantile(sampled(open(depth)), FAR_QUANTILE).min(MAX_SKY_DEPTH) as f32;
    for i in 0..depth.len() {
        if !is_open(sky[i]) {
            depth[i] = far;
            confidence[i] = 1.0;
        }
    }
    Ok(scale)
}
