//! Compressed video of a bag: the messages of a topic as the access units of a stream.

use crate::error::DatasetError;
use crate::topics::problem;
use std::sync::Arc;
use vidar_bag::{Bag, CompressedImage, Header, Message, MessageRef, Topic};
use vidar_core::{Timestamp, Warning, printable};
use vidar_video::{AccessUnits, StreamCodec, StreamUnit, VideoStream};

/// Messages of a topic, read when they are decoded.
struct UnitsOfTopic {
    bag: Arc<Bag>,
    /// Index of the topic in the bag.
    topic: usize,
}

impl AccessUnits for UnitsOfTopic {
    fn read(&self, number: usize) -> Result<Vec<u8>, String> {
        let topic = self.bag.topics().get(self.topic).ok_or("the topic is not in the bag")?;
        let message = topic.messages.get(number).ok_or("the topic has no such message")?;
        match self.bag.read(message).map_err(|e| e.to_string())? {
            Message::CompressedVideo(unit) => Ok(unit.data),
            _ => Err("no compressed video".into()),
        }
    }
}

/// A topic of compressed video, ready to be decoded.
pub(crate) struct BagVideo {
    pub stream: VideoStream,
    pub topic: Arc<str>,
    /// Stamps of all messages.
    pub times: Vec<Timestamp>,
    /// The first message that can be decoded.
    pub first: usize,
    /// Name of the camera's frame.
    pub frame: String,
    pub warnings: Vec<Warning>,
}

/// Looks through a topic of compressed video once: its stamps, and where decoding can begin. Nothing but the first picture is decoded.
pub(crate) fn open(
    bag: &Arc<Bag>,
    topic: &Topic,
    time: impl Fn(&Header, &MessageRef) -> Timestamp,
) -> Result<BagVideo, DatasetError> {
    let name = printable(&topic.name).into_owned();
    let failed = |what: String| problem(bag, format!("the compressed video of {name} {what}"));
    let (mut codec, mut parameter_sets, mut unread) = (None, Vec::new(), 0usize);
    let (mut frame, mut units) = (String::new(), Vec::new());
    for message in &topic.messages {
        let unit = match bag.read(message) {
            Ok(Message::CompressedVideo(unit)) => unit,
            _ => {
                unread += 1;
                CompressedImage { header: Header::default(), format: String::new(), data: Vec::new() }
            }
        };
        let stated = StreamCodec::from_name(&unit.format);
        if stated.is_none() && !unit.data.is_empty() {
            let format = printable(&unit.format).into_owned();
            let way = "h264 and h265 are decoded; record one of them, or images";
            return Err(failed(format!("is {format:?}: {way}")));
        }
        codec = codec.or(stated);
        if parameter_sets.is_empty()
            && let Some(codec) = codec
        {
            parameter_sets = codec.parameter_sets(&unit.data);
        }
        let stands_alone = codec.is_some_and(|c| c.stands_alone(&unit.data));
        units.push(StreamUnit { time: time(&unit.header, message), stands_alone });
        if frame.is_empty() {
            frame = unit.header.frame;
        }
    }
    let Some(codec) = codec else { return Err(failed("cannot be read".into())) };
    let Some(first) = units.iter().position(|u| u.stands_alone) else {
        return Err(failed("holds no picture that stands alone, so that decoding cannot begin".into()));
    };
    let place = format!("{} {name}", bag.path().display());
    let mut warnings = Vec::new();
    if first > 0 {
        let message =
            format!("the video begins with {first} pictures that need earlier ones; they are left out");
        warnings.push(Warning::new("video-begins-late", message).at(&place));
    }
    if unread > 0 {
        let message =
            format!("{unread} messages of the video cannot be read; pictures after them may be wrong");
        warnings.push(Warning::degraded("video-unreadable", message).at(&place));
    }
    let index = bag.topics().iter().position(|t| std::ptr::eq(t, topic)).unwrap_or(usize::MAX);
    let source = Arc::new(UnitsOfTopic { bag: Arc::clone(bag), topic: index });
    let stream = VideoStream::open(codec, &units, parameter_sets, source)
        .map_err(|reason| failed(format!("cannot be decoded: {reason}")))?;
    let times = units.iter().map(|u| u.time).collect();
    Ok(BagVideo { stream, topic: topic.name.as_str().into(), times, first, frame, warnings })
}
