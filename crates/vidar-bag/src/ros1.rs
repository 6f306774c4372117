//! The container of ROS 1 bags, version 2.0 (<http://wiki.ros.org/Bags/Format/2.0>).
//!
//! A file is a list of records: header length, header fields, data length, data. Chunks hold connections and messages and are
//! followed by index records. The walk below reads every record header once and skips the chunks, so the index at
//! the file's end, which a power loss leaves out, is not needed.

use crate::bytes::Bytes;
use crate::compression::{Compression, MAX_DECOMPRESSED_BYTES};
use crate::error::BagError;
use crate::file::{BagFile, MESSAGE_AHEAD_BYTES, Window};
use crate::index::{
    Chunk, Encoding, FileIndex, FileTopic, LastChunk, NO_CHUNK, cut_off, plain_type, read_list,
};
use vidar_core::Warning;

pub(crate) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

/// Longest record header; real ones have under 300 bytes.
const MAX_HEADER_BYTES: u32 = 64 << 10;

const OP_MESSAGE: u8 = 0x02;
const OP_BAG_HEADER: u8 = 0x03;
const OP_INDEX: u8 = 0x04;
const OP_CHUNK: u8 = 0x05;
const OP_CONNECTION: u8 = 0x07;

/// Walks through the file and lists its messages.
pub(crate) fn index(file: &BagFile) -> Result<FileIndex, BagError> {
    let mut walk = Walk { file, index: FileIndex::default(), unknown: 0, index_at: u64::MAX };
    let mut window = Window::new(file);
    let mut at = MAGIC.len() as u64;
    let mut is_whole = true;
    while at < file.length() {
        let head = match Head::read(&mut window, file, at) {
            // What follows a chunk that was being written when the power went is no record.
            Err(BagError::Malformed { .. }) if !walk.index.chunks.is_empty() => None,
            other => other?,
        };
        let Some(head) = head else {
            is_whole = false;
            break;
        };
        walk.record(&head, &mut window)?;
        at = head.data_at + u64::from(head.data_length);
    }
    // A file may also end between two records.
    is_whole &= walk.index_at != 0 && walk.index_at <= file.length();
    if is_whole {
        walk.finish_chunk()?;
    } else {
        walk.list_last_again()?;
        let warning = cut_off(file, at, walk.index.messages);
        walk.index.warnings.push(warning);
    }
    if walk.unknown > 0 {
        let message =
            format!("{} messages belong to connections that no record describes; left out", walk.unknown);
        walk.index.warnings.push(Warning::degraded("bag-connection", message).at(file.path().display()));
    }
    Ok(walk.index)
}

/// The start of a record in the file.
struct Head {
    at: u64,
    fields: Fields,
    data_at: u64,
    data_length: u32,
}

impl Head {
    /// `None` where the file ends inside the record.
    fn read(window: &mut Window<'_>, file: &BagFile, at: u64) -> Result<Option<Self>, BagError> {
        let Some(header_length) = number_at(window, at)? else { return Ok(None) };
        if header_length > MAX_HEADER_BYTES {
            let found = format!("a record header of {header_length} bytes");
            return Err(file.malformed(at, found, format!("at most {MAX_HEADER_BYTES} bytes")));
        }
        let Some(header) = window.get(at + 4, u64::from(header_length))? else { return Ok(None) };
        let fields = Fields::parse(header)
            .ok_or_else(|| file.malformed(at, "a record header that is no list of fields", "name=value"))?;
        let length_at = at + 4 + u64::from(header_length);
        let Some(data_length) = number_at(window, length_at)? else { return Ok(None) };
        let data_at = length_at + 4;
        let is_whole = data_at + u64::from(data_length) <= file.length();
        Ok(is_whole.then_some(Self { at, fields, data_at, data_length }))
    }
}

fn number_at(window: &mut Window<'_>, at: u64) -> Result<Option<u32>, BagError> {
    Ok(window.get(at, 4)?.and_then(|b| Bytes::new(b).u32()))
}

/// The fields of a record header that matter here.
#[derive(Debug, Default)]
struct Fields {
    op: Option<u8>,
    connection: Option<u32>,
    time: Option<i64>,
    size: Option<u32>,
    compression: Option<String>,
    topic: Option<String>,
    encryptor: Option<String>,
    index_at: Option<u64>,
}

