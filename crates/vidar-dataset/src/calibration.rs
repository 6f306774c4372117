//! Builds camera models from the entries of calibration files.

use crate::error::DatasetError;
use nalgebra::Matrix4;
use std::path::Path;
use vidar_core::camera::{DoubleSphere, Equidistant, Fov, RadTan};
use vidar_core::{CameraModel, Pinhole};

const SUPPORTED: &str = "pinhole with radtan, equidistant, fov or no distortion, or ds without distortion (omni and eucm are not read)";

/// The model of EuRoC's and Kalibr's pair of projection and distortion; size 0×0 when `size` is `None`.
pub(crate) fn model_from_parts(
    path: &Path,
    key: &str,
    (camera, distortion): (&str, &str),
    intrinsics: &[f64],
    coefficients: &[f64],
    size: Option<(usize, usize)>,
) -> Result<CameraModel, DatasetError> {
    let unsupported = || DatasetError::UnsupportedCamera {
        path: path.to_path_buf(),
        key: key.to_string(),
        found: format!("{camera:?} with distortion {distortion:?}"),
        expected: SUPPORTED,
    };
    let count = |what: &str, found: usize, expected: &str| DatasetError::Malformed {
        path: path.to_path_buf(),
        line: 0,
        found: format!("{key}: {found} {what}"),
        expected: expected.to_string(),
    };
    let bad = |source| DatasetError::BadCamera { path: path.to_path_buf(), key: key.to_string(), source };
    let four = || -> Result<[f64; 4], DatasetError> {
        coefficients.try_into().map_err(|_| {
            count("distortion coefficients", coefficients.len(), "4 distortion coefficients (radtan: 4 or 5)")
        })
    };
    let sphere = camera == "ds" || camera == "double-sphere";
    let focal = match (sphere, intrinsics) {
        (true, &[_, _, fx, fy, cx, cy]) | (false, &[fx, fy, cx, cy]) => [fx, fy, cx, cy],
        (true, _) => return Err(count("intrinsics", intrinsics.len(), "6: xi, alpha, fu, fv, pu, pv")),
        (false, _) if camera != "pinhole" => return Err(unsupported()),
        (false, _) => return Err(count("intrinsics", intrinsics.len(), "4: fu, fv, cu, cv")),
    };
    let (width, height) = size.unwrap_or((1, 1));
    let mut pinhole = Pinhole::new(focal[0], focal[1], focal[2], focal[3], width, height).map_err(bad)?;
    if size.is_none() {
        (pinhole.width, pinhole.height) = (0, 0);
    }
    let distorts = coefficients.iter().any(|c| *c != 0.0);
    match (camera, distortion) {
        ("pinhole", "none" | "") if !distorts => Ok(CameraModel::Pinhole(pinhole)),
        ("pinhole", "radial-tangential" | "radtan" | "plumb_bob") => match coefficients {
            // OpenCV's order: the third radial term comes last.
            &[k1, k2, p1, p2, k3] => RadTan::with_k3(pinhole, [k1, k2, p1, p2], k3),
            _ => RadTan::new(pinhole, four()?),
        }
        .map(CameraModel::RadTan)
        .map_err(bad),
        ("pinhole", "equidistant" | "kannala_brandt") => {
            Equidistant::new(pinhole, four()?).map(CameraModel::Equidistant).map_err(bad)
        }
        ("pinhole", "fov") => match coefficients {
            &[omega] => Fov::new(pinhole, omega).map(CameraModel::Fov).map_err(bad),
            other => Err(count("distortion coefficients", other.len(), "1: omega")),
        },
        ("ds" | "double-sphere", "none" | "") => DoubleSphere::new(pinhole, intrinsics[0], intrinsics[1])
            .map(CameraModel::DoubleSphere)
            .map_err(bad),
        _ => Err(unsupported()),
    }
}

/// Describes in numbers how a matrix deviates from a rigid transform.
pub(crate) fn departure(m: &Matrix4<f64>) -> String {
    if m.iter().any(|v| !v.is_finite()) {
        return "a value that is not finite".into();
    }
    let r = m.fixed_view::<3, 3>(0, 0);
    let deviation = (r.transpose() * r - nalgebra::Matrix3::identity()).amax();
    format!(
        "RᵀR deviates from the identity by {deviation:.3e}, determinant {:.4}, last row {} {} {} {}",
        r.determinant(),
        m[(3, 0)],
        m[(3, 1)],
        m[(3, 2)],
        m[(3, 3)]
    )
}
