//! What the odometry saw, kept for the adjustment after the recording's end.

use crate::backend::Smoother;
use crate::imu::{ImuBuffer, NavState};
use crate::tracking::HostImage;
use nalgebra::{Matrix2, Vector2};
use std::sync::Arc;
use vidar_core::{Duration, FrameId, ImuSample, LandmarkId, Se3, Timestamp, camera::Pixel};

/// Images are logged this far apart, and keyframes in any case: preintegration over it is good to a tenth of a millimetre,
/// and a hand turns by less than 20° in it.
const LOG_PERIOD: Duration = Duration::from_millis(200);

/// Images whose grey levels are kept are this far apart at first, and twice as far each time that their memory is full.
const FIRST_PLACE_PERIOD: Duration = Duration::from_millis(1000);

/// Memory of the grey levels that are kept, bytes: 80 images of 640 × 480 with their pyramids.
const MAX_PLACE_BYTES: usize = 32 << 20;

/// Stamps of images that are logged at a period vary by this.
const STAMP_JITTER: Duration = Duration::from_millis(50);

/// What is too old is dropped this much at a time.
const FORGET_PERIOD: Duration = Duration::from_millis(1000);

/// Logged images whose states are brought up to date with the window: more than any window holds.
const NEWEST_IMAGES: usize = 48;

/// A feature track. Numbers begin anew with every start of the tracker, which the generation counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct TrackKey {
    pub(crate) generation: u32,
    pub(crate) track: LandmarkId,
}

/// Where an image shows a track, as read out (the rolling shutter's motion is in it). 32 bytes: an hour at five images per
/// second with 150 tracks each is 90 MB.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LoggedObservation {
    pub(crate) key: TrackKey,
    pixel: [f32; 2],
    /// xx, xy, yy.
    covariance: [f32; 3],
}

impl LoggedObservation {
    pub(crate) fn new(key: TrackKey, pixel: &Pixel, covariance: &Matrix2<f64>) -> Self {
        let c = covariance;
        Self {
            key,
            pixel: [pixel.x as f32, pixel.y as f32],
            covariance: [c[(0, 0)] as f32, c[(0, 1)] as f32, c[(1, 1)] as f32],
        }
    }

    pub(crate) fn pixel(&self) -> Pixel {
        Vector2::new(self.pixel[0].into(), self.pixel[1].into())
    }

    pub(crate) fn covariance(&self) -> Matrix2<f64> {
        let [xx, xy, yy] = self.covariance.map(f64::from);
        Matrix2::new(xx, xy, xy, yy)
    }
}

/// The odometry's state at an image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LoggedState {
    /// States of different segments are in different worlds.
    pub(crate) segment: u32,
    pub(crate) state: NavState,
}

/// An image with all that it showed.
#[derive(Clone, Debug)]
pub(crate) struct LoggedImage {
    /// The odometry's own number, and the caller's.
    frame: FrameId,
    pub(crate) caller_frame: FrameId,
    /// Its stamp, in the clock of the images.
    pub(crate) stamp: Timestamp,
    pub(crate) observations: Vec<LoggedObservation>,
    pub(crate) state: Option<LoggedState>,
}

impl LoggedImage {
    /// The odometry's own number.
    pub(crate) fn number(&self) -> FrameId {
        self.frame
    }

    /// Whether it has a state of this segment.
    pub(crate) fn is_of(&self, segment: u32) -> bool {
        self.state.is_some_and(|s| s.segment == segment)
    }
}

/// Feature tracks, IMU measurements and states of a recording.
#[derive(Clone, Debug, Default)]
pub struct TrackLog {
    pub(crate) images: Vec<LoggedImage>,
    /// Number and stamp of every image.
    pub(crate) stamps: Vec<(FrameId, Timestamp)>,
    pub(crate) imu: Vec<ImuSample>,
    /// The IMU's rate, Hz.
    pub(crate) imu_rate_hz: f64,
    generation: u32,
    /// Images are logged so far apart.
    period: Duration,
    /// Images with their grey levels, to find what comes into view again.
    places: Vec<(Timestamp, Arc<HostImage>)>,
    place_period: Duration,
}

impl TrackLog {
    pub(crate) fn new(imu_rate_hz: f64) -> Self {
        Self { imu_rate_hz, period: LOG_PERIOD, place_period: FIRST_PLACE_PERIOD, ..Self::default() }
    }

    /// A log of every image, for what [`TrackLog::go_on_with`] adds to another one.
    pub(crate) fn of_every_image() -> Self {
        Self::default()
    }

    /// Keeps the grey levels of an image taken at `stamp`, where they are due. It must be logged, too.
    pub(crate) fn add_place(&mut self, stamp: Timestamp, image: &Arc<HostImage>) {
        if self.places.last().is_some_and(|(last, _)| stamp - *last < self.place_period) {
            return;
        }
        // Coarser levels add a third.
        let bytes = |image: &HostImage| image.pyramid.width() * image.pyramid.height() * 4 / 3;
        self.places.push((stamp, image.clone()));
        if self.places.len() * bytes(image) > MAX_PLACE_BYTES {
            let mut keeps = false;
            self.places.retain(|_| {
                keeps = !keeps;
                keeps
            });
            self.place_period = self.place_period + self.place_period;
        }
    }

