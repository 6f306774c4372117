//! The weighted similarity between two sets of points, in closed form.
//!
//! Minimises `Σ w |y − (s R x + t)|²` over R and t; the scale is Horn's symmetric ratio of spreads,
//! `s = √(Σ w |y'|² / Σ w |x'|²)`, which treats noise of both sides alike (Horn 1987, section 2.E), not Umeyama's
//! `tr(D S)/σ²`, which puts all noise on one side and is biased low.

use super::StreamingError;
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::{Sim3, So3, nearest_rotation};

/// What is estimated between two chunks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AlignMethod {
    /// Rotation, translation and scale from the points.
    #[default]
    Sim3,
    /// Rotation and translation; the scale is 1.
    Se3,
    /// The scale from the depth maps, rotation and translation from the points.
    ScaleSe3,
}

/// Fits `y ≈ s R x + t` to pairs with weights; `method` [`AlignMethod::Se3`] keeps s = 1.
///
/// # Errors
/// [`StreamingError::Degenerate`] when weights or points are not finite, all weight is gone, or the source has no spread
/// to scale. A planar source is fine; of the rotations that a line leaves open one is returned.
pub fn weighted_similarity(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
    method: AlignMethod,
) -> Result<Sim3, StreamingError> {
    let degenerate = |reason| StreamingError::Degenerate { pairs: source.len(), reason };
    let total: f64 = weights.iter().sum();
    if !(total >= 1e-6 && total.is_finite()) {
        return Err(degenerate("all weight is gone"));
    }
    let mean = |points: &[Vector3<f64>]| {
        points.iter().zip(weights).fold(Vector3::zeros(), |sum, (p, w)| sum + p * *w) / total
    };
    let (source_mean, target_mean) = (mean(source), mean(target));
    let mut covariance = Matrix3::zeros();
    let (mut source_spread, mut target_spread) = (0.0, 0.0);
    for ((x, y), w) in source.iter().zip(target).zip(weights) {
        let (x, y) = (x - source_mean, y - target_mean);
        covariance += x * y.transpose() * *w;
        source_spread += w * x.norm_squared();
        target_spread += w * y.norm_squared();
    }
    let scale = match method {
        AlignMethod::Sim3 => (target_spread / source_spread).sqrt(),
        AlignMethod::Se3 | AlignMethod::ScaleSe3 => 1.0,
    };
    if !(scale.is_finite() && scale > 0.0) {
        return Err(degenerate("the points have no spread"));
    }
    let rotation = rotation_of(&(covariance * (scale / total))).ok_or_else(|| degenerate("not finite"))?;
    let translation = target_mean - rotation.matrix() * source_mean * scale;
    Sim3::new(rotation, translation, scale).filter(Sim3::is_finite).ok_or_else(|| degenerate("not finite"))
}

/// R = V Uᵀ of `H = U D Vᵀ`, turned into a rotation by the sign of the smallest singular direction.
fn rotation_of(covariance: &Matrix3<f64>) -> Option<So3> {
    So3::from_matrix(&nearest_rotation(covariance)?.rotation.transpose())
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::LieGroup;

    fn points() -> Vec<Vector3<f64>> {
        (0..40)
            .map(|i| {
                let a = f64::from(i);
                Vector3::new((1.3 * a).sin() * 2.0, (0.7 * a).cos(), 3.0 + (2.1 * a).sin())
            })
            .collect()
    }

    fn truth() -> Sim3 {
        Sim3::new(
            So3::from_axis_angle(&Vector3::new(0.3, -1.0, 0.2), 2.4),
            Vector3::new(5.0, -2.0, 1.0),
            0.37,
        )
        .unwrap()
    }

    #[test]
    fn exact_pairs_give_the_exact_similarity_for_any_weights() {
        let source = points();
        let target: Vec<_> = source.iter().map(|p| truth().act(p)).collect();
        let weights: Vec<f64> = (0..source.len()).map(|i| 0.1 + (i % 7) as f64).collect();
        let fit = weighted_similarity(&source, &target, &weights, AlignMethod::Sim3).unwrap();
        assert!((fit.inverse() * truth()).log().norm() < 1e-12);
        let rigid = Sim3 { scale: 1.0, ..truth() };
        let target: Vec<_> = source.iter().map(|p| rigid.act(p)).collect();
        let fit = weighted_similarity(&source, &target, &weights, AlignMethod::Se3).unwrap();
        assert!((fit.inverse() * rigid).log().norm() < 1e-12);
    }

    #[test]
    fn what_fixes_no_similarity_is_an_error() {
        let source = points();
        let ones = vec![1.0; source.len()];
        let fit = |x: &[_], y: &[_], w: &[f64]| weighted_similarity(x, y, w, AlignMethod::Sim3);
        assert!(fit(&source, &source, &vec![0.0; source.len()]).is_err());
        let one_place = vec![Vector3::x(); source.len()];
        assert!(fit(&one_place, &source, &ones).is_err());
        assert!(fit(&source, &one_place, &ones).is_err());
        let mut broken = source.clone();
        broken[3].y = f64::NAN;
        assert!(fit(&broken, &source, &ones).is_err());
        assert!(fit(&[], &[], &[]).is_err());
    }
}
