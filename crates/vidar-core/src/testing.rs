//! Helpers for tests, used by all crates: checks of analytic derivatives, and the recordings beside the checkout.

use crate::simd::{self, Instructions};
use nalgebra::{SMatrix, SVector};
use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};

/// A file or folder of the recordings and reference results that are not part of the repository: below `VIDAR_SHARED`, or below
/// `shared` beside the checkout. `None` where it is not there, which [`skipped`] tells.
pub fn shared_data(part: &str) -> Option<PathBuf> {
    let root = std::env::var_os("VIDAR_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"), PathBuf::from);
    let path = root.join(part);
    if path.exists() {
        return Some(path);
    }
    skipped(&format_args!("{} is not there (VIDAR_SHARED names another place)", path.display()));
    None
}

/// Says on standard error that the test that asks is skipped, and why.
///
/// Not by `eprintln`, whose text is kept back when a test passes.
pub fn skipped(why: &dyn Display) {
    let thread = std::thread::current();
    let test = thread.name().unwrap_or("a test");
    // Where standard error is closed, nobody can be told.
    let _ = writeln!(std::io::stderr(), "skipped {test}: {why}");
}

/// Results of `work` on one thread, with each instruction set that this processor has, the portable one first.
#[allow(clippy::expect_used, reason = "a helper of tests fails as a test does")]
pub fn with_each_instruction_set<R: Send>(work: impl Fn() -> R + Sync) -> Vec<(Instructions, R)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool of one thread");
    let mut results = Vec::new();
    for limit in [Instructions::Portable, Instructions::Avx2, Instructions::Avx512] {
        let run = || {
            simd::limit(limit);
            (simd::available() == limit).then(&work)
        };
        results.extend(pool.install(run).map(|r| (limit, r)));
    }
    results
}

/// The result of `work`, which must not depend on the instruction set.
///
/// # Panics
/// If it does.
#[allow(clippy::expect_used, reason = "a helper of tests fails as a test does")]
pub fn same_with_each_instruction_set<R: Send + PartialEq>(work: impl Fn() -> R + Sync) -> R {
    let mut results = with_each_instruction_set(work).into_iter();
    let (_, portable) = results.next().expect("the portable one is always there");
    for (instructions, result) in results {
        assert!(result == portable, "{instructions:?} gives another result than the portable instructions");
    }
    portable
}

/// Jacobian of `f` at `x` by central differences with Richardson extrapolation.
fn numeric_jacobian<const M: usize, const N: usize>(
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

/// Largest absolute entry, NaN as soon as any entry is NaN.
///
/// nalgebra's `amax` compares and so ignores a NaN: a matrix with NaN would appear small.
pub fn largest_entry<const M: usize, const N: usize>(matrix: &SMatrix<f64, M, N>) -> f64 {
    matrix.iter().fold(
        0.0,
        |largest: f64, v| {
            if largest.is_nan() || v.is_nan() { f64::NAN } else { largest.max(v.abs()) }
        },
    )
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
    let error = largest_entry(&(analytic - numeric)) / largest_entry(&numeric).max(1.0);
    // A NaN error must fail, so the comparison is written this way round.
    if error <= tolerance {
        Ok(())
    } else {
        Err(format!("{name}: error {error:.3e} > {tolerance:.1e}\nanalytic {analytic}numeric {numeric}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix2, Vector2};

    fn curve(x: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(x[0].sin() * x[1], x[1].exp())
    }

    #[test]
    fn a_right_jacobian_passes_and_a_wrong_one_is_shown() {
        let x = Vector2::new(0.7_f64, 1.3);
        let right = Matrix2::new(x[0].cos() * x[1], x[0].sin(), 0.0, x[1].exp());
        assert_eq!(check_jacobian("curve", &right, curve, &x, 1e-10), Ok(()));
        let mut wrong = right;
        wrong[(0, 1)] += 1e-4;
        let message = check_jacobian("curve", &wrong, curve, &x, 1e-6).unwrap_err();
        assert!(message.starts_with("curve: error") && message.contains("numeric"), "{message}");
    }

    #[test]
    fn not_a_number_never_passes() {
        let x = Vector2::new(0.7_f64, 1.3);
        let nan = Matrix2::repeat(f64::NAN);
        assert!(check_jacobian("nan", &nan, curve, &x, 1e3).is_err());
        let mut one_nan = numeric_jacobian(curve, &x);
        one_nan[(1, 0)] = f64::NAN;
        assert!(largest_entry(&one_nan).is_nan() && largest_entry(&one_nan.transpose()).is_nan());
        assert_eq!(largest_entry(&Matrix2::new(1.0, -3.0, 2.0, 0.0)), 3.0);
        assert!(check_jacobian("one nan", &one_nan, curve, &x, 1e3).is_err());
        let broken = |_: &Vector2<f64>| Vector2::repeat(f64::NAN);
        assert!(check_jacobian("broken f", &Matrix2::zeros(), broken, &x, 1e3).is_err());
    }
}
