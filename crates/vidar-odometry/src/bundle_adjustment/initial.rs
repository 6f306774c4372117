//! First guess of all states and landmarks from the odometry's log.

use super::inertial::InertialFactor;
use super::landmark::{Landmark, MIN_INVERSE_DISTANCE};
use super::log::{TrackKey, TrackLog};
use super::observation::{self, SensorCalibration};
use super::problem::CalibrationPrior;
use super::problem::{FrameState, ObservedLandmark, Problem, WhitenedObservation};
use super::{AdjustmentError, Measurements};
use crate::backend::whitening;
use crate::imu::{ImuBuffer, ImuModel, NavState, Preintegration};
use crate::pipeline::health::MAX_IMU_GAP_SECS;
use nalgebra::Vector3;
use std::collections::BTreeMap;
use vidar_core::{Duration, ImuSample, LieGroup, Se3, So3, Timestamp};

/// Nearest landmark, 1/m.
const MAX_INVERSE_DISTANCE: f64 = 20.0;

/// Rays that differ by less than this tell no distance; the landmark starts at a typical one, rad.
const MIN_PARALLAX_RAD: f64 = 2e-3;
const TYPICAL_INVERSE_DISTANCE: f64 = 0.3;

/// Tracks that are longer become several landmarks, so that the reduced system stays a band also where a body at rest sees the
/// same things for minutes: 10 s at five images per second.
pub(super) const MAX_OBSERVATIONS: usize = 50;

/// Fewest images that see a landmark.
pub(super) const MIN_OBSERVATIONS: usize = 3;

/// States to start from, of consecutive logged images.
#[derive(Clone, Debug, Default)]
pub(super) struct Guess {
    /// Which images of the log.
    pub(super) images: Vec<usize>,
    /// Instants of the states, in the IMU's clock.
    pub(super) times: Vec<Timestamp>,
    pub(super) states: Vec<NavState>,
}

impl Guess {
    /// The solution's states at the instants that its correction of the clock gives the images. Those that the IMU no longer
    /// covers, at either end, are left out.
    pub(super) fn at_corrected_clock(&self, solution: &Problem, imu: &ImuBuffer) -> Self {
        let secs = solution.calibration.clock_secs;
        let correction = Duration::from_secs_f64(secs);
        let mut corrected = Self::default();
        for (k, frame) in solution.frames.iter().enumerate() {
            let time = self.times[k] + correction;
            if imu.at(time).is_some() {
                corrected.push(self.images[k], time, frame.body.state_after(secs));
            }
        }
        corrected
    }
}

/// The problem that begins with `guess`, whose state number `held` fixes position and heading of the world.
pub(super) fn build(
    recording: &Measurements<'_>,
    calibration: &SensorCalibration,
    prior: CalibrationPrior,
    guess: &Guess,
    held: usize,
) -> Result<Problem, AdjustmentError> {
    let Measurements { log, imu, model } = *recording;
    let gain = &calibration.gain;
    let at = |(time, state): (&Timestamp, &NavState)| FrameState::new(*time, *state, imu, model, gain);
    let frames: Option<Vec<FrameState>> = guess.times.iter().zip(&guess.states).map(at).collect();
    let mut frames = frames
        .filter(|f| f.len() >= MIN_OBSERVATIONS)
        .ok_or(AdjustmentError::TooShort { images: guess.images.len() })?;
    let mut interval = Vec::new();
    for k in 1..frames.len() {
        let (from, until) = (frames[k - 1].time, frames[k].time);
        let state = frames[k - 1].body.state;
        let is_covered = imu.interval(from, until, &mut interval).is_ok();
        frames[k].inertial = is_covered.then(|| InertialFactor::new(model, &state.bias, gain, &interval));
    }
    let landmarks = triangulate(log, &guess.images, &frames, calibration);
    let gauge = (held, frames[held].body.state);
    let active = (0..calibration.dim()).filter(|k| prior.sigmas[*k] > 0.0).collect();
    Ok(Problem { frames, landmarks, calibration: calibration.clone(), prior, active, gauge })
}

/// The odometry's states of the segment that has the most: the images from its first to its last one, those without a state
/// carried by the IMU.
pub(super) fn longest_segment(
    log: &TrackLog,
    imu: &ImuBuffer,
    model: &ImuModel,
    clock_offset: Duration,
) -> (u32, Guess) {
    let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
    for state in log.images.iter().filter_map(|i| i.state.as_ref()) {
        *counts.entry(state.segment).or_default() += 1;
    }
    // Of equally long ones the first.
    let longest = counts.iter().rev().max_by_key(|(_, count)| **count).map(|(segment, _)| *segment);
    let mut guess = Guess::default();
    if let Some(segment) = longest {
        let first = log.images.iter().position(|i| i.is_of(segment)).unwrap_or(0);
        guess.take_segment(log, imu, model, clock_offset, first, Se3::IDENTITY);
    }
    (longest.unwrap_or(0), guess)
}

