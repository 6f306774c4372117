//! Another clock, readout or rotation of the camera while there is a state: a second odometry catches up with them over the last
//! seconds, and its state then goes on in the same world. It works beside the first one, in slices of work whose results are due at
//! instants that the recording decides: an image waits for it only where a slice is not done when it is due.

use super::{Odometry, Phase, Status};
use crate::bundle_adjustment::{ImuGain, NewestState, TrackLog};
use crate::config::OdometryConfig;
use crate::deferred::Deferred;
use crate::frontend::PYRAMID_LEVELS;
use crate::imu::ImuBuffer;
use crate::initialization::StaticState;
use crate::pipeline::health::HealthMonitor;
use crate::pipeline::output::LossReason;
use crate::pipeline::time_calibration::Correction;
use nalgebra::Vector3;
use std::collections::VecDeque;
use vidar_core::{Duration, Frame, FrameId, ImuSample, LieGroup, RigCamera, Se3, So3, Timestamp};

/// Images kept, s and number: the longest stretch that a start in motion is solved from, or an adjustment takes; with some to spare.
const REPLAY_SECS: f64 = 3.5;
const REPLAY_FRAMES: usize = 200;

/// IMU measurements kept before the oldest image, s: clocks differ by 0.15 s at most, and half a second shows a body at rest.
const IMU_BEFORE_SECS: f64 = 0.7;

/// Time of the recording until the result of a slice is taken over, s, and how much of what waits a slice works on, so that the second
/// odometry catches up: with a state, without one while the first has one, and where neither has. An attempt to start takes up to
/// 0.4 s on one core, for which the images of a first odometry that has a state do not wait; a slice of few images ends with the next.
const SLICE_SECS: f64 = 0.1;
const STARTING_SLICE_SECS: f64 = 0.5;
const CAUGHT_UP_SECS: f64 = 0.3;
const CAUGHT_UP_STARTING_SECS: f64 = 0.9;
const CAUGHT_UP_BEFORE_ANY_STATE_SECS: f64 = 0.6;
const SHORT_SLICE: usize = 6;

/// So few images are worked on at once, without another thread.
const AT_ONCE: usize = 1;

/// After this long without a state of the second odometry the first one gives its own up, s.
const PATIENCE_SECS: f64 = 6.0;

/// An image that was worked on.
#[derive(Clone, Debug)]
struct RecentFrame {
    id: FrameId,
    frame: Frame,
    /// Pose in the world of the segment, where there was a state.
    world_from_body: Option<Se3>,
}

/// The last images, oldest first.
#[derive(Debug)]
pub(super) struct RecentFrames {
    keeps: bool,
    frames: VecDeque<RecentFrame>,
}

impl RecentFrames {
    pub fn new(keeps: bool) -> Self {
        Self { keeps, frames: VecDeque::new() }
    }

    /// Keeps images again, where they are needed again.
    pub fn go_on(&mut self, is_needed: bool) {
        self.keeps |= is_needed;
    }

    pub fn add(&mut self, id: FrameId, frame: &Frame) {
        if !self.keeps {
            return;
        }
        self.frames.push_back(RecentFrame { id, frame: frame.clone(), world_from_body: None });
        let is_old = |f: &RecentFrame| (frame.time - f.frame.time).as_secs_f64() > REPLAY_SECS;
        while self.frames.len() > REPLAY_FRAMES || self.frames.front().is_some_and(is_old) {
            self.frames.pop_front();
        }
    }

    /// The time from which IMU measurements are needed.
    pub fn oldest(&self) -> Option<Timestamp> {
        self.frames.front().map(|f| f.frame.time - Duration::from_secs_f64(IMU_BEFORE_SECS))
    }

    pub fn pose(&self, id: FrameId) -> Option<Se3> {
        self.frames.iter().find(|f| f.id == id)?.world_from_body
    }
}

