//! Observations as the window's factors: residuals, whitened, weighted and differentiated.

use super::SmootherConfig;
use super::products::product;
use super::visual::{self, CameraPose};
use super::window::{CALIBRATION_DIM, Landmark, LandmarkObservation};
use nalgebra::{SMatrix, Vector2};
use vidar_core::CameraModel;
use vidar_solve::Kernel;

/// Whitened residual that an observation which does not project counts as.
const UNPROJECTABLE_SIGMAS: f64 = 50.0;

type ByCalibration = SMatrix<f64, 2, CALIBRATION_DIM>;

/// One observation, whitened, weighted and differentiated.
pub(crate) struct WeightedObservation {
    pub(crate) residual: Vector2<f64>,
    pub(crate) jacobians: visual::VisualJacobians,
    pub(crate) by_calibration: Option<ByCalibration>,
}

/// What observations need to know beside themselves.
pub(crate) struct Scene<'a> {
    pub(crate) camera: &'a CameraModel,
    pub(crate) config: &'a SmootherConfig,
    pub(crate) camera_poses: &'a [CameraPose],
    pub(crate) camera_poses_at: &'a [CameraPose],
}

impl Scene<'_> {
    #[inline(always)]
    fn kernel(&self) -> Kernel {
        Kernel::Huber { k: self.config.huber_sigmas }
    }

    /// Whitened residual of an observation whose landmark projects to `pixel`.
    #[inline(always)]
    fn residual(&self, pixel: &Vector2<f64>, s: &LandmarkObservation) -> Vector2<f64> {
        s.whitening * (pixel - s.pixel)
    }

    /// Where a landmark projects at the present states.
    #[inline(always)]
    fn pixel(&self, landmark: &Landmark, s: &LandmarkObservation) -> Option<Vector2<f64>> {
        let (host, target) = (&self.camera_poses[landmark.host.frame], &self.camera_poses[s.frame]);
        self.camera.project(&visual::direction(host, target, &landmark.bearing, landmark.rho))
    }

    /// Evaluates an observation: stores its χ², returns its cost and, if it projects, what the system needs.
    #[inline(always)]
    pub(crate) fn observation(
        &self,
        landmark: &Landmark,
        s: &mut LandmarkObservation,
    ) -> (f64, Option<WeightedObservation>) {
        let (host, target) = (&self.camera_poses_at[landmark.host.frame], &self.camera_poses_at[s.frame]);
        let lost = self.kernel().loss(UNPROJECTABLE_SIGMAS * UNPROJECTABLE_SIGMAS);
        let jacobians = visual::jacobians(self.camera, host, target, &landmark.bearing, landmark.rho);
        let now = match &jacobians {
            // Derivatives are taken at the present states, and the pixel came with them.
            Some(j) if !self.config.first_estimates() => Some(j.pixel),
            _ => self.pixel(landmark, s),
        };
        let (Some(now), Some(mut jacobians)) = (now, jacobians) else {
            s.chi2 = UNPROJECTABLE_SIGMAS * UNPROJECTABLE_SIGMAS;
            return (lost, None);
        };
        let residual = self.residual(&now, s);
        s.chi2 = residual.norm_squared();
        let (weight, cost) = (self.kernel().weight(s.chi2), self.kernel().loss(s.chi2));
        let whiten = s.whitening * weight.sqrt();
        jacobians.by_host = product(&whiten, &jacobians.by_host);
        jacobians.by_target = product(&whiten, &jacobians.by_target);
        jacobians.by_landmark = product(&whiten, &jacobians.by_landmark);
        let mut by_calibration = None;
        if self.config.calibrates_camera() {
            let by_place =
                visual::by_body_from_camera(self.camera, host, target, &landmark.bearing, landmark.rho)
                    .unwrap_or_else(SMatrix::zeros);
            by_calibration = Some(product(&whiten, &calibration_columns(self.config, &by_place)));
        }
        (cost, Some(WeightedObservation { residual: residual * weight.sqrt(), jacobians, by_calibration }))
    }

    /// The host's own observation: it fixes the bearing only.
    #[inline(always)]
    pub(crate) fn host(&self, landmark: &mut Landmark) -> Option<(f64, WeightedObservation)> {
        let (pixel, by_direction) = self.camera.project_with_jacobian(&landmark.bearing)?;
        let residual = self.residual(&pixel, &landmark.host);
        let s = &mut landmark.host;
        s.chi2 = residual.norm_squared();
        let mut by_landmark = SMatrix::<f64, 2, 3>::zeros();
        let by_bearing = s.whitening * by_direction * visual::tangent_basis(&landmark.bearing);
        by_landmark.fixed_view_mut::<2, 2>(0, 0).copy_from(&by_bearing);
        let zero = SMatrix::zeros();
        let jacobians = visual::VisualJacobians { pixel, by_host: zero, by_target: zero, by_landmark };
        Some((0.5 * s.chi2, WeightedObservation { residual, jacobians, by_calibration: None }))
    }
}

fn calibration_columns(config: &SmootherConfig, by_place: &SMatrix<f64, 2, 6>) -> ByCalibration {
    let mut out = ByCalibration::zeros();
    if config.estimate_camera_rotation {
        out.fixed_view_mut::<2, 3>(0, 0).copy_from(&by_place.fixed_view::<2, 3>(0, 0));
    }
    if config.estimate_camera_position {
        out.fixed_view_mut::<2, 3>(0, 3).copy_from(&by_place.fixed_view::<2, 3>(0, 3));
    }
    out
}
