//! A provisional scale is settled by adjustments of all that was seen so far, beside the odometry.
//!
//! A sliding window takes what it marginalises at the scale that it had then. Where that was far off, the window knows less of the scale than it
//! says, and stays off. Adjusted all together with clock and gains among the unknowns, the same measurements give the scale with an honest
//! σ; the odometry then goes on from the newest state of the adjustment (decision 38).

use super::successor::level_motion;
use super::{Odometry, Status};
use crate::bundle_adjustment::{AdjustmentInput, CalibrationSigmas, NewestState, TrackLog, newest_state};
use crate::deferred::Deferred;
use vidar_core::{Duration, Se3, Timestamp};

/// Standard deviation of ln(scale) below which there is a scale to settle: a body that stands shows none.
const BEGUN_STD: f64 = 1.0;

/// A start is provisional where σ is still above this so long, s, after that.
const PROVISIONAL_STD: f64 = 0.1;
const JUDGED_SECS: f64 = 0.5;

/// A scale that is known this well needs no adjustment: the calibration is not known better.
const SETTLED_STD: f64 = 0.02;

/// First adjustment, s after the start, and each later one after so many times that time, up to the last: 2.5, 5, 10, 20, 40 s. At first the scale
/// is worst; in the end a hand has turned and accelerated often enough, and more states cost more than an image can wait for.
const FIRST_SECS: f64 = 2.5;
const LATER: f64 = 2.0;
const LAST_SECS: f64 = 45.0;

/// Images of an adjustment are this far apart, twice as far as they are logged: its time grows with up to the cube of their number.
const SPARSE_PERIOD: Duration = Duration::from_millis(400);

/// Time of the recording until the result is taken over, s: some 12 to 100 states take 0.2 to 2.5 s of a core.
const SOLVING_SECS: f64 = 2.0;

/// Stretch before the start that is adjusted, too, s, and how much earlier its IMU measurements begin: clocks differ by less.
const BEFORE_SECS: f64 = 4.0;
const IMU_BEFORE_SECS: f64 = 0.5;

/// A result that knows the scale no better is of no use.
const MAX_SCALE_STD: f64 = 0.5;

/// The provisional scale of the present state.
#[derive(Debug)]
pub(super) struct Settling {
    /// Whether scales are settled at all.
    is_wanted: bool,
    began: Option<Timestamp>,
    is_provisional: bool,
    /// When the next adjustment is due, s after the start.
    due_secs: f64,
    is_over: bool,
    solving: Option<Deferred<Option<NewestState>>>,
}

impl Settling {
    /// Before a start. `is_wanted` is false for an odometry whose states are not given out.
    pub fn new(is_wanted: bool) -> Self {
        let due_secs = FIRST_SECS;
        Self { is_wanted, began: None, is_provisional: false, due_secs, is_over: false, solving: None }
    }

    /// The state was given up.
    pub fn begin_anew(&mut self) {
        *self = Self::new(self.is_wanted);
    }

    /// Whether nothing is needed for it any more.
    pub fn is_over(&self) -> bool {
        self.is_over || !self.is_wanted
    }

    /// The time before which nothing is adjusted, at `now`.
    fn needed_from(&self, now: Timestamp) -> Timestamp {
        self.began.unwrap_or(now) - Duration::from_secs_f64(BEFORE_SECS)
    }
}

impl Odometry {
    /// Adjusts what was seen so far where that is due, and goes on from a result that is due.
    pub(super) fn settle_scale(&mut self, status: &Status, now: Timestamp) {
        if self.settling.is_over() {
            self.keyframes.forget_provisional();
        }
        let Status::Tracking(tracking) = status else { return };
        let settling = &mut self.settling;
        if settling.is_over() || (settling.began.is_none() && !(tracking.scale_std < BEGUN_STD)) {
            return;
        }
        let age = (now - *settling.began.get_or_insert(now)).as_secs_f64();
        settling.is_provisional |= age >= JUDGED_SECS && tracking.scale_std > PROVISIONAL_STD;
        if let Some(solving) = settling.solving.take_if(|s| s.is_due(now)) {
            if let Some(found) = solving.result().flatten().filter(|found| found.scale_std < MAX_SCALE_STD) {
                match self.is_contradicted_by(&found) {
                    true => self.begin_successor_at(found),
                    false => self.revise_by(&found),
                };
            }
            return;
        }
        let due = settling.due_secs;
        if age < due || settling.solving.is_some() || self.successor.is_some() {
            return;
        }
        settling.due_secs = LATER * due;
        let is_settled = !settling.is_provisional || tracking.scale_std < SETTLED_STD;
        settling.is_over = is_settled || due > LAST_SECS;
        if !settling.is_over() {
            let since = settling.needed_from(now);
            self.settling.solving =
                self.begin_newest_state(since, now + Duration::from_secs_f64(SOLVING_SECS));
        }
    }

