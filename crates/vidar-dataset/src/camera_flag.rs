//! A camera model as one command-line value: `pinhole:fx,fy,cx,cy`, `radtan:…,k1,k2,p1,p2[,k3]`, `kb4:…,k1,k2,k3,k4`, `ds:…,xi,alpha`,
//! `fov:…,omega`.

use crate::error::DatasetError;
use std::fmt;
use std::str::FromStr;
use vidar_core::camera::{DoubleSphere, Equidistant, Fov, RadTan};
use vidar_core::{CameraError, CameraModel, Pinhole};

/// A camera model read from a flag. Its size is 0×0 until it is taken from an image, see [`with_size`].
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFlag(pub CameraModel);

const EXPECTED: &str = "pinhole:fx,fy,cx,cy | radtan:fx,fy,cx,cy,k1,k2,p1,p2[,k3] | kb4:fx,fy,cx,cy,k1,k2,k3,k4 | \
                        ds:fx,fy,cx,cy,xi,alpha | fov:fx,fy,cx,cy,omega";

impl FromStr for CameraFlag {
    type Err = DatasetError;

    fn from_str(text: &str) -> Result<Self, DatasetError> {
        let bad = |found: String| DatasetError::BadOption {
            option: "camera model",
            found,
            expected: EXPECTED.to_string(),
        };
        let (name, numbers) = text.trim().split_once(':').ok_or_else(|| bad(format!("{text:?}")))?;
        let numbers: Vec<f64> = numbers
            .split(',')
            .map(|n| n.trim().parse::<f64>().map_err(|_| bad(format!("{n:?} in {text:?}"))))
            .collect::<Result<_, _>>()?;
        let model = from_parameters(name.trim(), &numbers)
            .ok_or_else(|| bad(format!("{name:?} with {} numbers", numbers.len())))?;
        model.map(Self).map_err(|e| bad(e.to_string()))
    }
}

impl fmt::Display for CameraFlag {
    /// As it is read, with enough digits to restore the same bits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match &self.0 {
            CameraModel::Pinhole(_) => "pinhole",
            CameraModel::RadTan(_) => "radtan",
            CameraModel::Equidistant(_) => "kb4",
            CameraModel::DoubleSphere(_) => "ds",
            CameraModel::Fov(_) => "fov",
        };
        let numbers: Vec<String> = self.0.parameters().iter().map(f64::to_string).collect();
        write!(f, "{name}:{}", numbers.join(","))
    }
}

/// The model with this name and these parameters, size 0×0; `None` for an unknown name or number of parameters.
fn from_parameters(name: &str, numbers: &[f64]) -> Option<Result<CameraModel, CameraError>> {
    let (&[fx, fy, cx, cy], rest) = numbers.split_first_chunk::<4>()?;
    // The checks of `Pinhole::new` hold for any size; 1x1 stands in until the image is known.
    let pinhole = match Pinhole::new(fx, fy, cx, cy, 1, 1) {
        Ok(pinhole) => Pinhole { width: 0, height: 0, ..pinhole },
        Err(e) => return Some(Err(e)),
    };
    match (name.to_ascii_lowercase().as_str(), rest) {
        ("pinhole", []) => Some(Ok(CameraModel::Pinhole(pinhole))),
        ("radtan", &[k1, k2, p1, p2]) => {
            Some(RadTan::new(pinhole, [k1, k2, p1, p2]).map(CameraModel::RadTan))
        }
        ("radtan", &[k1, k2, p1, p2, k3]) => {
            Some(RadTan::with_k3(pinhole, [k1, k2, p1, p2], k3).map(CameraModel::RadTan))
        }
        ("kb4" | "equidistant", &[k1, k2, k3, k4]) => {
            Some(Equidistant::new(pinhole, [k1, k2, k3, k4]).map(CameraModel::Equidistant))
        }
        ("ds", &[xi, alpha]) => Some(DoubleSphere::new(pinhole, xi, alpha).map(CameraModel::DoubleSphere)),
        ("fov", &[omega]) => Some(Fov::new(pinhole, omega).map(CameraModel::Fov)),
        _ => None,
    }
}

/// The same model for images of `width` × `height`, nothing else changed.
pub fn with_size(model: &CameraModel, width: usize, height: usize) -> Result<CameraModel, CameraError> {
    let p = model.intrinsics();
    let pinhole = Pinhole::new(p.fx, p.fy, p.cx, p.cy, width, height)?;
    let mut sized = model.clone();
    match &mut sized {
        CameraModel::Pinhole(m) => *m = pinhole,
        CameraModel::RadTan(m) => m.pinhole = pinhole,
        CameraModel::Equidistant(m) => m.pinhole = pinhole,
        CameraModel::DoubleSphere(m) => m.pinhole = pinhole,
        CameraModel::Fov(m) => m.pinhole = pinhole,
    }
    Ok(sized)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_model_is_read_from_its_flag() {
        for (text, name) in [
            ("pinhole:500,501,320,240", "pinhole"),
            ("radtan:458.654,457.296,367.215,248.375,-0.283,0.0739,0.0002,1.7e-5", "pinhole-radtan"),
            ("KB4: 190.9, 190.9, 254.9, 256.8, 0.0034, 0.0007, -0.002, 0.0002", "pinhole-equidistant"),
            ("ds:300,300,320,240,-0.2,0.59", "double-sphere"),
            ("fov:300,300,320,240,0.9", "fov"),
        ] {
            let flag: CameraFlag = text.parse().unwrap();
            assert_eq!(flag.0.name(), name);
            assert_eq!(flag.0.width(), 0);
            assert_eq!(flag.to_string().parse::<CameraFlag>().unwrap(), flag);
            let sized = with_size(&flag.0, 640, 480).unwrap();
            assert_eq!((sized.width(), sized.height()), (640, 480));
            assert_eq!(sized.intrinsics().fx, flag.0.intrinsics().fx);
        }
    }

    #[test]
    fn invalid_camera_flags_are_refused_with_the_expected_form() {
        for text in [
            "",
            "pinhole",
            "pinhole:1,2,3",
            "pinhole:1,2,3,x",
            "omni:1,2,3,4,5",
            "radtan:1,1,1,1",
            "pinhole:0,500,320,240",
            "pinhole:nan,500,320,240",
            "ds:300,300,320,240,-2,0.5",
        ] {
            let error = text.parse::<CameraFlag>().unwrap_err().to_string();
            assert!(error.contains("radtan:fx,fy,cx,cy,k1,k2,p1,p2"), "{error}");
        }
    }
}
