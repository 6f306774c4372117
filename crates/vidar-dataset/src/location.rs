//! Where the pixels of an image lie, and how they are read from there.

use crate::decode::{self, ImageLimits};
use crate::error::{DatasetError, io_error};
use crate::isolated::isolated;
use crate::recording::check_size;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_bag::{Bag, BagError, Message, MessageRef, Pixels, Topic};
use vidar_core::{FrameImage, Image, Timestamp};
use vidar_video::{Video, VideoStream};

/// Where the pixels of an image lie.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Location {
    /// An image file.
    File(PathBuf),
    /// A message of a bag.
    Message {
        /// The bag.
        bag: Arc<Path>,
        /// Its topic.
        topic: Arc<str>,
        /// The message's number in the topic, from 0, in the order of logging.
        number: u32,
    },
    /// A frame of a video.
    Frame {
        /// The video.
        video: Arc<Path>,
        /// The frame's number, from 0, in the order of display.
        number: u32,
    },
}

impl Location {
    /// The file or folder that the user knows: the image, or what it is in.
    pub fn path(&self) -> &Path {
        match self {
            Self::File(path) => path,
            Self::Message { bag, .. } => bag,
            Self::Frame { video, .. } => video,
        }
    }

    /// The image file; `None` for an image inside a recording.
    pub fn as_file(&self) -> Option<&Path> {
        match self {
            Self::File(path) => Some(path),
            Self::Message { .. } | Self::Frame { .. } => None,
        }
    }

    /// As a path for messages, which need not exist.
    pub(crate) fn place(&self) -> PathBuf {
        match self {
            Self::File(path) => path.clone(),
            other => PathBuf::from(other.to_string()),
        }
    }
}

impl From<PathBuf> for Location {
    fn from(path: PathBuf) -> Self {
        Self::File(path)
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Message { bag, topic, number } => write!(f, "{} {topic} message {number}", bag.display()),
            Self::Frame { video, number } => write!(f, "{} frame {number}", video.display()),
        }
    }
}

/// Files with their times as locations.
pub(crate) fn files(list: Vec<(Timestamp, PathBuf)>) -> Vec<(Timestamp, Location)> {
    list.into_iter().map(|(time, path)| (time, path.into())).collect()
}

/// The open recording that locations refer to; empty for folders of files.
#[derive(Clone, Debug, Default)]
pub(crate) struct Media {
    pub bag: Option<Arc<Bag>>,
    pub video: Option<Arc<Video>>,
    /// A topic of the bag that is compressed video: a picture of it needs the messages before.
    pub stream: Option<(Arc<str>, Arc<VideoStream>)>,
    /// A folder of confidences, named as the depth images are.
    pub depth_confidence: Option<PathBuf>,
}

/// Depth of a lower confidence is none: 0 is low, 1 medium, 2 high (ARKit's `ARConfidenceLevel`).
const MIN_CONFIDENCE: u8 = 1;

/// Depth as it is stored.
pub(crate) enum StoredDepth {
    /// Whole numbers of some unit.
    Units(Image<u16>),
    /// Metres; what is not finite and positive is no depth.
    Metres(Image<f32>),
}

impl StoredDepth {
    pub(crate) fn size(&self) -> (usize, usize) {
        match self {
            Self::Units(raw) => (raw.width(), raw.height()),
            Self::Metres(raw) => (raw.width(), raw.height()),
        }
    }
}

impl Media {
    /// Whether pictures come from a decoder one after the other.
    pub(crate) fn is_video(&self) -> bool {
        self.video.is_some() || self.stream.is_some()
    }

    /// Decodes a grey or colour image, whose size must be the expected one.
    pub(crate) fn image_of_size(
        &self,
        location: &Location,
        expected: Option<(usize, usize)>,
    ) -> Result<FrameImage, DatasetError> {
        let image = self.image(location)?;
        expected.map_or(Ok(()), |size| check_size(location, (image.width(), image.height()), size))?;
        Ok(image)
    }

    /// Decodes a grey or colour image.
    pub(crate) fn image(&self, location: &Location) -> Result<FrameImage, DatasetError> {
        if let Location::Frame { number, .. } = location {
            return Ok(self.video(location)?.frame(*number as usize)?);
        }
        if let Some((stream, number)) = self.stream(location) {
            return stream.frame(number).map_err(|reason| bad_image(location, reason));
        }
        match self.message(location)? {
            None => decode::read_image(location.path()),
            Some(message) => match pixels(&message).map_err(|reason| bad_image(location, reason))? {
                Pixels::Image(image) => Ok(image),
                Pixels::Float(_) => Err(bad_image(location, "numbers of 32 bits, which are depth".into())),
            },
        }
    }

    /// Decodes a depth image.
    pub(crate) fn depth(&self, location: &Location) -> Result<StoredDepth, DatasetError> {
        let Some(message) = self.message(location)? else {
            let raw = decode::read_depth(location.path())?;
            return self.confident(location.path(), raw).map(StoredDepth::Units);
        };
        match pixels(&message).map_err(|reason| bad_image(location, reason))? {
            Pixels::Float(metres) => Ok(StoredDepth::Metres(metres)),
            Pixels::Image(FrameImage::Gray16(raw)) => Ok(StoredDepth::Units(raw)),
            Pixels::Image(_) => Err(bad_image(location, "8-bit pixels; depth is 16UC1 or 32FC1".into())),
        }
    }

