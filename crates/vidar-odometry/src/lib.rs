//! Visual-inertial odometry: images and IMU samples in, metric states, keyframes and covariance out.

pub mod frontend;
pub mod system;

pub use system::{
    DivergenceSign, ImuUse, InputCounts, LossReason, Odometry, OdometryConfig, OdometryError, OdometryOutput,
    Stage, StageTimes, Status, TrackRecord, TrackSummary, Tracking,
};
pub mod estimator;
pub mod imu;
pub mod init;
pub mod simulate;
