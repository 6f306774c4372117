//! A writer of MCAP (<https://mcap.dev/spec>): chunks compressed with LZ4, an index behind each, and a summary.

use super::schemas::definition;
use crate::mcap::{CHANNEL, CHUNK, DATA_END, FOOTER, MAGIC, MESSAGE, MESSAGE_INDEX, METADATA, SCHEMA};
use std::collections::BTreeMap;
use std::io::{Error, ErrorKind, Result, Write};
use vidar_core::Timestamp;

const HEADER: u8 = 0x01;
const CHUNK_INDEX: u8 = 0x08;
const STATISTICS: u8 = 0x0b;
const METADATA_INDEX: u8 = 0x0d;
const SUMMARY_OFFSET: u8 = 0x0e;

/// A chunk is closed when it has this many bytes.
const CHUNK_BYTES: usize = 2 << 20;

/// A channel of the file: a topic with its type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChannelId(u16);

/// Writes messages of ROS 2 into an MCAP file. Without [`McapWriter::finish`] the file is as one of a recorder that lost power.
pub struct McapWriter<W: Write> {
    out: W,
    at: u64,
    schemas: Vec<Vec<u8>>,
    schema_names: Vec<&'static str>,
    channels: Vec<Vec<u8>>,
    counts: Vec<u64>,
    /// Records of the chunk that is open, the range of its times, and its messages by channel.
    chunk: Vec<u8>,
    times: Option<(u64, u64)>,
    indexes: BTreeMap<u16, Vec<(u64, u64)>>,
    chunk_indexes: Vec<Vec<u8>>,
    metadata_indexes: Vec<Vec<u8>>,
    all_times: Option<(u64, u64)>,
    /// Descriptions that are written into the data before the next chunk.
    is_declared: usize,
}

/// A record's body, little-endian.
#[derive(Default)]
struct Body(Vec<u8>);

impl Body {
    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        // Definitions, names and lists of indexes; chunks, whose length has 64 bits, are written apart.
        let mut body = self.u32(bytes.len() as u32);
        body.0.extend(bytes);
        body
    }

    fn text(self, text: &str) -> Self {
        self.bytes(text.as_bytes())
    }
}

fn record(op: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(9 + body.len());
    bytes.push(op);
    bytes.extend((body.len() as u64).to_le_bytes());
    bytes.extend(body);
    bytes
}

fn wider(range: Option<(u64, u64)>, time: u64) -> Option<(u64, u64)> {
    Some(range.map_or((time, time), |(first, last)| (first.min(time), last.max(time))))
}

impl<W: Write> McapWriter<W> {
    /// Begins a file.
    pub fn new(out: W, library: &str) -> Result<Self> {
        let mut writer = Self {
            out,
            at: 0,
            schemas: Vec::new(),
            schema_names: Vec::new(),
            channels: Vec::new(),
            counts: Vec::new(),
            chunk: Vec::new(),
            times: None,
            indexes: BTreeMap::new(),
            chunk_indexes: Vec::new(),
            metadata_indexes: Vec::new(),
            all_times: None,
            is_declared: 0,
        };
        writer.put(MAGIC)?;
        writer.put(&record(HEADER, &Body::default().text("ros2").text(library).0))?;
        Ok(writer)
    }

    fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.at += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    /// Adds a topic with messages of a type that [`super::encode`] writes.
    pub fn channel(&mut self, topic: &str, message_type: &'static str) -> Result<ChannelId> {
        let bad = |what: String| Error::new(ErrorKind::InvalidInput, what);
        let id = u16::try_from(self.channels.len()).map_err(|_| bad("more than 65536 topics".into()))?;
        let schema = match self.schema_names.iter().position(|name| *name == message_type) {
            Some(known) => known,
            None => {
                let text = definition(message_type).ok_or_else(|| bad(format!("the type {message_type}")))?;
                let number = self.schemas.len() as u16 + 1;
                let body = Body::default().u16(number).text(message_type).text("ros2msg").text(&text);
                self.schemas.push(record(SCHEMA, &body.0));
                self.schema_names.push(message_type);
                self.schemas.len() - 1
            }
        };
        // Schema numbers begin at 1: 0 means none.
        let body = Body::default().u16(id).u16(schema as u16 + 1).text(topic).text("cdr").u32(0);
        self.channels.push(record(CHANNEL, &body.0));
        self.counts.push(0);
        Ok(ChannelId(id))
    }

