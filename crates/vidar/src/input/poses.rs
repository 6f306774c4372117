//! Where the metric poses of a run come from, and ground truth to compare with.

use super::{MetricTrajectory, TrajectorySource};
use crate::config::{Config, PoseSource as PoseChoice};
use crate::engine::{GivenPoses, OdometryPoses, PoseSource};
use crate::error::Error;
use crate::odometry::EarlierMap;
use vidar_align::CouplingMode;
use vidar_core::{BodyFrame, Duration, StampedPose, Trajectory, TrajectoryError, Warning};
use vidar_dataset::{CalibrationSource, Recording};

/// Where a run takes its poses from, decided before anything is tracked.
#[derive(Clone, Debug)]
pub enum PosePlan {
    /// Nowhere: the coupling needs none.
    None,
    /// A given trajectory.
    Given(MetricTrajectory),
    /// Odometry; where it gives none, the fallback.
    Odometry {
        /// Ground truth, where `input.poses` is `auto` and there is any.
        fallback: Option<MetricTrajectory>,
    },
}

impl PosePlan {
    /// What the configuration asks for, of what the recording has.
    ///
    /// # Errors
    /// [`Error::NoMetricTrajectory`] where the coupling needs poses and there are none; a calibration that is only guessed.
    pub fn new(dataset: &Recording, config: &Config) -> Result<Self, Error> {
        let mode = config.coupling.mode;
        let choice = asked_for(config);
        let external = dataset
            .external_trajectory
            .as_ref()
            .map(|t| (&t.trajectory, TrajectorySource::External { file: t.source.display().to_string() }));
        let truth = dataset.ground_truth.as_ref().map(|t| (t, TrajectorySource::GroundTruth));
        let in_use = |(trajectory, source): (&Trajectory, TrajectorySource)| {
            let camera = BodyFrame::Camera(dataset.camera);
            let camera_trajectory = trajectory.in_frame(camera, &dataset.rig)?;
            Ok::<_, Error>(MetricTrajectory { source, camera_trajectory })
        };
        let given = match choice {
            PoseChoice::Odometry if is_usable_camera(dataset, mode) => {
                return Ok(Self::Odometry { fallback: None });
            }
            PoseChoice::Odometry => None,
            PoseChoice::Auto if external.is_none() && Imu::of(dataset, mode) == Imu::Usable => {
                // Ground truth of a body whose place on the rig is not known is no fallback; the evaluation says so.
                return Ok(Self::Odometry { fallback: truth.and_then(|truth| in_use(truth).ok()) });
            }
            PoseChoice::External => external,
            PoseChoice::GroundTruth => truth,
            PoseChoice::Auto => external.or(truth),
        };
        match given {
            Some(given) => in_use(given).map(Self::Given),
            None if mode.uses_pose_priors() => Err(Error::NoMetricTrajectory { name: dataset.name.clone() }),
            None => Ok(Self::None),
        }
    }

    /// Where poses come from, as far as it is known before tracking.
    pub fn source(&self) -> Option<TrajectorySource> {
        match self {
            Self::None => None,
            Self::Given(trajectory) => Some(trajectory.source.clone()),
            Self::Odometry { .. } => Some(TrajectorySource::Odometry),
        }
    }

    /// What the user should know where ground truth serves without having been asked for. It is the ordinary use of a recording without
    /// an IMU; an IMU that cannot be used is a degradation.
    pub fn warning(&self, dataset: &Recording, config: &Config) -> Option<Warning> {
        let is_ground_truth = self.source() == Some(TrajectorySource::GroundTruth);
        if !is_ground_truth || asked_for(config) != PoseChoice::Auto {
            return None;
        }
        let mode = config.coupling.mode;
        let used = match mode.uses_pose_priors() {
            true => "poses are the dataset's ground truth, and scores are an upper bound",
            false => "keyframes are selected by the dataset's ground truth",
        };
        let warning = match Imu::of(dataset, mode) {
            Imu::Usable => return None,
            Imu::None => Warning::new(
                "ground-truth-used",
                format!("the recording has no IMU for the odometry: {used}"),
            ),
            Imu::Unusable(reason) => Warning::degraded(
                "odometry-not-used",
                format!("the odometry cannot use the IMU ({reason}): {used}"),
            ),
        };
        Some(
            warning
                .hint("--trajectory FILE gives other poses; --set input.poses=ground-truth asks for these"),
        )
    }

    /// The given trajectory as a source of poses.
    pub fn given(&self, dataset: &Recording, config: &Config) -> Option<GivenPoses> {
        match self {
            Self::Given(trajectory) => Some(given_poses(trajectory, dataset, config)),
            Self::None | Self::Odometry { .. } => None,
        }
    }