/// The second odometry.
#[derive(Debug)]
pub(super) struct Successor {
    /// Between two slices of work.
    catch_up: Option<Box<CatchUp>>,
    slice: Option<Deferred<Box<CatchUp>>>,
    /// What came during a slice.
    samples: Vec<ImuSample>,
    images: Vec<RecentFrame>,
    /// Where it has other values of the camera than the first one.
    correction: Option<Correction>,
    /// Where it begins with a state from an adjustment.
    begun: Option<NewestState>,
    since: Timestamp,
}

/// The second odometry itself and the images that it has not worked on.
#[derive(Debug)]
struct CatchUp {
    odometry: Odometry,
    waiting: VecDeque<RecentFrame>,
}

impl CatchUp {
    fn has_state(&self) -> bool {
        matches!(self.odometry.phase, Phase::Tracking(_))
    }

    /// Works on the images that wait, up to a stretch of the recording.
    fn run(&mut self, first_has_state: bool) {
        let Some(begin) = self.waiting.front().map(|f| f.frame.time) else { return };
        loop {
            let secs = match (first_has_state, self.has_state()) {
                (_, true) => CAUGHT_UP_SECS,
                (true, false) => CAUGHT_UP_STARTING_SECS,
                (false, false) => CAUGHT_UP_BEFORE_ANY_STATE_SECS,
            };
            let is_next = |f: &mut RecentFrame| {
                (f.frame.time - begin).as_secs_f64() < secs && self.odometry.is_ready(&f.frame)
            };
            let Some(RecentFrame { id, frame, .. }) = self.waiting.pop_front_if(is_next) else { return };
            self.odometry.next_frame = id.0;
            self.odometry.process(frame);
        }
    }

    /// Images that wait and whose IMU measurements are there.
    fn ready(&self) -> usize {
        self.waiting.iter().take_while(|f| self.odometry.is_ready(&f.frame)).count()
    }

    /// The newest image that it has a pose of.
    fn newest_pose(&self) -> Option<(FrameId, Se3)> {
        let Phase::Tracking(window) = &self.odometry.phase else { return None };
        window.smoother.newest().map(|(id, _, state)| (id, state.world_from_body))
    }
}

impl Successor {
    /// Begun at `since`, with images to work on.
    fn new(odometry: Odometry, waiting: VecDeque<RecentFrame>, since: Timestamp) -> Self {
        Self {
            catch_up: Some(Box::new(CatchUp { odometry, waiting })),
            slice: None,
            samples: Vec::new(),
            images: Vec::new(),
            correction: None,
            begun: None,
            since,
        }
    }

    pub fn add_imu(&mut self, sample: ImuSample) {
        self.samples.push(sample);
    }

    /// The second odometry where its slice is done, with what came meanwhile and what it can do of it at once.
    fn between_slices(&mut self, now: Timestamp, first_has_state: bool) -> Option<&CatchUp> {
        if let Some(slice) = self.slice.take_if(|slice| slice.is_due(now)) {
            self.catch_up = slice.result();
        }
        let catch_up = self.catch_up.as_mut()?;
        for sample in self.samples.drain(..) {
            // What the first odometry took, this one takes: their buffers hold the same.
            let _ = catch_up.odometry.imu.push(catch_up.odometry.imu_gain.applied(&sample));
        }
        catch_up.waiting.extend(self.images.drain(..));
        if catch_up.ready() <= AT_ONCE {
            catch_up.run(first_has_state);
        }
        Some(catch_up)
    }

    /// Begins another slice where the last one is done.
    fn go_on(&mut self, now: Timestamp, first_has_state: bool) {
        let Some(mut catch_up) = self.catch_up.take_if(|c| c.ready() > 0) else { return };
        let secs = match catch_up.ready() {
            _ if first_has_state && !catch_up.has_state() => STARTING_SLICE_SECS,
            0..SHORT_SLICE => 0.0,
            _ => SLICE_SECS,
        };
        let due = now + Duration::from_secs_f64(secs);
        self.slice = Some(Deferred::begin(due, move || {
            catch_up.run(first_has_state);
            catch_up
        }));
    }
}

