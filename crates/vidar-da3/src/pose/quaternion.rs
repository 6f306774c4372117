//! Quaternions xyzw and matrices, as the pose encodings use them.

use nalgebra::Matrix3;

/// Divisors of the four candidates are not taken smaller than this.
const MIN_DIVISOR: f64 = 0.1;

/// The rotation of a quaternion xyzw of any length but zero.
pub fn matrix_from_quaternion([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    let s = 2.0 / (x * x + y * y + z * z + w * w);
    Matrix3::new(
        1.0 - s * (y * y + z * z),
        s * (x * y - z * w),
        s * (x * z + y * w),
        s * (x * y + z * w),
        1.0 - s * (x * x + z * z),
        s * (y * z - x * w),
        s * (x * z - y * w),
        s * (y * z + x * w),
        1.0 - s * (x * x + y * y),
    )
}

/// The quaternion xyzw of a rotation, w ≥ 0: of four candidates the one with the largest divisor.
pub fn quaternion_from_matrix(m: &Matrix3<f64>) -> [f64; 4] {
    let (a, b, c) = (m[(0, 0)], m[(1, 1)], m[(2, 2)]);
    let squares = [1.0 + a + b + c, 1.0 + a - b - c, 1.0 - a + b - c, 1.0 - a - b + c];
    let sizes = squares.map(|s: f64| s.max(0.0).sqrt());
    let best = (1..4).fold(0, |best, i| if sizes[i] > sizes[best] { i } else { best });
    // Rows: four times the products wxyz with w, x, y, z.
    let (yz, zx, xy) = (m[(2, 1)] - m[(1, 2)], m[(0, 2)] - m[(2, 0)], m[(1, 0)] - m[(0, 1)]);
    let (sum_xy, sum_zx, sum_yz) = (m[(1, 0)] + m[(0, 1)], m[(0, 2)] + m[(2, 0)], m[(1, 2)] + m[(2, 1)]);
    let square = sizes[best] * sizes[best];
    let [w, x, y, z] = match best {
        0 => [square, yz, zx, xy],
        1 => [yz, square, sum_xy, sum_zx],
        2 => [zx, sum_xy, square, sum_yz],
        _ => [xy, sum_zx, sum_yz, square],
    };
    let divisor = 2.0 * sizes[best].max(MIN_DIVISOR);
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z, w].map(|v| v / divisor * sign)
}
