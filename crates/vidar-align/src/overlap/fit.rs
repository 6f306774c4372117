//! The robust similarity between paired points, with its covariance.

use crate::streaming::{AlignMethod, StreamingError, weighted_similarity};
use nalgebra::{SMatrix, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::{LieGroup, Sim3};
use vidar_solve::Kernel;
use vidar_solve::statistics::{STD_PER_MAD, median_upper};

/// How an overlap is sampled and when its fit is accepted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OverlapConfig {
    /// Depths kept per view (100 to 20 000). More cost memory and time without effect: neighbouring pixels share the errors
    /// of a prediction.
    pub samples_per_view: usize,
    /// Most point pairs of one fit (1000 to 1 000 000); views are thinned evenly to stay below.
    pub max_pairs: usize,
    /// Fewest point pairs of an overlap constraint (3 or more).
    pub min_pairs: usize,
    /// Share of pairs that must agree within 5 % of depth for an overlap constraint (0 to 1). Lower it for models whose views
    /// disagree a lot; below it a chunk that shares frames with its neighbour is rejected.
    pub min_inlier_ratio: f64,
}

impl Default for OverlapConfig {
    fn default() -> Self {
        Self { samples_per_view: 2048, max_pairs: 40_000, min_pairs: 60, min_inlier_ratio: 0.3 }
    }
}

/// The same points in two chunks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointPairs {
    /// In the source chunk, its units.
    pub source: Vec<Vector3<f64>>,
    /// In the target chunk, its units.
    pub target: Vec<Vector3<f64>>,
    /// z-depth of each source point in its camera.
    pub source_depth: Vec<f64>,
    /// z-depth of each target point in its camera: what a residual is measured by.
    pub target_depth: Vec<f64>,
    /// Weight of each pair before robust weighting.
    pub weight: Vec<f64>,
    /// How many of them count as independent; 0 = all.
    pub independent: usize,
}

impl PointPairs {
    /// Adds a pair.
    pub fn push(&mut self, source: Vector3<f64>, target: Vector3<f64>, zs: f64, zt: f64, weight: f64) {
        self.source.push(source);
        self.target.push(target);
        self.source_depth.push(zs);
        self.target_depth.push(zt);
        self.weight.push(weight);
    }

    /// Number of pairs.
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }
}

/// A similarity between two chunks with its covariance.
#[derive(Clone, Debug, PartialEq)]
pub struct OverlapFit {
    /// Maps the source chunk to the target chunk.
    pub target_from_source: Sim3,
    /// Covariance of δ in `target_from_source · exp(δ)`: rotation (rad), translation (source units), ln(scale).
    pub covariance: SMatrix<f64, 7, 7>,
    /// Pairs that took part.
    pub pairs: usize,
    /// Share of them that agree within 5 % of depth in both chunks.
    pub inlier_ratio: f64,
    /// Median residual as a share of depth.
    pub median_residual: f64,
    /// Reweightings.
    pub iterations: usize,
}

impl OverlapFit {
    /// Standard deviation of ln(scale).
    pub fn log_scale_std(&self) -> f64 {
        self.covariance[(6, 6)].max(0.0).sqrt()
    }
}

/// Residual, as a share of depth, up to which a pair counts as agreeing.
pub(crate) const INLIER_RESIDUAL: f64 = 0.05;
/// Huber's width while the fit is still coarse, as a share of depth.
const HUBER_WIDTH: f64 = 0.03;
/// Steps with Huber's loss before the bounded one.
const COARSE_STEPS: usize = 6;
const STEPS: usize = 20;
const SETTLED: f64 = 1e-6;
/// Median of the length of a three-dimensional Gaussian of unit variance per axis.
const MEDIAN_OF_LENGTH: f64 = 1.538;
/// Factor on the standard deviations from independent pixels: errors of a model are not white.
const WIDENING: f64 = 3.0;
/// Least residual, share of depth: the resolution of f32 depth.
const RESIDUAL_FLOOR: f64 = 1e-6;

/// Fits `target ≈ S · source`.
///
/// # Errors
/// [`StreamingError::NoPairs`] below `min_pairs`, [`StreamingError::Degenerate`] when the pairs do not fix a similarity.
pub fn fit_overlap(pairs: &PointPairs, config: &OverlapConfig) -> Result<OverlapFit, StreamingError> {
    if pairs.len() < config.min_pairs.max(3) {
        return Err(StreamingError::NoPairs);
    }
    // Residuals are shares of depth, so squared ones weigh 1/z².
    let base: Vec<f64> = pairs.weight.iter().zip(&pairs.target_depth).map(|(w, z)| w / (z * z)).collect();
    let solve = |w: &[f64]| weighted_similarity(&pairs.source, &pairs.target, w, AlignMethod::Sim3);
    let mut fit = solve(&normalised(base.clone()))?;
    let mut residuals = vec![0.0; pairs.len()];
    let mut scratch = Vec::with_capacity(pairs.len());
    let mut iterations = 0;
    let mut bounded_from = COARSE_STEPS;
    for step in 0..STEPS {
        measure(pairs, &fit, &mut residuals);
        let coarse = step < bounded_from;
        let kernel = if coarse {
            Kernel::Huber { k: HUBER_WIDTH }
        } else {
            bounded_kernel(median(&residuals, &mut scratch))
        };
        let weights = base.iter().zip(&residuals).map(|(w, r)| w * kernel.weight_of_length(*r)).collect();
        let next = solve(&normalised(weights))?;
        iterations = step + 1;
        let change = (fit.inverse() * next).log();
        let typical_depth = pairs.target_depth[pairs.len() / 2] / next.scale;
        let moved = change.fixed_rows::<3>(0).norm()
            + change.fixed_rows::<3>(3).norm() / typical_depth.max(f64::MIN_POSITIVE)
            + change[6].abs();
        fit = next;
        if coarse && moved < 1e-3 {
            bounded_from = step + 1;
        } else if !coarse && moved < SETTLED {
            break;
        }
    }
    Ok(OverlapFit { iterations, ..evaluate_fit(pairs, fit) })
}

