//! How a lens turns the angle of a ray off its axis into a distance from the principal point.

use nalgebra::{Matrix2x3, RowVector3, SMatrix, Vector2, Vector3};
use vidar_core::camera::{CameraError, CameraModel, Equidistant, Pinhole, RadTan};

/// Largest angle off the axis that a fisheye is asked for, rad: lenses beyond 200° are panoramic attachments.
const MAX_THETA: f64 = 1.75;
/// Least growth of the radius, relative to that in the middle, at which a lens is still one to one.
const MIN_SLOPE: f64 = 0.05;

/// A family of projections with a focal length and two coefficients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensModel {
    /// A pinhole with radial distortion of the radial-tangential model: `r (1 + k1 r² + k2 r⁴)`, `r = tan θ`.
    #[default]
    RadTan,
    /// A fisheye (Kannala, Brandt 2006): `θ (1 + k1 θ² + k2 θ⁴)`.
    Equidistant,
}

/// A point through a lens.
pub(crate) struct Refracted {
    /// From the principal point, pixels; the derivative by ln of the focal length is the same.
    pub at: Vector2<f64>,
    pub d_point: Matrix2x3<f64>,
    /// By k1 and k2.
    pub d_radial: SMatrix<f64, 2, 2>,
}

impl LensModel {
    /// As Kalibr names its distortion.
    pub const fn kalibr_name(self) -> &'static str {
        match self {
            Self::RadTan => "radtan",
            Self::Equidistant => "equidistant",
        }
    }

    /// The camera with this focal length, principal point and size (`pinhole`) and these coefficients.
    ///
    /// # Errors
    /// The coefficients are not finite.
    pub fn camera(self, pinhole: Pinhole, [k1, k2]: [f64; 2]) -> Result<CameraModel, CameraError> {
        Ok(match self {
            Self::RadTan => CameraModel::RadTan(RadTan::new(pinhole, [k1, k2, 0.0, 0.0])?),
            Self::Equidistant => CameraModel::Equidistant(Equidistant::new(pinhole, [k1, k2, 0.0, 0.0])?),
        })
    }

    /// What is believed of k1 and k2 of any lens (σ): |k1| of lenses of phones and of EuRoC's is below 0.3; fisheyes of GoPro, TUM-VI and
    /// Insta360 have |k1| and |k2| up to 0.06.
    pub(super) const fn radial_sigmas(self) -> [f64; 2] {
        match self {
            Self::RadTan => [0.3, 0.2],
            Self::Equidistant => [0.1, 0.05],
        }
    }

    /// Trial focal lengths in image widths: fields of view from 90° to 39°, and from 190° to 82°.
    pub(super) const fn trial_focals(self) -> &'static [f64] {
        match self {
            Self::RadTan => &[0.5, 0.62, 0.75, 0.9, 1.1, 1.4],
            Self::Equidistant => &[0.3, 0.37, 0.45, 0.55, 0.7],
        }
    }

    /// Projects a point in camera axes; `None` behind the camera and where the distortion folds back.
    pub(crate) fn project(self, focal: f64, [k1, k2]: [f64; 2], p: &Vector3<f64>) -> Option<Refracted> {
        match self {
            Self::RadTan => through_pinhole(focal, k1, k2, p),
            Self::Equidistant => through_fisheye(focal, k1, k2, p),
        }
    }

    /// Unit direction in camera axes of a place in focal lengths, by iteration; good enough to start from.
    pub(super) fn direction(self, [k1, k2]: [f64; 2], seen: &Vector2<f64>) -> Vector3<f64> {
        match self {
            Self::RadTan => {
                let mut n = *seen;
                for _ in 0..8 {
                    let r2 = n.norm_squared();
                    n = seen / (1.0 + r2 * (k1 + r2 * k2)).max(0.3);
                }
                Vector3::new(n.x, n.y, 1.0).normalize()
            }
            Self::Equidistant => {
                let radius = seen.norm();
                let mut theta = radius;
                for _ in 0..8 {
                    let t2 = theta * theta;
                    theta = (radius / (1.0 + t2 * (k1 + t2 * k2)).max(0.3)).min(MAX_THETA);
                }
                let side = if radius > 1e-9 { seen * (theta.sin() / radius) } else { *seen };
                Vector3::new(side.x, side.y, theta.cos()).normalize()
            }
        }
    }
}

fn through_pinhole(f: f64, k1: f64, k2: f64, p: &Vector3<f64>) -> Option<Refracted> {
    if !(p.z > 0.05 * p.norm()) {
        return None;
    }
    let (iz, x, y) = (1.0 / p.z, p.x / p.z, p.y / p.z);
    let r2 = x * x + y * y;
    let d = 1.0 + r2 * (k1 + r2 * k2);
    let slope = 1.0 + r2 * (3.0 * k1 + r2 * 5.0 * k2);
    if !(slope > MIN_SLOPE && d > 0.05 && d < 5.0) {
        return None;
    }
    let dd = 2.0 * (k1 + 2.0 * r2 * k2);
    let (xx, xy, yy) = (f * (d + x * x * dd), f * x * y * dd, f * (d + y * y * dd));
    let d_point =
        Matrix2x3::new(xx * iz, xy * iz, -(xx * x + xy * y) * iz, xy * iz, yy * iz, -(xy * x + yy * y) * iz);
    let (fx, fy) = (f * x, f * y);
    let d_radial = SMatrix::<f64, 2, 2>::new(fx * r2, fx * r2 * r2, fy * r2, fy * r2 * r2);
    Some(Refracted { at: Vector2::new(fx * d, fy * d), d_point, d_radial })
}

