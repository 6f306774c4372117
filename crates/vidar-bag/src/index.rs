//! What a bag holds: topics, and where each of their messages lies.

use crate::compression::Compression;
use crate::error::BagError;
use crate::file::BagFile;
use std::collections::BTreeMap;
use vidar_core::{Timestamp, Warning};

/// How the messages of a topic are serialised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// ROS 1: little-endian, packed.
    Ros1,
    /// ROS 2: OMG CDR with its encapsulation header.
    Cdr,
    /// Protocol buffers.
    Protobuf,
    /// JSON.
    Json,
    /// Anything else; such messages are listed and not read.
    Other,
}

impl Encoding {
    pub(crate) fn from_name(name: &str) -> Self {
        match name {
            "ros1" => Self::Ros1,
            "cdr" => Self::Cdr,
            "protobuf" => Self::Protobuf,
            "json" => Self::Json,
            _ => Self::Other,
        }
    }
}

/// One topic.
#[derive(Clone, Debug)]
pub struct Topic {
    /// Its name, such as `/cam0/image_raw`.
    pub name: String,
    /// Its type without the `msg/` of ROS 2: `sensor_msgs/Image`, `foxglove.RawImage`.
    pub message_type: String,
    /// How its messages are serialised.
    pub encoding: Encoding,
    /// Its messages in the order of the times at which they were logged.
    pub messages: Vec<MessageRef>,
}

impl Topic {
    /// Mean rate of its messages by the times at which they were logged, Hz; `None` for fewer than two.
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = (self.messages.first()?, self.messages.last()?);
        let secs = (last.log_time - first.log_time).as_secs_f64();
        (secs > 0.0).then(|| (self.messages.len() - 1) as f64 / secs)
    }
}

/// Where a message lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageRef {
    /// When it was logged; its own stamp is inside.
    pub log_time: Timestamp,
    pub(crate) topic: u16,
    pub(crate) file: u16,
    /// Index into the file's chunks; [`NO_CHUNK`] when the message is in none.
    pub(crate) chunk: u32,
    /// Of its record in the decompressed chunk, or in the file.
    pub(crate) offset: u64,
}

/// The message is in no chunk.
pub(crate) const NO_CHUNK: u32 = u32::MAX;

/// Where a chunk lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Chunk {
    pub offset: u64,
    pub stored: u64,
    pub size: u64,
    pub compression: Compression,
}

/// Most messages of a recording: ten hours at 1 kHz. Their references then take 1.2 GB.
pub(crate) const MAX_MESSAGES: usize = 36_000_000;
/// Largest list of one topic's messages in one chunk, bytes: four million messages, and chunks have some MB.
const MAX_LIST_BYTES: u64 = 64 << 20;
/// Most topics; the largest robots publish some thousand.
pub(crate) const MAX_TOPICS: usize = 60_000;

/// The index of one file while it is built.
#[derive(Debug, Default)]
pub(crate) struct FileIndex {
    pub chunks: Vec<Chunk>,
    pub warnings: Vec<Warning>,
    /// By the number that the file gives to a connection or channel.
    pub topics: BTreeMap<u32, FileTopic>,
    pub messages: usize,
    /// Named texts about the recording (MCAP).
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// The chunk before this place in the file.
    pub last: Option<LastChunk>,
}

/// The chunk that was met last, and whether index records listed its messages.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LastChunk {
    pub number: u32,
    pub is_indexed: bool,
    pub was_opened: bool,
}

/// A connection of ROS 1, a channel of MCAP, a row of `topics` of ROS 2.
#[derive(Debug)]
pub(crate) struct FileTopic {
    pub name: String,
    pub message_type: String,
    pub encoding: Encoding,
    /// Log time in ns, chunk, offset.
    pub places: Vec<(i64, u32, u64)>,
}

