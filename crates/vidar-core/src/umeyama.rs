//! Closed-form alignment of paired points (Umeyama, PAMI 1991; the paper's section III-E).
//!
//! Given source points x, target points y and weights w, the similarity that minimises `Σ w |y − (s R x + t)|²` comes
//! from the means, the cross-covariance `Σ_xy = Σ w (y − ȳ)(x − x̄)ᵀ / Σ w = U D Vᵀ` and the source variance σ²:
//! `R = U diag(1, 1, det U det V) Vᵀ`, `s = tr(D diag(1, 1, det U det V))/σ²`, `t = ȳ − s R x̄` (eq. 40–43).
//! Points in a plane are enough; points on a line leave the rotation undetermined and are an error.

use crate::lie::{Se3, Sim3, So3};
use crate::svd3::proper_svd;
use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

/// Why paired points do not determine a transform.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum UmeyamaError {
    /// The two lists differ in length.
    #[error("{source_len} source points but {target_len} target points")]
    LengthMismatch {
        /// Points to move.
        source_len: usize,
        /// Points to reach.
        target_len: usize,
    },
    /// Fewer than three pairs with a positive weight.
    #[error("{found} point pairs, at least 3 are needed")]
    TooFewPoints {
        /// Pairs given.
        found: usize,
    },
    /// A coordinate is not finite.
    #[error("point pair {index} is not finite")]
    NotFinite {
        /// Which pair.
        index: usize,
    },
    /// The points coincide or lie on a line, so that the rotation is undetermined.
    #[error("points are degenerate: singular values {first:.3e} and {second:.3e} (on a line or coincident)")]
    Degenerate {
        /// Largest singular value of the cross-covariance.
        first: f64,
        /// The second singular value plus the signed third: curvature of the cost about the first direction.
        second: f64,
    },
    /// Points and weights differ in number.
    #[error("{points} point pairs but {weights} weights")]
    WeightCountMismatch {
        /// Pairs given.
        points: usize,
        /// Weights given.
        weights: usize,
    },
    /// A weight is negative or not finite.
    #[error("weight {index} must be finite and not negative, found {found}")]
    BadWeight {
        /// Which weight.
        index: usize,
        /// The value found.
        found: f64,
    },
}

/// Relative size of `second` below which the rotation is undetermined: a line of 1 m that is 30 µm wide still passes.
const RANK_TOLERANCE: f64 = 1e-9;

/// Standard deviation over distance from the origin below which points coincide up to rounding.
const COINCIDENCE_TOLERANCE: f64 = 1e-12;

