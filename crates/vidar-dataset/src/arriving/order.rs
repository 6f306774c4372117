//! Measurements of a stream in the order of their stamps, images decoded ahead of their turn.

use super::feed::{Feed, Item, Kind};
use super::{Shared, Topics, load};
use crate::ahead::Decoders;
use crate::error::DatasetError;
use crate::location::Location;
use crate::recording::ImageEntry;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, PoisonError};
use vidar_bag::{StreamPlace, StreamTopic};
use vidar_core::{CameraId, Duration, FrameId, FrameImage, ImuSample, Timestamp, Warning};

/// A sensor that is this far ahead of the other is not held back any longer: the other one has stopped.
const MOST_HELD: Duration = Duration::from_millis(2000);
/// IMU samples before and after the selected part, as for files.
const LEAD_IN: Duration = Duration::from_millis(3000);

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
pub enum Arrival {
    /// A sample of the IMU.
    Imu(ImuSample),
    /// An image with its pixels, or why it has none.
    Image(ImageEntry, Box<Result<FrameImage, DatasetError>>),
}

/// An image that waits for its turn.
struct Waiting {
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
    imu: VecDeque<ImuSample>,
    images: VecDeque<Waiting>,
    first_image: Option<Timestamp>,
    last_imu: Option<Timestamp>,
    last_image: Option<Timestamp>,
    /// Images of the topic so far, and those in the order of time.
    came: u32,
    numbered: u32,
    out_of_order: [usize; 2],
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
            last_imu: None,
            last_image: None,
            came: 0,
            numbered: 0,
            out_of_order: [0; 2],
            has_ended: false,
        }
    }

    /// The next measurement, waiting for it while `go_on` says so; `None` at the end of the stream. At equal times the IMU comes first.
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
        if let Some(sample) = self.imu.front().copied().filter(|s| image.is_none_or(|t| s.time <= t)) {
            self.imu.pop_front();
            return Some(Arrival::Imu(sample));
        }
        let Waiting { entry, topic, place, asked } = self.images.pop_front()?;
        let loaded = asked.and_then(|answer| answer.recv().ok());
        let image =
            loaded.unwrap_or_else(|| load(&self.shared.kept, &entry, &topic, &place, self.wanted.size));
        self.decode_ahead();
        Some(Arrival::Image(entry, Box::new(image)))
    }

    /// Whether nothing that is still to come is earlier than what is here.
    fn is_decided(&self) -> bool {
        let (imu, images) = (&self.imu, &self.images);
        if self.wanted.topics.imu.is_none() {
            return !images.is_empty();
        }
        let is_long = |span: Option<Duration>| span.is_some_and(|span| span > MOST_HELD);
        let of_imu = || imu.back().zip(imu.front()).map(|(last, first)| last.time - first.time);
        let of_images =
            || images.back().zip(images.front()).map(|(last, first)| last.entry.time - first.entry.time);
        match (imu.is_empty(), images.is_empty()) {
            (false, false) => true,
            (false, true) => is_long(of_imu()),
            (true, false) => is_long(of_images()),
            (true, true) => false,
        }
    }

    fn take(&mut self, item: Item) {
        match item.kind {
            Kind::Imu(sample) if self.wanted.topics.imu.as_ref() == Some(&item.topic.name) => {
                if self.last_imu.is_some_and(|t| sample.time <= t) {
                    self.out_of_order[0] += 1;
                    return;
                }
                self.last_imu = Some(sample.time);
                self.imu.push_back(sample);
                self.drop_unwanted();
            }
            Kind::Image if self.wanted.topics.image == item.topic.name => self.image(item),
            _ => {}
        }
    }

    fn image(&mut self, item: Item) {
        let number = self.came;
        self.came += 1;
        if self.last_image.is_some_and(|t| item.time <= t) {
            self.out_of_order[1] += 1;
            return;
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
        self.images.push_back(Waiting { entry, topic: item.topic, place: item.place, asked: None });
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
        self.imu.retain(|s| from.is_none_or(|t| s.time >= t) && to.is_none_or(|t| s.time <= t));
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
        for (count, what) in self.out_of_order.iter().zip(["IMU samples", "images"]) {
            if *count > 0 {
                let message = format!("{count} {what} came behind later ones and are left out");
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
