//! Rotation of the camera on the body from nothing: rotations of image pairs against those of the gyroscope.
//!
//! For each clock offset on a grid, the rates of both are compared without their means (a gyroscope bias does not matter),
//! and the rotation that maps one set to the other is found in closed form (Kabsch 1976; Tsai, Lenz 1989 for the idea of
//! hand-eye calibration on rotations). The offset that leaves least unexplained wins. Translation disturbs the image
//! rotations, so this is a start for the solver, good to some degrees, and tells the axis permutation.

use super::path::{OrientationPath, RateSample};
use super::solver::{ImageFeatures, common};
use nalgebra::{Matrix3, Vector3};
use vidar_core::{CameraModel, LieGroup, So3};

/// Matches that a pair of images needs.
const MIN_MATCHES: usize = 15;
/// Time between the images of a pair, s.
const PAIR_SECS: f64 = 0.09;
/// Pairs that a solution needs.
const MIN_PAIRS: usize = 15;
/// Clock offsets that are tried: ± this, in such steps, s.
const SEARCH_SECS: f64 = 0.15;
const STEP_SECS: f64 = 0.01;
/// Share of the images' rotation that may stay unexplained.
const MAX_UNEXPLAINED: f64 = 0.35;

/// Rotation body_from_camera and clock offset.
#[derive(Clone, Copy, Debug)]
pub(super) struct HandEye {
    pub body_from_camera: So3,
    pub offset_secs: f64,
}

/// `None` when the body turned too little about two axes, or no rotation explains the images.
pub(super) fn hand_eye(
    camera: &CameraModel,
    images: &[ImageFeatures],
    samples: &[RateSample],
) -> Option<HandEye> {
    // Per pair: times of both images, and rate of the camera in its own axes.
    let mut seen: Vec<(f64, f64, Vector3<f64>)> = Vec::new();
    for (k, image) in images.iter().enumerate() {
        let Some(j) = (k + 1..images.len()).find(|j| images[*j].secs - image.secs >= PAIR_SECS) else {
            continue;
        };
        let pairs: Vec<(Vector3<f64>, Vector3<f64>)> = common(image, &images[j])
            .iter()
            .filter_map(|[a, b]| {
                Some((camera.unproject(&image.features[*a].1)?, camera.unproject(&images[j].features[*b].1)?))
            })
            .collect();
        if pairs.len() < MIN_MATCHES {
            continue;
        }
        if let Some(turn) = rotation_between(&pairs) {
            seen.push((image.secs, images[j].secs, turn / (images[j].secs - image.secs)));
        }
    }
    if seen.len() < MIN_PAIRS {
        return None;
    }
    let path = OrientationPath::new(samples, &Vector3::zeros());
    let steps = (2.0 * SEARCH_SECS / STEP_SECS).round() as i32;
    let mut best: Option<(f64, HandEye)> = None;
    for k in 0..=steps {
        let offset_secs = -SEARCH_SECS + f64::from(k) * STEP_SECS;
        let rates: Vec<(Vector3<f64>, Vector3<f64>)> = seen
            .iter()
            .map(|(from, to, seen)| {
                let turn = path.at(from + offset_secs).inverse() * path.at(to + offset_secs);
                (turn.log() / (to - from), *seen)
            })
            .collect();
        let Some((unexplained, body_from_camera)) = best_rotation(&rates) else { continue };
        if best.as_ref().is_none_or(|(least, _)| unexplained < *least) {
            best = Some((unexplained, HandEye { body_from_camera, offset_secs }));
        }
    }
    best.filter(|(unexplained, _)| *unexplained < MAX_UNEXPLAINED).map(|(_, found)| found)
}

/// Rotation that maps the second rates of the pairs onto the first, means removed, and the share of the second that it
/// leaves unexplained. `None` where the rates span less than a plane.
fn best_rotation(rates: &[(Vector3<f64>, Vector3<f64>)]) -> Option<(f64, So3)> {
    let n = rates.len() as f64;
    let (a, b) = rates.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), r| (a + r.0, b + r.1));
    let (mean_a, mean_b) = (a / n, b / n);
    let (mut cross, mut seen2) = (Matrix3::<f64>::zeros(), 0.0);
    // Two rounds: pairs that the first rotation leaves far off (translation, wrong matches) lose weight.
    let mut rotation: Option<Matrix3<f64>> = None;
    let mut scale2 = f64::INFINITY;
    for _ in 0..3 {
        (cross, seen2) = (Matrix3::zeros(), 0.0);
        let (mut left, mut weights) = (0.0, 0.0);
        for (felt, seen) in rates {
            let (felt, seen) = (felt - mean_a, seen - mean_b);
            let r2 = rotation.map_or(0.0, |r| (felt - r * seen).norm_squared());
            let weight = if scale2.is_finite() { 1.0 / (1.0 + r2 / scale2) } else { 1.0 };
            cross += felt * seen.transpose() * weight;
            seen2 += (seen.norm_squared() + felt.norm_squared()) * 0.5 * weight;
            left += weight * r2;
            weights += weight;
        }
        let svd = cross.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let sign = (u * v_t).determinant().signum();
        if svd.singular_values[1] < 0.02 * svd.singular_values[0] {
            return None;
        }
        rotation = Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t);
        if rotation.is_some() && left > 0.0 {
            scale2 = (left / weights).max(1e-6);
        }
    }
    let rotation = rotation?;
    let unexplained = 1.0 - (rotation * cross.transpose()).trace() / seen2;
    Some((unexplained, So3::from_matrix(&rotation)?))
}

/// Rotation vector `before_from_now` that explains most of the motion of unit rays (before, now): Gauss-Newton with
/// Cauchy weights.
pub(crate) fn rotation_between(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Vector3<f64>> {
    let mut turn = Vector3::zeros();
    let mut scale2 = f64::INFINITY;
    for _ in 0..4 {
        let rotation = So3::exp(&turn);
        let (mut h, mut g, mut sum, mut weights) = (Matrix3::<f64>::zeros(), Vector3::zeros(), 0.0, 0.0);
        for (before, now) in pairs {
            let turned = rotation * *now;
            // before ≈ turned + δ × turned.
            let residual = before - turned;
            let r2 = residual.norm_squared();
            let weight = if scale2.is_finite() { 1.0 / (1.0 + r2 / scale2) } else { 1.0 };
            h += (Matrix3::identity() - turned * turned.transpose()) * weight;
            g += turned.cross(&residual) * weight;
            sum += weight * r2;
            weights += weight;
        }
        let step = h.try_inverse()? * g;
        turn = (So3::exp(&step) * rotation).log();
        scale2 = (sum / weights).max(1e-8);
    }
    turn.iter().all(|x| x.is_finite()).then_some(turn)
}
