//! What a recording does not state of its calibration.

use super::has_no_mount;
use vidar_dataset::{CalibrationSource, Recording};

/// What a recording with a gyroscope does not state of its calibration, and what therefore is looked for before it is tracked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MissingCalibration {
    /// All of it: camera, mount and clock.
    Camera,
    /// How the camera is mounted on the IMU; a lens is given.
    Mount,
}

impl MissingCalibration {
    pub(super) fn of(dataset: &Recording) -> Option<Self> {
        if dataset.imu.is_empty() {
            None
        } else if dataset.calibration == CalibrationSource::Guessed {
            Some(Self::Camera)
        } else {
            has_no_mount(dataset).then_some(Self::Mount)
        }
    }

    /// What a run does about it.
    pub fn words(self) -> &'static str {
        match self {
            Self::Camera => {
                "none is given: a run finds it from images and gyroscope first, and ends with E0208 where they do not show it; until then there \
                 are no poses, and camera and model view are a guess"
            }
            Self::Mount => {
                "the camera's place on the IMU is not given: a run finds it from images and gyroscope first; where they do not show it, the \
                 odometry starts with the one that was read or assumed"
            }
        }
    }
}
