//! Why there is no metric state yet, in words that say what to do.

use crate::backend::SmootherError;
use std::fmt;

/// Reason of an initialisation failure.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum InitFailureReason {
    /// Frames with IMU measurements between them.
    Frames,
    /// Seconds of frames or IMU measurements.
    Seconds,
    /// Tracks that several frames share.
    Tracks,
    /// Parallax between the window's rays that rotation does not explain, degrees.
    Parallax,
    /// Standard deviation of log(scale).
    ScaleUncertainty,
    /// Change of the scale between successive solutions, relative.
    ScaleAgreement,
    /// Share of observations that fit no solution.
    OutlierShare,
    /// Residual of the images, χ² per degree of freedom.
    ImageChi2,
    /// Residual of the IMU measurements, χ² per degree of freedom.
    ImuChi2,
    /// Speed, m/s.
    Speed,
    /// Accelerometer bias, m/s².
    AccelBias,
    /// Gyroscope bias, rad/s.
    GyroBias,
    /// Median distance of the scene, m.
    SceneDistance,
    /// Scatter of the gyroscope while standing still, rad/s.
    GyroStd,
    /// Scatter of the accelerometer while standing still, m/s².
    AccelStd,
    /// Motion in the image while standing still, px.
    ImageMotion,
    /// Mean specific force, m/s², which must be near gravity.
    SpecificForce,
    /// Angle between the camera's orientation as given and as estimated from gyroscope and images, degrees.
    CameraOrientation,
    /// The backend could not be built or rejected its first frames; the measured value and limit mean nothing.
    Backend(SmootherError),
}

/// A failure reason with its measured value and the limit.
#[derive(Clone, Debug, PartialEq)]
pub struct InitFailure {
    /// Reason of an initialisation failure.
    pub reason: InitFailureReason,
    /// What was measured.
    pub measured: f64,
    /// What it would have to be: at least, or at most, as [`InitFailure::wants_more`] says.
    pub limit: f64,
}

impl InitFailure {
    /// A failure of the backend, with its own reason.
    pub(crate) fn backend(error: SmootherError) -> Self {
        Self::new(InitFailureReason::Backend(error), f64::NAN, f64::NAN)
    }

    pub(crate) fn new(reason: InitFailureReason, measured: f64, limit: f64) -> Self {
        Self { reason, measured, limit }
    }

    /// Whether the value has to rise (parallax, tracks) rather than fall.
    pub fn wants_more(&self) -> bool {
        matches!(
            self.reason,
            InitFailureReason::Frames
                | InitFailureReason::Seconds
                | InitFailureReason::Tracks
                | InitFailureReason::Parallax
        )
    }
}

impl fmt::Display for InitFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, unit, advice) = match &self.reason {
            InitFailureReason::Backend(error) => return write!(f, "backend: {error}"),
            InitFailureReason::Frames => ("frames with IMU measurements", "", "wait"),
            InitFailureReason::Seconds => ("recorded time", " s", "wait"),
            InitFailureReason::Tracks => ("shared tracks", "", "show more texture, move less abruptly"),
            InitFailureReason::Parallax => ("parallax", " deg", "move sideways"),
            InitFailureReason::ScaleUncertainty => {
                ("std(log scale)", "", "speed up and slow down, move to and fro")
            }
            InitFailureReason::ScaleAgreement => ("change of scale between solutions", "", "keep moving"),
            InitFailureReason::OutlierShare => {
                ("share of observations that do not fit", "", "avoid moving things")
            }
            InitFailureReason::ImageChi2 => {
                ("image residual", " per dof", "check the camera calibration and clock offset")
            }
            InitFailureReason::ImuChi2 => ("inertial residual", " per dof", "check the IMU's noise and axes"),
            InitFailureReason::Speed => ("speed", " m/s", "check the calibration"),
            InitFailureReason::AccelBias => ("accelerometer bias", " m/s²", "move more, turn about two axes"),
            InitFailureReason::GyroBias => {
                ("gyroscope bias", " rad/s", "check the gyroscope's units and axes")
            }
            InitFailureReason::SceneDistance => {
                ("median distance", " m", "move sideways nearer to the scene")
            }
            InitFailureReason::GyroStd => {
                ("gyroscope scatter", " rad/s", "hold still, or move and start in flight")
            }
            InitFailureReason::AccelStd => {
                ("accelerometer scatter", " m/s²", "hold still, or move and start in flight")
            }
            InitFailureReason::ImageMotion => {
                ("image motion", " px", "hold still, or move and start in flight")
            }
            InitFailureReason::CameraOrientation => (
                "the camera's orientation on the IMU is off by",
                " deg",
                "check the extrinsic calibration (inverted?)",
            ),
            InitFailureReason::SpecificForce => {
                ("mean specific force", " m/s²", "check the accelerometer's units")
            }
        };
        let sign = if self.wants_more() { '<' } else { '>' };
        write!(f, "{name} {:.3}{unit} {sign} {:.3}{unit}: {advice}", self.measured, self.limit)
    }
}
