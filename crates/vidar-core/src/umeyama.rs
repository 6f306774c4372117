//! Closed-form alignment of paired points (Umeyama, PAMI 1991; the paper's section III-E).

use crate::lie::{Se3, Sim3, So3};
use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

/// Why paired points do not fix a transform.
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
    /// Fewer than three pairs.
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
    /// The points coincide or lie on a line, so that the rotation is free.
    #[error(
        "points are degenerate: second spread {second:.3e} of first {first:.3e} (on a line or in one place)"
    )]
    Degenerate {
        /// Largest singular value of the cross-covariance.
        first: f64,
        /// Second singular value.
        second: f64,
    },
}

/// Relative size of the second singular value below which the rotation counts as free.
const RANK_TOLERANCE: f64 = 1e-9;

/// The similarity `target_from_source` that minimises `Σ |y − (s R x + t)|²` (Umeyama 1991, eq. 40–43).
///
/// The least-squares scale `tr(D S)/σ_x²` is used; the paper's section III-E writes the ratio of RMS radii
/// `σ_t/σ_s`, which agrees for noise-free pairs and is available as [`rms_radius_scale`].
pub fn umeyama_sim3(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<Sim3, UmeyamaError> {
    let fit = fit(source, target)?;
    let scale = fit.signed_trace / fit.source_variance;
    Sim3::new(fit.rotation, fit.target_mean - fit.rotation * fit.source_mean * scale, scale)
        .ok_or(UmeyamaError::Degenerate { first: fit.signed_trace, second: 0.0 })
}

/// The rigid motion `target_from_source` that minimises `Σ |y − (R x + t)|²`.
pub fn umeyama_se3(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<Se3, UmeyamaError> {
    let fit = fit(source, target)?;
    Ok(Se3::new(fit.rotation, fit.target_mean - fit.rotation * fit.source_mean))
}

/// The paper's closed form of the scale, `σ_t/σ_s` with RMS radii (section III-E).
pub fn rms_radius_scale(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<f64, UmeyamaError> {
    check(source, target)?;
    let (source_variance, target_variance) =
        (variance(source, &mean(source)), variance(target, &mean(target)));
    let scale = (target_variance / source_variance).sqrt();
    if scale.is_finite() && scale > 0.0 {
        Ok(scale)
    } else {
        Err(UmeyamaError::Degenerate { first: source_variance, second: target_variance })
    }
}

struct Fit {
    rotation: So3,
    source_mean: Vector3<f64>,
    target_mean: Vector3<f64>,
    source_variance: f64,
    signed_trace: f64,
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

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len() as f64
}

fn variance(points: &[Vector3<f64>], mean: &Vector3<f64>) -> f64 {
    points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / points.len() as f64
}

fn fit(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Result<Fit, UmeyamaError> {
    check(source, target)?;
    let (source_mean, target_mean) = (mean(source), mean(target));
    let n = source.len() as f64;
    // Σ_xy of Umeyama eq. 38.
    let mut covariance = Matrix3::zeros();
    for (x, y) in source.iter().zip(target) {
        covariance += (y - target_mean) * (x - source_mean).transpose();
    }
    covariance /= n;
    let source_variance = variance(source, &source_mean);
    let target_variance = variance(target, &target_mean);
    let svd = covariance.svd(true, true);
    let degenerate = |first: f64, second: f64| UmeyamaError::Degenerate { first, second };
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(degenerate(f64::NAN, f64::NAN));
    };
    let d = svd.singular_values;
    // Judge the rank against the spread of the points, so that a cloud of one place is degenerate too.
    let reference = (source_variance * target_variance).sqrt();
    let extent = source_mean.norm().max(target_mean.norm()).max(f64::MIN_POSITIVE);
    let spread_is_rounding = source_variance.sqrt().min(target_variance.sqrt()) <= 1e-12 * extent;
    if spread_is_rounding || !(reference > 0.0) || d[1] <= RANK_TOLERANCE * reference {
        return Err(degenerate(d[0], d[1]));
    }
    let reflected = u.determinant() * v_t.determinant() < 0.0;
    let s = if reflected { -1.0 } else { 1.0 };
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, s)) * v_t;
    let rotation = So3::from_matrix(&rotation).ok_or_else(|| degenerate(d[0], d[1]))?;
    Ok(Fit { rotation, source_mean, target_mean, source_variance, signed_trace: d[0] + d[1] + s * d[2] })
}