/// Geman-McClure's kernel at the width of the residuals themselves.
fn bounded_kernel(median_residual: f64) -> Kernel {
    Kernel::GemanMcClure { k: 2.5 * STD_PER_MAD * median_residual.max(RESIDUAL_FLOOR) / 1.5 }
}

/// The inverse of `Σ wᵢ Jᵢᵀ Jᵢ / (ρ σ²)`, ρ = pairs per independent one, widened.
fn covariance(pairs: &PointPairs, fit: &Sim3, residuals: &[f64], median: f64) -> SMatrix<f64, 7, 7> {
    let sigma = median.max(RESIDUAL_FLOOR) / MEDIAN_OF_LENGTH;
    let kernel = bounded_kernel(median);
    let mut information = SMatrix::<f64, 7, 7>::zeros();
    let largest = pairs.weight.iter().fold(0.0, |a: f64, w| a.max(*w)).max(f64::MIN_POSITIVE);
    for i in 0..pairs.len() {
        let weight = kernel.weight_of_length(residuals[i]) * pairs.weight[i] / largest;
        let j = fit.d_act_d_perturbation(&pairs.source[i]) / pairs.target_depth[i];
        information += j.transpose() * j * weight;
    }
    let independent = if pairs.independent == 0 { pairs.len() } else { pairs.independent.min(pairs.len()) };
    let sharing = pairs.len() as f64 / independent as f64;
    let variance = sigma * sigma * sharing * WIDENING * WIDENING;
    // A direction that is not observable (all points in one place) stays free instead of failing.
    let open = information.diagonal().max().max(1e-12) * 1e-12;
    let regular = information + SMatrix::<f64, 7, 7>::identity() * open;
    regular.try_inverse().map_or_else(SMatrix::identity, |inverse| inverse * variance)
}

fn measure(pairs: &PointPairs, fit: &Sim3, residuals: &mut [f64]) {
    let (turn, shift) = (fit.rotation.matrix() * fit.scale, fit.translation);
    for (i, r) in residuals.iter_mut().enumerate() {
        *r = (pairs.target[i] - (turn * pairs.source[i] + shift)).norm() / pairs.target_depth[i];
    }
}

/// Weights that sum to their number, so that the closed form's threshold on the sum of weights is one on the pairs.
fn normalised(mut weights: Vec<f64>) -> Vec<f64> {
    let sum: f64 = weights.iter().sum();
    if sum > 0.0 && sum.is_finite() {
        let factor = weights.len() as f64 / sum;
        weights.iter_mut().for_each(|w| *w *= factor);
    }
    weights
}

fn median(values: &[f64], scratch: &mut Vec<f64>) -> f64 {
    scratch.clear();
    scratch.extend_from_slice(values);
    median_upper(scratch).unwrap_or(0.0)
}

/// Residuals, inlier ratio and covariance of a similarity found by other means.
pub(crate) fn evaluate_fit(pairs: &PointPairs, target_from_source: Sim3) -> OverlapFit {
    let mut residuals = vec![0.0; pairs.len()];
    measure(pairs, &target_from_source, &mut residuals);
    let median_residual = median(&residuals, &mut Vec::new());
    OverlapFit {
        target_from_source,
        covariance: covariance(pairs, &target_from_source, &residuals, median_residual),
        pairs: pairs.len(),
        inlier_ratio: inlier_ratio(pairs, &target_from_source, &residuals),
        median_residual,
        iterations: 0,
    }
}

/// Share of pairs within 5 % of depth on both sides: `|x − S⁻¹ y| / z_x` is the same error in units of the source.
fn inlier_ratio(pairs: &PointPairs, fit: &Sim3, residuals: &[f64]) -> f64 {
    let agrees = |i: usize| {
        let back = residuals[i] * pairs.target_depth[i] / (fit.scale * pairs.source_depth[i]);
        residuals[i].max(back) <= INLIER_RESIDUAL
    };
    (0..pairs.len()).filter(|&i| agrees(i)).count() as f64 / pairs.len().max(1) as f64
}