impl Fields {
    fn parse(header: &[u8]) -> Option<Self> {
        let mut fields = Self::default();
        let mut bytes = Bytes::new(header);
        while !bytes.is_at_end() {
            let field = bytes.counted()?;
            let split = field.iter().position(|&b| b == b'=')?;
            let (name, value) = (&field[..split], &field[split + 1..]);
            let text = || String::from_utf8_lossy(value).into_owned();
            match name {
                b"op" => fields.op = value.first().copied(),
                b"conn" => fields.connection = Bytes::new(value).u32(),
                b"time" => fields.time = time(&mut Bytes::new(value)),
                b"size" => fields.size = Bytes::new(value).u32(),
                b"compression" => fields.compression = Some(text()),
                b"topic" => fields.topic = Some(text()),
                b"index_pos" => fields.index_at = Bytes::new(value).u64(),
                b"encryptor" => fields.encryptor = Some(text()),
                _ => {}
            }
        }
        Some(fields)
    }
}

/// Seconds and nanoseconds in 32 bits each, as ns.
fn time(bytes: &mut Bytes<'_>) -> Option<i64> {
    let (secs, nanos) = (bytes.u32()?, bytes.u32()?);
    Some(i64::from(secs) * 1_000_000_000 + i64::from(nanos))
}

struct Walk<'a> {
    file: &'a BagFile,
    index: FileIndex,
    /// Messages of connections that are not described.
    unknown: usize,
    /// Where the header says that the index begins; 0 until the writer has closed the file.
    index_at: u64,
}

impl Walk<'_> {
    fn record(&mut self, head: &Head, window: &mut Window<'_>) -> Result<(), BagError> {
        let fields = &head.fields;
        match fields.op {
            Some(OP_BAG_HEADER) => {
                self.index_at = fields.index_at.unwrap_or(0);
                if let Some(name) =
                    fields.encryptor.as_ref().filter(|n| !n.is_empty() && !n.ends_with("NoEncryptor"))
                {
                    let found = format!("the bag is encrypted ({})", vidar_core::printable(name));
                    return Err(self.file.unsupported(
                        found,
                        "decrypt it with `rosbag encrypt`'s counterpart `rosbag decrypt`",
                    ));
                }
            }
            Some(OP_CHUNK) => {
                self.finish_chunk()?;
                self.chunk(head)?;
            }
            Some(OP_INDEX) => self.index_record(head)?,
            Some(OP_CONNECTION) => {
                let number = fields.connection;
                if let Some(data) = window.get(head.data_at, u64::from(head.data_length))?
                    && let (Some(number), Some(name)) = (number, &fields.topic)
                {
                    declare(&mut self.index, self.file, number, name, data)?;
                }
            }
            Some(OP_MESSAGE) => {
                // The format permits messages outside of chunks.
                self.add(fields, NO_CHUNK, head.at)?;
            }
            _ => {}
        }
        Ok(())
    }

    fn chunk(&mut self, head: &Head) -> Result<(), BagError> {
        let name = head.fields.compression.as_deref().unwrap_or("none");
        let Some(compression) = Compression::from_name(name) else {
            let found = format!("chunks are compressed with {:?}", vidar_core::printable(name));
            return Err(self
                .file
                .unsupported(found, "none, lz4 and bz2 are read; `rosbag decompress` makes such a bag"));
        };
        let size = u64::from(head.fields.size.unwrap_or(head.data_length));
        if size > MAX_DECOMPRESSED_BYTES {
            let path = self.file.path().to_path_buf();
            let what = "bytes of a chunk";
            return Err(BagError::TooLarge { path, what, found: size, limit: MAX_DECOMPRESSED_BYTES });
        }
        let number = self.index.chunks.len() as u32;
        let stored = u64::from(head.data_length);
        self.index.chunks.push(Chunk { offset: head.data_at, stored, size, compression });
        self.index.last = Some(LastChunk { number, is_indexed: false, was_opened: false });
        Ok(())
    }

    /// Messages of one connection in the chunk before.
    fn index_record(&mut self, head: &Head) -> Result<(), BagError> {
        let (Some(connection), Some(mut last)) = (head.fields.connection, self.index.last) else {
            return Ok(());
        };
        if !self.index.topics.contains_key(&connection) && !last.was_opened {
            // A chunk holds the description of every connection that appears in it for the first time.
            self.open_chunk(last.number, false)?;
            last.was_opened = true;
        }
        last.is_indexed = true;
        self.index.last = Some(last);
        let data = read_list(self.file, head.data_at, u64::from(head.data_length))?;
        let mut bytes = Bytes::new(&data);
        while let (Some(time), Some(offset)) = (time(&mut bytes), bytes.u32()) {
            if !self.index.add(self.file, connection, time, last.number, u64::from(offset))? {
                self.unknown += 1;
            }
        }
        Ok(())
    }

    /// Lists the messages of a chunk without index records from the chunk itself.
    fn finish_chunk(&mut self) -> Result<(), BagError> {
        match self.index.take_unindexed() {
            Some(number) => self.open_chunk(number, true),
            None => Ok(()),
        }
    }

    /// Lists the last chunk again from itself, because the file ended before all of its index records.
    fn list_last_again(&mut self) -> Result<(), BagError> {
        match self.index.take_incomplete() {
            Some(number) => self.open_chunk(number, true),
            None => Ok(()),
        }
    }

    fn open_chunk(&mut self, number: u32, with_messages: bool) -> Result<(), BagError> {
        let Some(bytes) = self.index.unpack(self.file, number)? else { return Ok(()) };
        let mut records = Bytes::new(&bytes);
        while !records.is_at_end() {
            let start = records.position() as u64;
            let Some((fields, data)) = record_in(&mut records) else { break };
            match (fields.op, fields.connection, &fields.topic) {
                (Some(OP_CONNECTION), Some(id), Some(name)) => {
                    declare(&mut self.index, self.file, id, name, data)?;
                }
                (Some(OP_MESSAGE), ..) if with_messages => self.add(&fields, number, start)?,
                _ => {}
            }
        }
        Ok(())
    }

    fn add(&mut self, fields: &Fields, chunk: u32, offset: u64) -> Result<(), BagError> {
        if let (Some(connection), Some(time)) = (fields.connection, fields.time)
            && !self.index.add(self.file, connection, time, chunk, offset)?
        {
            self.unknown += 1;
        }
        Ok(())
    }
}

