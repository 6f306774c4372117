//! Alignment of predicted with given cameras (DA3, pose-conditioned inference): the scale that makes depth metric.
//!
//! The given camera centres g are mapped onto the predicted ones p by the similarity `p ≈ s R g + t` (Umeyama 1991);
//! from ten views on by RANSAC with fixed samples ([`pcg64`]). Depth is then divided by s. Where the centres do not
//! determine a similarity (one view, two views, a straight line) the official code raises an error. Here the scale is the
//! ratio of lengths where there is a baseline; without one it is unobservable and [`ScaleSource`] reports that.

pub mod pcg64;

use crate::error::Da3Error;
use crate::pose::{centre, compose, parts, rigid_inverse};
use nalgebra::{Matrix3, Matrix4, Vector3};
use pcg64::Pcg64;
use serde::{Deserialize, Serialize};

/// Fewer views than this are fitted without RANSAC.
const RANSAC_MIN_VIEWS: usize = 10;
const RANSAC_ROUNDS: usize = 10;
const RANSAC_SEED: u32 = 42;
/// Singular values of the covariance above this count towards the official code's rank: absolute, in the scene's units squared.
const OFFICIAL_RANK_TOLERANCE: f64 = f64::EPSILON;
/// A second singular value below this share of the first is rounding: the centres lie on a line.
const LINE_TOLERANCE: f64 = 1e-9;

/// Positions coincide up to rounding when their largest distance from the mean is below this share of their distance from
/// the origin.
const COINCIDENT_TOLERANCE: f64 = 1e-12;

/// What the scale between given and predicted cameras was estimated from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScaleSource {
    /// A similarity of all camera centres.
    Similarity,
    /// A similarity of the centres that agree, found by RANSAC.
    SimilarityOfInliers,
    /// The centres lie on a line (or there are two): the ratio of lengths along it. The rotation is fitted to the
    /// orientations of the cameras.
    LengthAlongLine,
    /// All given or all predicted centres coincide. The scale is 1, so depth stays in the network's own units.
    Unobservable,
}

/// How given cameras map onto predicted ones: `p = scale · rotation · g + translation`.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraAlignment {
    /// Predicted units per given unit.
    pub scale: f64,
    /// Predicted frame from given frame.
    pub rotation: Matrix3<f64>,
    /// In predicted units.
    pub translation: Vector3<f64>,
    /// What the scale was estimated from.
    pub scale_source: ScaleSource,
    /// Number of views that agree with it.
    pub inliers: usize,
}

impl CameraAlignment {
    /// A given camera in the predicted frame and units.
    pub fn to_predicted(&self, camera_from_given: &Matrix4<f64>) -> Matrix4<f64> {
        let (given_from_camera, position) = parts(&rigid_inverse(camera_from_given));
        rigid_inverse(&compose(&(self.rotation * given_from_camera), &self.apply(&position)))
    }

    fn apply(&self, point_in_given: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_in_given * self.scale + self.translation
    }
}

/// Aligns given cameras with predicted ones (both `camera_from_world`). With `is_strict` every case in which the official
/// code raises an error is an error here too ([`Da3Error::DegenerateCameras`]).
pub fn align_cameras(
    predicted: &[Matrix4<f64>],
    given: &[Matrix4<f64>],
    is_strict: bool,
) -> Result<CameraAlignment, Da3Error> {
    if predicted.len() != given.len() || given.is_empty() {
        let reason = format!("{} predicted, {} given", predicted.len(), given.len());
        return Err(Da3Error::BadInput { what: "cameras to align", reason });
    }
    let source: Vec<Vector3<f64>> = given.iter().map(centre).collect();
    let target: Vec<Vector3<f64>> = predicted.iter().map(centre).collect();
    let full = fit(&source, &target);
    let is_refused = if is_strict { full.official_rank < 2 } else { full.is_line };
    if is_refused {
        if is_strict {
            return Err(Da3Error::DegenerateCameras { views: given.len(), detail: describe(&full) });
        }
        return Ok(align_line(predicted, given, &full));
    }
    if given.len() < RANSAC_MIN_VIEWS {
        return Ok(full.alignment(ScaleSource::Similarity, given.len()));
    }
    Ok(ransac(&source, &target, &full))
}

fn describe(fit: &Fit) -> String {
    if fit.is_coincident { "at one point".into() } else { "on a line".into() }
}

/// An Umeyama fit with its degeneracies.
struct Fit {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    scale: f64,
    values: [f64; 3],
    source_variance: f64,
    official_rank: usize,
    /// The rotation is undetermined: fewer than three positions, all on a line, or all at one point.
    is_line: bool,
    /// The scale is undetermined too: all at one point.
    is_coincident: bool,
}

impl Fit {
    fn alignment(&self, scale_source: ScaleSource, inliers: usize) -> CameraAlignment {
        let (rotation, translation) = (self.rotation, self.translation);
        CameraAlignment { scale: self.scale, rotation, translation, scale_source, inliers }
    }
}