impl Odometry {
    /// Begins a second odometry with corrected values where there are images to begin with; says whether.
    pub(super) fn begin_successor(&mut self, correction: &Correction) -> bool {
        let Some(newest) = self.recent.frames.back() else { return false };
        let mut camera = self.camera.clone();
        camera.time_offset = Duration::from_secs_f64(correction.offset_secs);
        if let Some(rotation) = correction.body_from_camera {
            camera.body_from_camera.rotation = rotation;
        }
        let odometry = self.second(camera, correction.readout_secs, self.imu.clone(), self.imu_gain);
        let successor = Successor::new(odometry, self.recent.frames.clone(), newest.frame.time);
        self.successor = Some(Successor { correction: Some(*correction), ..successor });
        true
    }

    /// Begins a second odometry with the state that an adjustment found for an image that is kept, and with its clock, readout and gains.
    pub(super) fn begin_successor_at(&mut self, begun: NewestState) -> Option<()> {
        let now = self.recent.frames.back()?.frame.time;
        let at = self.recent.frames.iter().position(|f| f.id == begun.frame)?;
        let camera = RigCamera {
            time_offset: begun.time_offset,
            body_from_camera: begun.body_from_camera,
            ..self.camera.clone()
        };
        let imu = self.imu.multiplied(&begun.gain.beyond(&self.imu_gain));
        let mut odometry = self.second(camera, begun.readout_secs.max(0.0), imu, begun.gain);
        odometry.begin_at(&begun, &self.recent.frames[at].frame)?;
        let successor = Successor::new(odometry, self.recent.frames.range(at + 1..).cloned().collect(), now);
        self.successor = Some(Successor { begun: Some(begun), ..successor });
        Some(())
    }

    /// A second odometry with other values of the camera, which are not corrected again, and measurements that have gains applied.
    fn second(&self, camera: RigCamera, readout_secs: f64, imu: ImuBuffer, imu_gain: ImuGain) -> Self {
        let config = OdometryConfig {
            readout_ms: Some(1e3 * readout_secs),
            align_timing: false,
            ..self.config.clone()
        };
        let tracker = self.phase.tracker().another();
        let camera = (self.camera_id, camera);
        let fresh = Self::fresh(config, tracker, camera, self.working.another(), self.imu_model, imu);
        Self { imu_gain, log: self.log.as_ref().map(|_| TrackLog::of_every_image()), ..fresh }
    }

    /// Begins with a state that is known and the image that it belongs to.
    fn begin_at(&mut self, begun: &NewestState, frame: &Frame) -> Option<()> {
        let time = self.imu_time(frame);
        let host = self.images.take(begun.frame, &frame.image, PYRAMID_LEVELS, self.shutter_at(time))?;
        let start = StaticState { state: begun.state, sigmas: begun.sigmas };
        let typical_inverse = 1.0 / begun.median_distance_m.clamp(0.1, 100.0);
        let window = self.start_at(&host, time, &start, typical_inverse).ok()?;
        self.last_frame = Some(time);
        self.last_host = Some(host.clone());
        let status = self.begin(window, frame, host.frame);
        self.log_image(frame, host.frame, &status);
        matches!(self.phase, Phase::Tracking(_)).then_some(())
    }

    /// Lets the second odometry, if there is one, work on its images up to the newest, `id`, and goes on with its state when it has
    /// caught up. What became of the image otherwise, where the state had to be given up.
    pub(super) fn follow_successor(&mut self, id: FrameId) -> Option<Status> {
        let pose = match &self.phase {
            Phase::Tracking(window) => {
                window.smoother.state(id).map(|s| self.world_from_smoother() * s.world_from_body)
            }
            Phase::Initializing(_) => None,
        };
        let newest = self.recent.frames.back_mut().filter(|f| f.id == id)?;
        newest.world_from_body = pose;
        let Some(mut successor) = self.successor.take() else {
            if self.time_calibration.is_settled() && self.settling.is_over() {
                self.recent = RecentFrames::new(false);
            }
            return None;
        };
        let newest = newest.clone();
        let now = newest.frame.time;
        let waited_secs = (now - successor.since).as_secs_f64();
        if waited_secs > 0.0 {
            successor.images.push(newest);
        }
        let has_state = matches!(self.phase, Phase::Tracking(_));
        let up_to_date = successor.between_slices(now, has_state).filter(|c| c.ready() == 0);
        match up_to_date.map(CatchUp::newest_pose) {
            Some(Some((at, new))) => {
                let old = self.recent.pose(at);
                self.go_on_with(successor, old.map(|old| level_motion(&old, &new)));
            }
            Some(None) if !has_state => self.go_on_with(successor, None),
            _ if waited_secs < PATIENCE_SECS => {
                successor.go_on(now, has_state);
                self.successor = Some(successor);
            }
            _ => return successor.correction.and_then(|correction| self.correct(&correction)),
        }
        None
    }

