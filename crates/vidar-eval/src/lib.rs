//! Trajectory, depth and surface metrics with the paper's protocols.