impl FileIndex {
    /// Makes a topic known; a repeated declaration changes nothing.
    pub(crate) fn declare(
        &mut self,
        file: &BagFile,
        number: u32,
        topic: impl FnOnce() -> FileTopic,
    ) -> Result<(), BagError> {
        if self.topics.contains_key(&number) {
            return Ok(());
        }
        if self.topics.len() == MAX_TOPICS {
            return Err(too_many(file, "topics", MAX_TOPICS));
        }
        self.topics.insert(number, topic());
        Ok(())
    }

    /// Adds a message; returns whether its topic is known.
    pub(crate) fn add(
        &mut self,
        file: &BagFile,
        number: u32,
        time: i64,
        chunk: u32,
        offset: u64,
    ) -> Result<bool, BagError> {
        let Some(topic) = self.topics.get_mut(&number) else { return Ok(false) };
        if self.messages == MAX_MESSAGES {
            return Err(too_many(file, "messages", MAX_MESSAGES));
        }
        self.messages += 1;
        topic.places.push((time, chunk, offset));
        Ok(true)
    }

    /// The last chunk, where no index record follows it: its messages are to be listed from itself.
    pub(crate) fn take_unindexed(&mut self) -> Option<u32> {
        self.last.take().filter(|last| !last.is_indexed).map(|last| last.number)
    }

    /// The last chunk without what was listed of it: it is to be listed from itself, because the file ended before all of its
    /// index records.
    pub(crate) fn take_incomplete(&mut self) -> Option<u32> {
        let last = self.last.take()?;
        self.forget_chunk(last.number);
        Some(last.number)
    }

    /// The records of a chunk; `None`, with a warning, where it is damaged.
    pub(crate) fn unpack(&mut self, file: &BagFile, number: u32) -> Result<Option<Vec<u8>>, BagError> {
        let chunk = self.chunks[number as usize];
        let packed = file.read(chunk.offset, chunk.stored)?;
        match chunk.compression.decompress(&packed, Some(chunk.size)) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(reason) => {
                let message = format!("a chunk at byte {} is damaged and left out: {reason}", chunk.offset);
                self.warnings.push(Warning::degraded("bag-chunk", message).at(file.path().display()));
                Ok(None)
            }
        }
    }

    /// Takes back the messages of the chunk that was listed last.
    fn forget_chunk(&mut self, chunk: u32) {
        for topic in self.topics.values_mut() {
            let kept = topic.places.iter().rposition(|p| p.1 != chunk).map_or(0, |last| last + 1);
            self.messages -= topic.places.len() - kept;
            topic.places.truncate(kept);
        }
    }
}

/// A list of messages behind a chunk, where it is of a length that one has.
pub(crate) fn read_list(file: &BagFile, at: u64, length: u64) -> Result<Vec<u8>, BagError> {
    if length > MAX_LIST_BYTES {
        let (path, what) = (file.path().to_path_buf(), "bytes of a list of messages");
        return Err(BagError::TooLarge { path, what, found: length, limit: MAX_LIST_BYTES });
    }
    file.read(at, length)
}

fn too_many(file: &BagFile, what: &'static str, limit: usize) -> BagError {
    let path = file.path().to_path_buf();
    BagError::TooLarge { path, what, found: limit as u64 + 1, limit: limit as u64 }
}

/// ROS 2 writes `sensor_msgs/msg/Image` for what ROS 1 calls `sensor_msgs/Image`.
pub(crate) fn plain_type(name: &str) -> String {
    name.replace("/msg/", "/")
}

/// Kind of the warning about a file that ends inside a record.
pub(crate) const CUT_OFF: &str = "bag-cut-off";

/// The warning about a file that ends inside a record.
pub(crate) fn cut_off(file: &BagFile, whole: u64, messages: usize) -> Warning {
    let lost = file.length().saturating_sub(whole);
    let message = format!(
        "the bag is cut off: its last {lost} bytes are no whole record; the {messages} messages before them are read"
    );
    Warning::degraded(CUT_OFF, message)
        .at(file.path().display())
        .hint("a power loss or a full disk while recording does this; nothing else is needed to use the rest")
}
