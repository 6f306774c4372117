//! The unknowns of the adjustment and what was measured of them.

use super::envelope::Envelope;
use super::image_prior::ImagePrior;
use super::inertial::{GAIN_DIM, ImuGain, InertialFactor};
use super::landmark::Landmark;
use super::observation::{MovingBody, STATE_DIM, SensorCalibration};
use crate::imu::{ImuBuffer, ImuModel, NavState};
use nalgebra::{Matrix2, Vector3};
use vidar_core::{LensMotion, Timestamp, camera::Pixel};

/// Unknowns of a state: rotation, position, velocity, biases of gyroscope and accelerometer.
pub(super) const FRAME_DIM: usize = 15;

/// A state of the chain.
#[derive(Clone, Debug)]
pub(super) struct FrameState {
    /// Instant of the state, in the IMU's clock.
    pub(super) time: Timestamp,
    pub(super) body: MovingBody,
    /// Inertial factor from the state before; none at the beginning of a chain.
    pub(super) inertial: Option<InertialFactor>,
}

/// An observation of a landmark.
#[derive(Clone, Copy, Debug)]
pub(super) struct WhitenedObservation {
    pub(super) frame: usize,
    /// Where the image shows it, as read out.
    pub(super) pixel: Pixel,
    /// `W` with `WᵀW = Σ⁻¹`.
    pub(super) whitening: Matrix2<f64>,
}

/// A landmark with all its observations, oldest first.
#[derive(Clone, Debug)]
pub(super) struct ObservedLandmark {
    pub(super) landmark: Landmark,
    pub(super) observations: Vec<WhitenedObservation>,
}

/// Standard deviations of what is known of the calibration before; zero: it is not estimated.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CalibrationPrior {
    pub(super) mean: SensorCalibration,
    /// In the order of [`super::observation::Linearised::by_calibration`].
    pub(super) sigmas: Vec<f64>,
    /// What may differ from image to image.
    pub(super) image: ImagePrior,
}

/// States, landmarks and calibration, with all measurements.
#[derive(Clone, Debug)]
pub(super) struct Problem {
    pub(super) frames: Vec<FrameState>,
    pub(super) landmarks: Vec<ObservedLandmark>,
    pub(super) calibration: SensorCalibration,
    pub(super) prior: CalibrationPrior,
    /// Indices of the calibration's unknowns that are estimated.
    pub(super) active: Vec<usize>,
    /// The state that is held, and where: position and heading of the world are free otherwise.
    pub(super) gauge: (usize, NavState),
}

impl Problem {
    /// Unknowns of the reduced system: states, then calibration.
    pub(super) fn dim(&self) -> usize {
        self.calibration_offset() + self.active.len()
    }

    /// Where the calibration's unknowns begin.
    pub(super) fn calibration_offset(&self) -> usize {
        self.offset(self.frames.len())
    }

    /// Unknowns of a state: [`FRAME_DIM`], then those of its image.
    pub(super) fn frame_dim(&self) -> usize {
        FRAME_DIM + self.prior.image.dim()
    }

    /// Where the unknowns of a state begin.
    pub(super) fn offset(&self, frame: usize) -> usize {
        self.frame_dim() * frame
    }

    /// How many of the active unknowns are the camera's; the others are the IMU's gains.
    pub(super) fn active_camera(&self) -> usize {
        let gains = self.calibration.dim() - GAIN_DIM;
        self.active.partition_point(|index| *index < gains)
    }

    /// The envelope of the reduced system: a state is coupled to the one before and to all that share a landmark with it.
    pub(super) fn envelope(&self) -> Envelope {
        let mut oldest: Vec<usize> = (0..self.frames.len()).map(|k| k.saturating_sub(1)).collect();
        for seen in &self.landmarks {
            let Some(first) = seen.observations.first().map(|o| o.frame) else { continue };
            for observation in &seen.observations {
                oldest[observation.frame] = oldest[observation.frame].min(first);
            }
        }
        let states =
            oldest.iter().flat_map(|first| std::iter::repeat_n(self.offset(*first), self.frame_dim()));
        Envelope::new(states.chain(vec![0; self.active.len()]).collect())
    }

    /// The calibration moved by a step of its active unknowns; `None` where the camera would not be valid.
    pub(super) fn calibration_plus(&self, step: &[f64]) -> Option<SensorCalibration> {
        let mut delta = vec![0.0; self.calibration.dim()];
        for (index, value) in self.active.iter().zip(step) {
            delta[*index] = *value;
        }
        self.calibration.plus(&delta)
    }
}

impl FrameState {
    /// A state at `time` with the IMU measurements around it; `None` where the IMU does not cover it.
    pub(super) fn new(
        time: Timestamp,
        state: NavState,
        imu: &ImuBuffer,
        model: &ImuModel,
        gain: &ImuGain,
    ) -> Option<Self> {
        let around = vidar_core::Duration::from_millis(10);
        let at = |time: Timestamp| Some(gain.applied(&imu.at(time)?));
        let now = at(time)?;
        let (before, after) = (at(time - around).unwrap_or(now), at(time + around).unwrap_or(now));
        let secs = (after.time - before.time).as_secs_f64();
        let gyro_change = if secs > 0.0 { (after.gyro.0 - before.gyro.0) / secs } else { Vector3::zeros() };
        let body = MovingBody {
            state,
            gyro: now.gyro.0,
            gyro_change,
            force: now.accel.0,
            gravity: model.gravity(),
            lens: LensMotion::NONE,
            delay_secs: 0.0,
        };
        Some(Self { time, body, inertial: None })
    }
}

const _: () = assert!(STATE_DIM < FRAME_DIM);