    /// Takes the second odometry's state over; `world_from_new` leads from its world to that of the segment.
    fn go_on_with(&mut self, successor: Successor, world_from_new: Option<Se3>) {
        let Some(catch_up) = successor.catch_up else { return };
        let new = catch_up.odometry;
        let reason = LossReason::Recalibrated {
            time_offset_ms: 1e3 * new.camera.time_offset.as_secs_f64(),
            readout_ms: 1e3 * new.time_calibration.readout_secs,
        };
        if let (Some(log), Some(begun), Some(placed)) = (&mut self.log, &successor.begun, &world_from_new) {
            log.replace_states(self.segment, &begun.states, placed);
        }
        self.relocalizer.lose(&reason, new.last_frame.unwrap_or_default());
        self.camera = new.camera;
        self.time_calibration.readout_secs = new.time_calibration.readout_secs;
        (self.imu, self.imu_gain) = (new.imu, new.imu_gain);
        self.phase = new.phase;
        self.config.stamp_scatter_ms = self.config.stamp_scatter_ms.or(new.config.stamp_scatter_ms);
        self.config.image_shift_deg = self.config.image_shift_deg.or(new.config.image_shift_deg);
        if let Phase::Tracking(window) = &mut self.phase {
            window.smoother.set_image_unknowns(&self.config);
        }
        self.check = new.check;
        self.last_frame = new.last_frame;
        self.last_host = new.last_host;
        self.failure = new.failure;
        self.placed = world_from_new;
        self.health_monitor = HealthMonitor::default();
        self.keyframes.forget_held();
        if let (Some(begun), Some(placed)) = (&successor.begun, &world_from_new) {
            self.revise_keyframes(begun, new.log.as_ref(), placed);
        }
        // Tracks have other names from here on.
        self.time_calibration.forget_tracks();
        match (&mut self.log, &new.log) {
            (Some(log), Some(other)) => log.go_on_with(other),
            (log, _) => log.iter_mut().for_each(TrackLog::next_generation),
        }
    }
}

/// The motion that brings `new` onto `old` about the vertical: both know where down is.
pub(super) fn level_motion(old: &Se3, new: &Se3) -> Se3 {
    let turn = (old.rotation * new.rotation.inverse()).matrix();
    let heading = (turn[(1, 0)] - turn[(0, 1)]).atan2(turn[(0, 0)] + turn[(1, 1)]);
    let rotation = So3::exp(&(Vector3::z() * heading));
    Se3::new(rotation, old.translation - rotation.act(&new.translation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_level_motion_keeps_down_and_joins_the_poses() {
        let motion = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 2.1)), Vector3::new(1.0, -2.0, 0.5));
        let new = Se3::new(So3::exp(&Vector3::new(0.4, -0.3, 1.0)), Vector3::new(0.3, 0.2, -0.1));
        let found = level_motion(&(motion * new), &new);
        assert!((found.inverse() * motion).log().norm() < 1e-12);
        // A pose that is out of level does not tilt the world.
        let tilted = motion * new * Se3::new(So3::exp(&Vector3::new(0.05, 0.02, 0.0)), Vector3::zeros());
        let found = level_motion(&tilted, &new);
        assert!((found.rotation.act(&Vector3::z()) - Vector3::z()).norm() < 1e-12);
        assert!((found.act(&new.translation) - tilted.translation).norm() < 1e-12);
    }
}