    /// The trajectory that serves where the odometry gives no pose.
    pub fn fallback(&self, dataset: &Recording, config: &Config) -> Option<GivenPoses> {
        match self {
            Self::Odometry { fallback: Some(trajectory) } => Some(given_poses(trajectory, dataset, config)),
            Self::None | Self::Given(_) | Self::Odometry { fallback: None } => None,
        }
    }

    /// Whether they come from the recording's own camera and IMU.
    pub fn is_odometry(&self) -> bool {
        matches!(self, Self::Odometry { .. })
    }

    /// Sources of poses for the engine: the one that is planned, and its fallback.
    ///
    /// # Errors
    /// Settings or calibration that the odometry refuses.
    #[allow(clippy::type_complexity)] // two sources of one kind, named by their place in `EngineSetup`
    pub fn open(
        &self,
        dataset: &Recording,
        config: &Config,
    ) -> Result<(Option<Box<dyn PoseSource>>, Option<Box<dyn PoseSource>>), Error> {
        let boxed = |poses: GivenPoses| Box::new(poses) as Box<dyn PoseSource>;
        Ok(match self {
            Self::None => (None, None),
            Self::Given(trajectory) => (Some(boxed(given_poses(trajectory, dataset, config))), None),
            Self::Odometry { fallback } => {
                let earlier = EarlierMap::of(config)?;
                let map = earlier.as_ref().map(|earlier| &earlier.map);
                let odometry = OdometryPoses::new(&dataset.rig, dataset.camera, &config.odometry, map)?;
                let fallback = fallback.as_ref().map(|t| boxed(given_poses(t, dataset, config)));
                (Some(Box::new(odometry)), fallback)
            }
        })
    }
}

fn given_poses(trajectory: &MetricTrajectory, dataset: &Recording, config: &Config) -> GivenPoses {
    // Poses are in the IMU's clock: t_imu = t_camera + offset.
    let offset = dataset.rig.camera(dataset.camera).map_or(Duration::ZERO, |c| c.time_offset);
    GivenPoses::new(trajectory.clone(), offset, Duration::from_secs_f64(config.input.max_pose_gap_secs))
}

/// Which poses the configuration asks for.
fn asked_for(config: &Config) -> PoseChoice {
    match config.coupling.mode {
        CouplingMode::GroundTruth => PoseChoice::GroundTruth,
        _ => config.input.poses,
    }
}

/// Odometry of a guessed camera leads nowhere; what is not metric does without. Metric modes refuse such a camera.
fn is_usable_camera(dataset: &Recording, mode: CouplingMode) -> bool {
    mode.uses_pose_priors() || dataset.calibration != CalibrationSource::Guessed
}

/// The IMU of a recording, for the odometry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Imu {
    /// There is none.
    None,
    /// There is one, which cannot be used for this reason.
    Unusable(&'static str),
    /// There is one.
    Usable,
}

impl Imu {
    fn of(dataset: &Recording, mode: CouplingMode) -> Self {
        match (dataset.rig.imu.is_some(), dataset.imu.is_empty()) {
            (false, true) => Self::None,
            (true, true) => Self::Unusable("it has no samples in this part of the recording"),
            (false, false) => Self::Unusable("its noise is not known"),
            (true, false) if !is_usable_camera(dataset, mode) => {
                Self::Unusable("the camera has no calibration")
            }
            (true, false) => Self::Usable,
        }
    }
}

/// Ground truth of the camera in use at the images' stamps, where there is any.
///
/// # Errors
/// The place of its body on the rig is not known.
pub fn truth_in_camera(dataset: &Recording) -> Result<Option<Trajectory>, TrajectoryError> {
    truth_of(BodyFrame::Camera(dataset.camera), dataset)
}

/// The same of the IMU.
///
/// # Errors
/// As [`truth_in_camera`].
pub fn truth_in_imu(dataset: &Recording) -> Result<Option<Trajectory>, TrajectoryError> {
    truth_of(BodyFrame::Imu, dataset)
}

/// That a comparison with a reference was not possible.
pub(crate) fn not_evaluated(what: &str, reason: &dyn std::fmt::Display) -> Warning {
    Warning::degraded("not-evaluated", format!("{what}: {reason}"))
}

fn truth_of(frame: BodyFrame, dataset: &Recording) -> Result<Option<Trajectory>, TrajectoryError> {
    let Some(truth) = &dataset.ground_truth else { return Ok(None) };
    let truth = truth.in_frame(frame, &dataset.rig)?;
    // Ground truth is in the IMU's clock: t_imu = t_camera + offset.
    let offset = dataset.rig.camera(dataset.camera).map_or(Duration::ZERO, |c| c.time_offset);
    let stamped = |p: &StampedPose| StampedPose { time: p.time - offset, ..*p };
    Trajectory::new(frame, truth.poses().iter().map(stamped).collect()).map(Some)
}
