//! Refinement of one camera with fixed points, and of one point with fixed cameras, for vision without an IMU.
//!
//! Gauss-Newton on whitened reprojection errors with Huber's loss; an edgelet counts across its edge only, because its
//! information has rank one. With `e = W (u − π(T X))` and `T ← T exp(δ)`, `∂e/∂δ = −W J_π [−R X^ | R]`.

use super::config::RefinementConfig;
use super::feature::PixelMeasurement;
use super::image_alignment::MotionPrediction;
use nalgebra::{Matrix2x3, Matrix2x6, Matrix3, Matrix6, Vector2, Vector3, Vector6};
use vidar_core::{CameraModel, LieGroup, Se3};

/// A known point and where the camera shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointObservation {
    /// The point, in the anchor's frame (the world, or a keyframe's camera).
    pub point_in_anchor: Vector3<f64>,
    /// Where it was found.
    pub measurement: PixelMeasurement,
}

/// A camera after refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraRefinement {
    /// Where the camera is.
    pub camera_from_anchor: Se3,
    /// Inverse covariance of its right perturbation, [rotation, translation], prior included.
    pub information: Matrix6<f64>,
    /// Mean over inliers of the squared whitened error per known direction; one when the errors are as stated.
    pub chi2_per_dof: f64,
    /// Observations within the outlier bound.
    pub inliers: usize,
    /// Whether the steps became small.
    pub converged: bool,
}

/// A camera with a known place, and where it shows the point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointSighting {
    /// Place of the camera.
    pub camera_from_anchor: Se3,
    /// Where the point was found.
    pub measurement: PixelMeasurement,
}

/// A point after refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointRefinement {
    /// The point.
    pub point_in_anchor: Vector3<f64>,
    /// Its inverse covariance, 1/m².
    pub information: Matrix3<f64>,
    /// Mean squared whitened error over the sightings' known directions.
    pub chi2_per_dof: f64,
}

/// Whitened error and its derivatives by the point in the camera.
fn reproject(
    camera: &CameraModel,
    measurement: &PixelMeasurement,
    point_in_camera: &Vector3<f64>,
) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
    let (pixel, d_pixel_d_point) = camera.project_with_jacobian(point_in_camera)?;
    let w = measurement.whitening();
    Some((w * (measurement.pixel - pixel), -(w * d_pixel_d_point)))
}

/// `d_error_d_camera` from `d_error_d_point_in_camera`.
fn by_camera(
    d_error_d_point: &Matrix2x3<f64>,
    camera_from_anchor: &Se3,
    point: &Vector3<f64>,
) -> Matrix2x6<f64> {
    d_error_d_point * camera_from_anchor.d_act_d_perturbation(point)
}

/// Huber's weight of a whitened error.
fn huber(error: &Vector2<f64>, bound: f64) -> f64 {
    let norm = error.norm();
    if norm > bound { bound / norm } else { 1.0 }
}

/// Known directions of a measurement: two for a corner, one for an edgelet.
fn known_directions(measurement: &PixelMeasurement) -> f64 {
    let [strong, weak, _] = super::feature::eigen(&measurement.information);
    if weak > 1e-6 * strong { 2.0 } else { 1.0 }
}

/// Where a camera is, from points that are known; `prior` is also the start.
///
/// `None` when the observations and the prior together do not fix six unknowns.
pub fn refine_camera(
    camera: &CameraModel,
    observations: &[PointObservation],
    prior: &MotionPrediction,
    config: &RefinementConfig,
) -> Option<CameraRefinement> {
    let mut at = prior.current_from_anchor;
    let mut converged = false;
    let mut information = prior.information;
    for _ in 0..config.max_iterations {
        let deviation: Vector6<f64> = at.minus(&prior.current_from_anchor);
        let mut gradient = prior.information * deviation;
        information = prior.information;
        for seen in observations {
            let point = at * seen.point_in_anchor;
            let Some((error, d_point)) = reproject(camera, &seen.measurement, &point) else { continue };
            let jacobian = by_camera(&d_point, &at, &seen.point_in_anchor);
            let weight = huber(&error, config.huber_sigmas);
            information += jacobian.transpose() * jacobian * weight;
            gradient += jacobian.transpose() * error * weight;
        }
        let step = -information.cholesky()?.solve(&gradient);
        at = at.plus(&step);
        // In units of the step's own standard deviation: a hundredth of it is no news.
        if step.dot(&(information * step)) < 1e-4 {
            converged = true;
            break;
        }
    }
    let (mut chi2, mut directions, mut inliers) = (0.0, 0.0, 0);
    for seen in observations {
        let point = at * seen.point_in_anchor;
        let Some((error, _)) = reproject(camera, &seen.measurement, &point) else { continue };
        if error.norm() <= config.outlier_sigmas {
            chi2 += error.norm_squared();
            directions += known_directions(&seen.measurement);
            inliers += 1;
        }
    }
    let chi2_per_dof = chi2 / f64::max(directions - 6.0, 1.0);
    Some(CameraRefinement { camera_from_anchor: at, information, chi2_per_dof, inliers, converged })
}