impl Guess {
    /// Appends the states of a segment, moved by `placed`, from its first image on; the images in between that have none are
    /// carried by the IMU.
    pub(super) fn take_segment(
        &mut self,
        log: &TrackLog,
        imu: &ImuBuffer,
        model: &ImuModel,
        clock_offset: Duration,
        first: usize,
        placed: Se3,
    ) {
        let Some(segment) = log.images[first].state.map(|s| s.segment) else { return };
        let last = log.images.iter().rposition(|i| i.is_of(segment)).unwrap_or(first);
        for image in first..=last {
            let time = log.images[image].stamp + clock_offset;
            if imu.at(time).is_none() {
                // With a corrected clock an image at either end may lie beyond the IMU's measurements.
                continue;
            }
            let state = match &log.images[image].state {
                Some(logged) => Some(logged.state.moved(&placed)),
                // The segment's first states were those of images that are left out.
                None if self.images.is_empty() => continue,
                None => self.carried_to(time, imu, model),
            };
            let Some(state) = state else { return };
            self.push(image, time, state);
        }
    }

    /// Adds a state at the end.
    pub(super) fn push(&mut self, image: usize, time: Timestamp, state: NavState) {
        self.images.push(image);
        self.times.push(time);
        self.states.push(state);
    }

    /// Adds a state at the beginning.
    pub(super) fn push_front(&mut self, image: usize, time: Timestamp, state: NavState) {
        self.images.insert(0, image);
        self.times.insert(0, time);
        self.states.insert(0, state);
    }

    /// The newest state carried to `time`; `None` where the IMU does not cover it.
    pub(super) fn carried_to(&self, time: Timestamp, imu: &ImuBuffer, model: &ImuModel) -> Option<NavState> {
        let (from, state) = (self.times.last()?, self.states.last()?);
        Some(bridge(imu, model, state, *from, time)?.predict(state))
    }

    /// The oldest state carried back to `time`.
    pub(super) fn carried_back_to(
        &self,
        time: Timestamp,
        imu: &ImuBuffer,
        model: &ImuModel,
    ) -> Option<NavState> {
        let (until, state) = (self.times.first()?, self.states.first()?);
        Some(before(state, &bridge(imu, model, state, time, *until)?))
    }
}

/// What the IMU carries a state by; nothing through a gap that the odometry does not bridge, either: half a second of interpolated
/// measurements moved a segment by 0.4 m without a word.
fn bridge(
    imu: &ImuBuffer,
    model: &ImuModel,
    state: &NavState,
    from: Timestamp,
    until: Timestamp,
) -> Option<Preintegration> {
    let mut interval = Vec::new();
    let gap = imu.interval(from, until, &mut interval).ok()?;
    let is_bridged = gap.is_none_or(|gap| gap.length.as_secs_f64() <= MAX_IMU_GAP_SECS);
    is_bridged.then(|| Preintegration::new(*model, state.bias, &interval))
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
pub(super) fn onto(pose: &Se3, target: &Se3) -> Se3 {
    let turn = target.rotation * pose.rotation.inverse();
    let forward = turn.act(&Vector3::x());
    let yaw = So3::exp(&(Vector3::z() * forward.y.atan2(forward.x)));
    Se3::new(yaw, target.translation - yaw.act(&pose.translation))
}

/// The state at the beginning of a stretch that ends in `after`.
pub(super) fn before(after: &NavState, preintegration: &Preintegration) -> NavState {
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
    calibration: &SensorCalibration,
) -> Vec<ObservedLandmark> {
    let mut tracks: BTreeMap<TrackKey, Vec<WhitenedObservation>> = BTreeMap::new();
    for (frame, index) in chain.iter().enumerate() {
        for logged in &log.images[*index].observations {
            if let Some(whitening) = whitening(&logged.covariance()) {
                tracks.entry(logged.key).or_default().push(WhitenedObservation {
                    frame,
                    pixel: logged.pixel(),
                    whitening,
                });
            }
        }
    }
    let landmark = |observations: &[WhitenedObservation]| {
        let landmark = first_guess(observations, frames, calibration)?;
        Some(ObservedLandmark { landmark, observations: observations.to_vec() })
    };
    let parts = tracks.values().flat_map(|seen| seen.chunks(MAX_OBSERVATIONS));
    parts.filter(|part| part.len() >= MIN_OBSERVATIONS).filter_map(landmark).collect()
}

/// Direction of the first observation; the inverse distance that fits the other rays best: linear least squares of
/// `(m + ρ (A − c)) × d = 0`.
pub(super) fn first_guess(
    observations: &[WhitenedObservation],
    frames: &[FrameState],
    calibration: &SensorCalibration,
) -> Option<Landmark> {
    let ray = |o: &WhitenedObservation| {
        let camera = observation::camera_pose(&frames[o.frame].body, calibration, &o.pixel);
        let row_secs = calibration.secs_from_middle(o.pixel.y);
        let pixel = frames[o.frame].body.lens.calibrated(&calibration.camera, &o.pixel, row_secs);
        Some((camera.translation, camera.rotation.act(&calibration.camera.unproject(&pixel)?)))
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

#[cfg(test)]
mod tests {
    use super::super::log::tests::log;
    use super::*;
    use vidar_core::ImuNoise;

    /// The clock leaves the first image before the IMU's measurements, and the next one has no state: the segment begins with the third.
    #[test]
    fn a_segment_begins_with_the_first_state_that_the_imu_covers() {
        let mut log = log(8);
        log.images[1].state = None;
        let (imu, model) = (log.imu(), ImuModel::from_data_sheet(&ImuNoise::EUROC, 2.0, 2.0));
        let guess = |clock_ms| longest_segment(&log, &imu, &model, Duration::from_millis(clock_ms)).1;
        assert_eq!(guess(-50).images, [2, 3, 4, 5, 6, 7]);
        assert_eq!(guess(5).images, [0, 1, 2, 3, 4, 5, 6, 7], "carried where a state is known before");
    }
}
