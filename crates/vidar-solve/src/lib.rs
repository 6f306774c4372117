//! Building blocks of robust least squares: sparse normal equations, robust losses, medians.
//!
//! [`NormalEquations`] gathers `Jᵀ J` and `Jᵀ r` block by block and solves them by a sparse Cholesky factorisation with a
//! fill-reducing order. It runs on one thread in a fixed order: same input, same bits. [`Kernel`] holds the robust losses,
//! [`statistics`] the medians.

pub mod kernels;
mod normal;
pub mod statistics;

pub use kernels::Kernel;
pub use normal::{NormalEquations, SolveError};