/// Whether an observation fits a camera within the configured bound.
pub fn is_inlier(
    camera: &CameraModel,
    seen: &PointObservation,
    camera_from_anchor: &Se3,
    config: &RefinementConfig,
) -> bool {
    let point = *camera_from_anchor * seen.point_in_anchor;
    reproject(camera, &seen.measurement, &point)
        .is_some_and(|(error, _)| error.norm() <= config.outlier_sigmas)
}

/// Where a point is, from cameras that are known.
///
/// `None` when the sightings do not fix it, or it ends up where a camera cannot see it.
pub fn refine_point(
    camera: &CameraModel,
    sightings: &[PointSighting],
    start: &Vector3<f64>,
    config: &RefinementConfig,
) -> Option<PointRefinement> {
    let mut point = *start;
    for _ in 0..config.max_iterations {
        let (information, gradient, _) = point_terms(camera, sightings, &point, config)?;
        let step = -information.cholesky()?.solve(&gradient);
        point += step;
        if step.dot(&(information * step)) < 1e-4 {
            break;
        }
    }
    let (information, _, chi2) = point_terms(camera, sightings, &point, config)?;
    let directions: f64 = sightings.iter().map(|s| known_directions(&s.measurement)).sum();
    let chi2_per_dof = chi2 / f64::max(directions - 3.0, 1.0);
    point.iter().all(|v| v.is_finite()).then_some(PointRefinement {
        point_in_anchor: point,
        information,
        chi2_per_dof,
    })
}

