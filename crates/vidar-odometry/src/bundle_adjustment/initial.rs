//! First guess of all states and landmarks from the odometry's log.

use super::log::{LoggedImage, TrackKey, TrackLog};
use super::observation::{self, Calibration, Landmark, MIN_INVERSE_DISTANCE};
use super::problem::{FrameState, Observation, ObservedLandmark, Problem};
use super::{AdjustmentError, CalibrationPrior};
use crate::backend::whitening;
use crate::imu::{ImuBuffer, ImuModel, NavState, Preintegration};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use vidar_core::{Duration, ImuSample, LieGroup, Se3, So3, Timestamp};

/// Longest stretch without a state that the IMU alone carries, s: at 0.03 m/s² of error 0.4 m, which the tracks that run
/// through it then correct.
const MAX_BRIDGE_SECS: f64 = 5.0;

/// Nearest landmark, 1/m.
const MAX_INVERSE_DISTANCE: f64 = 20.0;

/// Rays that differ by less than this tell no distance; the landmark starts at a typical one, rad.
const MIN_PARALLAX_RAD: f64 = 2e-3;
const TYPICAL_INVERSE_DISTANCE: f64 = 0.3;

/// Fewest images that see a landmark.
const MIN_OBSERVATIONS: usize = 3;

/// States to start from, of consecutive logged images.
#[derive(Clone, Debug)]
pub(super) struct Guess {
    /// Which images of the log.
    pub(super) images: Vec<usize>,
    /// Instants of the states, in the IMU's clock.
    times: Vec<Timestamp>,
    states: Vec<NavState>,
}

impl Guess {
    /// The solution's states at the instants that its correction of the clock gives the images.
    pub(super) fn at_corrected_clock(&self, solution: &Problem) -> Self {
        let secs = solution.calibration.clock_secs;
        let correction = Duration::from_secs_f64(secs);
        Self {
            images: self.images.clone(),
            times: self.times.iter().map(|t| *t + correction).collect(),
            states: solution.frames.iter().map(|f| f.body.state_after(secs)).collect(),
        }
    }
}

/// The problem that begins with `guess`.
pub(super) fn build(
    log: &TrackLog,
    imu: &ImuBuffer,
    model: &ImuModel,
    calibration: &Calibration,
    prior: CalibrationPrior,
    guess: &Guess,
) -> Result<Problem, AdjustmentError> {
    let at = |(time, state): (&Timestamp, &NavState)| FrameState::new(*time, *state, imu, model);
    let frames: Option<Vec<FrameState>> = guess.times.iter().zip(&guess.states).map(at).collect();
    let mut frames = frames
        .filter(|f| f.len() >= MIN_OBSERVATIONS)
        .ok_or(AdjustmentError::TooShort { images: guess.images.len() })?;
    let mut interval = Vec::new();
    for k in 1..frames.len() {
        let (from, until) = (frames[k - 1].time, frames[k].time);
        let state = frames[k - 1].body.state;
        frames[k].preintegration = preintegrate(imu, model, &state, from, until, &mut interval);
    }
    let landmarks = triangulate(log, &guess.images, &frames, calibration);
    let gauge = frames[0].body.state;
    let active = (0..calibration.dim()).filter(|k| prior.sigmas[*k] > 0.0).collect();
    Ok(Problem { frames, landmarks, calibration: calibration.clone(), prior, active, gauge })
}

/// Indices of the longest run of images whose states are known or within reach of one that is.
fn longest_chain(log: &TrackLog, imu: &ImuBuffer, clock_offset: Duration) -> Vec<usize> {
    let covered = |image: &LoggedImage| imu.at(image.stamp + clock_offset).is_some();
    let known: Vec<Timestamp> = log.images.iter().filter(|i| i.state.is_some()).map(|i| i.stamp).collect();
    let near = |time: Timestamp| {
        let after = known.partition_point(|k| *k < time);
        let before = after.checked_sub(1).and_then(|k| known.get(k));
        let secs = |other: &Timestamp| (*other - time).as_secs_f64().abs();
        known.get(after).into_iter().chain(before).any(|k| secs(k) <= MAX_BRIDGE_SECS)
    };
    let mut chains: Vec<Vec<usize>> = vec![Vec::new()];
    for (index, image) in log.images.iter().enumerate() {
        let gap = chains.last().and_then(|c| c.last()).map(|last| image.stamp - log.images[*last].stamp);
        if !covered(image) || !near(image.stamp) || gap.is_some_and(|g| g.as_secs_f64() > MAX_BRIDGE_SECS) {
            chains.push(Vec::new());
        }
        if covered(image)
            && near(image.stamp)
            && let Some(chain) = chains.last_mut()
        {
            chain.push(index);
        }
    }
    let states = |c: &Vec<usize>| c.iter().filter(|k| log.images[**k].state.is_some()).count();
    // Of equally long ones the first.
    chains.into_iter().rev().max_by_key(states).unwrap_or_default()
}

