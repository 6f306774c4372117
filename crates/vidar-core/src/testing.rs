//! Helpers for tests: the one way in which derivatives are checked in this project.

use nalgebra::{SMatrix, SVector};

/// Jacobian of `f` at `x` by central differences with Richardson extrapolation.
pub fn numeric_jacobian<const M: usize, const N: usize>(
    f: impl Fn(&SVector<f64, N>) -> SVector<f64, M>,
    x: &SVector<f64, N>,
) -> SMatrix<f64, M, N> {
    let central = |h: f64, column: usize| {
        let mut plus = *x;
        let mut minus = *x;
        plus[column] += h;
        minus[column] -= h;
        (f(&plus) - f(&minus)) / (plus[column] - minus[column])
    };
    let mut jacobian = SMatrix::<f64, M, N>::zeros();
    for column in 0..N {
        let h = 1e-4 * x[column].abs().max(1.0);
        // Richardson: the h² error term of the two central differences cancels.
        let derivative = (central(h / 2.0, column) * 4.0 - central(h, column)) / 3.0;
        jacobian.set_column(column, &derivative);
    }
    jacobian
}

/// Compares an analytic Jacobian with the numeric one.
///
/// The error is the largest absolute difference over the largest entry (at least 1); `Err` names both matrices.
pub fn check_jacobian<const M: usize, const N: usize>(
    name: &str,
    analytic: &SMatrix<f64, M, N>,
    f: impl Fn(&SVector<f64, N>) -> SVector<f64, M>,
    x: &SVector<f64, N>,
    tolerance: f64,
) -> Result<(), String> {
    let numeric = numeric_jacobian(f, x);
    let error = (analytic - numeric).amax() / numeric.amax().max(1.0);
    // A NaN error must fail, so the comparison is written this way round.
    if error <= tolerance {
        Ok(())
    } else {
        Err(format!("{name}: error {error:.3e} > {tolerance:.1e}\nanalytic {analytic}numeric {numeric}"))
    }
}
