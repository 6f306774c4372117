//! MCAP as it comes: bytes are pushed, messages are handed out as soon as they are whole, and read again from the file in which
//! the stream is kept.

use crate::bytes::Bytes;
use crate::chunks::Chunks;
use crate::compression::{Compression, MAX_DECOMPRESSED_BYTES};
use crate::error::BagError;
use crate::file::BagFile;
use crate::index::{Chunk, Encoding, MAX_MESSAGES, MAX_TOPICS, plain_type};
use crate::mcap::{
    self, CHANNEL, CHUNK, DATA_END, FOOTER, HEAD_BYTES, MAGIC, MAX_DESCRIPTION_BYTES, MESSAGE,
    MESSAGE_HEAD_BYTES, SCHEMA, chunk_in, head_in,
};
use crate::message::{self, Header, Message};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use vidar_core::Timestamp;

/// Longest name of a topic or type, bytes.
const MAX_NAME_BYTES: usize = 4096;

/// A topic of a stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StreamTopic {
    /// Its name.
    pub name: String,
    /// Its type without the `msg/` of ROS 2.
    pub message_type: String,
    /// How its messages are serialised.
    pub encoding: Encoding,
}

impl StreamTopic {
    /// Decodes a message of this topic; the error says what is wrong.
    pub fn decode(&self, bytes: &[u8]) -> Result<Message, String> {
        message::decode(&self.message_type, self.encoding, bytes)
    }

    /// Stamp and frame of a message of this topic, for messages of ROS from its first bytes alone.
    pub fn header(&self, bytes: &[u8]) -> Result<Header, String> {
        match self.encoding {
            Encoding::Ros1 | Encoding::Cdr => message::header(self.encoding, &self.message_type, bytes),
            _ => Ok(self.decode(bytes)?.header()),
        }
    }
}

/// Where a message of a stream lies in the file that the stream is kept in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StreamPlace {
    /// The chunk where it is compressed.
    chunk: Option<Chunk>,
    /// Of its record in the decompressed chunk, or in the file.
    offset: u64,
}

/// A message that has come.
#[derive(Clone, Copy, Debug)]
pub struct StreamMessage<'a> {
    /// Its topic.
    pub topic: &'a Arc<StreamTopic>,
    /// When it was logged; its own stamp is inside.
    pub log_time: Timestamp,
    /// Where it lies.
    pub place: StreamPlace,
    /// The bytes of the stream up to the end of the record that it came in.
    pub end: u64,
    /// Its serialised bytes.
    pub data: &'a [u8],
}

/// How a stream ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamEnd {
    /// Whether the data are whole: a recorder closed them.
    pub is_closed: bool,
    /// Bytes at the end that are no whole record.
    pub lost_bytes: u64,
    /// Messages that were handed out.
    pub messages: u64,
    /// Messages of channels that no record describes.
    pub unknown: u64,
    /// Chunks that could not be decompressed.
    pub damaged_chunks: u64,
}

type Sink<'a> = dyn FnMut(StreamMessage<'_>) + 'a;

/// A push parser of MCAP, chunked or not, without any index. Memory is bounded by one record as it comes and its chunk, whatever lengths are announced.
#[derive(Debug)]
pub struct McapStream {
    /// For messages about it: the file that it is kept in.
    file: Arc<BagFile>,
    /// Bytes that came and are not used yet; the first lies at `at` of the stream.
    buffer: Vec<u8>,
    at: u64,
    /// Bytes of a record that is passed over, still to come.
    to_skip: u64,
    has_magic: bool,
    schemas: BTreeMap<u16, String>,
    topics: BTreeMap<u16, Arc<StreamTopic>>,
    end: StreamEnd,
}

impl McapStream {
    /// A parser of what is kept in `kept`, which only names it in errors.
    pub fn new(kept: &KeptStream) -> Self {
        Self {
            file: Arc::clone(&kept.file),
            buffer: Vec::new(),
            at: 0,
            to_skip: 0,
            has_magic: false,
            schemas: BTreeMap::new(),
            topics: BTreeMap::new(),
            end: StreamEnd::default(),
        }
    }