fn through_fisheye(f: f64, k1: f64, k2: f64, p: &Vector3<f64>) -> Option<Refracted> {
    let (r, n2) = (p.xy().norm(), p.norm_squared());
    let theta = r.atan2(p.z);
    let t2 = theta * theta;
    let d = 1.0 + t2 * (k1 + t2 * k2);
    let slope = 1.0 + t2 * (3.0 * k1 + t2 * 5.0 * k2);
    if !(theta < MAX_THETA && slope > MIN_SLOPE && d > 0.05 && d < 5.0 && n2 > 0.0) {
        return None;
    }
    // θd/r and its derivatives; on the axis it is 1/z.
    let on_axis = r < 1e-8 * n2.sqrt();
    let (g, d_g) = if on_axis {
        (1.0 / p.z, RowVector3::new(0.0, 0.0, -1.0 / (p.z * p.z)))
    } else {
        let g = theta * d / r;
        let d_theta = RowVector3::new(p.x * p.z / (r * n2), p.y * p.z / (r * n2), -r / n2);
        let d_r = RowVector3::new(p.x / r, p.y / r, 0.0);
        (g, d_theta * (slope / r) - d_r * (g / r))
    };
    let mut d_point = Matrix2x3::zeros();
    d_point.set_row(0, &(d_g * p.x + RowVector3::new(g, 0.0, 0.0)));
    d_point.set_row(1, &(d_g * p.y + RowVector3::new(0.0, g, 0.0)));
    let by_k1 = if on_axis { 0.0 } else { theta * t2 / r };
    let d_radial = SMatrix::<f64, 2, 2>::new(p.x * by_k1, p.x * by_k1 * t2, p.y * by_k1, p.y * by_k1 * t2);
    Some(Refracted { at: p.xy() * (f * g), d_point: d_point * f, d_radial: d_radial * f })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [(LensModel, [f64; 2]); 2] =
        [(LensModel::RadTan, [-0.2, 0.04]), (LensModel::Equidistant, [0.03, -0.01])];

    #[test]
    fn projections_are_those_of_the_camera_models() {
        let pinhole = Pinhole::new(400.0, 400.0, 320.0, 240.0, 640, 480).unwrap();
        for (lens, radial) in LENSES {
            let camera = lens.camera(pinhole, radial).unwrap();
            for p in [Vector3::new(0.3, -0.2, 1.0), Vector3::new(0.0, 0.0, 2.0), Vector3::new(-0.7, 0.4, 1.1)]
            {
                let at = lens.project(400.0, radial, &p).unwrap().at + Vector2::new(320.0, 240.0);
                assert!((at - camera.project(&p).unwrap()).norm() < 1e-9, "{lens:?} {p}");
                let back = lens.direction(radial, &((at - Vector2::new(320.0, 240.0)) / 400.0));
                assert!((back - p.normalize()).norm() < 2e-3, "{lens:?} {p}: {back}");
            }
        }
    }

    #[test]
    fn derivatives_are_those_of_the_projection() {
        const STEP: f64 = 1e-6;
        for (lens, radial) in LENSES {
            let p = Vector3::new(0.5, -0.3, 0.8);
            let found = lens.project(2.0, radial, &p).unwrap();
            for axis in 0..3 {
                let mut to = p;
                to[axis] += STEP;
                let slope = (lens.project(2.0, radial, &to).unwrap().at - found.at) / STEP;
                assert!((slope - found.d_point.column(axis)).norm() < 1e-5, "{lens:?} {axis}");
            }
            for k in 0..2 {
                let mut to = radial;
                to[k] += STEP;
                let slope = (lens.project(2.0, to, &p).unwrap().at - found.at) / STEP;
                assert!((slope - found.d_radial.column(k)).norm() < 1e-5, "{lens:?} k{}", k + 1);
            }
        }
    }

    #[test]
    fn what_a_lens_does_not_see_has_no_place() {
        assert!(LensModel::RadTan.project(1.0, [0.0; 2], &Vector3::new(1.0, 0.0, -0.1)).is_none());
        assert!(
            LensModel::RadTan.project(1.0, [-0.4, 0.0], &Vector3::new(1.5, 0.0, 1.0)).is_none(),
            "it folds back"
        );
        assert!(LensModel::Equidistant.project(1.0, [0.0; 2], &Vector3::new(1.0, 0.0, -0.1)).is_some());
        assert!(LensModel::Equidistant.project(1.0, [0.0; 2], &Vector3::new(0.0, 0.0, -1.0)).is_none());
        assert!(LensModel::Equidistant.project(1.0, [0.0; 2], &Vector3::zeros()).is_none());
    }
}