/// States of the longest chain in one world: the odometry's where it has them, carried by the IMU where it has none. The world is that of
/// the first segment; later ones are turned about the vertical and moved to where the IMU arrives.
pub(super) fn chained_states(
    log: &TrackLog,
    imu: &ImuBuffer,
    model: &ImuModel,
    clock_offset: Duration,
) -> Guess {
    let chain = longest_chain(log, imu, clock_offset);
    let time = |index: &usize| log.images[*index].stamp + clock_offset;
    let mut interval = Vec::new();
    let mut states: Vec<Option<NavState>> = Vec::with_capacity(chain.len());
    let mut placed: Option<(u32, Se3)> = None;
    for (k, index) in chain.iter().enumerate() {
        let arrived = (k > 0).then(|| states[k - 1]).flatten().and_then(|before: NavState| {
            let (from, until) = (time(&chain[k - 1]), time(index));
            Some(preintegrate(imu, model, &before, from, until, &mut interval)?.predict(&before))
        });
        let Some(logged) = &log.images[*index].state else {
            states.push(arrived);
            continue;
        };
        let here = match (placed, arrived) {
            (Some((segment, here)), _) if segment == logged.segment => here,
            (_, None) => Se3::IDENTITY,
            (_, Some(arrived)) => onto(&logged.state.world_from_body, &arrived.world_from_body),
        };
        placed = Some((logged.segment, here));
        states.push(Some(NavState {
            world_from_body: here * logged.state.world_from_body,
            velocity: here.rotation * logged.state.velocity,
            bias: logged.state.bias,
        }));
    }
    // What lies before the first state is carried backwards.
    for k in (0..chain.len().saturating_sub(1)).rev() {
        if states[k].is_none()
            && let Some(after) = states[k + 1]
        {
            let (from, until) = (time(&chain[k]), time(&chain[k + 1]));
            states[k] =
                preintegrate(imu, model, &after, from, until, &mut interval).map(|p| before(&after, &p));
        }
    }
    // Where the IMU has a gap, the chain ends.
    let first = states.iter().position(Option::is_some).unwrap_or(0);
    let states: Vec<NavState> = states[first..].iter().map_while(|s| *s).collect();
    let images = chain[first..first + states.len()].to_vec();
    Guess { times: images.iter().map(time).collect(), images, states }
}

pub(super) fn preintegrate(
    imu: &ImuBuffer,
    model: &ImuModel,
    state: &NavState,
    from: Timestamp,
    until: Timestamp,
    interval: &mut Vec<ImuSample>,
) -> Option<Preintegration> {
    imu.interval(from, until, interval).ok()?;
    Some(Preintegration::new(*model, state.bias, interval))
}

/// The turn about the vertical and the shift that bring a pose of one levelled world to where it is in another.
fn onto(pose: &Se3, target: &Se3) -> Se3 {
    let turn = target.rotation * pose.rotation.inverse();
    let forward = turn.act(&Vector3::x());
    let yaw = So3::exp(&(Vector3::z() * forward.y.atan2(forward.x)));
    Se3::new(yaw, target.translation - yaw.act(&pose.translation))
}

/// The state at the beginning of a stretch that ends in `after`.
fn before(after: &NavState, preintegration: &Preintegration) -> NavState {
    let (turn, position, velocity) = preintegration.corrected(&after.bias);
    let t = preintegration.secs();
    let gravity = preintegration.model().gravity();
    let rotation = after.world_from_body.rotation * turn.inverse();
    let velocity_before = after.velocity - gravity * t - rotation.act(&velocity);
    let place = after.world_from_body.translation
        - velocity_before * t
        - gravity * (0.5 * t * t)
        - rotation.act(&position);
    NavState { world_from_body: Se3::new(rotation, place), velocity: velocity_before, bias: after.bias }
}

/// Landmarks from all tracks, in the order of their keys.
fn triangulate(
    log: &TrackLog,
    chain: &[usize],
    frames: &[FrameState],
    calibration: &Calibration,
) -> Vec<ObservedLandmark> {
    let mut tracks: BTreeMap<TrackKey, Vec<Observation>> = BTreeMap::new();
    for (frame, index) in chain.iter().enumerate() {
        for logged in &log.images[*index].observations {
            if let Some(whitening) = whitening(&logged.covariance()) {
                tracks.entry(logged.key).or_default().push(Observation {
                    frame,
                    pixel: logged.pixel(),
                    whitening,
                });
            }
        }
    }
    tracks.retain(|_, seen| seen.len() >= MIN_OBSERVATIONS);
    let landmark = |observations: Vec<Observation>| {
        let landmark = first_guess(&observations, frames, calibration)?;
        Some(ObservedLandmark { landmark, observations })
    };
    tracks.into_values().filter_map(landmark).collect()
}

/// Direction of the first observation; the inverse distance that fits the other rays best: linear least squares of
/// `(m + ρ (A − c)) × d = 0`.
pub(super) fn first_guess(
    observations: &[Observation],
    frames: &[FrameState],
    calibration: &Calibration,
) -> Option<Landmark> {
    let ray = |o: &Observation| {
        let camera = observation::camera_pose(&frames[o.frame].body, calibration, &o.pixel);
        Some((camera.translation, camera.rotation.act(&calibration.camera.unproject(&o.pixel)?)))
    };
    let (origin, direction) = ray(observations.first()?)?;
    let (mut across, mut along, mut widest) = (0.0, 0.0, 0.0_f64);
    for (place, other) in observations[1..].iter().filter_map(ray) {
        let (a, b) = (direction.cross(&other), (origin - place).cross(&other));
        across -= b.dot(&a);
        along += b.norm_squared();
        widest = widest.max(a.norm());
    }
    let told = widest > MIN_PARALLAX_RAD && along > 0.0;
    let inverse = if told { across / along } else { TYPICAL_INVERSE_DISTANCE };
    let inverse = if inverse > 0.0 { inverse } else { MIN_INVERSE_DISTANCE };
    Some(Landmark { direction, inverse_distance: inverse.min(MAX_INVERSE_DISTANCE), origin })
}
