//! A recording that is still made: MCAP from a stream, kept in a file while it comes.
//!
//! ```text
//! stream ─▶ thread: file, push parser ─▶ bounded queue ─▶ opening: facts from the beginning of the file
//!                                                      └▶ Arrivals: IMU and images in the order of their stamps
//! ```

mod feed;
mod order;
mod stamps;

pub use order::{Arrival, Arrivals, Arrived};

use crate::bag;
use crate::error::DatasetError;
use crate::location::pixels;
use crate::options::OpenOptions;
use crate::recording::{ImageEntry, Recording};
use crate::topics::{self, ImuTopics};
use feed::{Feed, Item, Kind};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use vidar_bag::{Bag, KeptStream, Pixels, Role, StreamPlace, StreamTopic, role_of};
use vidar_core::{Duration, FrameId, FrameImage, Timestamp, Warning};

/// What the stream tells before its first measurement is used: IMU samples up to this long after the first image show the
/// noise of the IMU, and topics and calibration have come, too.
pub const OPENING: Duration = Duration::from_millis(2500);
/// A stream without a calibration or without an IMU is not waited for any longer.
const LONGEST_OPENING: Duration = Duration::from_millis(10_000);
/// Most messages of the opening that are kept for the measurements: ten seconds at 20 kHz.
const MOST_OPENING_MESSAGES: usize = 200_000;

/// An image of the stream and where its message lies.
type Place = (ImageEntry, Arc<StreamTopic>, StreamPlace);

/// What the threads of an arriving recording share.
#[derive(Debug)]
struct Shared {
    kept: Arc<KeptStream>,
    /// Every image that was handed out, in the order of time.
    images: RwLock<Vec<Place>>,
    /// What was noticed on the way.
    warnings: Mutex<Vec<Warning>>,
}

impl Shared {
    fn warn(&self, warning: Warning) {
        self.warnings.lock().unwrap_or_else(PoisonError::into_inner).push(warning);
    }
}

/// A recording that is still made. Its facts are those of its first seconds, its measurements come by [`ArrivingRecording::arrivals`], and
/// its images can be read again while it goes on.
#[derive(Debug)]
pub struct ArrivingRecording {
    path: PathBuf,
    options: OpenOptions,
    shared: Arc<Shared>,
    arrivals: Mutex<Option<Arrivals>>,
}

impl ArrivingRecording {
    /// Takes a stream of MCAP, keeps it in `path` and returns what its beginning tells: topics, calibration, sensors, and the IMU samples of
    /// [`OPENING`]. Poses and depth of the stream are left to [`ArrivingRecording::whole`]. `go_on` is asked while nothing comes.
    ///
    /// # Errors
    /// The stream is no MCAP, or has no images that can be used as they come; `path` cannot be written.
    pub fn open(
        input: impl Read + Send + 'static,
        path: &Path,
        options: &OpenOptions,
        go_on: &dyn Fn() -> bool,
    ) -> Result<(Self, Recording), DatasetError> {
        options.validate()?;
        let feed = Feed::start(input, path)?;
        let shared =
            Arc::new(Shared { kept: feed.kept(), images: RwLock::default(), warnings: Mutex::default() });
        let opening = Opening::take(&feed, options, go_on)?;
        let bag = Arc::new(Bag::open_beginning(path, opening.bytes)?);
        let topics = Topics::choose(&bag, options)?;
        let facts = facts(&bag, path, options)?;
        let wanted = order::Wanted {
            topics,
            size: facts.rig.camera(facts.camera).map(|c| (c.model.width(), c.model.height())),
            camera: facts.camera,
            start: options.start,
            end: options.end,
        };
        let arrivals = Arrivals::new(opening.items, feed, wanted, Arc::clone(&shared));
        let arrivals = Mutex::new(Some(arrivals));
        Ok((Self { path: path.to_path_buf(), options: options.clone(), shared, arrivals }, facts))
    }

