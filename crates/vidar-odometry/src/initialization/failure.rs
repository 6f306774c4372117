//! Why there is no metric state yet, in words that say what to do.

use std::fmt;

/// What stands in the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Obstacle {
    /// Frames with readings between them.
    Frames,
    /// Seconds of frames or readings.
    Seconds,
    /// Tracks that several frames share.
    Tracks,
    /// Parallax between the window's rays that rotation does not explain, degrees.
    Parallax,
    /// Standard deviation of log(scale).
    ScaleUncertainty,
    /// Change of the scale between successive solutions, relative.
    ScaleAgreement,
    /// Share of sightings that fit no solution.
    WrongSightings,
    /// Misfit of the images, χ² per degree of freedom.
    ImageMisfit,
    /// Misfit of the inertial readings, χ² per degree of freedom.
    InertialMisfit,
    /// Speed, m/s.
    Speed,
    /// Accelerometer bias, m/s².
    AccelBias,
    /// Gyroscope bias, rad/s.
    GyroBias,
    /// Median distance of the scene, m.
    SceneDistance,
    /// Scatter of the gyroscope while standing still, rad/s.
    GyroScatter,
    /// Scatter of the accelerometer while standing still, m/s².
    AccelScatter,
    /// Motion in the image while standing still, px.
    ImageMotion,
    /// Mean specific force, m/s², which must be near gravity.
    SpecificForce,
    /// Angle between the camera's orientation as given and as gyroscope and images tell it together, degrees.
    CameraOrientation,
}

/// An obstacle with its measured value and the limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refusal {
    /// What stands in the way.
    pub obstacle: Obstacle,
    /// What was measured.
    pub measured: f64,
    /// What it would have to be: at least, or at most, as [`Refusal::wants_more`] says.
    pub limit: f64,
}

impl Refusal {
    pub(crate) fn new(obstacle: Obstacle, measured: f64, limit: f64) -> Self {
        Self { obstacle, measured, limit }
    }

    /// Whether the value has to rise (parallax, tracks) rather than fall.
    pub fn wants_more(&self) -> bool {
        matches!(self.obstacle, Obstacle::Frames | Obstacle::Seconds | Obstacle::Tracks | Obstacle::Parallax)
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, unit, advice) = match self.obstacle {
            Obstacle::Frames => ("frames with readings", "", "wait"),
            Obstacle::Seconds => ("recorded time", " s", "wait"),
            Obstacle::Tracks => ("shared tracks", "", "show more texture, move less abruptly"),
            Obstacle::Parallax => ("parallax", " deg", "move sideways"),
            Obstacle::ScaleUncertainty => ("std(log scale)", "", "speed up and slow down, move to and fro"),
            Obstacle::ScaleAgreement => ("change of scale between solutions", "", "keep moving"),
            Obstacle::WrongSightings => ("share of sightings that do not fit", "", "avoid moving things"),
            Obstacle::ImageMisfit => {
                ("image misfit", " per dof", "check the camera calibration and clock offset")
            }
            Obstacle::InertialMisfit => ("inertial misfit", " per dof", "check the IMU's noise and axes"),
            Obstacle::Speed => ("speed", " m/s", "check the calibration"),
            Obstacle::AccelBias => ("accelerometer bias", " m/s²", "move more, turn about two axes"),
            Obstacle::GyroBias => ("gyroscope bias", " rad/s", "check the gyroscope's units and axes"),
            Obstacle::SceneDistance => ("median distance", " m", "move sideways nearer to the scene"),
            Obstacle::GyroScatter => {
                ("gyroscope scatter", " rad/s", "hold still, or move and start in flight")
            }
            Obstacle::AccelScatter => {
                ("accelerometer scatter", " m/s²", "hold still, or move and start in flight")
            }
            Obstacle::ImageMotion => ("image motion", " px", "hold still, or move and start in flight"),
            Obstacle::CameraOrientation => (
                "the camera's orientation on the IMU is off by",
                " deg",
                "check the extrinsic calibration (inverted?)",
            ),
            Obstacle::SpecificForce => ("mean specific force", " m/s²", "check the accelerometer's units"),
        };
        let sign = if self.wants_more() { '<' } else { '>' };
        write!(f, "{name} {:.3}{unit} {sign} {:.3}{unit}: {advice}", self.measured, self.limit)
    }
}