fn point_terms(
    camera: &CameraModel,
    sightings: &[PointSighting],
    point: &Vector3<f64>,
    config: &RefinementConfig,
) -> Option<(Matrix3<f64>, Vector3<f64>, f64)> {
    let (mut information, mut gradient, mut chi2) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
    for seen in sightings {
        let in_camera = seen.camera_from_anchor * *point;
        let (error, d_point) = reproject(camera, &seen.measurement, &in_camera)?;
        let jacobian = d_point * seen.camera_from_anchor.rotation.matrix();
        let weight = huber(&error, config.huber_sigmas);
        information += jacobian.transpose() * jacobian * weight;
        gradient += jacobian.transpose() * error * weight;
        chi2 += error.norm_squared();
    }
    Some((information, gradient, chi2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::testbed::Random;
    use vidar_core::testing::check_jacobian;
    use vidar_core::{Pinhole, So3};

    fn camera() -> CameraModel {
        CameraModel::Pinhole(Pinhole::new(458.0, 457.0, 367.0, 248.0, 752, 480).unwrap())
    }

    fn place() -> Se3 {
        Se3::new(So3::exp(&Vector3::new(0.1, -0.3, 0.2)), Vector3::new(0.3, -0.2, 0.5))
    }

    /// Points in the anchor's frame, and what a camera at `place()` measures of them with `sigma_px`.
    fn observations(n: usize, sigma_px: f64, outliers: usize, seed: u64) -> Vec<PointObservation> {
        let mut random = Random::new(seed);
        (0..n)
            .map(|k| {
                let in_camera =
                    Vector3::new(random.gaussian(), random.gaussian() * 0.7, 3.0 + 3.0 * random.uniform());
                let point_in_anchor = place().inverse() * in_camera;
                let mut pixel = camera().project(&in_camera).unwrap();
                pixel += Vector2::new(random.gaussian(), random.gaussian()) * sigma_px;
                // Not the edgelets, which may not feel it.
                if k % 3 == 1 && k < 3 * outliers {
                    pixel.x += 25.0;
                }
                let angle = random.uniform() * std::f64::consts::PI;
                let normal = Vector2::new(angle.cos(), angle.sin());
                let measurement = if k % 3 == 0 {
                    PixelMeasurement::across_edge(pixel, &normal, sigma_px)
                } else {
                    PixelMeasurement::isotropic(pixel, sigma_px)
                };
                PointObservation { point_in_anchor, measurement }
            })
            .collect()
    }

    #[test]
    fn reprojection_jacobians_are_the_numeric_ones() {
        for seen in observations(10, 1.0, 0, 3) {
            let error =
                |t: &Se3, p: &Vector3<f64>| reproject(&camera(), &seen.measurement, &(*t * *p)).unwrap().0;
            let (_, d_point) =
                reproject(&camera(), &seen.measurement, &(place() * seen.point_in_anchor)).unwrap();
            let analytic = by_camera(&d_point, &place(), &seen.point_in_anchor);
            let f = |d: &Vector6<f64>| error(&place().plus(d), &seen.point_in_anchor);
            check_jacobian("camera", &analytic, f, &Vector6::zeros(), 1e-6).unwrap();
            let analytic = d_point * place().rotation.matrix();
            let f = |p: &Vector3<f64>| error(&place(), p);
            check_jacobian("point", &analytic, f, &seen.point_in_anchor, 1e-6).unwrap();
        }
    }

    #[test]
    fn a_camera_is_found_with_an_honest_covariance_despite_outliers() {
        let config = RefinementConfig::default();
        let start = place().plus(&Vector6::new(0.02, -0.03, 0.01, 0.05, -0.05, 0.08));
        let prior = MotionPrediction { current_from_anchor: start, information: Matrix6::zeros() };
        let mut nees = 0.0;
        for seed in 0..60 {
            let all = observations(90, 0.5, 4, seed);
            let found = refine_camera(&camera(), &all, &prior, &config).unwrap();
            let error: Vector6<f64> = place().minus(&found.camera_from_anchor);
            assert!(error.fixed_rows::<3>(3).norm() < 0.03, "{error}");
            assert!(found.converged && found.inliers >= 83 && found.inliers <= 86, "{found:?}");
            assert!(found.chi2_per_dof > 0.5 && found.chi2_per_dof < 1.4, "{}", found.chi2_per_dof);
            assert!(!is_inlier(&camera(), &all[1], &found.camera_from_anchor, &config));
            nees += error.dot(&(found.information * error)) / 60.0;
        }
        assert!(nees > 3.5 && nees < 10.0, "NEES {nees}");
    }

    #[test]
    fn too_few_observations_are_refused_and_a_prior_helps() {
        let config = RefinementConfig::default();
        let start = MotionPrediction { current_from_anchor: place(), information: Matrix6::zeros() };
        assert!(refine_camera(&camera(), &observations(2, 0.5, 0, 1), &start, &config).is_none());
        let known = MotionPrediction { information: Matrix6::identity() * 1e4, ..start };
        assert!(refine_camera(&camera(), &observations(2, 0.5, 0, 1), &known, &config).is_some());
    }

    #[test]
    fn a_point_is_found_from_several_cameras() {
        let mut random = Random::new(5);
        let truth = Vector3::new(0.4, -0.2, 4.0);
        let sightings: Vec<PointSighting> = (0..6)
            .map(|k| {
                let at =
                    Se3::from_translation(Vector3::new(0.15 * f64::from(k), 0.02 * f64::from(k * k), 0.0));
                let pixel = camera().project(&(at * truth)).unwrap()
                    + Vector2::new(random.gaussian(), random.gaussian()) * 0.3;
                PointSighting { camera_from_anchor: at, measurement: PixelMeasurement::isotropic(pixel, 0.3) }
            })
            .collect();
        let start = truth * 1.5;
        let found = refine_point(&camera(), &sightings, &start, &RefinementConfig::default()).unwrap();
        let error = found.point_in_anchor - truth;
        assert!(error.dot(&(found.information * error)) < 16.0, "{error}");
        assert!(error.norm() < 0.1 && found.chi2_per_dof < 3.0);
        let alone = &sightings[..1];
        assert!(refine_point(&camera(), alone, &start, &RefinementConfig::default()).is_none());
    }
}
