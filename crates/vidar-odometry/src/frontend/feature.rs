//! A feature of a keyframe, and what a frame measures of it.

use nalgebra::{Matrix2, Vector2, Vector3};
use vidar_core::CameraModel;
use vidar_core::camera::Pixel;

/// What surrounds a feature: a corner is fixed in both directions, an edgelet only across the edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FeatureKind {
    /// Texture in two directions.
    Corner,
    /// A piece of an edge.
    Edgelet {
        /// Unit direction of the grey-level gradient at the feature, level-0 pixels.
        normal: Vector2<f64>,
    },
}

/// A place in a keyframe whose surroundings can be found again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feature {
    /// Where it is in the image, level-0 pixels: the centre of its patch.
    pub pixel: Pixel,
    /// Where a global shutter at the image's time would show it, level-0 pixels; the same as `pixel` unless the shutter rolls.
    pub global_pixel: Pixel,
    /// Unit direction of `global_pixel` in the keyframe's camera frame.
    pub bearing: Vector3<f64>,
    /// Pyramid level on which it was found.
    pub level: u8,
    /// Corner or edgelet.
    pub kind: FeatureKind,
}

impl Feature {
    /// A feature at `pixel`; `None` where the camera has no direction for it.
    pub fn new(camera: &CameraModel, pixel: Pixel, level: u8, kind: FeatureKind) -> Option<Self> {
        let bearing = camera.unproject(&pixel)?;
        Some(Self { pixel, global_pixel: pixel, bearing, level, kind })
    }

    /// The same patch with the rolling shutter's motion removed from its direction; `None` where the camera has no
    /// direction for `global_pixel`.
    pub fn with_global_pixel(self, camera: &CameraModel, global_pixel: Pixel) -> Option<Self> {
        if global_pixel == self.pixel {
            return Some(self);
        }
        Some(Self { global_pixel, bearing: camera.unproject(&global_pixel)?, ..self })
    }

    /// Whether it is a piece of an edge.
    pub fn is_edgelet(&self) -> bool {
        matches!(self.kind, FeatureKind::Edgelet { .. })
    }
}

/// A position in an image with what is known of its error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelMeasurement {
    /// Where the feature was found, level-0 pixels.
    pub pixel: Pixel,
    /// Inverse covariance, 1/px² of level 0. Of rank one for an edgelet: nothing is known along the edge.
    pub information: Matrix2<f64>,
}

/// Standard deviation that stands for "unknown", pixels.
const UNKNOWN_PX: f64 = 1e3;

impl PixelMeasurement {
    /// Covariance, px²; a direction of which nothing is known gets (1000 px)².
    pub fn covariance(&self) -> Matrix2<f64> {
        let floor = Matrix2::identity() / (UNKNOWN_PX * UNKNOWN_PX);
        (self.information + floor)
            .try_inverse()
            .unwrap_or_else(|| Matrix2::identity() * UNKNOWN_PX * UNKNOWN_PX)
    }

    /// `W` with `Wᵀ W = information`: residuals in pixels times `W` have unit variance.
    ///
    /// The first row is the better known direction; the second is zero for an edgelet.
    pub fn whitening(&self) -> Matrix2<f64> {
        let [strong, weak, direction] = eigen(&self.information);
        let axis = Vector2::new(direction.cos(), direction.sin());
        let (s, w) = (strong.max(0.0).sqrt(), weak.max(0.0).sqrt());
        Matrix2::new(s * axis.x, s * axis.y, -w * axis.y, w * axis.x)
    }
}

/// Larger and smaller eigenvalue of a symmetric matrix, and the angle of the larger one's axis.
pub(crate) fn eigen(m: &Matrix2<f64>) -> [f64; 3] {
    let (mean, half) = (0.5 * (m.m11 + m.m22), 0.5 * (m.m11 - m.m22));
    let root = (half * half + m.m12 * m.m12).sqrt();
    [mean + root, mean - root, 0.5 * m.m12.atan2(half)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whitening_is_a_root_of_the_information() {
        for m in [Matrix2::new(4.0, 1.0, 1.0, 2.0), Matrix2::new(1.0, -3.0, -3.0, 9.0), Matrix2::zeros()] {
            let measured = PixelMeasurement { pixel: Pixel::zeros(), information: m };
            let w = measured.whitening();
            assert!((w.transpose() * w - m).amax() < 1e-12, "{m}");
        }
    }

    #[test]
    fn nothing_is_known_along_an_edge() {
        let normal = Vector2::new(0.6, 0.8);
        let information = normal * normal.transpose() / 0.25;
        let measured = PixelMeasurement { pixel: Pixel::new(3.0, 4.0), information };
        let along = Vector2::new(-0.8, 0.6);
        let variance = |d: &Vector2<f64>| (d.transpose() * measured.covariance() * d).x;
        assert!((variance(&normal) - 0.25).abs() < 1e-6);
        assert!(variance(&along) > 0.9e6);
        assert!(measured.whitening().row(1).norm() < 1e-6);
        assert!((measured.whitening() * along).norm() < 1e-6);
    }
}
