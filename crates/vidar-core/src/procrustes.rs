//! The rotation nearest to a matrix: what is left of a sum of outer products or of rotations (orthogonal Procrustes problem,
//! Schönemann 1966; with the sign of Kabsch 1976).

use nalgebra::{Matrix3, Vector3};

/// The rotation nearest to a matrix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearestRotation {
    /// R, a rotation matrix: `|R − M|` is least and `tr(Rᵀ M)` greatest among rotations.
    pub rotation: Matrix3<f64>,
    /// Singular values of M, falling. The rotation is undetermined where the second is zero.
    pub singular_values: Vector3<f64>,
}

/// `R = U diag(1, 1, det U det V) Vᵀ` of `M = U S Vᵀ`; `None` when M is not finite.
///
/// For `M = Σ a bᵀ`, R is the rotation that maps the b best onto the a. The decomposition is nalgebra's; that of
/// [`umeyama`](crate::umeyama) keeps more digits where M is all but singular, and its bits differ.
pub fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<NearestRotation> {
    if !matrix.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = matrix.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    Some(NearestRotation { rotation, singular_values: svd.singular_values })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LieGroup, So3};

    #[test]
    fn a_stretched_rotation_gives_the_rotation_and_a_mirror_gives_none_of_its_own() {
        let truth = So3::exp(&Vector3::new(0.4, -1.1, 0.7));
        let axes = So3::exp(&Vector3::new(-0.2, 0.3, 0.9)).matrix();
        let stretched = |values: [f64; 3]| {
            truth.matrix() * axes * Matrix3::from_diagonal(&values.into()) * axes.transpose()
        };
        let found = nearest_rotation(&stretched([3.0, 2.0, 0.5])).unwrap();
        assert!((found.rotation - truth.matrix()).amax() < 1e-12);
        assert!((found.singular_values - Vector3::new(3.0, 2.0, 0.5)).amax() < 1e-12);
        // A mirror image in the weakest direction: the rotation stays.
        let found = nearest_rotation(&stretched([3.0, 2.0, -0.5])).unwrap();
        assert!((found.rotation - truth.matrix()).amax() < 1e-12);
        assert!(nearest_rotation(&Matrix3::from_element(f64::NAN)).is_none());
    }
}