fn declare(
    index: &mut FileIndex,
    file: &BagFile,
    number: u32,
    name: &str,
    data: &[u8],
) -> Result<(), BagError> {
    index.declare(file, number, || {
        let mut message_type = String::new();
        let mut bytes = Bytes::new(data);
        while let Some(field) = bytes.counted() {
            if let Some(value) = field.strip_prefix(b"type=") {
                message_type = plain_type(&String::from_utf8_lossy(value));
            }
        }
        FileTopic { name: name.to_string(), message_type, encoding: Encoding::Ros1, places: Vec::new() }
    })
}

fn record_in<'a>(bytes: &mut Bytes<'a>) -> Option<(Fields, &'a [u8])> {
    let fields = Fields::parse(bytes.counted()?)?;
    Some((fields, bytes.counted()?))
}

/// The bytes of the message whose record begins at `offset` of a decompressed chunk.
pub(crate) fn message_in(chunk: &[u8], offset: u64) -> Option<&[u8]> {
    let mut bytes = Bytes::new(chunk.get(usize::try_from(offset).ok()?..)?);
    let (fields, data) = record_in(&mut bytes)?;
    (fields.op == Some(OP_MESSAGE)).then_some(data)
}

/// The bytes of the message whose record begins at `offset` of the file, where the chunk is not compressed; at
/// most the first `most` of them.
pub(crate) fn message_at(file: &BagFile, offset: u64, most: u64) -> Result<Option<Vec<u8>>, BagError> {
    let mut window = Window::reading_ahead(file, MESSAGE_AHEAD_BYTES);
    let Some(head) = Head::read(&mut window, file, offset)? else { return Ok(None) };
    if head.fields.op != Some(OP_MESSAGE) {
        return Ok(None);
    }
    Ok(window.get(head.data_at, u64::from(head.data_length).min(most))?.map(<[u8]>::to_vec))
}
