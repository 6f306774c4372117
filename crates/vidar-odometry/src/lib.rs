//! Visual-inertial odometry: images and IMU samples in, metric states, keyframes and covariance out.

pub mod frontend;
pub mod system;

pub use system::{
    DivergenceSign, ImuUse, InitCondition, InitProgress, LossReason, OdometryConfig, OdometryError, OdometryOutput, Status,
    Tracking,
};
