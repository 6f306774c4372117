//! Building blocks of robust estimation: Levenberg-Marquardt, sparse normal equations, robust losses, medians, a robust
//! similarity.
//!
//! [`levenberg_marquardt`] is the one loop of damped steps that all estimators share. [`NormalEquations`] gathers `Jᵀ J` and `Jᵀ r` block by block and solves them by a sparse Cholesky factorisation with a
//! fill-reducing order. It runs on one thread in a fixed order: same input, same bits. [`Kernel`] holds the robust losses,
//! [`statistics`] the medians, [`robust_similarity`] finds a similarity among outliers with the random numbers of [`pcg64`].

pub mod kernels;
pub mod levenberg_marquardt;
mod normal;
pub mod pcg64;
mod similarity;
pub mod statistics;

pub use kernels::Kernel;
pub use normal::{NormalEquations, SolveError};
pub use similarity::{RobustSimilarity, mean_rotation, ransac_samples, robust_similarity};