    /// The measurements, once; `None` the second time.
    pub fn arrivals(&self) -> Option<Arrivals> {
        self.arrivals.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Reads an image that came, again.
    ///
    /// # Errors
    /// No such image came, or it cannot be decoded.
    pub fn load_image(&self, frame: FrameId, time: Timestamp) -> Result<FrameImage, DatasetError> {
        let images = self.shared.images.read().unwrap_or_else(PoisonError::into_inner);
        let found = images.binary_search_by_key(&time, |(entry, ..)| entry.time);
        let found = found.ok().and_then(|i| images.get(i)).filter(|(entry, ..)| entry.frame_id == frame);
        let Some((entry, topic, place)) = found.cloned() else {
            let reason = format!("the stream had no image {frame}");
            return Err(DatasetError::BadImage { path: self.path.clone(), reason });
        };
        drop(images);
        load(&self.shared.kept, &entry, &topic, &place, None)
    }

    /// What was noticed on the way so far, such as that the stream is cut off.
    pub fn take_warnings(&self) -> Vec<Warning> {
        std::mem::take(&mut *self.shared.warnings.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The recording as it was kept, once the stream has ended.
    ///
    /// # Errors
    /// As [`crate::open`].
    pub fn whole(&self) -> Result<Recording, DatasetError> {
        crate::open(&self.path, &self.options)
    }
}

/// The facts of the beginning, without what only the whole recording has.
fn facts(bag: &Arc<Bag>, path: &Path, options: &OpenOptions) -> Result<Recording, DatasetError> {
    let uncut = OpenOptions { start: None, end: None, ..options.clone() };
    let mut facts = bag::of(Arc::clone(bag), path, "a stream of MCAP".into(), &uncut)?.finish(&uncut)?;
    facts.ground_truth = None;
    facts.depths.clear();
    facts.depth_sensor = None;
    if options.trajectory.is_none() {
        facts.external_trajectory = None;
    }
    let until = facts.images.first().map(|i| i.time + OPENING);
    facts.imu.retain(|s| until.is_none_or(|t| s.time <= t));
    Ok(facts)
}

/// Names of the topics whose messages are used.
#[derive(Clone, Debug)]
struct Topics {
    image: String,
    imu: Option<String>,
}

impl Topics {
    fn choose(bag: &Bag, options: &OpenOptions) -> Result<Self, DatasetError> {
        let choice = topics::choose(bag, options)?;
        if role_of(&choice.image.message_type, choice.image.encoding) == Some(Role::Video) {
            let what = format!("{} is compressed video, which is not read from a stream", choice.image.name);
            return Err(topics::problem(bag, format!("{what}; write the stream to a file and give that")));
        }
        let imu = match choice.imu {
            ImuTopics::None => None,
            ImuTopics::One(topic) => Some(topic.name.clone()),
            ImuTopics::Apart { gyro, accel } => {
                let what = format!("gyroscope and accelerometer come apart ({}, {})", gyro.name, accel.name);
                let way = "a stream needs one topic of both; write it to a file and give that";
                return Err(topics::problem(bag, format!("{what}; {way}")));
            }
        };
        Ok(Self { image: choice.image.name.clone(), imu })
    }
}

/// The first seconds of a stream.
struct Opening {
    items: Vec<Item>,
    /// Bytes of the stream in which they came.
    bytes: u64,
}

impl Opening {
    /// Takes messages until the stream has told enough, or ends.
    fn take(feed: &Feed, options: &OpenOptions, go_on: &dyn Fn() -> bool) -> Result<Self, DatasetError> {
        let (mut items, mut bytes) = (Vec::new(), 0);
        let mut has_calibration = options.camera_model.is_some() || !options.calibration.is_empty();
        let (mut first, mut last, mut imu) = (None::<Timestamp>, None::<Timestamp>, None::<Timestamp>);
        loop {
            let Some(item) = feed.next(go_on)? else {
                // The stream has ended: all of it is its beginning.
                bytes = u64::MAX;
                break;
            };
            bytes = bytes.max(item.end);
            match item.kind {
                Kind::Image => {
                    first = first.or(Some(item.time));
                    last = last.max(Some(item.time));
                }
                Kind::Imu(_) => imu = imu.max(Some(item.time)),
                Kind::CameraInfo => has_calibration = true,
            }
            items.push(item);
            if items.len() >= MOST_OPENING_MESSAGES {
                break;
            }
            // A chunk holds messages in any order: the facts are those of its end.
            let (Some(first), Some(last)) = (first, last) else { continue };
            let is_told =
                has_calibration && imu.is_some_and(|t| t > first + OPENING) && last > first + OPENING;
            if is_told || last > first + LONGEST_OPENING {
                break;
            }
        }
        Ok(Self { items, bytes })
    }
}

/// Reads and decodes an image.
fn load(
    kept: &KeptStream,
    entry: &ImageEntry,
    topic: &StreamTopic,
    place: &StreamPlace,
    size: Option<(usize, usize)>,
) -> Result<FrameImage, DatasetError> {
    let bad = |reason: String| DatasetError::BadImage { path: entry.location.place(), reason };
    let bytes = kept.bytes(place)?;
    let message = topic.decode(&bytes).map_err(bad)?;
    match pixels(&message).map_err(bad)? {
        Pixels::Float(_) => Err(bad("numbers of 32 bits, which are depth".into())),
        Pixels::Image(image) => {
            let found = (image.width(), image.height());
            size.map_or(Ok(()), |size| crate::recording::check_size(&entry.location, found, size))?;
            Ok(image)
        }
    }
}