    /// Drops all grey levels.
    pub(crate) fn forget_places(&mut self) {
        self.places.clear();
    }

    /// Grey levels of a logged image, where they were kept.
    pub(crate) fn place_of(&self, image: usize) -> Option<&HostImage> {
        let stamp = self.images[image].stamp;
        let at = self.places.binary_search_by_key(&stamp, |(stamp, _)| *stamp).ok()?;
        Some(&self.places[at].1)
    }

    /// The tracker starts anew.
    pub(crate) fn next_generation(&mut self) {
        self.generation = self.generation.wrapping_add(1);
    }

    /// Another tracker goes on from here: `other` has what it saw of the same images so far, so that its tracks overlap with those that end.
    pub(crate) fn go_on_with(&mut self, other: &Self) {
        let first = self.generation.wrapping_add(1);
        for image in &mut self.images {
            if let Ok(at) = other.images.binary_search_by_key(&image.frame, |i| i.frame) {
                image.observations.extend(other.images[at].observations.iter().map(|seen| {
                    let generation = first.wrapping_add(seen.key.generation);
                    LoggedObservation { key: TrackKey { generation, ..seen.key }, ..*seen }
                }));
            }
        }
        self.generation = first.wrapping_add(other.generation);
    }

    pub(crate) fn add_imu(&mut self, sample: &ImuSample) {
        self.imu.push(*sample);
    }

    /// IMU measurements as they came.
    pub(crate) fn imu_samples(&self) -> &[ImuSample] {
        &self.imu
    }

    /// The IMU measurements.
    pub(crate) fn imu(&self) -> ImuBuffer {
        let mut imu = ImuBuffer::new(self.imu_rate_hz);
        for sample in &self.imu {
            // What is out of order was left out by the odometry, too.
            let _ = imu.push(*sample);
        }
        imu
    }

    /// An image that the caller calls `caller_frame`.
    pub(crate) fn add_stamp(&mut self, caller_frame: FrameId, stamp: Timestamp) {
        self.stamps.push((caller_frame, stamp));
    }

    /// Whether an image taken at `stamp` is due to be logged.
    pub(crate) fn is_due(&self, stamp: Timestamp) -> bool {
        self.images.last().is_none_or(|last| stamp - last.stamp >= self.period)
    }

    /// Logs an image, with the caller's number and its stamp.
    pub(crate) fn add_image<'a>(
        &mut self,
        frame: FrameId,
        (caller_frame, stamp): (FrameId, Timestamp),
        state: Option<LoggedState>,
        shown: impl Iterator<Item = (LandmarkId, &'a Pixel, Matrix2<f64>)>,
    ) {
        let generation = self.generation;
        let observations = shown
            .map(|(track, pixel, covariance)| {
                LoggedObservation::new(TrackKey { generation, track }, pixel, &covariance)
            })
            .collect();
        self.images.push(LoggedImage { frame, caller_frame, stamp, observations, state });
    }

    /// The log with images at least `period` apart.
    pub(crate) fn every(&self, period: Duration) -> Self {
        Self {
            images: at_least(period, self.images.iter()),
            stamps: self.stamps.clone(),
            imu: self.imu.clone(),
            places: self.places.clone(),
            ..*self
        }
    }

    /// What was logged from a stamp on, without grey levels: images at least `period` apart, IMU measurements from `before` that stamp on.
    pub(crate) fn since(&self, stamp: Timestamp, before: Duration, period: Duration) -> Self {
        Self {
            images: at_least(period, self.images.iter().filter(|image| image.stamp >= stamp)),
            stamps: self.stamps.iter().filter(|(_, s)| *s >= stamp).copied().collect(),
            imu: self.imu.iter().filter(|s| s.time >= stamp - before).copied().collect(),
            places: Vec::new(),
            ..*self
        }
    }

    /// Drops what was logged before a stamp, a second at a time; IMU measurements that are `before` earlier.
    pub(crate) fn forget_before(&mut self, stamp: Timestamp, before: Duration) {
        let is_old = |first: Option<Timestamp>| first.is_some_and(|t| t < stamp - before - FORGET_PERIOD);
        if is_old(self.imu.first().map(|s| s.time)) || is_old(self.stamps.first().map(|(_, s)| *s)) {
            self.images.retain(|i| i.stamp >= stamp);
            self.stamps.retain(|(_, s)| *s >= stamp);
            self.imu.retain(|s| s.time >= stamp - before);
        }
    }

    /// Number of starts of the tracker so far.
    pub(crate) fn generation(&self) -> u32 {
        self.generation
    }

    /// Moves the states of a segment, whose world is `scale` times too small, into that of another one.
    pub(crate) fn join(&mut self, segment: u32, into: u32, into_from_segment: &Se3, scale: f64) {
        let states = self.images.iter_mut().filter_map(|i| i.state.as_mut());
        for logged in states.filter(|s| s.segment == segment) {
            logged.segment = into;
            logged.state.world_from_body.translation *= scale;
            logged.state.velocity *= scale;
            logged.state = logged.state.moved(into_from_segment);
        }
    }