    /// Adds a message. Messages should come in the order of their times; any order is valid.
    pub fn write(&mut self, channel: ChannelId, time: Timestamp, message: &[u8]) -> Result<()> {
        let Some(count) = self.counts.get_mut(usize::from(channel.0)) else {
            return Err(Error::new(ErrorKind::InvalidInput, "a channel of another file"));
        };
        let sequence = *count as u32;
        *count += 1;
        // Logging times have no sign; the message's own stamp keeps it.
        let time = u64::try_from(time.nanos()).unwrap_or(0);
        let mut body = Body::default().u16(channel.0).u32(sequence).u64(time).u64(time);
        body.0.extend(message);
        self.indexes.entry(channel.0).or_default().push((time, self.chunk.len() as u64));
        self.chunk.extend(record(MESSAGE, &body.0));
        self.times = wider(self.times, time);
        self.all_times = wider(self.all_times, time);
        if self.chunk.len() >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    /// Adds named texts about the recording.
    pub fn metadata(&mut self, name: &str, entries: &BTreeMap<String, String>) -> Result<()> {
        self.close_chunk()?;
        let mut map = Body::default();
        for (key, value) in entries {
            map = map.text(key).text(value);
        }
        let bytes = record(METADATA, &Body::default().text(name).bytes(&map.0).0);
        let index = Body::default().u64(self.at).u64(bytes.len() as u64).text(name);
        self.metadata_indexes.push(record(METADATA_INDEX, &index.0));
        self.put(&bytes)
    }

    /// Writes the open chunk and its indexes.
    fn close_chunk(&mut self) -> Result<()> {
        let Some((first, last)) = self.times.take() else { return Ok(()) };
        // Descriptions stand before the first chunk with messages of theirs; all are repeated, which readers expect.
        if self.is_declared < self.channels.len() {
            let described: Vec<u8> = self.schemas.iter().chain(&self.channels).flatten().copied().collect();
            self.is_declared = self.channels.len();
            self.put(&described)?;
        }
        let records = std::mem::take(&mut self.chunk);
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(&records)?;
        let packed = encoder.finish().map_err(Error::other)?;
        let head = Body::default().u64(first).u64(last).u64(records.len() as u64).u32(0).text("lz4");
        let mut body = head.u64(packed.len() as u64).0;
        body.extend(&packed);
        let chunk_at = self.at;
        let bytes = record(CHUNK, &body);
        let chunk_length = bytes.len() as u64;
        self.put(&bytes)?;
        let index_at = self.at;
        let mut offsets = Body::default();
        for (channel, entries) in std::mem::take(&mut self.indexes) {
            offsets = offsets.u16(channel).u64(self.at);
            let mut list = Body::default();
            for (time, offset) in entries {
                list = list.u64(time).u64(offset);
            }
            self.put(&record(MESSAGE_INDEX, &Body::default().u16(channel).bytes(&list.0).0))?;
        }
        let index = Body::default().u64(first).u64(last).u64(chunk_at).u64(chunk_length).bytes(&offsets.0);
        let index =
            index.u64(self.at - index_at).text("lz4").u64(packed.len() as u64).u64(records.len() as u64);
        self.chunk_indexes.push(record(CHUNK_INDEX, &index.0));
        Ok(())
    }

    /// Writes the summary and ends the file.
    pub fn finish(mut self) -> Result<W> {
        self.close_chunk()?;
        self.put(&record(DATA_END, &Body::default().u32(0).0))?;
        let (first, last) = self.all_times.unwrap_or((0, 0));
        let mut counts = Body::default();
        for (channel, count) in self.counts.iter().enumerate() {
            counts = counts.u16(channel as u16).u64(*count);
        }
        let statistics = Body::default()
            .u64(self.counts.iter().sum())
            .u16(self.schemas.len() as u16)
            .u32(self.channels.len() as u32)
            .u32(0)
            .u32(self.metadata_indexes.len() as u32)
            .u32(self.chunk_indexes.len() as u32)
            .u64(first)
            .u64(last)
            .bytes(&counts.0);
        let groups = [
            (SCHEMA, std::mem::take(&mut self.schemas)),
            (CHANNEL, std::mem::take(&mut self.channels)),
            (STATISTICS, vec![record(STATISTICS, &statistics.0)]),
            (CHUNK_INDEX, std::mem::take(&mut self.chunk_indexes)),
            (METADATA_INDEX, std::mem::take(&mut self.metadata_indexes)),
        ];
        let summary_at = self.at;
        let mut offsets = Vec::new();
        for (op, records) in groups.iter().filter(|(_, records)| !records.is_empty()) {
            let begin = self.at;
            for bytes in records {
                self.put(bytes)?;
            }
            let mut body = Body(vec![*op]);
            body = body.u64(begin).u64(self.at - begin);
            offsets.push(record(SUMMARY_OFFSET, &body.0));
        }
        let offsets_at = self.at;
        for bytes in &offsets {
            self.put(bytes)?;
        }
        let footer = Body::default().u64(summary_at).u64(offsets_at).u32(0);
        self.put(&record(FOOTER, &footer.0))?;
        self.put(MAGIC)?;
        self.out.flush()?;
        Ok(self.out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::{Header, ImuMessage, Message};
    use crate::{Bag, write::encode};

    fn imu(i: i64) -> Message {
        Message::Imu(ImuMessage {
            header: Header { stamp: Timestamp::from_nanos(1_000_000_007 * i), frame: "imu0".into() },
            angular_velocity: [i as f64, 0.0, 0.0],
            linear_acceleration: [0.0, 0.0, 9.81],
        })
    }

    #[test]
    fn a_written_file_is_read_back_whole_and_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.mcap");
        let mut writer = McapWriter::new(Vec::new(), "test").unwrap();
        let (name, _) = encode(&imu(0)).unwrap();
        let channel = writer.channel("/imu0", name).unwrap();
        let entries = BTreeMap::from([("key".to_string(), "value ä".to_string())]);
        writer.metadata("notes", &entries).unwrap();
        // Some 3.5 MB: two chunks.
        let count = 10_000;
        for i in 0..count {
            writer
                .write(channel, Timestamp::from_nanos(1_000_000_007 * i), &encode(&imu(i)).unwrap().1)
                .unwrap();
        }
        let bytes = writer.finish().unwrap();
        std::fs::write(&path, &bytes).unwrap();
        let bag = Bag::open(&path).unwrap();
        assert!(bag.warnings().is_empty(), "{:?}", bag.warnings());
        assert_eq!(bag.metadata("notes"), Some(&entries));
        assert_eq!(bag.metadata("other"), None);
        let topic = &bag.topics()[0];
        assert_eq!((topic.name.as_str(), topic.messages.len()), ("/imu0", count as usize));
        for i in [0, 1, 4321, count - 1] {
            assert_eq!(bag.read(&topic.messages[i as usize]).unwrap(), imu(i));
        }
        // The first chunk is whole when the recorder loses power in the second.
        std::fs::write(&path, &bytes[..bytes.len() * 3 / 4]).unwrap();
        let cut = Bag::open(&path).unwrap();
        assert!(!cut.warnings().is_empty() && cut.topics()[0].messages.len() > 3000);
    }
}
