//! The odometry's thread: measurements as they arrive, poses as they are found.

use super::ending::Ending;
use super::pose_file::PoseFile;
use super::publish::LivePublisher;
use super::queue::{Item, Queue};
use super::thinning::{Passed, Thinning};
use crate::engine::{FrameStamp, FrameState, PoseReport, PoseSource};
use crate::error::Error;
use crate::input::Measurement;
use std::collections::VecDeque;
use std::time::{Duration, Instant};
use vidar_core::{SensorEvent, Timestamp, Warning};
use vidar_dataset::DatasetError;

/// An image that is taken up this long after it arrived is not tracked: four images at 20 Hz. The IMU bridges such a gap, while a delay
/// that grows makes every later pose late.
const MOST_DELAY: Duration = Duration::from_millis(200);

/// What came while a stream was opened waits, and is tracked all the same until it has been caught up with, for this long at most:
/// four times the opening.
const CATCH_UP: Duration = Duration::from_secs(10);

/// When measurements arrive.
pub(super) enum ArrivalClock {
    /// As fast as they are taken.
    Taken,
    /// In the rhythm of their stamps, from the first one on.
    Stamped(Option<(Instant, Timestamp)>),
    /// When their messages came. Since when what came before is being caught up with; none once it is.
    Came(Option<Instant>),
}

impl ArrivalClock {
    /// When a measurement of this time arrives; `came` is when its message did.
    fn of(&mut self, time: Timestamp, came: Option<Instant>) -> Instant {
        match self {
            Self::Taken => Instant::now(),
            Self::Stamped(start) => {
                let (began, first) = *start.get_or_insert_with(|| (Instant::now(), time));
                let after = u64::try_from((time - first).nanos()).unwrap_or(0);
                began + Duration::from_nanos(after)
            }
            Self::Came(_) => came.unwrap_or_else(Instant::now),
        }
    }

    /// Whether time goes on while the map works.
    fn waits_for_nobody(&self) -> bool {
        !matches!(self, Self::Taken)
    }

    /// Whether an image that arrived then is too late to be tracked.
    fn is_too_late(&mut self, arrived: Instant) -> bool {
        let is_late = self.waits_for_nobody() && arrived.elapsed() > MOST_DELAY;
        match self {
            Self::Came(catching_up) => {
                *catching_up = catching_up.filter(|since| is_late && since.elapsed() < CATCH_UP);
                is_late && catching_up.is_none()
            }
            _ => is_late,
        }
    }
}

/// The machine of the thread.
pub(super) struct Tracker<'a> {
    pub poses: Option<Box<dyn PoseSource + 'a>>,
    pub queue: &'a Queue,
    pub arrival: ArrivalClock,
    pub thinning: Thinning,
    pub pose_file: PoseFile<'a>,
    /// Who else hears of poses.
    pub publisher: Option<&'a LivePublisher>,
    pub unreadable: &'a (dyn Fn(FrameStamp, &DatasetError) -> Warning + Sync),
    pub counts: Counts,
    /// Images without a report, with when they arrived.
    pub waiting: VecDeque<(FrameStamp, Instant)>,
}

/// What is counted and measured on the way.
#[derive(Clone, Debug, Default)]
pub(super) struct Counts {
    pub images: usize,
    pub not_tracked: usize,
    /// From the arrival of an image to its pose, s.
    pub seconds: Vec<f32>,
    /// From the arrival of the measurement that decided the pose, s: the image itself, or the IMU that reaches its instant.
    pub seconds_from_sensors: Vec<f32>,
}

