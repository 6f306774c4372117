//! Messages of an MCAP file in the order of their times, from any time on.

use super::FORMAT;
use super::convert::stands_alone;
use crate::error::ExportError;
use mcap::McapResult;
use mcap::records::MessageHeader;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions, ReadOrder};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{Channel, Summary};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Longest chunk that is read. A chunk holds one message at least, and the longest is a mesh: 40 bytes a triangle.
const MAX_CHUNK_BYTES: usize = 1 << 30;

/// Schema of messages that change a scene, and need those before them.
const SCENE_SCHEMA: &str = "foxglove.SceneUpdate";

/// A message.
pub(super) struct Message {
    /// Log time, ns.
    pub time: u64,
    /// As the channel encodes it.
    pub data: Vec<u8>,
}

/// An open file.
pub(super) struct Playback {
    path: PathBuf,
    file: File,
    summary: Summary,
    reader: IndexedReader,
    /// Read, and not yet due.
    next: Option<(u16, Message)>,
    /// Time of each topic's first message, ns.
    first: BTreeMap<String, u64>,
}

impl Playback {
    /// Opens a file by the summary at its end.
    pub fn open(path: &Path) -> Result<Self, ExportError> {
        let failed = |action, source| ExportError::File { action, path: path.to_owned(), source };
        let mut file = File::open(path).map_err(|e| failed("read", e))?;
        let summary = summary(&mut file).map_err(|e| malformed(path, "a whole file with an index", e))?;
        let Some(summary) = summary.filter(|s| !s.channels.is_empty() && s.stats.is_some()) else {
            return Err(malformed(path, "a file with an index and messages", "none"));
        };
        let reader =
            reader(&summary, IndexedReaderOptions::new()).map_err(|e| malformed(path, "chunks", e))?;
        let mut this =
            Self { path: path.to_owned(), file, summary, reader, next: None, first: BTreeMap::new() };
        for topic in this.channels().map(|c| c.topic.clone()).collect::<Vec<_>>() {
            let forward = this.scan(IndexedReaderOptions::new().include_topics([topic.as_str()]))?;
            this.first.extend(forward.map(|m| (topic, m.time)));
        }
        Ok(this)
    }

    /// Times of the first and the last message, ns.
    pub fn times(&self) -> (u64, u64) {
        self.summary.stats.as_ref().map_or((0, 0), |s| (s.message_start_time, s.message_end_time))
    }

    /// All channels.
    pub fn channels(&self) -> impl Iterator<Item = &Arc<Channel<'static>>> {
        self.summary.channels.values()
    }

    /// The file is not as expected.
    pub fn malformed(&self, expected: &str, found: impl ToString) -> ExportError {
        malformed(&self.path, expected, found)
    }

    /// The next messages are those after a time.
    pub fn seek(&mut self, time: u64) {
        self.next = None;
        // The same options were accepted when the file was opened.
        if let Ok(reader) = reader(&self.summary, IndexedReaderOptions::new().starting_after(time)) {
            self.reader = reader;
        }
    }

    /// The next message up to a time, with its topic.
    pub fn next_until(&mut self, time: u64) -> Result<Option<(String, Message)>, ExportError> {
        if self.next.is_none() {
            self.next = next(&mut self.reader, &mut self.file).map_err(|e| self.malformed("messages", e))?;
        }
        let due = self.next.take_if(|(_, message)| message.time <= time);
        Ok(due.and_then(|(id, message)| Some((self.summary.channels.get(&id)?.topic.clone(), message))))
    }

    /// What a viewer needs of a topic to show this time, in order: its last message; of a scene those since the last one that
    /// stands alone.
    pub fn state(&mut self, topic: &str, time: u64) -> Result<Vec<Message>, ExportError> {
        if self.first.get(topic).is_none_or(|first| *first > time) {
            return Ok(Vec::new());
        }
        let is_scene = self
            .channels()
            .any(|c| c.topic == topic && c.schema.as_ref().is_some_and(|s| s.name == SCENE_SCHEMA));
        let backward = IndexedReaderOptions::new().with_order(ReadOrder::ReverseLogTime).ending_at(time);
        let failed = |e| malformed(&self.path, "messages", e);
        let mut reader = reader(&self.summary, backward.include_topics([topic])).map_err(failed)?;
        let mut state = Vec::new();
        while let Some((_, message)) = next(&mut reader, &mut self.file).map_err(failed)? {
            let is_enough = !is_scene || stands_alone(&message.data);
            state.push(message);
            if is_enough {
                break;
            }
        }
        state.reverse();
        Ok(state)
    }

    /// The first message with these options.
    fn scan(&mut self, options: IndexedReaderOptions) -> Result<Option<Message>, ExportError> {
        let found = reader(&self.summary, options).and_then(|mut reader| next(&mut reader, &mut self.file));
        found.map(|m| m.map(|(_, message)| message)).map_err(|e| self.malformed("messages", e))
    }
}

