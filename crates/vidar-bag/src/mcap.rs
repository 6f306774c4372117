//! The container MCAP (<https://mcap.dev/spec>).
//!
//! A file is a list of records: opcode, length in 64 bits, body. The walk below reads the record heads once and skips the
//! chunks where message indexes follow them, so the summary at the file's end, which a power loss leaves out, is not needed.

use crate::bytes::Bytes;
use crate::compression::{Compression, MAX_DECOMPRESSED_BYTES};
use crate::error::BagError;
use crate::file::{BagFile, MESSAGE_AHEAD_BYTES, Window};
use crate::index::{
    Chunk, Encoding, FileIndex, FileTopic, LastChunk, NO_CHUNK, cut_off, plain_type, read_list,
};
use std::collections::BTreeMap;
use vidar_core::Warning;

pub(crate) const MAGIC: &[u8] = b"\x89MCAP0\r\n";

pub(crate) const FOOTER: u8 = 0x02;
pub(crate) const SCHEMA: u8 = 0x03;
pub(crate) const CHANNEL: u8 = 0x04;
pub(crate) const MESSAGE: u8 = 0x05;
pub(crate) const CHUNK: u8 = 0x06;
pub(crate) const MESSAGE_INDEX: u8 = 0x07;
pub(crate) const METADATA: u8 = 0x0c;
pub(crate) const DATA_END: u8 = 0x0f;

/// Opcode and length.
pub(crate) const HEAD_BYTES: u64 = 9;
/// Fields of a message before its data: channel, sequence, two times.
pub(crate) const MESSAGE_HEAD_BYTES: u64 = 22;
/// Fields of a chunk before its compression's name: two times, size, checksum.
const CHUNK_HEAD_BYTES: u64 = 28;
/// Largest schema or channel; the largest definitions of ROS have under 100 kB.
pub(crate) const MAX_DESCRIPTION_BYTES: u64 = 16 << 20;

/// Largest record of metadata that is kept, and how many are.
const MAX_METADATA_BYTES: u64 = 64 << 10;
const MAX_METADATA: usize = 64;

/// Walks through the file and lists its messages.
pub(crate) fn index(file: &BagFile) -> Result<FileIndex, BagError> {
    let mut walk = Walk { file, index: FileIndex::default(), schemas: BTreeMap::new(), unknown: 0 };
    let mut window = Window::new(file);
    let mut at = MAGIC.len() as u64;
    let mut has_end = false;
    while at < file.length() {
        let Some((op, length)) = head_at(&mut window, at)? else { break };
        let body = at + HEAD_BYTES;
        let Some(end) = body.checked_add(length).filter(|&end| end <= file.length()) else { break };
        // No record has kind 0; a file system may leave zeros after what it had written when the power went.
        if op == 0 {
            break;
        }
        // After the data come a repetition of the descriptions and the footer; the data are whole then.
        has_end |= op == DATA_END || op == FOOTER;
        walk.record(op, body, length, &mut window)?;
        at = end;
        if op == FOOTER {
            break;
        }
    }
    if has_end {
        walk.finish_chunk()?;
    } else {
        walk.list_last_again()?;
    }
    let mut index = walk.index;
    if !has_end {
        let warning = cut_off(file, at, index.messages);
        index.warnings.push(warning);
    }
    if walk.unknown > 0 {
        let message =
            format!("{} messages belong to channels that no record describes; left out", walk.unknown);
        index.warnings.push(Warning::degraded("bag-connection", message).at(file.path().display()));
    }
    Ok(index)
}

fn head_at(window: &mut Window<'_>, at: u64) -> Result<Option<(u8, u64)>, BagError> {
    let Some(bytes) = window.get(at, HEAD_BYTES)? else { return Ok(None) };
    Ok(head_in(&mut Bytes::new(bytes)))
}

pub(crate) fn head_in(bytes: &mut Bytes<'_>) -> Option<(u8, u64)> {
    Some((bytes.array::<1>()?[0], bytes.u64()?))
}

struct Walk<'a> {
    file: &'a BagFile,
    index: FileIndex,
    /// Name of every schema.
    schemas: BTreeMap<u16, String>,
    unknown: usize,
}

