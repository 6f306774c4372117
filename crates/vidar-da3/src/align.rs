//! Alignment of predicted with given cameras (DA3, pose-conditioned inference): the scale that makes depth metric.
//!
//! The given camera centres g are mapped onto the predicted ones p by the similarity `p ≈ s R g + t` that
//! [`vidar_solve::robust_similarity`] finds. Depth is then divided by s. Where the centres do not determine a similarity (one
//! view, two views, a straight line) the official code raises an error. Here the scale is the ratio of lengths where there is
//! a baseline; without one it is unobservable and [`ScaleSource`] reports that.

use crate::error::Da3Error;
use crate::pose::{centre, compose, parts, rigid_inverse};
use nalgebra::{Matrix3, Matrix4, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::So3;
use vidar_solve::{mean_rotation, robust_similarity};

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
    let Ok(fit) = robust_similarity(&source, &target) else {
        return match is_strict {
            true => {
                Err(Da3Error::DegenerateCameras { views: given.len(), detail: describe(&source, &target) })
            }
            false => Ok(align_line(predicted, given, &source, &target)),
        };
    };
    Ok(CameraAlignment {
        scale: fit.target_from_source.scale,
        rotation: fit.target_from_source.rotation.matrix(),
        translation: fit.target_from_source.translation,
        scale_source: match fit.is_of_inliers {
            true => ScaleSource::SimilarityOfInliers,
            false => ScaleSource::Similarity,
        },
        inliers: fit.inliers,
    })
}

fn describe(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> String {
    let is_point = are_coincident(source) || are_coincident(target);
    if is_point { "at one point".into() } else { "on a line".into() }
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len() as f64
}

fn are_coincident(points: &[Vector3<f64>]) -> bool {
    let mean = mean(points);
    let spread = points.iter().map(|p| (p - mean).norm()).fold(0.0, f64::max);
    let size = points.iter().map(|p| p.norm()).fold(0.0, f64::max);
    !(spread > COINCIDENT_TOLERANCE * size)
}

/// The scale from lengths along the line; the rotation that fits the orientations of the cameras best.
fn align_line(
    predicted: &[Matrix4<f64>],
    given: &[Matrix4<f64>],
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
) -> CameraAlignment {
    let turns = predicted.iter().zip(given).filter_map(|(p, g)| {
        let (camera_from_predicted, _) = parts(p);
        let (camera_from_given, _) = parts(g);
        So3::from_matrix(&(camera_from_predicted.transpose() * camera_from_given))
    });
    let rotation = mean_rotation(turns).map_or_else(Matrix3::identity, |r| r.matrix());
    let (source_mean, target_mean) = (mean(source), mean(target));
    let (mut covariance, mut variance) = (Matrix3::zeros(), 0.0);
    for (g, p) in source.iter().zip(target) {
        covariance += (p - target_mean) * (g - source_mean).transpose();
        variance += (g - source_mean).norm_squared();
    }
    // On a line the covariance has one singular value, which is its norm.
    let along = covariance.norm() / variance;
    let is_coincident = are_coincident(source) || are_coincident(target);
    let is_observable = !is_coincident && along.is_finite() && along > 0.0;
    let scale = if is_observable { along } else { 1.0 };
    CameraAlignment {
        scale,
        translation: target_mean - rotation * source_mean * scale,
        rotation,
        scale_source: if is_observable { ScaleSource::LengthAlongLine } else { ScaleSource::Unobservable },
        inliers: given.len(),
    }
}

#[cfg(test)]
mod tests;
