//! Starts, and what becomes of them.

use super::flights::Flown;
use nalgebra::Vector3;
use vidar_core::{FrameId, ImuNoise, LieGroup};
use vidar_odometry::backend::Smoother;
use vidar_odometry::imu::NavState;
use vidar_odometry::initialization::{MAX_LOG_SCALE_SIGMA, StaticInitConfig, initialize_static};
use vidar_odometry::simulate::{
    FeatureOdometry, FeatureOdometryConfig, Flight, Simulation, SimulationConfig, StepOutput,
};
use vidar_synth::{FlightKind, FlightPath, SynthConfig};

/// How long a start in flight may take, s.
const PATIENCE_SECS: f64 = 10.0;

/// How long a body rests before it leaves, s.
pub const REST_SECS: f64 = 1.0;

/// From this error of the body's velocity on, a state is called lost, m/s.
const LOST_MPS: f64 = 0.5;

/// A window whose frames lie nearer together than this (root mean square) does not determine the scale by its extent, m.
const RESTING_M: f64 = 0.05;

/// Error of log(scale): of the window's extent, or where the body hardly moves (and noise would be all of it), the median
/// over the scene's distances.
fn log_scale_error(smoother: &Smoother, simulation: &Simulation) -> f64 {
    let truth = |id: FrameId| simulation.frames[id.index()].truth.world_from_body;
    let ids: Vec<FrameId> = smoother.frames().collect();
    let spread = |places: Vec<Vector3<f64>>| {
        let mean = places.iter().sum::<Vector3<f64>>() / places.len() as f64;
        places.iter().map(|p| (p - mean).norm_squared()).sum::<f64>().sqrt()
    };
    let found = ids.iter().map(|id| smoother.state(*id).unwrap().world_from_body.translation).collect();
    let extent = spread(ids.iter().map(|id| truth(*id).translation).collect());
    if extent > RESTING_M * (ids.len() as f64).sqrt() {
        return (spread(found) / extent).ln();
    }
    let ratio = |l: vidar_odometry::backend::LandmarkEstimate| {
        let camera = truth(l.host) * simulation.body_from_camera;
        Some(-(l.inverse_distance * (simulation.point(l.id)? - camera.translation).norm()).ln())
    };
    quantile(smoother.landmarks().filter_map(ratio).collect(), 0.5)
}

/// What became of one start.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    pub name: String,
    pub from_secs: f64,
    /// Time until it was accepted.
    pub waited_secs: Option<f64>,
    /// Why it was not, at last.
    pub failure: String,
    /// Error of log(scale) when it was accepted, and its stated standard deviation.
    pub at_acceptance: f64,
    pub sigma: f64,
    /// Errors in the end: log(scale), and the body's velocity, m/s.
    pub later: f64,
    pub velocity_mps: f64,
    /// Error of log(scale) over its stated standard deviation, [`SCALE_TOLD_SECS`] after the start.
    pub normalised: Vec<f64>,
}

/// When the stated scale of a running state is compared with the truth, s after its start.
pub const SCALE_TOLD_SECS: [f64; 4] = [0.5, 2.0, 5.0, 10.0];

impl Outcome {
    pub fn is_lost(&self) -> bool {
        self.waited_secs.is_some() && !(self.velocity_mps < LOST_MPS)
    }
}

fn velocity_error(state: &NavState, truth: &NavState) -> f64 {
    let in_body = |s: &NavState| s.world_from_body.rotation.inverse() * s.velocity;
    (in_body(state) - in_body(truth)).norm()
}

/// Starts in flight at `from_secs` and flies on for `later_secs`.
pub fn start_in_flight(flight: &impl Flight, from_secs: f64, later_secs: f64, seed: u64) -> Outcome {
    start_with(flight, from_secs, later_secs, &SimulationConfig { seed, ..Default::default() })
}

