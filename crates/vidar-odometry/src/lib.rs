//! Visual-inertial odometry: images and IMU samples in, metric states, keyframes and covariance out.