    /// Takes the next bytes of the stream and hands out the messages that are whole with them.
    ///
    /// # Errors
    /// The stream is no MCAP, or a record contradicts its format or is above a limit. Nothing can be read after that.
    pub fn push(&mut self, mut bytes: &[u8], sink: &mut Sink<'_>) -> Result<(), BagError> {
        if self.end.is_closed {
            // Behind the data come a repetition of the descriptions and an index.
            return Ok(());
        }
        if self.to_skip > 0 {
            let skipped = self.to_skip.min(bytes.len() as u64);
            self.to_skip -= skipped;
            self.at += skipped;
            bytes = &bytes[skipped as usize..];
        }
        self.buffer.extend_from_slice(bytes);
        let buffer = std::mem::take(&mut self.buffer);
        let mut used = 0;
        let result = self.records(&buffer, &mut used, sink);
        self.buffer = buffer;
        self.buffer.drain(..used);
        self.at += used as u64;
        result
    }

    /// The stream has ended.
    pub fn finish(self) -> StreamEnd {
        let lost_bytes = if self.end.is_closed { 0 } else { self.buffer.len() as u64 };
        // A record that is passed over and did not come whole has nothing that is missed.
        StreamEnd { lost_bytes, ..self.end }
    }

    /// Reads whole records; `used` bytes of `buffer` are done with.
    fn records(&mut self, buffer: &[u8], used: &mut usize, sink: &mut Sink<'_>) -> Result<(), BagError> {
        if !self.has_magic {
            let known = buffer.len().min(MAGIC.len());
            if buffer[..known] != MAGIC[..known] {
                return Err(BagError::NotABag {
                    path: self.file.path().to_path_buf(),
                    found: format!("a stream whose first bytes are {:02x?}", &buffer[..known]),
                    expected: "MCAP".into(),
                });
            }
            if known < MAGIC.len() {
                return Ok(());
            }
            (self.has_magic, *used) = (true, known);
        }
        while !self.end.is_closed {
            let rest = &buffer[*used..];
            let Some((op, length)) = head_in(&mut Bytes::new(rest)) else { return Ok(()) };
            let at = self.at + *used as u64;
            self.check(op, length, at)?;
            // Checked: what is kept has at most some hundred MB.
            let whole = (HEAD_BYTES + length.min(MAX_DECOMPRESSED_BYTES + HEAD_BYTES)) as usize;
            match op {
                SCHEMA | CHANNEL | MESSAGE | CHUNK => {
                    let Some(record) = rest.get(..whole) else { return Ok(()) };
                    self.record(op, &record[HEAD_BYTES as usize..], at, sink)?;
                    *used += whole;
                }
                DATA_END | FOOTER => self.end.is_closed = true,
                _ => {
                    let here = (HEAD_BYTES.saturating_add(length)).min(rest.len() as u64);
                    self.to_skip = HEAD_BYTES.saturating_add(length) - here;
                    *used += here as usize;
                }
            }
        }
        Ok(())
    }

    fn check(&self, op: u8, length: u64, at: u64) -> Result<(), BagError> {
        let limit = match op {
            // A power cut leaves zeros in a file; a stream has none.
            0 => return Err(self.file.malformed(at, "a record of kind 0", "a record")),
            SCHEMA | CHANNEL => MAX_DESCRIPTION_BYTES,
            MESSAGE | CHUNK => MAX_DECOMPRESSED_BYTES,
            _ => u64::MAX,
        };
        if length > limit {
            let path = self.file.path().to_path_buf();
            return Err(BagError::TooLarge { path, what: "bytes of a record", found: length, limit });
        }
        Ok(())
    }

    fn record(&mut self, op: u8, body: &[u8], at: u64, sink: &mut Sink<'_>) -> Result<(), BagError> {
        let end = at + HEAD_BYTES + body.len() as u64;
        match op {
            MESSAGE => self.message(body, StreamPlace { chunk: None, offset: at }, end, sink),
            CHUNK => self.chunk(body, at + HEAD_BYTES, sink),
            _ => self.describe(op, body, at),
        }
    }

    /// A schema or a channel.
    fn describe(&mut self, op: u8, body: &[u8], at: u64) -> Result<(), BagError> {
        let mut bytes = Bytes::new(body);
        let (Some(id), schema) = (bytes.u16(), if op == CHANNEL { bytes.u16() } else { Some(0) }) else {
            return Ok(());
        };
        let (Some(schema), Some(name)) = (schema, bytes.text()) else { return Ok(()) };
        if name.len() > MAX_NAME_BYTES {
            return Err(self.file.malformed(at, "a name of more than 4096 bytes", "a name"));
        }
        if op == SCHEMA {
            self.schemas.insert(id, plain_type(&name));
        } else if let (Some(encoding), false) = (bytes.text(), self.topics.contains_key(&id)) {
            if self.topics.len() == MAX_TOPICS {
                let (path, limit) = (self.file.path().to_path_buf(), MAX_TOPICS as u64);
                return Err(BagError::TooLarge { path, what: "topics", found: limit + 1, limit });
            }
            let message_type = self.schemas.get(&schema).cloned().unwrap_or_default();
            let encoding = Encoding::from_name(&encoding);
            self.topics.insert(id, Arc::new(StreamTopic { name, message_type, encoding }));
        }
        Ok(())
    }

