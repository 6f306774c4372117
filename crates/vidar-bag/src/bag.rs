//! An open recording: one bag, or the split files of one.

use crate::chunks::Chunks;
use crate::compression::Compression;
use crate::db3::{self, Db3};
use crate::error::BagError;
use crate::file::BagFile;
use crate::index::{CUT_OFF, Encoding, FileIndex, MessageRef, NO_CHUNK, Topic};
use crate::message::{self, Header, Message};
use crate::{mcap, metadata, parts, ros1, sqlite};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{Timestamp, Warning};

/// The containers that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BagFormat {
    /// ROS 1 bag 2.0.
    Ros1,
    /// MCAP.
    Mcap,
    /// SQLite of ROS 2.
    Sqlite,
}

impl BagFormat {
    /// The format by a file's first bytes.
    pub fn of_bytes(bytes: &[u8]) -> Option<Self> {
        [(ros1::MAGIC, Self::Ros1), (mcap::MAGIC, Self::Mcap), (sqlite::MAGIC, Self::Sqlite)]
            .into_iter()
            .find_map(|(magic, format)| bytes.starts_with(magic).then_some(format))
    }

    /// Its name for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ros1 => "ROS 1 bag",
            Self::Mcap => "MCAP",
            Self::Sqlite => "ROS 2 bag (SQLite)",
        }
    }
}

/// An open recording. Its index is in memory, its messages stay in the files until they are asked for.
#[derive(Debug)]
pub struct Bag {
    path: PathBuf,
    format: BagFormat,
    parts: Vec<Part>,
    topics: Vec<Topic>,
    warnings: Vec<Warning>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    messages_are_compressed: bool,
    unpacked: Chunks,
}

/// One file with its chunks.
#[derive(Debug)]
struct Part {
    chunks: Vec<crate::index::Chunk>,
    container: Container,
}

#[derive(Debug)]
enum Container {
    Ros1(Arc<BagFile>),
    Mcap(Arc<BagFile>),
    Sqlite(Db3),
}

impl Container {
    fn file(&self) -> &BagFile {
        match self {
            Self::Ros1(file) | Self::Mcap(file) => file,
            Self::Sqlite(db3) => db3.file(),
        }
    }
}

/// Bytes that hold stamp and frame of any message; names of frames are far shorter.
const HEADER_BYTES: u64 = 1 << 10;

