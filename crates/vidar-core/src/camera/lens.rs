//! A lens that moves while filming: autofocus and optical stabilisation.

use super::{CameraModel, Pixel};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// How the lens has moved when an image was taken, from where the camera's calibration has it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LensMotion {
    /// `ln` of the image's focal length over the calibration's: autofocus changes it.
    pub log_focal: f64,
    /// What the image is shifted by while its middle row is exposed, in focal lengths (the tangent of an angle): optical stabilisation
    /// shifts it.
    pub shift: Vector2<f64>,
    /// How the shift goes on from row to row, focal lengths per second.
    pub shift_rate: Vector2<f64>,
}

impl LensMotion {
    /// A lens that is where the calibration has it.
    pub const NONE: Self =
        Self { log_focal: 0.0, shift: Vector2::new(0.0, 0.0), shift_rate: Vector2::new(0.0, 0.0) };

    /// Where the image shows what the calibrated camera shows at `pixel`, in a row that is exposed so many seconds after the middle one.
    pub fn shown(&self, camera: &CameraModel, pixel: &Pixel, row_secs: f64) -> Pixel {
        if *self == Self::NONE {
            return *pixel;
        }
        let centre = camera.principal_point();
        centre + (pixel - centre) * self.log_focal.exp() + self.shift_px(camera, row_secs)
    }

    /// Where the calibrated camera shows what the image shows at `pixel`.
    pub fn calibrated(&self, camera: &CameraModel, pixel: &Pixel, row_secs: f64) -> Pixel {
        if *self == Self::NONE {
            return *pixel;
        }
        let centre = camera.principal_point();
        centre + (pixel - centre - self.shift_px(camera, row_secs)) * (-self.log_focal).exp()
    }

    /// The shift in a row, px.
    pub fn shift_px(&self, camera: &CameraModel, row_secs: f64) -> Vector2<f64> {
        camera.focal_lengths().component_mul(&(self.shift + self.shift_rate * row_secs))
    }

    /// What lies between this motion and `other`, `share` of the way.
    #[must_use]
    pub fn towards(&self, other: &Self, share: f64) -> Self {
        Self {
            log_focal: self.log_focal + share * (other.log_focal - self.log_focal),
            shift: self.shift + (other.shift - self.shift) * share,
            shift_rate: self.shift_rate + (other.shift_rate - self.shift_rate) * share,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pinhole;

    #[test]
    fn what_a_moved_lens_shows_is_taken_back_to_where_the_calibrated_one_shows_it() {
        let camera = CameraModel::Pinhole(Pinhole::new(400.0, 420.0, 310.0, 250.0, 640, 480).unwrap());
        let moved = LensMotion {
            log_focal: 0.02,
            shift: Vector2::new(0.01, -0.005),
            shift_rate: Vector2::new(0.0, 0.5),
        };
        let pixel = Pixel::new(410.0, 150.0);
        let shown = moved.shown(&camera, &pixel, 0.01);
        let larger = 100.0 * 0.02_f64.exp();
        let expected = Pixel::new(310.0 + larger + 4.0, 250.0 - larger - 2.1 + 2.1);
        assert!((shown - expected).norm() < 1e-9, "{shown}");
        assert!((moved.calibrated(&camera, &shown, 0.01) - pixel).norm() < 1e-9);
        assert_eq!(LensMotion::NONE.shown(&camera, &pixel, 0.01), pixel);
        let half = LensMotion::NONE.towards(&moved, 0.5);
        assert!((half.log_focal - 0.01).abs() < 1e-12 && (half.shift - moved.shift * 0.5).norm() < 1e-12);
        assert!((half.shift_rate.y - 0.25).abs() < 1e-12);
    }
}