    /// Where image `frame` shows a track, if it was logged.
    pub(crate) fn pixel_of(&self, frame: FrameId, key: TrackKey) -> Option<Pixel> {
        let image = self.images.iter().rev().find(|i| i.frame == frame)?;
        image.observations.iter().find(|o| o.key == key).map(LoggedObservation::pixel)
    }

    /// Adds a loop constraint: image `frame`, if it was logged, shows an earlier track.
    pub(crate) fn add_loop_constraint(
        &mut self,
        frame: FrameId,
        key: TrackKey,
        pixel: &Pixel,
        covariance: &Matrix2<f64>,
    ) {
        let Some(image) = self.images.iter_mut().rev().find(|i| i.frame == frame) else { return };
        if image.observations.iter().all(|o| o.key != key) {
            image.observations.push(LoggedObservation::new(key, pixel, covariance));
        }
    }

    /// Brings the states of images that the window still holds up to date; `in_world` takes them to the world of their segment.
    pub(crate) fn follow(&mut self, smoother: &Smoother, in_world: impl Fn(NavState) -> NavState) {
        let newest = self.images.len().saturating_sub(NEWEST_IMAGES);
        for image in &mut self.images[newest..] {
            if let (Some(logged), Some(state)) = (&mut image.state, smoother.state(image.frame)) {
                logged.state = in_world(*state);
            }
        }
    }
}

/// The images that are at least `period` apart.
fn at_least<'a>(period: Duration, all: impl Iterator<Item = &'a LoggedImage>) -> Vec<LoggedImage> {
    let mut images: Vec<LoggedImage> = Vec::new();
    for image in all {
        let is_due = |last: &LoggedImage| image.stamp - last.stamp >= period - STAMP_JITTER;
        if images.last().is_none_or(is_due) {
            images.push(image.clone());
        }
    }
    images
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn at(millis: i64) -> Timestamp {
        Timestamp::from_nanos(millis * 1_000_000)
    }

    fn sample(millis: i64) -> ImuSample {
        let zero = Vector3::zeros();
        ImuSample {
            time: at(millis),
            gyro: vidar_core::AngularRate(zero),
            accel: vidar_core::SpecificForce(zero),
        }
    }

    /// An image every 200 ms with a state at (number, 0, 0), IMU measurements every 10 ms.
    pub(in crate::bundle_adjustment) fn log(images: u32) -> TrackLog {
        let mut log = TrackLog::new(100.0);
        for k in 0..images {
            let stamp = at(i64::from(k) * 200);
            let mut state = NavState::REST;
            state.world_from_body.translation.x = f64::from(k);
            log.add_stamp(FrameId(k), stamp);
            let state = Some(LoggedState { segment: 3, state });
            log.add_image(FrameId(k), (FrameId(k), stamp), state, std::iter::empty());
        }
        (0..i64::from(images) * 20).for_each(|k| log.add_imu(&sample(10 * k)));
        log
    }

    #[test]
    fn tracks_of_another_tracker_overlap_with_those_that_end() {
        let show = |log: &mut TrackLog, frame: u32, track: u32| {
            let pixel = Vector2::new(f64::from(frame), 1.0);
            let shown = [(LandmarkId(track), &pixel, Matrix2::identity())];
            log.add_image(FrameId(frame), (FrameId(frame), at(0)), None, shown.into_iter());
        };
        let (mut log, mut other) = (TrackLog::new(100.0), TrackLog::of_every_image());
        log.next_generation();
        [2, 4, 6].into_iter().for_each(|frame| show(&mut log, frame, 7));
        [3, 4].into_iter().for_each(|frame| show(&mut other, frame, 7));
        // It had to start again.
        other.next_generation();
        [5, 6].into_iter().for_each(|frame| show(&mut other, frame, 7));
        assert!(other.is_due(at(0)) && !log.is_due(at(0)));
        log.go_on_with(&other);
        show(&mut log, 8, 7);
        let seen = |k: usize| log.images[k].observations.iter().map(|o| o.key.generation).collect::<Vec<_>>();
        assert_eq!([seen(0), seen(1), seen(2), seen(3)], [vec![1], vec![1, 2], vec![1, 3], vec![3]]);
    }

    #[test]
    fn what_is_older_than_needed_is_dropped_a_second_at_a_time() {
        let mut kept = log(50);
        kept.forget_before(at(1400), Duration::from_millis(500));
        assert_eq!(kept.images.len(), 50, "less than a second too old");
        kept.forget_before(at(4000), Duration::from_millis(500));
        assert_eq!((kept.images[0].stamp, kept.stamps[0].1), (at(4000), at(4000)));
        assert_eq!(kept.imu[0].time, at(3500));
        let whole = log(50);
        let late = whole.since(at(4000), Duration::from_millis(500), Duration::from_millis(400));
        assert_eq!((late.images.len(), late.stamps.len(), late.imu.len()), (15, 30, kept.imu.len()));
        assert_eq!(whole.images.len(), 50);
    }
}