/// The similarity `target_from_source` that minimises `Σ |y − (s R x + t)|²` (Umeyama 1991, eq. 40–43).
///
/// The least-squares scale `tr(D S)/σ_x²` is used; the paper's section III-E writes the ratio of RMS radii
/// `σ_t/σ_s`, which agrees for noise-free pairs.
pub fn umeyama_sim3(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<Sim3, UmeyamaError> {
    check(source, target)?;
    similarity(&fit(source, target, |_| 1.0)?)
}

/// The similarity that minimises `Σ w |y − (s R x + t)|²`; weights are finite, not negative, three of them positive.
///
/// Only the ratios of weights matter. A pair of weight 0 has no influence.
pub fn umeyama_sim3_weighted(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
) -> Result<Sim3, UmeyamaError> {
    similarity(&weighted_fit(source, target, weights)?)
}

/// The rigid motion `target_from_source` that minimises `Σ |y − (R x + t)|²`.
pub fn umeyama_se3(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<Se3, UmeyamaError> {
    check(source, target)?;
    Ok(rigid(&fit(source, target, |_| 1.0)?))
}

fn similarity(fit: &Fit) -> Result<Sim3, UmeyamaError> {
    let scale = fit.signed_trace / fit.source_variance;
    let translation = fit.target_mean - fit.rotation * fit.source_mean * scale;
    Sim3::new(fit.rotation, translation, scale)
        .filter(Sim3::is_finite)
        .ok_or(UmeyamaError::Degenerate { first: fit.signed_trace, second: 0.0 })
}

fn rigid(fit: &Fit) -> Se3 {
    Se3::new(fit.rotation, fit.target_mean - fit.rotation * fit.source_mean)
}

struct Fit {
    rotation: So3,
    source_mean: Vector3<f64>,
    target_mean: Vector3<f64>,
    source_variance: f64,
    signed_trace: f64,
}

struct Moments {
    source_mean: Vector3<f64>,
    target_mean: Vector3<f64>,
    source_variance: f64,
    target_variance: f64,
    /// `Σ_xy` of eq. 38.
    covariance: Matrix3<f64>,
}

fn check(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<(), UmeyamaError> {
    if source.len() != target.len() {
        return Err(UmeyamaError::LengthMismatch { source_len: source.len(), target_len: target.len() });
    }
    if source.len() < 3 {
        return Err(UmeyamaError::TooFewPoints { found: source.len() });
    }
    let finite = |p: &Vector3<f64>| p.iter().all(|v| v.is_finite());
    match source.iter().zip(target).position(|(x, y)| !finite(x) || !finite(y)) {
        Some(index) => Err(UmeyamaError::NotFinite { index }),
        None => Ok(()),
    }
}

fn weighted_fit(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
) -> Result<Fit, UmeyamaError> {
    check(source, target)?;
    if weights.len() != source.len() {
        return Err(UmeyamaError::WeightCountMismatch { points: source.len(), weights: weights.len() });
    }
    if let Some(index) = weights.iter().position(|w| !(w.is_finite() && *w >= 0.0)) {
        return Err(UmeyamaError::BadWeight { index, found: weights[index] });
    }
    let found = weights.iter().filter(|w| **w > 0.0).count();
    if found < 3 {
        return Err(UmeyamaError::TooFewPoints { found });
    }
    // Only ratios matter; the largest weight becomes 1, so that no sum overflows.
    let largest = weights.iter().fold(0.0, |a: f64, &w| a.max(w));
    fit(source, target, |i| weights[i] / largest)
}

fn mean(points: &[Vector3<f64>], weight: impl Fn(usize) -> f64) -> Vector3<f64> {
    let total: f64 = (0..points.len()).map(&weight).sum();
    let about = |origin: Vector3<f64>| {
        let sum: Vector3<f64> = points.iter().enumerate().map(|(i, p)| (p - origin) * weight(i)).sum();
        origin + sum / total
    };
    // The second pass sums small numbers, so that a cloud far from the origin keeps its digits.
    about(about(Vector3::zeros()))
}

/// Means, variances and cross-covariance; an error when the points of a cloud coincide up to rounding.
fn moments(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weight: impl Fn(usize) -> f64,
) -> Result<Moments, UmeyamaError> {
    let (source_mean, target_mean) = (mean(source, &weight), mean(target, &weight));
    let (mut source_variance, mut target_variance, mut total) = (0.0, 0.0, 0.0);
    let mut covariance = Matrix3::zeros();
    for (i, (x, y)) in source.iter().zip(target).enumerate() {
        let (w, x, y) = (weight(i), x - source_mean, y - target_mean);
        source_variance += w * x.norm_squared();
        target_variance += w * y.norm_squared();
        covariance += y * x.transpose() * w;
        total += w;
    }
    let (source_variance, target_variance) = (source_variance / total, target_variance / total);
    let coincident = |variance: f64, mean: &Vector3<f64>| {
        !(variance.is_finite() && variance.sqrt() > COINCIDENCE_TOLERANCE * mean.norm() && variance > 0.0)
    };
    if coincident(source_variance, &source_mean) || coincident(target_variance, &target_mean) {
        return Err(UmeyamaError::Degenerate { first: source_variance, second: target_variance });
    }
    let covariance = covariance / total;
    Ok(Moments { source_mean, target_mean, source_variance, target_variance, covariance })
}

fn fit(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weight: impl Fn(usize) -> f64,
) -> Result<Fit, UmeyamaError> {
    let Moments { source_mean, target_mean, source_variance, target_variance, covariance } =
        moments(source, target, weight)?;
    let svd =
        proper_svd(&covariance).ok_or(UmeyamaError::Degenerate { first: covariance.amax(), second: 0.0 })?;
    let [first, second, third] = svd.values;
    // Rotating about the first direction changes the cost by second + third: zero on a line, and for the mirror
    // image of a cloud with two equal variances, where two rotations are equally good.
    let curvature = second + third;
    let degenerate = UmeyamaError::Degenerate { first, second: curvature };
    if !(curvature > RANK_TOLERANCE * (source_variance * target_variance).sqrt()) {
        return Err(degenerate);
    }
    let rotation = So3::from_matrix(&svd.rotation).ok_or(degenerate)?;
    Ok(Fit { rotation, source_mean, target_mean, source_variance, signed_trace: first + curvature })
}