impl Walk<'_> {
    fn record(&mut self, op: u8, body: u64, length: u64, window: &mut Window<'_>) -> Result<(), BagError> {
        match op {
            SCHEMA | CHANNEL => {
                self.check_length(body, length)?;
                let described = window.get(body, length)?.map(|b| self.describe(op, b));
                described.transpose().map(|_| ())
            }
            MESSAGE => {
                self.finish_chunk()?;
                match window.get(body, MESSAGE_HEAD_BYTES.min(length))? {
                    Some(bytes) => self.message(bytes, NO_CHUNK, body - HEAD_BYTES),
                    None => Ok(()),
                }
            }
            CHUNK => {
                self.finish_chunk()?;
                self.chunk(body, length, window)
            }
            MESSAGE_INDEX => self.message_index(body, length),
            METADATA if length <= MAX_METADATA_BYTES => {
                if let Some((name, entries)) = window.get(body, length)?.and_then(metadata_in)
                    && self.index.metadata.len() < MAX_METADATA
                {
                    self.index.metadata.insert(name, entries);
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn check_length(&self, at: u64, length: u64) -> Result<(), BagError> {
        if length <= MAX_DESCRIPTION_BYTES {
            return Ok(());
        }
        let found = format!("a description of {length} bytes");
        Err(self.file.malformed(at, found, format!("at most {MAX_DESCRIPTION_BYTES} bytes")))
    }

    /// A schema or a channel.
    fn describe(&mut self, op: u8, body: &[u8]) -> Result<(), BagError> {
        let mut bytes = Bytes::new(body);
        if op == SCHEMA {
            if let (Some(id), Some(name)) = (bytes.u16(), bytes.text()) {
                self.schemas.insert(id, plain_type(&name));
            }
            return Ok(());
        }
        let (Some(id), Some(schema), Some(name), Some(encoding)) =
            (bytes.u16(), bytes.u16(), bytes.text(), bytes.text())
        else {
            return Ok(());
        };
        let message_type = self.schemas.get(&schema).cloned().unwrap_or_default();
        let encoding = Encoding::from_name(&encoding);
        self.index.declare(self.file, u32::from(id), || FileTopic {
            name,
            message_type,
            encoding,
            places: Vec::new(),
        })
    }

    /// The head of a message, which is all that the index needs.
    fn message(&mut self, body: &[u8], chunk: u32, offset: u64) -> Result<(), BagError> {
        let mut bytes = Bytes::new(body);
        if let (Some(channel), Some(_sequence), Some(time)) = (bytes.u16(), bytes.u32(), bytes.u64()) {
            self.add(channel, time, chunk, offset)?;
        }
        Ok(())
    }

    fn add(&mut self, channel: u16, time: u64, chunk: u32, offset: u64) -> Result<(), BagError> {
        let time = i64::try_from(time).unwrap_or(i64::MAX);
        if !self.index.add(self.file, u32::from(channel), time, chunk, offset)? {
            self.unknown += 1;
        }
        Ok(())
    }

    fn chunk(&mut self, body: u64, length: u64, window: &mut Window<'_>) -> Result<(), BagError> {
        let malformed = || {
            self.file.malformed(body, "a chunk that ends in its head", "times, size, compression, records")
        };
        // The name of a compression has a few bytes; more than the window's 64 would be no name.
        let head = window.get(body, length.min(CHUNK_HEAD_BYTES + 64))?.ok_or_else(malformed)?;
        let chunk = chunk_in(self.file, head, body, length)?;
        let number = self.index.chunks.len() as u32;
        self.index.chunks.push(chunk);
        self.index.last = Some(LastChunk { number, is_indexed: false, was_opened: false });
        Ok(())
    }

    /// Messages of one channel in the chunk before.
    fn message_index(&mut self, body: u64, length: u64) -> Result<(), BagError> {
        let Some(mut last) = self.index.last else { return Ok(()) };
        let data = read_list(self.file, body, length)?;
        let mut bytes = Bytes::new(&data);
        let (Some(channel), Some(entries)) = (bytes.u16(), bytes.counted()) else { return Ok(()) };
        if !self.index.topics.contains_key(&u32::from(channel)) && !last.was_opened {
            self.open_chunk(last.number, false)?;
            last.was_opened = true;
        }
        last.is_indexed = true;
        self.index.last = Some(last);
        let mut entries = Bytes::new(entries);
        while let (Some(time), Some(offset)) = (entries.u64(), entries.u64()) {
            self.add(channel, time, last.number, offset)?;
        }
        Ok(())
    }

    /// Lists the messages of a chunk that no index follows from the chunk itself.
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
            let Some((op, length)) = head_in(&mut records) else { break };
            let Some(body) = usize::try_from(length).ok().and_then(|n| records.take(n)) else { break };
            match op {
                SCHEMA | CHANNEL => self.describe(op, body)?,
                MESSAGE if with_messages => self.message(body, number, start)?,
                _ => {}
            }
        }
        Ok(())
    }
}

/// The chunk whose record's body of `length` bytes lies at `body` and begins with `head`.
pub(crate) fn chunk_in(file: &BagFile, head: &[u8], body: u64, length: u64) -> Result<Chunk, BagError> {
    let malformed =
        || file.malformed(body, "a chunk that ends in its head", "times, size, compression, records");
    let mut bytes = Bytes::new(head);
    let parsed = (|| {
        bytes.take(16)?;
        let size = bytes.u64()?;
        bytes.u32()?;
        let compression = bytes.text()?;
        let stored = bytes.u64()?;
        Some((size, compression, body + bytes.position() as u64, stored))
    })();
    let (size, compression, offset, stored) = parsed.ok_or_else(malformed)?;
    if offset.checked_add(stored).is_none_or(|end| end > body + length) {
        return Err(malformed());
    }
    let Some(compression) = Compression::from_name(&compression) else {
        let found = format!("chunks are compressed with {:?}", vidar_core::printable(&compression));
        let way = "lz4, zstd and none are read; `mcap compress` and `mcap decompress` convert";
        return Err(file.unsupported(found, way));
    };
    if size > MAX_DECOMPRESSED_BYTES {
        let (path, what) = (file.path().to_path_buf(), "bytes of a chunk");
        return Err(BagError::TooLarge { path, what, found: size, limit: MAX_DECOMPRESSED_BYTES });
    }
    Ok(Chunk { offset, stored, size, compression })
}

/// A record of metadata: its name, and texts by key.
fn metadata_in(body: &[u8]) -> Option<(String, BTreeMap<String, String>)> {
    let mut bytes = Bytes::new(body);
    let name = bytes.text()?;
    let mut map = Bytes::new(bytes.counted()?);
    let mut entries = BTreeMap::new();
    while let (Some(key), Some(value)) = (map.text(), map.text()) {
        entries.insert(key, value);
    }
    Some((name, entries))
}

/// The bytes of the message whose record begins at `offset` of a decompressed chunk.
pub(crate) fn message_in(chunk: &[u8], offset: u64) -> Option<&[u8]> {
    let mut bytes = Bytes::new(chunk.get(usize::try_from(offset).ok()?..)?);
    let (op, length) = head_in(&mut bytes)?;
    let body = bytes.take(usize::try_from(length).ok()?)?;
    if op == MESSAGE { body.get(MESSAGE_HEAD_BYTES as usize..) } else { None }
}

/// The bytes of the message whose record begins at `offset` of the file, where the chunk is not compressed; at
/// most the first `most` of them.
pub(crate) fn message_at(file: &BagFile, offset: u64, most: u64) -> Result<Option<Vec<u8>>, BagError> {
    let mut window = Window::reading_ahead(file, MESSAGE_AHEAD_BYTES);
    match head_at(&mut window, offset)? {
        Some((MESSAGE, length)) if length >= MESSAGE_HEAD_BYTES => {
            let (at, bytes) = (offset + HEAD_BYTES + MESSAGE_HEAD_BYTES, length - MESSAGE_HEAD_BYTES);
            Ok(window.get(at, bytes.min(most))?.map(<[u8]>::to_vec))
        }
        _ => Ok(None),
    }
}
