//! Alignment of predicted with given cameras (DA3, pose-conditioned inference): the scale that makes depth metric.
//!
//! The given camera centres g are mapped onto the predicted ones p by the similarity `p ≈ s R g + t` (Umeyama 1991);
//! from ten views on by RANSAC with fixed samples ([`pcg64`]). Depth is then divided by s. Where the centres do not
//! fix a similarity (one view, two views, a straight line) the official code stops; here the answer says what can be
//! observed: with a baseline its length ratio, without one nothing.

pub mod pcg64;

use crate::error::Da3Error;
use crate::pose::{centre, compose, parts, rigid_inverse};
use nalgebra::{Matrix3, Matrix4, Vector3};
use pcg64::Pcg64;
use serde::{Deserialize, Serialize};

/// From this many views on samples are drawn.
const RANSAC_MIN_VIEWS: usize = 10;
const RANSAC_ROUNDS: usize = 10;
const RANSAC_SEED: u32 = 42;
/// Singular values of the covariance that the official code counts as there: absolute, in the scene's units squared.
const OFFICIAL_RANK_TOLERANCE: f64 = f64::EPSILON;
/// Share of the first singular value below which the second one is rounding: a straight line.
const LINE_TOLERANCE: f64 = 1e-9;

/// Spread over distance from the origin below which positions are one place seen through rounding.
const PLACE_TOLERANCE: f64 = 1e-12;

/// What fixed the scale between given and predicted cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScaleEvidence {
    /// A similarity of all camera centres.
    Similarity,
    /// A similarity of the centres that agree, found by RANSAC.
    SimilarityOfInliers,
    /// The centres lie on a line (or there are two): the ratio of lengths along it; orientation comes from the
    /// cameras' own.
    LengthAlongLine,
    /// One place only, given or predicted: nothing. The scale is 1, that is, the network's own units.
    Nothing,
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
    /// What the scale rests on.
    pub evidence: ScaleEvidence,
    /// Views that agree with it.
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

/// Aligns given cameras with predicted ones (both `camera_from_world`). With `is_strict` a case in which the official
/// code raises is an error here too.
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
        return Ok(full.alignment(ScaleEvidence::Similarity, given.len()));
    }
    Ok(ransac(&source, &target, &full))
}

fn describe(fit: &Fit) -> String {
    if fit.is_place { "in one place".into() } else { "on a line".into() }
}

/// An Umeyama fit with what is needed to judge it.
struct Fit {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    scale: f64,
    values: [f64; 3],
    source_variance: f64,
    official_rank: usize,
    /// No rotation follows: fewer than three positions, or a line, or one place.
    is_line: bool,
    /// Not even a length follows.
    is_place: bool,
}

impl Fit {
    fn alignment(&self, evidence: ScaleEvidence, inliers: usize) -> CameraAlignment {
        let (rotation, translation) = (self.rotation, self.translation);
        CameraAlignment { scale: self.scale, rotation, translation, evidence, inliers }
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
    let is_place = is_one_place(source, &source_mean) || is_one_place(target, &target_mean);
    // A matrix that is not finite has no decomposition: the fit is refused as one place.
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
        is_line: is_place || source.len() < 3 || !(values[1] > LINE_TOLERANCE * values[0]),
        is_place,
    }
}

fn is_one_place(points: &[Vector3<f64>], mean: &Vector3<f64>) -> bool {
    let spread = points.iter().map(|p| (p - mean).norm()).fold(0.0, f64::max);
    let size = points.iter().map(|p| p.norm()).fold(0.0, f64::max);
    !(spread > PLACE_TOLERANCE * size)
}

/// The scale along the only direction there is; the rotation that fits the cameras' own orientations best.
fn align_line(predicted: &[Matrix4<f64>], given: &[Matrix4<f64>], full: &Fit) -> CameraAlignment {
    let mut sum = Matrix3::zeros();
    for (p, g) in predicted.iter().zip(given) {
        let (camera_from_predicted, _) = parts(p);
        let (camera_from_given, _) = parts(g);
        sum += camera_from_predicted.transpose() * camera_from_given;
    }
    let rotation = nearest_rotation(&sum);
    let along = full.values[0] / full.source_variance;
    let is_seen = !full.is_place && along.is_finite() && along > 0.0;
    let scale = if is_seen { along } else { 1.0 };
    let mean =
        |cameras: &[Matrix4<f64>]| cameras.iter().map(centre).sum::<Vector3<f64>>() / cameras.len() as f64;
    CameraAlignment {
        scale,
        translation: mean(predicted) - rotation * mean(given) * scale,
        rotation,
        evidence: if is_seen { ScaleEvidence::LengthAlongLine } else { ScaleEvidence::Nothing },
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

/// Ten fits to half of the views each; the one with most inliers, then least mean error, refitted to its inliers.
///
/// The threshold is the median over views of the distance to the *nearest* predicted centre after a fit to all.
fn ransac(source: &[Vector3<f64>], target: &[Vector3<f64>], full: &Fit) -> CameraAlignment {
    let everything = full.alignment(ScaleEvidence::Similarity, source.len());
    let nearest = |g: &Vector3<f64>| {
        let moved = everything.apply(g);
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
        let candidate = candidate.alignment(ScaleEvidence::SimilarityOfInliers, 0);
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
        return everything;
    };
    if count < 3 {
        return CameraAlignment { inliers: count, ..candidate };
    }
    let chosen = |points: &[Vector3<f64>]| inliers.iter().map(|&i| points[i]).collect::<Vec<_>>();
    let refit = fit(&chosen(source), &chosen(target));
    if refit.official_rank < 2 {
        return CameraAlignment { inliers: count, ..candidate };
    }
    refit.alignment(ScaleEvidence::SimilarityOfInliers, count)
}

/// The samples of RANSAC for a number of views: the same as the official code draws.
pub fn samples(views: usize) -> Vec<Vec<usize>> {
    let size = 3.max(views.div_ceil(2));
    let mut generator = Pcg64::seed(RANSAC_SEED);
    (0..RANSAC_ROUNDS).map(|_| generator.choose(views, size)).collect()
}

/// Middle value, mean of the two middle ones for an even number.
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
