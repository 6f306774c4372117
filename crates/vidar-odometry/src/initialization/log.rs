//! What is kept of the images before there is a state.

use crate::backend::Observation;
use crate::imu::Preintegration;
use nalgebra::{Matrix2, Vector2};
use vidar_core::{FrameId, LandmarkId, Timestamp};

/// What a frame saw of a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackObservation {
    /// The track.
    pub landmark: LandmarkId,
    /// Where, pixels.
    pub pixel: Vector2<f64>,
    /// Covariance of `pixel`, px².
    pub covariance: Matrix2<f64>,
}

impl TrackObservation {
    /// The observation by `frame`.
    pub(crate) fn by(&self, frame: FrameId) -> Observation {
        let Self { landmark, pixel, covariance } = *self;
        Observation { frame, landmark, pixel, covariance }
    }
}

/// A frame before there is a state: what it saw, and the IMU measurements since the frame before in the log.
#[derive(Clone, Debug)]
pub struct LoggedFrame {
    /// Its number.
    pub frame: FrameId,
    /// When it was taken, in the clock of the IMU.
    pub time: Timestamp,
    /// IMU measurements since the frame before; what the first frame holds is not used.
    pub preintegration: Option<Preintegration>,
    /// What it saw.
    pub observations: Vec<TrackObservation>,
}

/// The IMU measurements of successive frames as one; `None` where there are none.
pub(super) fn joined<'a>(frames: impl IntoIterator<Item = &'a LoggedFrame>) -> Option<Preintegration> {
    let mut parts = frames.into_iter().filter_map(|f| f.preintegration.as_ref());
    let mut sum = parts.next()?.clone();
    parts.for_each(|part| sum.append(part));
    Some(sum)
}