    /// Depth with 0 where its confidence is low; as it is where there is no confidence.
    fn confident(&self, depth: &Path, raw: Image<u16>) -> Result<Image<u16>, DatasetError> {
        let beside = |folder: &PathBuf| Some(folder.join(depth.file_name()?));
        let Some(path) = self.depth_confidence.as_ref().and_then(beside).filter(|p| p.is_file()) else {
            return Ok(raw);
        };
        let reason = match decode::read_image(&path)? {
            FrameImage::Gray8(levels) if (levels.width(), levels.height()) == (raw.width(), raw.height()) => {
                let kept = |(depth, level): (&u16, &u8)| if *level < MIN_CONFIDENCE { 0 } else { *depth };
                let pixels = raw.data().iter().zip(levels.data()).map(kept).collect();
                return Image::from_vec(raw.width(), raw.height(), pixels)
                    .map_err(|e| DatasetError::BadImage { path: path.clone(), reason: e.to_string() });
            }
            other => format!(
                "{}x{} levels of confidence, depth is {}x{}",
                other.width(),
                other.height(),
                raw.width(),
                raw.height()
            ),
        };
        Err(DatasetError::BadImage { path, reason })
    }

    /// Columns and rows.
    pub(crate) fn size(&self, location: &Location) -> Result<(usize, usize), DatasetError> {
        if let Location::Frame { .. } = location {
            return Ok(self.video(location)?.size());
        }
        if let Some((stream, _)) = self.stream(location) {
            return Ok(stream.size());
        }
        match self.message(location)? {
            None => decode::read_size(location.path()),
            Some(Message::Image(image)) => Ok((image.width as usize, image.height as usize)),
            Some(message) => match pixels(&message).map_err(|reason| bad_image(location, reason))? {
                Pixels::Image(image) => Ok((image.width(), image.height())),
                Pixels::Float(image) => Ok((image.width(), image.height())),
            },
        }
    }

    fn video(&self, location: &Location) -> Result<&Video, DatasetError> {
        self.video.as_deref().ok_or_else(|| bad_image(location, "the recording is not open".into()))
    }

    /// The stream of compressed video that a location is a picture of, and the picture's number.
    fn stream(&self, location: &Location) -> Option<(&VideoStream, usize)> {
        let (Location::Message { topic, number, .. }, Some((name, stream))) = (location, &self.stream) else {
            return None;
        };
        (name == topic).then_some((stream, *number as usize))
    }

    /// Says which pictures will be asked for, so that a video decodes no more than these need.
    pub(crate) fn expect<'a>(&self, locations: impl Iterator<Item = &'a Location> + Clone) {
        if let Some(video) = &self.video {
            let number = |location: &Location| match location {
                Location::Frame { number, .. } => Some(*number as usize),
                _ => None,
            };
            video.expect(locations.clone().filter_map(number));
        }
        if let Some((_, stream)) = &self.stream {
            stream.expect(locations.filter_map(|location| Some(self.stream(location)?.1)));
        }
    }

    /// The message at a location; `None` for a file.
    fn message(&self, location: &Location) -> Result<Option<Message>, DatasetError> {
        let Location::Message { topic, number, .. } = location else { return Ok(None) };
        let lost = || bad_image(location, "the recording is not open".into());
        let bag = self.bag.as_ref().ok_or_else(lost)?;
        let found = bag.topics().iter().find(|t| *t.name == **topic);
        let message = found.and_then(|t| t.messages.get(*number as usize)).ok_or_else(lost)?;
        Ok(Some(bag.read(message)?))
    }

    /// What identifies the recording that images lie in: names and sizes of its files.
    pub(crate) fn fingerprint(&self) -> Result<String, DatasetError> {
        let mut text = String::new();
        let files = self.bag.iter().flat_map(|b| b.files()).chain(self.video.iter().map(|v| v.path()));
        for path in files {
            let size = std::fs::metadata(path).map_err(io_error(path))?.len();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            text.push_str(&format!("{name} {size}\n"));
        }
        Ok(text)
    }
}

fn bad_image(location: &Location, reason: String) -> DatasetError {
    DatasetError::BadImage { path: location.place(), reason }
}

/// Bytes that `compressed_depth_image_transport` puts before the PNG.
const DEPTH_PREFIX_BYTES: usize = 12;

/// The pixels of an image message, raw or compressed.
pub(crate) fn pixels(message: &Message) -> Result<Pixels, String> {
    match message {
        Message::Image(image) => image.pixels(),
        Message::CompressedImage(image) => {
            let is_depth = image.format.contains("compressedDepth");
            let bytes =
                if is_depth { image.data.get(DEPTH_PREFIX_BYTES..) } else { Some(image.data.as_slice()) };
            let bytes = bytes.ok_or("a compressed depth image without its head")?;
            isolated(|| decode::decode_image(bytes, &ImageLimits::default()))
                .map(Pixels::Image)
                .map_err(|reason| format!("{reason} (format {:?})", vidar_core::printable(&image.format)))
        }
        _ => Err("no image".into()),
    }
}

/// The messages of a topic as locations, with their stamps.
pub(crate) fn locate(
    bag: &Bag,
    topic: &Topic,
    mut stamp: impl FnMut(&MessageRef) -> Result<Timestamp, BagError>,
) -> Result<Vec<(Timestamp, Location)>, DatasetError> {
    let (path, name): (Arc<Path>, Arc<str>) = (bag.path().into(), topic.name.as_str().into());
    let mut at = |number: usize, message: &MessageRef| {
        let location =
            Location::Message { bag: Arc::clone(&path), topic: Arc::clone(&name), number: number as u32 };
        Ok((stamp(message)?, location))
    };
    topic.messages.iter().enumerate().map(|(number, message)| at(number, message)).collect()
}
