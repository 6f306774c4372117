//! numpy's percentile, median and rounding, and a camera in double precision.

use nalgebra::{Matrix3, Matrix4, Vector3};

/// numpy's `percentile` with linear interpolation, of ascending values.
pub(super) fn percentile(sorted: &[f64], percent: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let at = percent / 100.0 * last as f64;
    let low = (at.floor().max(0.0) as usize).min(last);
    let (a, b) = (sorted[low], sorted[(low + 1).min(last)]);
    let t = at - low as f64;
    // From the nearer end, as numpy does, so that t = 1 gives b exactly.
    Some(if t < 0.5 { a + (b - a) * t } else { b - (b - a) * (1.0 - t) })
}

/// The percentile of values in any order.
pub(super) fn percentile_of(mut values: Vec<f64>, percent: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    percentile(&values, percent)
}

/// numpy's `round` of 32-bit floats: scaled, rounded half to even, and scaled back in 32 bits.
pub(super) fn rounded(value: f32, scale: f32) -> f32 {
    (value * scale).round_ties_even() / scale
}

/// A camera in the official program's conventions.
pub(super) struct Camera {
    pub camera_from_world: Matrix4<f64>,
    pub world_from_camera: Matrix4<f64>,
    pub k: Matrix3<f64>,
    pub k_inverse: Matrix3<f64>,
}

impl Camera {
    pub fn new(extrinsics: &[[f32; 4]; 3], intrinsics: &[[f32; 3]; 3]) -> Option<Self> {
        let mut camera_from_world = Matrix4::identity();
        for (r, row) in extrinsics.iter().enumerate() {
            for (c, value) in row.iter().enumerate() {
                camera_from_world[(r, c)] = f64::from(*value);
            }
        }
        let k = Matrix3::from_fn(|r, c| f64::from(intrinsics[r][c]));
        let world_from_camera = camera_from_world.try_inverse()?;
        let k_inverse = k.try_inverse()?;
        let finite = world_from_camera.iter().chain(k_inverse.iter()).all(|v| v.is_finite());
        finite.then_some(Self { camera_from_world, world_from_camera, k, k_inverse })
    }

    /// The point of pixel (u, v) at a z-depth, in the world.
    pub fn point(&self, u: f64, v: f64, depth: f64) -> Vector3<f64> {
        let in_camera = self.k_inverse * Vector3::new(u, v, 1.0) * depth;
        transform(&self.world_from_camera, &in_camera)
    }
}

/// An affine transform of a point.
pub(super) fn transform(matrix: &Matrix4<f64>, point: &Vector3<f64>) -> Vector3<f64> {
    (matrix * point.push(1.0)).xyz()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_numpys() {
        // numpy.percentile([1, 2, 4, 8], [0, 10, 40, 50, 90, 100])
        let values = [1.0, 2.0, 4.0, 8.0];
        let expected = [1.0, 1.3, 2.4, 3.0, 6.8, 8.0];
        for (percent, expected) in [0.0, 10.0, 40.0, 50.0, 90.0, 100.0].into_iter().zip(expected) {
            assert!((percentile(&values, percent).unwrap() - expected).abs() < 1e-12, "{percent}");
        }
        assert_eq!(percentile(&[], 50.0), None);
        assert_eq!(percentile(&[3.0], 98.0), Some(3.0));
        assert_eq!(percentile_of(vec![8.0, 1.0, 4.0, 2.0], 50.0), Some(3.0));
    }

    #[test]
    fn rounding_is_half_to_even_in_thirty_two_bits() {
        assert_eq!(rounded(0.125, 100.0), 0.12);
        assert_eq!(rounded(2.5, 1.0), 2.0);
        assert_eq!(rounded(-1.5, 1.0), -2.0);
        assert!(rounded(f32::NAN, 100.0).is_nan());
    }
}