fn start_with(flight: &impl Flight, from_secs: f64, later_secs: f64, settings: &SimulationConfig) -> Outcome {
    let simulation = Simulation::new(flight, from_secs, PATIENCE_SECS + later_secs, settings);
    let config = FeatureOdometryConfig::new(&settings.noise, 2.0);
    let mut odometry = FeatureOdometry::for_simulation(config, &simulation).unwrap();
    let mut outcome = Outcome { from_secs, ..Default::default() };
    for (k, frame) in simulation.frames.iter().enumerate() {
        let secs = k as f64 / settings.camera_rate_hz;
        match odometry.push(frame.id, frame.time, &frame.observations).unwrap() {
            StepOutput::Initialised { log_scale_sigma, .. } => {
                outcome.waited_secs = Some(secs);
                outcome.at_acceptance = log_scale_error(odometry.smoother().unwrap(), &simulation);
                outcome.sigma = log_scale_sigma;
            }
            StepOutput::Waiting(_) if secs > PATIENCE_SECS => return outcome,
            StepOutput::Waiting(Some(failure)) => outcome.failure = failure.to_string(),
            StepOutput::Waiting(None) => {}
            StepOutput::Tracking(state) => outcome.velocity_mps = velocity_error(&state, &frame.truth),
        }
        let told = SCALE_TOLD_SECS.get(outcome.normalised.len());
        if let (Some(at), Some(after)) = (outcome.waited_secs, told)
            && secs >= at + after
        {
            let smoother = odometry.smoother().unwrap();
            let sigma = smoother.log_scale_sigma().unwrap();
            outcome.normalised.push(log_scale_error(smoother, &simulation) / sigma);
        }
        if outcome.waited_secs.is_some_and(|at| secs >= at + later_secs) {
            break;
        }
    }
    if outcome.waited_secs.is_some() {
        outcome.later = log_scale_error(odometry.smoother().unwrap(), &simulation);
    }
    outcome
}

/// Starts from the rest that `flight` begins with, and flies on for `later_secs`. At rest the scale is not observable: it counts
/// as accepted with the first frame at which its stated σ is as well as a start in flight must know it.
pub fn start_from_rest(flight: &impl Flight, later_secs: f64, seed: u64) -> Outcome {
    let settings = SimulationConfig { seed, ..Default::default() };
    let simulation = Simulation::new(flight, 0.0, REST_SECS + 1.0 + later_secs, &settings);
    let config = FeatureOdometryConfig::new(&ImuNoise::EUROC, 2.0);
    let mut odometry = FeatureOdometry::for_simulation(config, &simulation).unwrap();
    let mut outcome = Outcome::default();
    let rate = settings.camera_rate_hz;
    let first = (0.8 * rate) as usize;
    let begin = simulation.frames[first].time;
    let imu_samples: Vec<_> = simulation.imu_samples.iter().filter(|r| r.time <= begin).copied().collect();
    let rest = match initialize_static(&imu_samples, None, &StaticInitConfig::default()) {
        Ok(rest) => rest,
        Err(failure) => return Outcome { failure: failure.to_string(), ..outcome },
    };
    odometry.start_at(&simulation.frames[first], rest.state, rest.sigmas).unwrap();
    let limit = MAX_LOG_SCALE_SIGMA;
    for (k, frame) in simulation.frames.iter().enumerate().skip(first + 1) {
        let StepOutput::Tracking(state) = odometry.push(frame.id, frame.time, &frame.observations).unwrap()
        else {
            unreachable!("it was started")
        };
        outcome.velocity_mps = velocity_error(&state, &frame.truth);
        if outcome.waited_secs.is_none() {
            let smoother = odometry.smoother().unwrap();
            outcome.sigma = smoother.log_scale_sigma().unwrap();
            outcome.at_acceptance = log_scale_error(smoother, &simulation);
            outcome.waited_secs = (outcome.sigma <= limit).then_some(k as f64 / rate - REST_SECS);
            outcome.failure = format!("std(log scale) {:.3} > {limit}", outcome.sigma);
        }
    }
    outcome.later = log_scale_error(odometry.smoother().unwrap(), &simulation);
    outcome
}

/// A hand-held path of `seed` with a consumer IMU, and what its start `from_secs` on became.
pub fn start_in_hand(kind: FlightKind, seed: u64, from_secs: f64, later_secs: f64) -> Outcome {
    let preset = match kind {
        FlightKind::HandheldLively => SynthConfig::phone_fast(),
        _ => SynthConfig::phone_slow(),
    };
    let config = SynthConfig { seed, ..preset };
    let flight = Flown(FlightPath::built_in(&config).unwrap());
    let noise = config.imu_noise;
    let settings = SimulationConfig { seed, noise, imu_rate_hz: noise.rate_hz, ..Default::default() };
    start_with(&flight, from_secs, later_secs, &settings)
}

pub fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get((values.len() as f64 * share) as usize).copied().unwrap_or(f64::NAN)
}