impl Bag {
    /// Opens a bag file, the folder of a ROS 2 bag, or a folder that holds the numbered parts of one recording, and lists its
    /// messages.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let (files, messages_are_compressed) = if path.is_dir() {
            match metadata::read(path)? {
                Some(found) => (found.files, found.messages_are_compressed),
                None => (parts::parts_in(path)?, false),
            }
        } else {
            (vec![path.to_path_buf()], false)
        };
        if files.len() > parts::MAX_FILES {
            let (path, found) = (path.to_path_buf(), files.len() as u64);
            return Err(BagError::TooLarge { path, what: "files", found, limit: parts::MAX_FILES as u64 });
        }
        let mut bag = Self { messages_are_compressed, ..Self::without_files(path) };
        let files = files.iter().map(|file| BagFile::open(file));
        bag.list(files)?;
        Ok(bag)
    }

    /// Opens the first bytes of an MCAP file that is still written, as if it had no more.
    pub fn open_beginning(path: &Path, bytes: u64) -> Result<Self, BagError> {
        let mut bag = Self::without_files(path);
        bag.list([BagFile::beginning(path, bytes)].into_iter())?;
        bag.warnings.retain(|w| w.kind != CUT_OFF);
        Ok(bag)
    }

    fn without_files(path: &Path) -> Self {
        Self {
            path: path.to_path_buf(),
            format: BagFormat::Mcap,
            parts: Vec::new(),
            topics: Vec::new(),
            warnings: Vec::new(),
            metadata: BTreeMap::new(),
            messages_are_compressed: false,
            unpacked: Chunks::default(),
        }
    }

    /// Lists topics and messages of the files.
    fn list(&mut self, files: impl Iterator<Item = Result<BagFile, BagError>>) -> Result<(), BagError> {
        let mut topics = BTreeMap::<(String, String), Topic>::new();
        for file in files {
            let (format, container, index) = open_file(file?)?;
            self.format = format;
            self.take(index, container, &mut topics);
        }
        self.topics = topics.into_values().collect();
        for (number, topic) in self.topics.iter_mut().enumerate() {
            topic.messages.iter_mut().for_each(|m| m.topic = number as u16);
            // Stable: messages of one time stay in the order in which they were written.
            topic.messages.sort_by_key(|m| m.log_time);
        }
        if self.topics.iter().all(|t| t.messages.is_empty()) {
            let found = format!("{} topics without messages", self.topics.len());
            return Err(BagError::Empty { path: self.path.clone(), found });
        }
        Ok(())
    }

    /// Adds the index of one file.
    fn take(
        &mut self,
        index: FileIndex,
        container: Container,
        topics: &mut BTreeMap<(String, String), Topic>,
    ) {
        let file = self.parts.len() as u16;
        for found in index.topics.into_values() {
            // Connections of several publishers to one topic are one topic.
            let key = (found.name.clone(), found.message_type.clone());
            let topic = topics.entry(key).or_insert_with(|| Topic {
                name: found.name,
                message_type: found.message_type,
                encoding: found.encoding,
                messages: Vec::new(),
            });
            topic.messages.extend(found.places.iter().map(|&(time, chunk, offset)| MessageRef {
                log_time: Timestamp::from_nanos(time),
                topic: 0,
                file,
                chunk,
                offset,
            }));
        }
        self.warnings.extend(index.warnings);
        self.metadata.extend(index.metadata);
        self.parts.push(Part { chunks: index.chunks, container });
    }

    /// What was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The container of its files.
    pub fn format(&self) -> BagFormat {
        self.format
    }

    /// Its files.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.parts.iter().map(|p| p.container.file().path())
    }

    /// Its topics by name.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// What was found wrong while listing its messages.
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// The texts that its writer left about it under a name (MCAP's metadata).
    pub fn metadata(&self, name: &str) -> Option<&BTreeMap<String, String>> {
        self.metadata.get(name)
    }

    /// The topic of a message.
    pub fn topic_of(&self, message: &MessageRef) -> Option<&Topic> {
        self.topics.get(usize::from(message.topic))
    }

    /// Reads and decodes one message. Messages may be read in any order and from several threads.
    pub fn read(&self, message: &MessageRef) -> Result<Message, BagError> {
        let (message_type, encoding) =
            self.topic_of(message).map_or(("", Encoding::Other), |t| (t.message_type.as_str(), t.encoding));
        let bytes = self.bytes(message)?;
        message::decode(message_type, encoding, &bytes).map_err(|reason| self.bad_message(message, reason))
    }

    /// Stamp and frame of one message. Of an image in a chunk without compression only the head is read.
    pub fn header(&self, message: &MessageRef) -> Result<Header, BagError> {
        let Some(topic) = self.topic_of(message) else { return Ok(Header::default()) };
        if matches!(topic.encoding, Encoding::Ros1 | Encoding::Cdr) && !self.messages_are_compressed {
            let head = self.first_bytes(message, HEADER_BYTES)?;
            return message::header(topic.encoding, &topic.message_type, &head)
                .map_err(|reason| self.bad_message(message, reason));
        }
        Ok(self.read(message)?.header())
    }

    /// The serialised bytes of one message.
    pub fn bytes(&self, message: &MessageRef) -> Result<Vec<u8>, BagError> {
        self.first_bytes(message, u64::MAX)
    }

    /// The first bytes of one message; `most` of them or more.
    fn first_bytes(&self, message: &MessageRef, most: u64) -> Result<Vec<u8>, BagError> {
        let lost = || self.bad_message(message, "no message is where the index says".into());
        let part = self.parts.get(usize::from(message.file)).ok_or_else(lost)?;
        let found = if message.chunk == NO_CHUNK {
            match &part.container {
                Container::Ros1(file) => ros1::message_at(file, message.offset, most),
                Container::Mcap(file) => mcap::message_at(file, message.offset, most),
                Container::Sqlite(db3) => db3.message(message.offset),
            }
        } else {
            self.in_chunk(part, message, most).map_err(|e| match e {
                BagError::Malformed { found, .. } => self.bad_message(message, found),
                other => other,
            })
        };
        let bytes = found?.ok_or_else(lost)?;
        if self.messages_are_compressed {
            return Compression::Zstd.decompress(&bytes, None).map_err(|r| self.bad_message(message, r));
        }
        Ok(bytes)
    }

    fn in_chunk(&self, part: &Part, message: &MessageRef, most: u64) -> Result<Option<Vec<u8>>, BagError> {
        let Some(&chunk) = part.chunks.get(message.chunk as usize) else { return Ok(None) };
        if chunk.compression == Compression::None {
            if message.offset >= chunk.stored {
                return Ok(None);
            }
            let offset = chunk.offset + message.offset;
            return match &part.container {
                Container::Ros1(file) => ros1::message_at(file, offset, most),
                Container::Mcap(file) => mcap::message_at(file, offset, most),
                Container::Sqlite(_) => Ok(None),
            };
        }
        let (Container::Ros1(file) | Container::Mcap(file)) = &part.container else { return Ok(None) };
        let read = |content: &Result<Vec<u8>, String>| {
            let bytes = content.as_ref().map_err(|reason| {
                let found = format!("a chunk that is damaged: {reason}");
                file.malformed(chunk.offset, found, "a whole chunk")
            })?;
            let found = match &part.container {
                Container::Ros1(_) => ros1::message_in(bytes, message.offset),
                _ => mcap::message_in(bytes, message.offset),
            };
            Ok(found.map(|bytes| cut(bytes, most)))
        };
        self.unpacked.get((message.file, file), &part.chunks, message.chunk, read).unwrap_or(Ok(None))
    }

    fn bad_message(&self, message: &MessageRef, reason: String) -> BagError {
        let topic = self.topic_of(message);
        let path =
            self.parts.get(usize::from(message.file)).map_or(&*self.path, |p| p.container.file().path());
        BagError::BadMessage {
            path: path.to_path_buf(),
            topic: topic.map_or_else(String::new, |t| t.name.clone()),
            time: message.log_time.to_secs_string(),
            message_type: topic.map_or_else(String::new, |t| t.message_type.clone()),
            reason,
        }
    }
}

