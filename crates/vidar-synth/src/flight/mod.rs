//! The exact flight: a pose for every instant, with the derivatives that an IMU feels.
//!
//! Whatever the source, built in or a recorded trajectory, the flight is a quintic B-spline over poses every 50 ms
//! ([`spline`]); what is written as truth, what the camera sees and what the IMU reads come from that one curve.

mod builtin;
mod handheld;
mod recorded;
mod spline;

pub use spline::FlightState;

use crate::config::{Start, SynthConfig};
use crate::device::Mount;
use crate::error::SynthError;
use crate::extent::Extent;
use nalgebra::Vector3;
use spline::{LEAD, ORDER, PoseSpline};
use vidar_core::{Se3, Trajectory};

/// Time between control poses, s. Quintic splines of this spacing follow motion up to about 5 Hz.
const INTERVAL_SECS: f64 = 0.05;

/// How far the curve goes on before the first and after the last instant, s: room for an exposure.
const MARGIN_SECS: f64 = 0.2;

/// Time in which a body at rest reaches the flight's own speed, s.
const RAMP_SECS: f64 = 2.0;

/// Motion of the body over time, with exact derivatives. Time is in seconds after the sequence's beginning.
#[derive(Clone, Debug)]
pub struct FlightPath {
    spline: PoseSpline,
    duration_secs: f64,
}

impl FlightPath {
    /// The flight that `config` asks for: through `trajectory` when there is one, else the built-in one.
    ///
    /// # Errors
    /// A key outside its domain, or a trajectory that cannot be flown (see [`FlightPath::from_trajectory`]).
    pub fn new(config: &SynthConfig, trajectory: Option<&Trajectory>) -> Result<Self, SynthError> {
        match trajectory {
            Some(trajectory) => Self::from_trajectory(trajectory, config),
            None => Self::built_in(config),
        }
    }

    /// The built-in flight `config.flight` through `config.scene`.
    pub fn built_in(config: &SynthConfig) -> Result<Self, SynthError> {
        config.validate()?;
        let time_map = TimeMap::new(config.start, 0.0);
        let poses = Self::built_in_poses(config, &time_map);
        // The built-in flights are what the spline makes of them; nothing need be passed through.
        let spline = PoseSpline::new(-margin_secs(), INTERVAL_SECS, &poses);
        Ok(Self { spline, duration_secs: config.duration_secs })
    }

    /// Control poses of the body on the built-in flight.
    fn built_in_poses(config: &SynthConfig, time_map: &TimeMap) -> Vec<Se3> {
        use vidar_core::LieGroup;
        let times = control_times(config.duration_secs);
        let camera_from_body = config.body_from_camera().inverse();
        if let Some(path) = handheld::Handheld::new(config) {
            let at = |t: f64| {
                path.world_from_camera(time_map.source_secs(t), t, time_map.lift(t)) * camera_from_body
            };
            return times.map(at).collect();
        }
        let course = builtin::Course::new(config);
        let euroc = times.map(|t| course.world_from_body(time_map.source_secs(t), time_map.lift(t)));
        if config.device.mount == Mount::Euroc {
            return euroc.collect();
        }
        // Courses are those of EuRoC's body; another mount keeps the camera where it was.
        let euroc_from_body = crate::rig::euroc_body_from_camera() * camera_from_body;
        euroc.map(|world_from_euroc| world_from_euroc * euroc_from_body).collect()
    }

    /// A flight through a recorded trajectory of the body or of a camera of EuRoC's rig, z up.
    ///
    /// Jitter is smoothed by `config.trajectory_smoothing_secs`; `config.start` decides whether the body first rests
    /// at the first pose. The flight ends with the trajectory or after `config.duration_secs`.
    ///
    /// # Errors
    /// Fewer than 4 poses, less than a second of flight, a gap of more than a second, or a body that the rig lacks.
    pub fn from_trajectory(trajectory: &Trajectory, config: &SynthConfig) -> Result<Self, SynthError> {
        config.validate()?;
        let source = recorded::Recorded::new(trajectory, config)?;
        let lead_in = if config.start == Start::InFlight { MARGIN_SECS } else { 0.0 };
        let time_map = TimeMap::new(config.start, lead_in);
        let available = time_map.sequence_secs(source.duration_secs() - MARGIN_SECS);
        let duration_secs = config.duration_secs.min(available);
        let poses: Vec<Se3> =
            control_times(duration_secs).map(|t| source.world_from_body(time_map.source_secs(t))).collect();
        let resting = match config.start {
            Start::Static { secs } => ((secs + margin_secs()) / INTERVAL_SECS) as usize + ORDER,
            Start::InFlight => 0,
        };
        let spline = PoseSpline::through(-margin_secs(), INTERVAL_SECS, &poses, resting, 40);
        Ok(Self { spline, duration_secs })
    }

