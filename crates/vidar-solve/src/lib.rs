//! Robust non-linear least squares on manifolds: losses, sparse normal equations, Levenberg-Marquardt.
//!
//! [`NormalEquations`] gathers `Jᵀ J` and `Jᵀ r` block by block and solves them by a sparse Cholesky factorisation with a
//! fill-reducing order. It runs on one thread in a fixed order: same input, same bits.

mod normal;

pub use normal::{NormalEquations, SolveError};