/// The first `most` bytes.
fn cut(bytes: &[u8], most: u64) -> Vec<u8> {
    let length = bytes.len().min(usize::try_from(most).unwrap_or(usize::MAX));
    bytes[..length].to_vec()
}

fn open_file(file: BagFile) -> Result<(BagFormat, Container, FileIndex), BagError> {
    let head = file.read(0, file.length().min(16))?;
    Ok(match BagFormat::of_bytes(&head) {
        Some(format @ BagFormat::Ros1) => {
            let index = ros1::index(&file)?;
            (format, Container::Ros1(Arc::new(file)), index)
        }
        Some(format @ BagFormat::Mcap) => {
            let index = mcap::index(&file)?;
            (format, Container::Mcap(Arc::new(file)), index)
        }
        Some(format @ BagFormat::Sqlite) => {
            let (db3, index) = db3::index(file)?;
            (format, Container::Sqlite(db3), index)
        }
        None => {
            let found = match head.as_slice() {
                [] => "an empty file (0 bytes)".to_string(),
                head if head.starts_with(b"#ROSBAG") => "a ROS bag of a version before 2.0".to_string(),
                head => format!("a file whose first bytes are {head:02x?}"),
            };
            let expected = "a ROS 1 bag 2.0, an MCAP file or an SQLite bag of ROS 2".to_string();
            return Err(BagError::NotABag { path: file.path().to_path_buf(), found, expected });
        }
    })
}