fn reader(summary: &Summary, options: IndexedReaderOptions) -> McapResult<IndexedReader> {
    IndexedReader::new_with_options(summary, options.with_record_length_limit(MAX_CHUNK_BYTES))
}

fn summary(file: &mut File) -> McapResult<Option<Summary>> {
    let mut reader = SummaryReader::new();
    while let Some(event) = reader.next_event() {
        match event? {
            SummaryReadEvent::ReadRequest(need) => {
                let written = file.read(reader.insert(need))?;
                reader.notify_read(written);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
        }
    }
    Ok(reader.finish())
}

/// The next message of a reader, which asks for the chunks that it needs.
fn next(reader: &mut IndexedReader, file: &mut File) -> McapResult<Option<(u16, Message)>> {
    let mut chunk = Vec::new();
    while let Some(event) = reader.next_event() {
        match event? {
            IndexedReadEvent::ReadChunkRequest { offset, length } => {
                file.seek(SeekFrom::Start(offset))?;
                chunk.clear();
                // The length is what the file says: no more is allocated than is there.
                (&mut *file).take(length as u64).read_to_end(&mut chunk)?;
                if chunk.len() < length {
                    return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
                }
                reader.insert_chunk_record_data(offset, &chunk)?;
            }
            IndexedReadEvent::Message { header, data } => {
                let MessageHeader { channel_id, log_time, .. } = header;
                return Ok(Some((channel_id, Message { time: log_time, data: data.to_vec() })));
            }
        }
    }
    Ok(None)
}

fn malformed(path: &Path, expected: &str, found: impl ToString) -> ExportError {
    ExportError::Malformed {
        format: FORMAT,
        place: path.display().to_string(),
        expected: expected.to_owned(),
        found: found.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;
    use foxglove::Decode;
    use foxglove::messages::SceneUpdate;
    use vidar_core::{Se3, Timestamp, TriangleMesh};

    /// A triangle at each place, metres along x.
    fn mesh(at: &[f32]) -> TriangleMesh {
        TriangleMesh {
            positions: at
                .iter()
                .flat_map(|x| [[*x, 0.2, 0.2], [x + 0.1, 0.2, 0.2], [*x, 0.3, 0.2]])
                .collect(),
            triangles: (0..at.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            ..TriangleMesh::default()
        }
    }

    /// Numbers of the patches that a viewer shows which takes these messages one after the other.
    fn shown(messages: &[Message]) -> Vec<String> {
        let mut shown = Vec::new();
        for message in messages {
            let update = SceneUpdate::decode(&message.data[..]).unwrap();
            for deletion in &update.deletions {
                shown.retain(|id| !deletion.id.is_empty() && *id != deletion.id);
            }
            for entity in update.entities {
                shown.retain(|id| *id != entity.id);
                shown.push(entity.id);
            }
        }
        shown.sort();
        shown
    }

    #[test]
    fn a_viewer_that_jumps_is_told_the_surface_of_that_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        let mut scene = Scene::create(&path, Timestamp::from_nanos(500_000_000)).unwrap();
        let surfaces: [&[f32]; 4] = [&[0.2, 5.2], &[0.2, 5.2, 9.2], &[0.2, 9.2], &[0.2, 9.2]];
        for (second, places) in surfaces.iter().enumerate() {
            scene.camera_pose(Timestamp::from_nanos(1_000_000_000 * (1 + second as i64)), &Se3::IDENTITY);
            scene.mesh(&mesh(places), second == 3);
        }
        scene.finish().unwrap();
        let mut playback = Playback::open(&path).unwrap();
        let mut at = |secs: f64| {
            let messages = playback.state("/map/mesh", (secs * 1e9) as u64).unwrap();
            (messages.len(), shown(&messages))
        };
        let names = |numbers: &[u32]| numbers.iter().map(|n| format!("surface {n}")).collect::<Vec<_>>();
        assert_eq!(at(0.5), (0, Vec::new()));
        assert_eq!(at(1.5), (1, names(&[0, 1])));
        assert_eq!(at(2.5), (2, names(&[0, 1, 2])));
        assert_eq!(at(3.5), (3, names(&[0, 2])));
        assert_eq!(at(4.5), (1, names(&[0, 2])), "the last surface stands alone");
        assert_eq!(playback.state("/tf", 3_500_000_000).unwrap().len(), 1);
    }
}
