//! Metric trajectories, and where they come from.

use serde::Serialize;
use vidar_core::Trajectory;

/// Where the metric poses of a run come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "source", rename_all = "kebab-case")]
pub enum TrajectorySource {
    /// A trajectory that the user gave.
    External {
        /// Which file.
        file: String,
    },
    /// The dataset's ground truth: scores made with it are an upper bound.
    GroundTruth,
    /// Odometry of the recording's own camera and IMU.
    Odometry,
}

impl std::fmt::Display for TrajectorySource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::External { file } => write!(f, "external trajectory {file}"),
            Self::GroundTruth => f.write_str("ground truth (upper bound)"),
            Self::Odometry => f.write_str("odometry of camera and IMU"),
        }
    }
}

/// A metric trajectory of the camera in use.
#[derive(Clone, Debug)]
pub struct MetricTrajectory {
    /// Where it came from.
    pub source: TrajectorySource,
    /// Poses of the camera in use, m.
    pub camera_trajectory: Trajectory,
}
