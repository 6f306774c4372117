//! Measurements of a stream in the order of their stamps, images decoded ahead of their turn.

use super::feed::{Feed, Item, Kind};
use super::stamps::Stamps;
use super::{Shared, Topics, load};
use crate::ahead::Decoders;
use crate::error::DatasetError;
use crate::location::Location;
use crate::recording::ImageEntry;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, PoisonError};
use std::time::Instant;
use vidar_bag::{StreamPlace, StreamTopic};
use vidar_core::{CameraId, Duration, FrameId, FrameImage, ImuSample, Timestamp, Warning};

/// A sensor that is this far ahead of the other is not held back any longer: the other one has stopped.
const MOST_HELD: Duration = Duration::from_millis(2000);
/// IMU samples before and after the selected part, as for files.
const LEAD_IN: Duration = Duration::from_millis(3000);
/// Messages in a row of the IMU, and of the camera, that come behind later ones when its clock was set back: a second at 200 and at 20 Hz.
const CLOCK_SET_BACK: [usize; 2] = [200, 20];
/// Intervals between images that tell when the next one can come at the earliest.
const INTERVALS: usize = 8;

/// What is taken of a stream.
#[derive(Debug)]
pub(super) struct Wanted {
    pub topics: Topics,
    /// Columns and rows that images must have.
    pub size: Option<(usize, usize)>,
    pub camera: CameraId,
    pub start: Option<Duration>,
    pub end: Option<Duration>,
}

/// A measurement that arrived.
#[derive(Debug)]
pub struct Arrival {
    /// When its message came.
    pub came: Instant,
    /// What came.
    pub what: Arrived,
}

/// What an arrival is.
#[derive(Debug)]
pub enum Arrived {
    /// A sample of the IMU.
    Imu(ImuSample),
    /// An image with its pixels, or why it has none.
    Image(ImageEntry, Box<Result<FrameImage, DatasetError>>),
}

/// An image that waits for its turn.
struct Waiting {
    came: Instant,
    entry: ImageEntry,
    topic: Arc<StreamTopic>,
    place: StreamPlace,
    asked: Option<Receiver<Result<FrameImage, DatasetError>>>,
}

/// The measurements of an arriving recording.
pub struct Arrivals {
    /// What came while the recording was opened.
    opening: std::vec::IntoIter<Item>,
    feed: Feed,
    wanted: Wanted,
    shared: Arc<Shared>,
    decoders: Option<Decoders>,
    imu: VecDeque<(ImuSample, Instant)>,
    images: VecDeque<Waiting>,
    first_image: Option<Timestamp>,
    last_image: Option<Timestamp>,
    /// The newest intervals between images.
    intervals: VecDeque<Duration>,
    /// Of the IMU and of the camera.
    stamps: [Stamps; 2],
    /// Images of the topic so far, and those in the order of time.
    came: u32,
    numbered: u32,
    has_ended: bool,
}

impl Arrivals {
    pub(super) fn new(opening: Vec<Item>, feed: Feed, wanted: Wanted, shared: Arc<Shared>) -> Self {
        Self {
            opening: opening.into_iter(),
            feed,
            wanted,
            shared,
            decoders: None,
            imu: VecDeque::new(),
            images: VecDeque::new(),
            first_image: None,
            last_image: None,
            intervals: VecDeque::new(),
            stamps: Default::default(),
            came: 0,
            numbered: 0,
            has_ended: false,
        }
    }

    /// The next measurement, waiting for it while `go_on` says so; `None` at the end of the stream. At equal times the IMU comes first. An
    /// image that comes in less than half of the shortest interval before it can be behind IMU samples that are later.
    pub fn next(&mut self, go_on: &dyn Fn() -> bool) -> Option<Arrival> {
        while !self.has_ended && !self.is_decided() {
            let item = match self.opening.next() {
                Some(item) => Ok(Some(item)),
                None => self.feed.next(go_on),
            };
            match item {
                Ok(Some(item)) => self.take(item),
                Ok(None) => self.end(),
                Err(error) => {
                    self.shared.warn(Warning::degraded("stream-broken", error.to_string()));
                    self.end();
                }
            }
        }
        self.decode_ahead();
        let image = self.images.front().map(|i| i.entry.time);
        let is_first = |(s, _): &(ImuSample, Instant)| image.is_none_or(|t| s.time <= t);
        if let Some((sample, came)) = self.imu.front().copied().filter(is_first) {
            self.imu.pop_front();
            return Some(Arrival { came, what: Arrived::Imu(sample) });
        }
        let Waiting { came, entry, topic, place, asked } = self.images.pop_front()?;
        let loaded = asked.and_then(|answer| answer.recv().ok());
        let image =
            loaded.unwrap_or_else(|| load(&self.shared.kept, &entry, &topic, &place, self.wanted.size));
        self.decode_ahead();
        Some(Arrival { came, what: Arrived::Image(entry, Box::new(image)) })
    }

