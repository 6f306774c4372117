//! Robust non-linear least squares on manifolds: losses, Levenberg-Marquardt, pose graphs, sample consensus.