    /// Length of the flight, s.
    pub fn duration_secs(&self) -> f64 {
        self.duration_secs
    }

    /// Pose and derivatives at `secs`; outside the flight (by more than an exposure) the curve means nothing.
    pub fn state(&self, secs: f64) -> FlightState {
        self.spline.state(secs)
    }

    /// Pose of the body at `secs`.
    pub fn world_from_body(&self, secs: f64) -> Se3 {
        self.state(secs).world_from_body
    }

    /// What a perfect accelerometer reads at `secs`, in the body frame, m/s²: `R⁻¹ (a − g)`.
    pub fn specific_force(&self, secs: f64) -> Vector3<f64> {
        let state = self.state(secs);
        let gravity = Vector3::new(0.0, 0.0, -vidar_core::GRAVITY_MPS2);
        let rotation = state.world_from_body.rotation;
        use vidar_core::LieGroup;
        rotation.inverse() * (state.acceleration_in_world - gravity)
    }

    /// Positions of the body every `step_secs`, ends included.
    pub fn positions(&self, step_secs: f64) -> Vec<Vector3<f64>> {
        let n = (self.duration_secs / step_secs).ceil().max(1.0) as usize;
        let at = |k: usize| self.duration_secs * k as f64 / n as f64;
        (0..=n).map(|k| self.world_from_body(at(k)).translation).collect()
    }

    /// Length of the path, m, by chords of 10 ms.
    pub fn path_length_m(&self) -> f64 {
        self.positions(0.01).windows(2).map(|w| (w[1] - w[0]).norm()).sum()
    }

    /// The smallest box that holds the path.
    pub(crate) fn extent(&self) -> Extent {
        Extent::around(&self.positions(0.02))
    }
}

/// Time before zero that control poses cover: the margin, and what the spline's order needs, in whole intervals.
fn margin_secs() -> f64 {
    ((MARGIN_SECS / INTERVAL_SECS).ceil() + LEAD as f64) * INTERVAL_SECS
}

fn control_times(duration_secs: f64) -> impl Iterator<Item = f64> {
    let n = ((duration_secs + 2.0 * margin_secs()) / INTERVAL_SECS).ceil() as usize + ORDER;
    (0..n).map(|k| k as f64 * INTERVAL_SECS - margin_secs())
}

/// How time in the sequence becomes time on the source's course.
struct TimeMap {
    start: Start,
    /// Time on the course at the sequence's beginning, s.
    lead_in_secs: f64,
}

impl TimeMap {
    fn new(start: Start, lead_in_secs: f64) -> Self {
        Self { start, lead_in_secs }
    }

    /// Time on the course; its rate goes from 0 to 1 by the quintic smooth step, whose integral is written out.
    fn source_secs(&self, t: f64) -> f64 {
        match self.start {
            Start::InFlight => t + self.lead_in_secs,
            Start::Static { secs } => {
                let x = ((t - secs) / RAMP_SECS).max(0.0);
                let ramped = if x < 1.0 {
                    RAMP_SECS * x * x * x * x * (x * x - 3.0 * x + 2.5)
                } else {
                    RAMP_SECS * (x - 0.5)
                };
                ramped + self.lead_in_secs
            }
        }
    }

    /// Time in the sequence at which the course's time is `source_secs` (of the part after the ramp).
    fn sequence_secs(&self, source_secs: f64) -> f64 {
        match self.start {
            Start::InFlight => source_secs - self.lead_in_secs,
            Start::Static { secs } => source_secs - self.lead_in_secs + secs + 0.5 * RAMP_SECS,
        }
    }

    /// How far the body has lifted from the ground, 0…1.
    fn lift(&self, t: f64) -> f64 {
        match self.start {
            Start::InFlight => 1.0,
            Start::Static { secs } => smooth_step((t - secs) / (1.25 * RAMP_SECS)),
        }
    }
}

/// The quintic smooth step: 0 below 0, 1 above 1, twice continuously differentiable.
pub(crate) fn smooth_step(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (x * (6.0 * x - 15.0) + 10.0)
}

#[cfg(test)]
mod tests;
