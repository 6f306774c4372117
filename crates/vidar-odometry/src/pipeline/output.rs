//! What the odometry says of every image.

use crate::backend::SmootherError;
use crate::initialization::InitFailure;
use std::fmt;
use vidar_core::{
    FrameId, Health, LieGroup, NavCovariance, NavState, OdometryKeyframe, PoseCovariance, RevisedPose, Se3,
    SparseLandmark, Timestamp,
};

/// What is known after one image.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryOutput {
    /// Which image.
    pub frame_id: FrameId,
    /// Its time, in the clock of the images.
    pub time: Timestamp,
    /// What is known.
    pub status: Status,
}

/// Whether there is a state, and if not, why.
#[derive(Clone, Debug, PartialEq)]
pub enum Status {
    /// Not started yet; what is missing.
    Waiting(InitFailure),
    /// There is a state.
    Tracking(Box<Tracking>),
    /// There was one, and it cannot be kept.
    Lost(LossReason),
}

impl OdometryOutput {
    /// The state and all that belongs to it, if there is one.
    pub fn tracking(&self) -> Option<&Tracking> {
        match &self.status {
            Status::Tracking(tracking) => Some(tracking),
            Status::Waiting(_) | Status::Lost(_) => None,
        }
    }

    /// One word for the frame.
    pub fn health(&self) -> Health {
        match &self.status {
            Status::Waiting(_) => Health::ScaleUnknown,
            Status::Tracking(tracking) => tracking.health,
            Status::Lost(_) => Health::Lost,
        }
    }
}

/// The state at one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracking {
    /// Counts worlds: poses of different segments cannot be compared.
    pub segment: u32,
    /// The state.
    pub state: NavState,
    /// Its covariance, relative to the first pose of the segment.
    pub covariance: NavCovariance,
    /// Standard deviation of ln(scale); infinite while lengths are not metres.
    pub scale_std: f64,
    /// How far it may be trusted.
    pub health: Health,
    /// Landmarks of the smoother that this image shows.
    pub tracked: usize,
    /// What became of all tracks in this image.
    pub tracks: TrackSummary,
    /// Those landmarks, with their depth from this image.
    pub landmarks: Vec<SparseLandmark>,
    /// The keyframe that this image became, if it did.
    pub keyframe: Option<Box<OdometryKeyframe>>,
    /// Keyframes whose poses changed since the last output.
    pub revised: Vec<RevisedPose>,
    /// Keyframes told before, as an adjustment that settles the scale has them: what was mapped by them moves with them.
    pub settled: Vec<RevisedPose>,
    /// Two segments of which this image shows that they are of one world.
    pub joined: Option<Joined>,
}

/// Two segments whose worlds became one, because a place was found again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joined {
    /// The segment that ends here: all its poses, also those before, belong to the other one with the transform.
    pub segment: u32,
    /// The segment that it is part of from here on.
    pub into: u32,
    /// From the world of the one to that of the other: a turn about the vertical and a shift.
    pub into_from_segment: Se3,
    /// Landmarks that both show.
    pub matches: usize,
}

impl Joined {
    /// A state in the world of the segment that it is part of now; one of another segment stays.
    pub fn apply(&self, segment: &mut u32, state: &mut NavState) {
        if *segment == self.segment {
            *segment = self.into;
            *state = moved(state, &self.into_from_segment);
        }
    }

    /// The same for a keyframe.
    pub fn apply_to_keyframe(&self, keyframe: &mut OdometryKeyframe) {
        if keyframe.segment == self.segment {
            move_keyframe(keyframe, &self.into_from_segment);
        }
        self.apply(&mut keyframe.segment, &mut keyframe.state);
    }
}

impl Tracking {
    /// Tells that two segments are one, the own one perhaps.
    pub(crate) fn join(&mut self, joined: &Joined) {
        if self.segment == joined.segment {
            self.move_by(&joined.into_from_segment);
            self.segment = joined.into;
            self.keyframe.iter_mut().for_each(|k| k.segment = joined.into);
        }
        self.joined = Some(*joined);
    }

    /// Expresses all poses in a world that differs by a turn about the vertical and a shift.
    pub(crate) fn move_by(&mut self, to_from_own: &Se3) {
        self.state = moved(&self.state, to_from_own);
        let mut turn = NavCovariance::identity();
        for at in [POSITION, VELOCITY] {
            turn.fixed_view_mut::<3, 3>(at, at).copy_from(&to_from_own.rotation.matrix());
        }
        self.covariance = turn * self.covariance * turn.transpose();
        for keyframe in self.keyframe.iter_mut() {
            keyframe.state = moved(&keyframe.state, to_from_own);
            move_keyframe(keyframe, to_from_own);
        }
        for revised in self.revised.iter_mut().chain(&mut self.settled) {
            revised.world_from_camera = *to_from_own * revised.world_from_camera;
        }
    }
}

/// Entries of a state's covariance from which on they are of its position and of its velocity.
const POSITION: usize = 3;
const VELOCITY: usize = 6;

