//! Synthetic worlds in EuRoC layout: exact flight, camera, IMU, depth and scan; deterministic by seed.