impl Tracker<'_> {
    /// Takes measurements, of a stream with when each came, until they end, `is_cancelled`, or nobody takes the poses. What the odometry says at the end.
    ///
    /// # Errors
    /// What the odometry cannot go on with, or the file of poses could not be written.
    pub fn run(
        &mut self,
        measurements: impl Iterator<Item = (Measurement, Option<Instant>)>,
        is_cancelled: &dyn Fn() -> bool,
    ) -> Result<Ending, Error> {
        for (measurement, came) in measurements {
            let arrived = self.arrival.of(time_of(&measurement), came);
            if !self.sleep_until(arrived, is_cancelled) || is_cancelled() {
                break;
            }
            if !self.take(measurement, arrived)? {
                break;
            }
        }
        let ending = self.poses.as_mut().map_or_else(Ending::default, |poses| Ending::of(poses.as_mut()));
        for report in &ending.reports {
            self.measure(report, None)?;
        }
        let images = self.waiting.drain(..).collect();
        self.send(Item::Tracked { images, report: None, is_keyframe: false });
        Ok(ending)
    }

    /// Sleeps until a measurement arrives, in steps, so that Ctrl-C and the end of the map are noticed. Whether to go on.
    fn sleep_until(&self, arrived: Instant, is_cancelled: &dyn Fn() -> bool) -> bool {
        const STEP: Duration = Duration::from_millis(50);
        loop {
            let left = arrived.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return true;
            }
            if is_cancelled() || self.queue.is_closed_within(left.min(STEP)) {
                return false;
            }
        }
    }

    /// Takes one measurement; whether anybody wants more.
    fn take(&mut self, measurement: Measurement, arrived: Instant) -> Result<bool, Error> {
        let reports = match measurement {
            Measurement::Event(SensorEvent::Image(frame)) => {
                let stamp = FrameStamp { frame_id: frame.id, time: frame.time, camera: frame.camera };
                self.image(stamp, arrived);
                if self.arrival.is_too_late(arrived) {
                    self.counts.not_tracked += 1;
                    self.stamp(&stamp)
                } else {
                    self.event(SensorEvent::Image(frame))?
                }
            }
            Measurement::Event(event) => self.event(event)?,
            Measurement::Stamp(stamp) => {
                self.image(stamp, arrived);
                self.stamp(&stamp)
            }
            Measurement::Unreadable(stamp, error) => {
                if !self.send(Item::Warning((self.unreadable)(stamp, &error))) {
                    return Ok(false);
                }
                self.image(stamp, arrived);
                self.stamp(&stamp)
            }
        };
        if self.poses.is_none() {
            let images = self.waiting.drain(..).collect();
            return Ok(self.send(Item::Tracked { images, report: None, is_keyframe: false }));
        }
        for report in reports {
            if !self.deliver(report, arrived)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn image(&mut self, stamp: FrameStamp, arrived: Instant) {
        self.counts.images += 1;
        self.waiting.push_back((stamp, arrived));
        // With each image, also while none gets a pose.
        if let Some(publisher) = self.publisher {
            let left_out = self.counts.not_tracked + self.thinning.thinned + self.thinning.dropped;
            publisher.health((self.queue.load().images, left_out));
        }
    }

    fn event(&mut self, event: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        self.poses.as_mut().map_or_else(|| Ok(Vec::new()), |poses| poses.push(event))
    }

    fn stamp(&mut self, stamp: &FrameStamp) -> Vec<PoseReport> {
        self.poses.as_mut().map_or_else(Vec::new, |poses| poses.push_stamp(stamp))
    }

    /// Measures and writes the pose of a report, decided by what arrived at `decided`; at the end of the recording by nothing.
    fn measure(&mut self, report: &PoseReport, decided: Option<Instant>) -> Result<(), Error> {
        let PoseReport::Posed { state, keyframe, .. } = report else {
            self.publisher.into_iter().for_each(LivePublisher::no_pose);
            return Ok(());
        };
        if let Some(publisher) = self.publisher {
            publisher.pose(state, keyframe.as_deref());
        }
        let image = self.waiting.iter().find(|(stamp, _)| stamp.frame_id == state.frame_id);
        if let Some((_, arrived)) = image {
            let since = decided.map_or(*arrived, |decided| decided.max(*arrived));
            self.counts.seconds.push(arrived.elapsed().as_secs_f32());
            self.counts.seconds_from_sensors.push(since.elapsed().as_secs_f32());
        }
        self.pose_file.add(state)
    }

    /// Hands a report over, with the images up to its time that may become keyframes.
    fn deliver(&mut self, report: PoseReport, arrived: Instant) -> Result<bool, Error> {
        self.measure(&report, Some(arrived))?;
        let (time, pose, moves_others) = match &report {
            PoseReport::Posed { state, joined, settled, .. } => {
                let FrameState { time, world_from_camera, .. } = *state;
                (time, Some(world_from_camera), joined.is_some() || !settled.is_empty())
            }
            PoseReport::NotPosed { time } => (*time, None, false),
        };
        let count = self.waiting.iter().take_while(|(stamp, _)| stamp.time <= time).count();
        let mut images: Vec<(FrameStamp, Instant)> = self.waiting.drain(..count).collect();
        let mut report = Some(Box::new(report));
        let mut is_keyframe = false;
        if self.arrival.waits_for_nobody() {
            let load = self.queue.load();
            if let Some(warning) = self.thinning.observe(&load) {
                self.send(Item::Warning(warning));
            }
            let passed = self.thinning.pass(pose.as_ref());
            is_keyframe = passed == Passed::Keyframe;
            if passed == Passed::LeftOut {
                images.clear();
            }
            if !self.thinning.keeps_report(load.items, moves_others) {
                report = None;
                images.clear();
                is_keyframe = false;
            }
            if report.is_none() && images.is_empty() {
                // Nothing is left of it; an empty item would wait like any other.
                return Ok(!self.queue.is_closed_within(Duration::ZERO));
            }
        }
        Ok(self.send(Item::Tracked { images, report, is_keyframe }))
    }

    /// Hands something over: at once where time does not wait; else when there is room.
    fn send(&self, item: Item) -> bool {
        match self.arrival.waits_for_nobody() {
            true => self.queue.push(item),
            false => self.queue.push_waiting(item),
        }
    }
}

fn time_of(measurement: &Measurement) -> Timestamp {
    match measurement {
        Measurement::Event(event) => event.time(),
        Measurement::Stamp(stamp) | Measurement::Unreadable(stamp, _) => stamp.time,
    }
}

#[cfg(test)]
mod tests {
    use super::super::queue::{CAPACITY, Load, MOST_REPORTS};
    use super::*;
    use crate::events::Events;
    use crate::run_folder::{OutputLocation, RunFolder};
    use vidar_core::{CameraId, FrameId};

    /// A map that takes nothing, however long the recording goes on.
    #[test]
    fn behind_a_map_that_stands_still_no_more_waits_than_is_stated() {
        let parent = tempfile::tempdir().unwrap();
        let place = OutputLocation::Exact { path: parent.path().join("run"), force: false };
        let folder = RunFolder::create(&place).unwrap();
        let (events, queue) = (Events::none(), Queue::default());
        let unreadable = |_: FrameStamp, _: &DatasetError| Warning::new("unread", "not read");
        let mut tracker = Tracker {
            poses: None,
            queue: &queue,
            arrival: ArrivalClock::Stamped(None),
            thinning: Thinning::new(&vidar_align::keyframe_selection::KeyframeConfig::default()),
            pose_file: PoseFile::create(&folder, &events).unwrap(),
            publisher: None,
            unreadable: &unreadable,
            counts: Counts::default(),
            waiting: VecDeque::new(),
        };
        for i in 0..3 * MOST_REPORTS as u32 {
            let time = Timestamp::from_nanos(i64::from(i) * 50_000_000);
            tracker.image(FrameStamp { frame_id: FrameId(i), time, camera: CameraId(0) }, Instant::now());
            assert!(tracker.deliver(PoseReport::NotPosed { time }, Instant::now()).unwrap());
        }
        let Load { images, items, .. } = queue.load();
        assert!(images <= CAPACITY, "{images} images wait");
        // Warnings are few: one for each change of what is left out.
        assert!((MOST_REPORTS..MOST_REPORTS + 8).contains(&items), "{items} items wait");
        assert_eq!(tracker.thinning.poses_dropped + items, 3 * MOST_REPORTS + warnings(&queue));
        let report = PoseReport::NotPosed { time: Timestamp::from_nanos(0) };
        assert!(!tracker.deliver(report, Instant::now()).unwrap());
    }

    #[test]
    fn what_came_while_a_stream_was_opened_is_tracked_until_it_is_caught_up_with() {
        let now = Instant::now();
        let before = |ms: u64| now.checked_sub(Duration::from_millis(ms)).unwrap();
        let mut clock = ArrivalClock::Came(Some(now));
        assert_eq!(clock.of(Timestamp::from_nanos(5), Some(before(2500))), before(2500));
        assert!(!clock.is_too_late(before(2500)) && !clock.is_too_late(before(900)));
        assert!(!clock.is_too_late(before(10)), "caught up");
        assert!(clock.is_too_late(before(2500)) && !clock.is_too_late(before(10)));
        // A machine that never catches up leaves images to the IMU, too.
        let mut slow = ArrivalClock::Came(Some(before(11_000)));
        assert!(slow.is_too_late(before(2500)));
    }

    /// Empties and closes the queue; how many of its items were warnings.
    fn warnings(queue: &Queue) -> usize {
        queue.close();
        std::iter::from_fn(|| queue.pop()).filter(|item| matches!(item, Item::Warning(_))).count()
    }
}