fn moved(state: &NavState, to_from_own: &Se3) -> NavState {
    NavState {
        world_from_body: *to_from_own * state.world_from_body,
        velocity_in_world: to_from_own.rotation.act(&state.velocity_in_world),
        ..*state
    }
}

/// Pose and covariance of a keyframe; its state is moved by itself.
fn move_keyframe(keyframe: &mut OdometryKeyframe, to_from_own: &Se3) {
    keyframe.world_from_camera = *to_from_own * keyframe.world_from_camera;
    let mut turn = PoseCovariance::identity();
    turn.fixed_view_mut::<3, 3>(POSITION, POSITION).copy_from(&to_from_own.rotation.matrix());
    keyframe.pose_covariance = turn * keyframe.pose_covariance * turn.transpose();
}

/// Tracks of one image, counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackSummary {
    /// Landmarks that were looked for.
    pub landmarks_tried: usize,
    /// Landmarks that were found.
    pub landmarks_found: usize,
    /// Tracks without a known distance that were looked for.
    pub seeds_tried: usize,
    /// Tracks without a known distance that were found.
    pub seeds_found: usize,
    /// Landmarks that were found and contradict the others.
    pub contradicting: usize,
    /// χ² of the window's observations per degree of freedom; 1 is expected.
    pub chi2_per_dof: f64,
}

/// Why a state was given up.
#[derive(Clone, Debug, PartialEq)]
pub enum LossReason {
    /// Too few landmarks for too long.
    NoFeatures {
        /// How long nothing was seen, s.
        secs: f64,
    },
    /// No IMU measurement for too long.
    ImuGap {
        /// Length of the gap, s.
        secs: f64,
    },
    /// No image for too long.
    ImageGap {
        /// Length of the gap, s.
        secs: f64,
    },
    /// Tracks and gyroscope contradict the clock offset, readout time or camera rotation in use; they were corrected.
    Recalibrated {
        /// Clock offset now in use: what to add to image stamps, ms.
        time_offset_ms: f64,
        /// Readout time of the rolling shutter now in use, ms.
        readout_ms: f64,
    },
    /// The backend rejected the image's frame, observations or marginalisation.
    Backend(SmootherError),
    /// The state contradicts the sensors or physics.
    Diverged {
        /// What gave it away.
        sign: DivergenceSign,
        /// Its value, in the sign's unit.
        found: f64,
        /// Largest value that is believed.
        limit: f64,
    },
}

/// What gives a diverged state away.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DivergenceSign {
    /// Speed, m/s.
    Speed,
    /// Length of the gyroscope's bias, rad/s.
    GyroBias,
    /// Length of the accelerometer's bias, m/s².
    AccelBias,
    /// Share of measurements that contradict the prediction.
    RejectedShare,
    /// Angle between the camera's orientation as given and as gyroscope and images tell it together, degrees.
    CameraOrientation,
    /// A number that is not finite.
    NotFinite,
}

impl fmt::Display for LossReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoFeatures { secs } => write!(f, "no landmark was seen for {secs:.2} s"),
            Self::ImuGap { secs } => write!(f, "no IMU measurement for {secs:.2} s"),
            Self::ImageGap { secs } => write!(f, "no image for {secs:.2} s"),
            Self::Recalibrated { time_offset_ms, readout_ms } => write!(
                f,
                "the camera's clock is {time_offset_ms:+.1} ms off and its rows take {readout_ms:.1} ms: started anew with that"
            ),
            Self::Backend(error) => write!(f, "backend: {error}"),
            Self::Diverged { sign, found, limit } => match sign {
                DivergenceSign::Speed => write!(f, "speed {found:.1} m/s > {limit:.1} m/s"),
                DivergenceSign::GyroBias => write!(f, "gyroscope bias {found:.2} rad/s > {limit:.2} rad/s"),
                DivergenceSign::AccelBias => {
                    write!(f, "accelerometer bias {found:.2} m/s² > {limit:.2} m/s²")
                }
                DivergenceSign::RejectedShare => {
                    write!(f, "{:.0} % of the measurements contradict the prediction", 100.0 * found)
                }
                DivergenceSign::CameraOrientation => {
                    write!(
                        f,
                        "gyroscope and images disagree: the camera's orientation is off by {found:.0} deg"
                    )
                }
                DivergenceSign::NotFinite => write!(f, "the state is not finite"),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_backend_error_is_reported_with_its_own_reason() {
        let reason = LossReason::Backend(SmootherError::Full { held: 18 });
        assert!(reason.to_string().contains("18 frames already"), "{reason}");
    }

    #[test]
    fn a_loss_names_its_reason_with_values() {
        let reason = LossReason::Diverged { sign: DivergenceSign::Speed, found: 31.0, limit: 20.0 };
        assert_eq!(reason.to_string(), "speed 31.0 m/s > 20.0 m/s");
        assert_eq!(LossReason::ImuGap { secs: 0.75 }.to_string(), "no IMU measurement for 0.75 s");
    }
}
