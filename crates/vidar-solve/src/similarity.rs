//! Robust similarity between paired points, and the mean of rotations.
//!
//! [`robust_similarity`] is how Depth Anything 3 finds the scale s* of the paper's section III-E: Umeyama's closed form, from
//! ten pairs on by RANSAC over the samples of the official program, so that the program's own network and the alignment of
//! predictions made elsewhere divide depth by the same number.

use crate::pcg64::Pcg64;
use crate::statistics::median;
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, Sim3, So3, UmeyamaError, nearest_rotation, umeyama_sim3};

/// Fewer pairs than this are fitted without RANSAC.
const RANSAC_MIN_PAIRS: usize = 10;
const RANSAC_ROUNDS: usize = 10;
const RANSAC_SEED: u32 = 42;

/// A similarity that most pairs agree with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobustSimilarity {
    /// `y ≈ s R x + t` for source points x and target points y.
    pub target_from_source: Sim3,
    /// Pairs that agree with it; all of them where none was left out.
    pub inliers: usize,
    /// Whether it was found by RANSAC.
    pub is_of_inliers: bool,
}

/// Umeyama's similarity; from ten pairs on ten fits to half of the pairs each. The fit with most inliers, then the smallest mean
/// error, is fitted again to its inliers. The threshold is the median over source points of the distance to the *nearest*
/// target point after a fit to all.
///
/// # Errors
/// The pairs do not determine a similarity: fewer than three, on a line, or not finite.
pub fn robust_similarity(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
) -> Result<RobustSimilarity, UmeyamaError> {
    let all = umeyama_sim3(source, target)?;
    let of_all = RobustSimilarity { target_from_source: all, inliers: source.len(), is_of_inliers: false };
    if source.len() < RANSAC_MIN_PAIRS {
        return Ok(of_all);
    }
    let nearest = |x: &Vector3<f64>| {
        let moved = all.act(x);
        target.iter().map(|y| (y - moved).norm()).fold(f64::INFINITY, f64::min)
    };
    let threshold = median(&mut source.iter().map(nearest).collect::<Vec<f64>>()).unwrap_or(f64::NAN);
    let fit = |chosen: &[usize]| {
        let of = |points: &[Vector3<f64>]| chosen.iter().map(|&i| points[i]).collect::<Vec<_>>();
        umeyama_sim3(&of(source), &of(target)).ok()
    };
    let mut best: Option<(f64, Sim3, Vec<usize>)> = None;
    for sample in ransac_samples(source.len()) {
        let Some(candidate) = fit(&sample) else { continue };
        let error = |i: usize| (candidate.act(&source[i]) - target[i]).norm();
        let inliers: Vec<usize> = (0..source.len()).filter(|&i| error(i) <= threshold).collect();
        let sum = inliers.iter().map(|&i| error(i)).sum::<f64>();
        let mean = if inliers.is_empty() { f64::INFINITY } else { sum / inliers.len() as f64 };
        let is_better = best
            .as_ref()
            .is_none_or(|b| inliers.len() > b.2.len() || (inliers.len() == b.2.len() && mean < b.0));
        if is_better {
            best = Some((mean, candidate, inliers));
        }
    }
    Ok(best.map_or(of_all, |(_, candidate, inliers)| RobustSimilarity {
        target_from_source: fit(&inliers).unwrap_or(candidate),
        inliers: inliers.len(),
        is_of_inliers: true,
    }))
}

/// The samples of RANSAC for a number of pairs: the same as the official program draws.
pub fn ransac_samples(pairs: usize) -> Vec<Vec<usize>> {
    let size = 3.max(pairs.div_ceil(2));
    let mut generator = Pcg64::seed(RANSAC_SEED);
    (0..RANSAC_ROUNDS).map(|_| generator.choose(pairs, size)).collect()
}

/// The rotation nearest to the sum of rotations (the chordal mean); `None` for none, or when they cancel.
pub fn mean_rotation(rotations: impl Iterator<Item = So3>) -> Option<So3> {
    let mut count = 0usize;
    let sum = rotations.fold(Matrix3::zeros(), |m, r| {
        count += 1;
        m + r.matrix()
    });
    if count == 0 {
        return None;
    }
    So3::from_matrix(&nearest_rotation(&sum)?.rotation)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bend(n: usize) -> Vec<Vector3<f64>> {
        (0..n).map(|i| i as f64).map(|t| Vector3::new(t, 0.1 * t * t, (t * 0.7).sin())).collect()
    }

    #[test]
    fn an_outlier_among_ten_or_more_is_left_out_and_a_line_is_refused() {
        let truth = Sim3 {
            scale: 0.5,
            ..Sim3::from_se3(&vidar_core::Se3::exp(&[0.4, -0.7, 0.2, 0.3, 0.1, -2.0].into()))
        };
        let source = bend(16);
        let mut target: Vec<Vector3<f64>> = source.iter().map(|x| truth.act(x)).collect();
        let few = robust_similarity(&source[..6], &target[..6]).unwrap();
        assert_eq!((few.inliers, few.is_of_inliers), (6, false));
        assert!((few.target_from_source.scale - 0.5).abs() < 1e-12);
        target[11] = Vector3::new(40.0, -30.0, 9.0);
        let found = robust_similarity(&source, &target).unwrap();
        assert!(found.is_of_inliers && found.inliers < 16, "{found:?}");
        assert!((found.target_from_source.scale - 0.5).abs() < 1e-6, "{found:?}");
        let line: Vec<Vector3<f64>> = (0..12).map(|i| Vector3::new(2.0, -1.0, 0.5) * f64::from(i)).collect();
        assert!(robust_similarity(&line, &line).is_err());
    }

    #[test]
    fn the_mean_of_rotations_lies_between_them() {
        let about_z = |angle: f64| So3::exp(&Vector3::new(0.0, 0.0, angle));
        let mean = mean_rotation([0.1, 0.3].into_iter().map(about_z)).unwrap();
        assert!((mean.log().z - 0.2).abs() < 1e-12);
        assert!(mean_rotation(std::iter::empty()).is_none());
    }
}