/// `cov = 1/n Σ (p − p̄)(g − ḡ)ᵀ = U D Vᵀ`, `R = U S Vᵀ`, `s = tr(D S)/σ_g²`, `t = p̄ − s R ḡ` (Umeyama, eq. 40–43).
fn fit(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Fit {
    let n = source.len() as f64;
    let mean = |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / n;
    let (source_mean, target_mean) = (mean(source), mean(target));
    let mut covariance = Matrix3::zeros();
    let mut source_variance = 0.0;
    for (g, p) in source.iter().zip(target) {
        covariance += (p - target_mean) * (g - source_mean).transpose() / n;
        source_variance += (g - source_mean).norm_squared() / n;
    }
    let is_coincident = are_coincident(source, &source_mean) || are_coincident(target, &target_mean);
    // A matrix that is not finite has no decomposition; the fit is treated as coincident positions.
    let decomposed = covariance.iter().all(|v| v.is_finite()).then(|| covariance.svd(true, true));
    let (mut values, mut rotation, mut trace) = ([0.0; 3], Matrix3::identity(), 0.0);
    if let Some(svd) = decomposed
        && let (Some(u), Some(v_t)) = (svd.u, svd.v_t)
    {
        values = svd.singular_values.into();
        let is_mirror = u.determinant() * v_t.determinant() < 0.0;
        let signs = Vector3::new(1.0, 1.0, if is_mirror { -1.0 } else { 1.0 });
        rotation = u * Matrix3::from_diagonal(&signs) * v_t;
        trace = svd.singular_values.dot(&signs);
    }
    let scale = if source_variance > 0.0 { trace / source_variance } else { 0.0 };
    Fit {
        translation: target_mean - rotation * source_mean * scale,
        rotation,
        scale,
        values,
        source_variance,
        official_rank: values.iter().filter(|v| **v > OFFICIAL_RANK_TOLERANCE).count(),
        is_line: is_coincident || source.len() < 3 || !(values[1] > LINE_TOLERANCE * values[0]),
        is_coincident,
    }
}

fn are_coincident(points: &[Vector3<f64>], mean: &Vector3<f64>) -> bool {
    let spread = points.iter().map(|p| (p - mean).norm()).fold(0.0, f64::max);
    let size = points.iter().map(|p| p.norm()).fold(0.0, f64::max);
    !(spread > COINCIDENT_TOLERANCE * size)
}

/// The scale from lengths along the line; the rotation that fits the orientations of the cameras best.
fn align_line(predicted: &[Matrix4<f64>], given: &[Matrix4<f64>], full: &Fit) -> CameraAlignment {
    let mut sum = Matrix3::zeros();
    for (p, g) in predicted.iter().zip(given) {
        let (camera_from_predicted, _) = parts(p);
        let (camera_from_given, _) = parts(g);
        sum += camera_from_predicted.transpose() * camera_from_given;
    }
    let rotation = nearest_rotation(&sum);
    let along = full.values[0] / full.source_variance;
    let is_observable = !full.is_coincident && along.is_finite() && along > 0.0;
    let scale = if is_observable { along } else { 1.0 };
    let mean =
        |cameras: &[Matrix4<f64>]| cameras.iter().map(centre).sum::<Vector3<f64>>() / cameras.len() as f64;
    CameraAlignment {
        scale,
        translation: mean(predicted) - rotation * mean(given) * scale,
        rotation,
        scale_source: if is_observable { ScaleSource::LengthAlongLine } else { ScaleSource::Unobservable },
        inliers: given.len(),
    }
}

fn nearest_rotation(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    if !matrix.iter().all(|v| v.is_finite()) {
        return Matrix3::identity();
    }
    let svd = matrix.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => {
            let sign = (u.determinant() * v_t.determinant()).signum();
            u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t
        }
        _ => Matrix3::identity(),
    }
}

/// Ten fits to half of the views each; the one with most inliers, then the smallest mean error, is refitted to its inliers.
///
/// The threshold is the median over views of the distance to the *nearest* predicted centre after a fit to all.
fn ransac(source: &[Vector3<f64>], target: &[Vector3<f64>], full: &Fit) -> CameraAlignment {
    let all_views = full.alignment(ScaleSource::Similarity, source.len());
    let nearest = |g: &Vector3<f64>| {
        let moved = all_views.apply(g);
        target.iter().map(|p| (p - moved).norm()).fold(f64::INFINITY, f64::min)
    };
    let threshold = median(source.iter().map(nearest).collect());
    let mut best: Option<(usize, f64, CameraAlignment, Vec<usize>)> = None;
    for sample in samples(source.len()) {
        let of =
            |points: &[Vector3<f64>], chosen: &[usize]| chosen.iter().map(|&i| points[i]).collect::<Vec<_>>();
        let candidate = fit(&of(source, &sample), &of(target, &sample));
        if candidate.official_rank < 2 {
            continue;
        }
        let candidate = candidate.alignment(ScaleSource::SimilarityOfInliers, 0);
        let error = |i: usize| (candidate.apply(&source[i]) - target[i]).norm();
        let inliers: Vec<usize> = (0..source.len()).filter(|&i| error(i) <= threshold).collect();
        let count = inliers.len();
        let mean = inliers.iter().map(|&i| error(i)).sum::<f64>() / count as f64;
        let mean = if count == 0 { f64::INFINITY } else { mean };
        let is_better = best.as_ref().is_none_or(|b| count > b.0 || (count == b.0 && mean < b.1));
        if is_better {
            best = Some((count, mean, candidate, inliers));
        }
    }
    let Some((count, _, candidate, inliers)) = best else {
        return all_views;
    };
    if count < 3 {
        return CameraAlignment { inliers: count, ..candidate };
    }
    let chosen = |points: &[Vector3<f64>]| inliers.iter().map(|&i| points[i]).collect::<Vec<_>>();
    let refit = fit(&chosen(source), &chosen(target));
    if refit.official_rank < 2 {
        return CameraAlignment { inliers: count, ..candidate };
    }
    refit.alignment(ScaleSource::SimilarityOfInliers, count)
}

/// The samples of RANSAC for a number of views: the same as the official code draws.
pub fn samples(views: usize) -> Vec<Vec<usize>> {
    let size = 3.max(views.div_ceil(2));
    let mut generator = Pcg64::seed(RANSAC_SEED);
    (0..RANSAC_ROUNDS).map(|_| generator.choose(views, size)).collect()
}

/// The median; the mean of the two central values for an even number.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => f64::NAN,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}

#[cfg(test)]
mod tests;