    /// Whether nothing that is still to come is earlier than what is here.
    fn is_decided(&self) -> bool {
        let (imu, images) = (&self.imu, &self.images);
        if self.wanted.topics.imu.is_none() {
            return !images.is_empty();
        }
        let is_long = |span: Option<Duration>| span.is_some_and(|span| span > MOST_HELD);
        let of_imu = || imu.back().zip(imu.front()).map(|((last, _), (first, _))| last.time - first.time);
        let of_images =
            || images.back().zip(images.front()).map(|(last, first)| last.entry.time - first.entry.time);
        match (imu.is_empty(), images.is_empty()) {
            (false, false) => true,
            // The image before waits for samples after it.
            (false, true) => {
                let next = self.next_image_from();
                is_long(of_imu()) || imu.front().zip(next).is_some_and(|((first, _), t)| first.time <= t)
            }
            (true, false) => is_long(of_images()),
            (true, true) => false,
        }
    }

    /// Until when no further image comes, where their rhythm is known.
    fn next_image_from(&self) -> Option<Timestamp> {
        let shortest = self.intervals.iter().min().filter(|_| self.intervals.len() == INTERVALS)?;
        Some(self.last_image? + Duration::from_nanos(shortest.nanos() / 2))
    }

    fn take(&mut self, item: Item) {
        let (sensor, number) = match item.kind {
            Kind::Imu(_) if self.wanted.topics.imu.as_ref() == Some(&item.topic.name) => (0, 0),
            Kind::Image if self.wanted.topics.image == item.topic.name => (1, self.came),
            _ => return,
        };
        self.came += u32::from(sensor == 1);
        let Some(stamps) = self.stamps.get_mut(sensor) else { return };
        let passed = stamps.pass(item);
        let is_set_back = CLOCK_SET_BACK.get(sensor).is_some_and(|most| stamps.behind_in_a_row() >= *most);
        for (item, before) in passed.into_iter().zip([1, 0]) {
            match item {
                Some(Item { kind: Kind::Imu(sample), came, .. }) => {
                    self.imu.push_back((sample, came));
                    self.drop_unwanted();
                }
                Some(item) => self.image(item, number.saturating_sub(before)),
                None => {}
            }
        }
        if is_set_back {
            let message = "stamps went back and stay behind: a clock was set; what came before is used";
            self.shared.warn(Warning::degraded("clock-set-back", message.to_owned()));
            self.end();
        }
    }

    fn image(&mut self, item: Item, number: u32) {
        if let Some(last) = self.last_image {
            self.intervals.push_back(item.time - last);
            self.intervals.drain(..self.intervals.len().saturating_sub(INTERVALS));
        }
        self.last_image = Some(item.time);
        let first = *self.first_image.get_or_insert(item.time);
        let frame_id = FrameId(self.numbered);
        self.numbered += 1;
        self.drop_unwanted();
        let after = item.time - first;
        if self.wanted.start.is_some_and(|s| after < s) || self.wanted.end.is_some_and(|e| after > e) {
            return;
        }
        let (bag, topic): (Arc<Path>, Arc<str>) =
            (self.shared.kept.path().into(), item.topic.name.as_str().into());
        let location = Location::Message { bag, topic, number };
        let entry = ImageEntry { frame_id, time: item.time, camera: self.wanted.camera, location };
        let mut images = self.shared.images.write().unwrap_or_else(PoisonError::into_inner);
        images.push((entry.clone(), Arc::clone(&item.topic), item.place));
        drop(images);
        let Item { topic, place, came, .. } = item;
        self.images.push_back(Waiting { came, entry, topic, place, asked: None });
    }

    /// Lets IMU samples go that lie outside of the selected part.
    fn drop_unwanted(&mut self) {
        let (Some(first), start, end) = (self.first_image, self.wanted.start, self.wanted.end) else {
            return;
        };
        if start.is_none() && end.is_none() {
            return;
        }
        let from = start.map(|s| first + s - LEAD_IN);
        let to = end.map(|e| first + e + LEAD_IN);
        self.imu.retain(|(s, _)| from.is_none_or(|t| s.time >= t) && to.is_none_or(|t| s.time <= t));
    }

    fn decode_ahead(&mut self) {
        let decoders = self.decoders.get_or_insert_with(Decoders::for_images);
        for waiting in self.images.iter_mut().take(decoders.most_asked()) {
            if waiting.asked.is_none() {
                let (kept, size) = (Arc::clone(&self.shared.kept), self.wanted.size);
                let (entry, topic, place) =
                    (waiting.entry.clone(), Arc::clone(&waiting.topic), waiting.place);
                waiting.asked = Some(decoders.ask(move || load(&kept, &entry, &topic, &place, size)));
            }
        }
    }

    fn end(&mut self) {
        self.has_ended = true;
        self.feed.ending().into_iter().for_each(|w| self.shared.warn(w));
        for (stamps, what) in self.stamps.iter().zip(["IMU samples", "images"]) {
            let count = stamps.left_out();
            if count > 0 {
                let message = format!(
                    "{count} {what} came behind later ones, or far ahead of all others, and are left out"
                );
                self.shared
                    .warn(Warning::new("time-not-increasing", message).hint("files are sorted before use"));
            }
        }
    }
}

impl std::fmt::Debug for Arrivals {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Arrivals").field("wanted", &self.wanted).finish_non_exhaustive()
    }
}
