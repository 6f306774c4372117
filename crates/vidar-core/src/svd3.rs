//! Singular value decomposition of a 3×3 matrix, turned so that both bases are right-handed.
//!
//! One-sided Jacobi rotations (Hestenes 1958; Demmel, Veselić 1992) find small singular values to their own relative
//! precision. nalgebra's decomposition of 3×3 matrices goes through `MᵀM`, which squares the condition: for points
//! along an almost straight flight it loses half of the digits of the rotation about that line.

use nalgebra::{Matrix3, Vector3};

/// `M = U · diag(values) · Vᵀ` with det U = det V = 1, so that the last value carries the sign of det M.
pub(crate) struct ProperSvd {
    /// `U · Vᵀ`: the rotation R that maximises `tr(Rᵀ M)`.
    pub rotation: Matrix3<f64>,
    /// In falling size; the first two are not negative, the third may be.
    pub values: [f64; 3],
}

/// Decomposes `matrix`; `None` when it is zero, not finite, or has a second singular value that is exactly zero.
pub(crate) fn proper_svd(matrix: &Matrix3<f64>) -> Option<ProperSvd> {
    let size = matrix.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    if !(size > 0.0 && matrix.iter().all(|v| v.is_finite())) {
        return None;
    }
    let scaled = matrix / size;
    let mut columns = [0, 1, 2].map(|i| scaled.column(i).into_owned());
    let mut right = [Vector3::x(), Vector3::y(), Vector3::z()];
    // Convergence is quadratic; ten sweeps are several times more than any matrix needs.
    for _ in 0..10 {
        let mut turned = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            turned |= make_orthogonal(&mut columns, &mut right, p, q);
        }
        if !turned {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| columns[b].norm_squared().total_cmp(&columns[a].norm_squared()));
    let [first, second, _] = order;
    let u0 = columns[first].try_normalize(0.0)?;
    let u1 = columns[second].try_normalize(0.0)?;
    let (v0, v1) = (right[first], right[second]);
    let (u2, v2) = (u0.cross(&u1), v0.cross(&v1));
    Some(ProperSvd {
        rotation: u0 * v0.transpose() + u1 * v1.transpose() + u2 * v2.transpose(),
        values: [columns[first].norm() * size, columns[second].norm() * size, u2.dot(&(scaled * v2)) * size],
    })
}

/// Turns columns `p` and `q` in their plane until they are orthogonal; `false` when they were already.
fn make_orthogonal(
    columns: &mut [Vector3<f64>; 3],
    right: &mut [Vector3<f64>; 3],
    p: usize,
    q: usize,
) -> bool {
    let (a, b) = (columns[p], columns[q]);
    let (aa, bb, ab) = (a.norm_squared(), b.norm_squared(), a.dot(&b));
    if ab.abs() <= f64::EPSILON * (aa * bb).sqrt() {
        return false;
    }
    let zeta = (bb - aa) / (2.0 * ab);
    let tan = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
    let cos = 1.0 / (1.0 + tan * tan).sqrt();
    let sin = cos * tan;
    for basis in [columns, right] {
        (basis[p], basis[q]) = (basis[p] * cos - basis[q] * sin, basis[p] * sin + basis[q] * cos);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::{LieGroup, So3};
    use proptest::prelude::*;

    fn rotation() -> impl Strategy<Value = Matrix3<f64>> {
        (-2.0..2.0_f64, -2.0..2.0_f64, -2.0..2.0_f64)
            .prop_map(|(x, y, z)| So3::exp(&Vector3::new(x, y, z)).matrix())
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn finds_the_values_and_the_rotation_that_made_the_matrix(
            u in rotation(), v in rotation(), first in 0.1..10.0_f64, second in -8.0..0.0_f64, third in -1.0..1.0_f64,
        ) {
            // Second value down to 1e-8 of the first, third anywhere between plus and minus the second.
            let d = Vector3::new(first, first * 10f64.powf(second), 0.0);
            let d = Vector3::new(d.x, d.y, d.y * third);
            let svd = proper_svd(&(u * Matrix3::from_diagonal(&d) * v.transpose())).unwrap();
            for i in 0..3 {
                prop_assert!((svd.values[i] - d[i]).abs() <= 1e-14 * first, "{:?} {d:?}", svd.values);
            }
            prop_assert!((svd.rotation.determinant() - 1.0).abs() < 1e-14);
            // The rotation's error grows with the inverse of the gap d1 + d2.
            let error = (svd.rotation - u * v.transpose()).amax();
            prop_assert!(error <= 1e-14 * first / (d.y + d.z).max(1e-30), "{error:.2e} {d:?}");
        }
    }

    #[test]
    fn what_has_no_second_direction_is_refused() {
        assert!(proper_svd(&Matrix3::zeros()).is_none());
        assert!(proper_svd(&Matrix3::repeat(f64::NAN)).is_none());
        assert!(proper_svd(&Matrix3::repeat(f64::INFINITY)).is_none());
        let line = Vector3::x() * Vector3::y().transpose();
        assert!(proper_svd(&line).is_none());
    }
}