    fn message(
        &mut self,
        body: &[u8],
        place: StreamPlace,
        end: u64,
        sink: &mut Sink<'_>,
    ) -> Result<(), BagError> {
        let mut bytes = Bytes::new(body);
        let head = (bytes.u16(), bytes.u32(), bytes.u64(), bytes.u64());
        let (Some(channel), Some(_sequence), Some(time), Some(_published)) = head else { return Ok(()) };
        let Some(topic) = self.topics.get(&channel) else {
            self.end.unknown += 1;
            return Ok(());
        };
        if self.end.messages == MAX_MESSAGES as u64 {
            let (path, limit) = (self.file.path().to_path_buf(), MAX_MESSAGES as u64);
            return Err(BagError::TooLarge { path, what: "messages", found: limit + 1, limit });
        }
        self.end.messages += 1;
        let log_time = Timestamp::from_nanos(i64::try_from(time).unwrap_or(i64::MAX));
        sink(StreamMessage { topic, log_time, place, end, data: &body[MESSAGE_HEAD_BYTES as usize..] });
        Ok(())
    }

    /// A chunk, which lies at `at` of the stream. One that is damaged is left out, as in files.
    fn chunk(&mut self, body: &[u8], at: u64, sink: &mut Sink<'_>) -> Result<(), BagError> {
        let file = Arc::clone(&self.file);
        let chunk = chunk_in(&file, body, at, body.len() as u64)?;
        let end = at + body.len() as u64;
        let begin = (chunk.offset - at) as usize;
        let stored = &body[begin..begin + chunk.stored as usize];
        let unpacked;
        let records = match chunk.compression {
            Compression::None => stored,
            compression => match compression.decompress(stored, Some(chunk.size)) {
                Ok(bytes) => {
                    unpacked = bytes;
                    &unpacked
                }
                Err(_) => {
                    self.end.damaged_chunks += 1;
                    return Ok(());
                }
            },
        };
        let mut bytes = Bytes::new(records);
        while !bytes.is_at_end() {
            let start = bytes.position() as u64;
            let Some((op, length)) = head_in(&mut bytes) else { break };
            let Some(body) = usize::try_from(length).ok().and_then(|n| bytes.take(n)) else { break };
            let place = match chunk.compression {
                Compression::None => StreamPlace { chunk: None, offset: chunk.offset + start },
                _ => StreamPlace { chunk: Some(chunk), offset: start },
            };
            match op {
                SCHEMA | CHANNEL => self.describe(op, body, at)?,
                MESSAGE => self.message(body, place, end, sink)?,
                _ => {}
            }
        }
        Ok(())
    }
}

/// The file that a stream is kept in while it comes. Its messages can be read in any order and from several threads.
#[derive(Debug)]
pub struct KeptStream {
    file: Arc<BagFile>,
    unpacked: Chunks,
}

impl KeptStream {
    /// Opens the file, which something else writes.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        Ok(Self { file: Arc::new(BagFile::growing(path)?), unpacked: Chunks::with_threads(0) })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// The serialised bytes of a message.
    pub fn bytes(&self, place: &StreamPlace) -> Result<Vec<u8>, BagError> {
        let at = place.chunk.map_or(place.offset, |chunk| chunk.offset);
        let found = match place.chunk {
            None => mcap::message_at(&self.file, place.offset, u64::MAX)?,
            Some(chunk) => self.unpacked.get_alone(&self.file, chunk, |content| {
                let bytes =
                    content.as_ref().map_err(|reason| self.file.malformed(at, reason, "a whole chunk"))?;
                Ok::<_, BagError>(mcap::message_in(bytes, place.offset).map(<[u8]>::to_vec))
            })?,
        };
        found.ok_or_else(|| self.file.malformed(at, "no message", "a message of the stream"))
    }
}