    /// Whether the window's scale differs from an adjustment's by more than that does not know. Where it does not, the window goes on: a new one
    /// would know less of the scene.
    fn is_contradicted_by(&self, found: &NewestState) -> bool {
        let difference = self.log.as_ref().and_then(|log| log.log_scale_to(&found.states, self.segment));
        self.successor.is_none() && difference.is_some_and(|ln| ln.abs() > found.scale_std)
    }

    /// Keyframes that the window left before it knew the scale, as an adjustment that agrees with it now has them.
    fn revise_by(&mut self, found: &NewestState) -> Option<()> {
        let now = self.recent.pose(found.frame)?;
        self.revise_keyframes(found, None, &level_motion(&now, &found.state.world_from_body));
        Some(())
    }

    /// Keyframes told so far get their poses from an adjustment, and later ones from what a second odometry logged; `world_from_found` leads from
    /// the world of both to that of the segment.
    pub(super) fn revise_keyframes(
        &mut self,
        found: &NewestState,
        second: Option<&TrackLog>,
        world_from_found: &Se3,
    ) {
        let pose = |image| found.pose_of(image).or_else(|| second?.pose_of(image));
        let body_from_camera = &found.body_from_camera;
        self.settled =
            self.keyframes.moved(|image| Some(*world_from_found * pose(image)? * *body_from_camera));
    }

    /// Keeps no more of the log than is needed, where it is kept for nothing else: a second odometry's is needed until it takes over.
    pub(super) fn shorten_log(&mut self, now: Timestamp) {
        if self.keeps_log || !self.settling.is_wanted {
            return;
        }
        let from = self.settling.needed_from(now);
        match &mut self.log {
            Some(_) if self.settling.is_over() => self.log = None,
            Some(log) => log.forget_before(from, Duration::from_secs_f64(IMU_BEFORE_SECS)),
            None if self.settling.is_over() => {}
            None => self.log = self.new_log(),
        }
    }

    /// A log that begins now.
    pub(super) fn new_log(&self) -> Option<TrackLog> {
        self.imu_model.map(|_| TrackLog::new(1.0 / self.imu.nominal_period().as_secs_f64()))
    }

    /// What an adjustment may change of the camera: where its place on the body is refined on the way, nobody measured that.
    fn known_camera(&self) -> CalibrationSigmas {
        let known = CalibrationSigmas { images: self.image_prior(), ..CalibrationSigmas::default() };
        if self.config.estimate_extrinsics { known.with_found_mount() } else { known }
    }

    /// Begins an adjustment of what was logged from `since` on.
    fn begin_newest_state(&self, since: Timestamp, due: Timestamp) -> Option<Deferred<Option<NewestState>>> {
        let (log, model) = (self.log.as_ref()?, self.imu_model?);
        let mut log = log.since(since, Duration::from_secs_f64(IMU_BEFORE_SECS), SPARSE_PERIOD);
        // Of other images nobody asks for the pose.
        log.stamps.retain(|(image, _)| self.keyframes.is_provisional(*image));
        let mut camera = self.camera.clone();
        camera.time_offset += self.estimated_offset();
        let readout_secs = self.time_calibration.readout_secs;
        let given_body_from_camera = self.given_body_from_camera;
        let sigmas = self.known_camera();
        let solve = move || {
            let input = AdjustmentInput {
                log: &log,
                camera: &camera,
                readout_secs,
                given_body_from_camera,
                // Gains are among the unknowns.
                model: model.with_gyro_gain_std(0.0),
                data_sheet: model.noise,
                sigmas: &sigmas,
            };
            on_one_thread(|| newest_state(&input).ok())
        };
        Some(Deferred::begin(due, solve))
    }
}

/// Work that takes one processor: the others are the images' that go on.
fn on_one_thread<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
        Ok(pool) => pool.install(work),
        Err(_) => work(),
    }
}
