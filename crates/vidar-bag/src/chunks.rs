//! Decompressed chunks: those read last are kept, and the next ones are decompressed on threads of their own.

use crate::compression::Compression;
use crate::file::BagFile;
use crate::index::Chunk;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::{Builder, JoinHandle, available_parallelism};

/// Decompressed chunks that are kept or in work, bytes as announced; the one that is asked for stays even when it is larger.
const KEPT_BYTES: u64 = 32 << 20;
/// Most threads, and the chunks ahead of the reader for each: one in work and one that is ready.
const MOST_THREADS: usize = 4;
const AHEAD_PER_THREAD: usize = 2;
/// Largest chunk that is decompressed ahead, bytes. A decompressor's own state then stays small, too.
const MOST_AHEAD_BYTES: u64 = 8 << 20;

/// The name of threads that decompress chunks. A panic of theirs is an error of one chunk, and nothing for a panic hook to report.
pub const CHUNK_THREAD: &str = "vidar chunk decoder";

/// File of a chunk, and its number there; its offset where chunks are not numbered.
type Place = (u16, u64);

/// A chunk that is decompressed once, by the first thread that needs it, while others wait; or why it cannot be.
pub(crate) type Unpacked = OnceLock<Result<Vec<u8>, String>>;

/// What is to be decompressed.
#[derive(Clone)]
struct Job {
    file: Arc<BagFile>,
    chunk: Chunk,
    unpacked: Arc<Unpacked>,
}

impl Job {
    /// The content; whoever comes first decompresses it. The bytes do not depend on who that is.
    fn content(&self) -> &Result<Vec<u8>, String> {
        let Chunk { offset, stored, size, compression } = self.chunk;
        self.unpacked.get_or_init(|| {
            let packed = self.file.read(offset, stored).map_err(|e| e.to_string())?;
            compression.decompress(&packed, Some(size))
        })
    }
}

struct Kept {
    place: Place,
    size: u64,
    unpacked: Arc<Unpacked>,
    /// Whether a reader asked for it; otherwise it was only decompressed ahead.
    was_asked: bool,
}

#[derive(Default)]
struct State {
    /// The newest last.
    kept: Vec<Kept>,
    jobs: VecDeque<Job>,
    is_over: bool,
    threads: Vec<JoinHandle<()>>,
    /// Threads were started, or the system gives none.
    is_started: bool,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    wanted: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The decompressed chunks of a recording. Threads are started when a second chunk follows a first one, so never for files without
/// compression.
pub(crate) struct Chunks {
    shared: Arc<Shared>,
    count: usize,
}

impl Default for Chunks {
    fn default() -> Self {
        Self::with_threads(available_parallelism().map_or(1, usize::from).min(MOST_THREADS))
    }
}

impl Chunks {
    /// With at most so many threads; 0 decompresses where it is read.
    pub(crate) fn with_threads(count: usize) -> Self {
        Self { shared: Arc::default(), count }
    }

    /// The content of a chunk of `file`, whose chunks are `all`.
    pub(crate) fn get<T>(
        &self,
        (number, file): (u16, &Arc<BagFile>),
        all: &[Chunk],
        index: u32,
        read: impl FnOnce(&Result<Vec<u8>, String>) -> T,
    ) -> Option<T> {
        let chunk = *all.get(index as usize)?;
        let unpacked = self.plan((number, file), all, index, chunk.size);
        Some(read(Job { file: Arc::clone(file), chunk, unpacked }.content()))
    }

    /// The content of a chunk that no others are known beside.
    pub(crate) fn get_alone<T>(
        &self,
        file: &Arc<BagFile>,
        chunk: Chunk,
        read: impl FnOnce(&Result<Vec<u8>, String>) -> T,
    ) -> T {
        let unpacked = self.shared.lock().newest((0, chunk.offset), chunk.size);
        read(Job { file: Arc::clone(file), chunk, unpacked }.content())
    }

    /// Threads that run.
    #[cfg(test)]
    pub(crate) fn threads(&self) -> usize {
        self.shared.lock().threads.len()
    }

    /// Makes a chunk the newest; where it follows one that was read, the next ones are asked for.
    fn plan(
        &self,
        (number, file): (u16, &Arc<BagFile>),
        all: &[Chunk],
        index: u32,
        size: u64,
    ) -> Arc<Unpacked> {
        let mut guard = self.shared.lock();
        let state = &mut *guard;
        let unpacked = state.newest((number, index.into()), size);
        let follows = index.checked_sub(1).is_some_and(|before| state.was_asked((number, before.into())));
        if follows && self.count > 0 {
            let mut held: u64 = state.kept.iter().map(|k| k.size).sum();
            for (next, chunk) in
                (index + 1..).zip(all.iter().skip(index as usize + 1)).take(self.count * AHEAD_PER_THREAD)
            {
                let is_kept = state.kept.iter().any(|k| k.place == (number, next.into()));
                if chunk.compression == Compression::None || chunk.size > MOST_AHEAD_BYTES || is_kept {
                    continue;
                }
                // The oldest go first, and never the one that is read now or those ahead of it.
                while held + chunk.size > KEPT_BYTES {
                    let Some(oldest) =
                        state.kept.iter().position(|k| k.was_asked && k.place != (number, index.into()))
                    else {
                        break;
                    };
                    held -= state.kept.remove(oldest).size;
                }
                if held + chunk.size > KEPT_BYTES {
                    break;
                }
                held += chunk.size;
                let ahead = Arc::<Unpacked>::default();
                let kept = Kept {
                    place: (number, next.into()),
                    size: chunk.size,
                    unpacked: Arc::clone(&ahead),
                    was_asked: false,
                };
                state.kept.push(kept);
                state.jobs.push_back(Job { file: Arc::clone(file), chunk: *chunk, unpacked: ahead });
            }
            if !state.jobs.is_empty() {
                self.start(state);
                self.shared.wanted.notify_all();
            }
        }
        unpacked
    }

    fn start(&self, state: &mut State) {
        if std::mem::replace(&mut state.is_started, true) {
            return;
        }
        let spawn = |_| {
            let shared = Arc::clone(&self.shared);
            Builder::new().name(CHUNK_THREAD.into()).spawn(move || work(&shared)).ok()
        };
        state.threads = (0..self.count).filter_map(spawn).collect();
    }
}

impl State {
    /// The place of a chunk among those that are kept, as the newest; the oldest go.
    fn newest(&mut self, place: Place, size: u64) -> Arc<Unpacked> {
        let found = self.kept.iter().position(|k| k.place == place).map(|at| self.kept.remove(at));
        let mut kept =
            found.unwrap_or_else(|| Kept { place, size, unpacked: Arc::default(), was_asked: true });
        kept.was_asked = true;
        let unpacked = Arc::clone(&kept.unpacked);
        self.kept.push(kept);
        let mut held: u64 = self.kept.iter().map(|k| k.size).sum();
        while held > KEPT_BYTES && self.kept.len() > 1 {
            held -= self.kept.remove(0).size;
        }
        // What nobody keeps any more need not be decompressed.
        self.jobs.retain(|job| Arc::strong_count(&job.unpacked) > 1);
        unpacked
    }

    fn was_asked(&self, place: Place) -> bool {
        self.kept.iter().any(|k| k.place == place && k.was_asked)
    }
}

fn work(shared: &Shared) {
    loop {
        let mut state = shared.lock();
        let job = loop {
            if state.is_over {
                return;
            }
            match state.jobs.pop_front() {
                Some(job) => break job,
                None => state = shared.wanted.wait(state).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(state);
        let _ = job.content();
    }
}

impl Drop for Chunks {
    /// Waits for the chunks in work, so that no thread outlives the recording.
    fn drop(&mut self) {
        let threads = {
            let mut state = self.shared.lock();
            state.is_over = true;
            state.jobs.clear();
            std::mem::take(&mut state.threads)
        };
        self.shared.wanted.notify_all();
        threads.into_iter().for_each(|thread| drop(thread.join()));
    }
}

impl std::fmt::Debug for Chunks {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Chunks").field("threads", &self.count).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    const CHUNK_BYTES: usize = 1 << 20;

    /// A file of chunks whose bytes tell their number; the one of `damaged` has other bytes than were compressed.
    fn file(
        compression: Compression,
        count: usize,
        damaged: Option<usize>,
    ) -> (tempfile::TempDir, Arc<BagFile>, Vec<Chunk>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("chunks");
        let (mut bytes, mut chunks) = (Vec::new(), Vec::new());
        for number in 0..count {
            let content = vec![number as u8; CHUNK_BYTES];
            let mut stored = match compression {
                Compression::None => content,
                _ => {
                    let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
                    encoder.write_all(&content).unwrap();
                    encoder.finish().unwrap()
                }
            };
            if damaged == Some(number) {
                stored.iter_mut().skip(4).for_each(|b| *b = !*b);
            }
            let offset = bytes.len() as u64;
            chunks.push(Chunk { offset, stored: stored.len() as u64, size: CHUNK_BYTES as u64, compression });
            bytes.extend(stored);
        }
        std::fs::write(&path, bytes).unwrap();
        let file = Arc::new(BagFile::open(&path).unwrap());
        (folder, file, chunks)
    }

    fn read(chunks: &Chunks, file: &Arc<BagFile>, all: &[Chunk], index: u32) -> Result<Vec<u8>, String> {
        chunks.get((0, file), all, index, Result::clone).unwrap()
    }

    fn held(chunks: &Chunks) -> u64 {
        chunks.shared.lock().kept.iter().map(|k| k.size).sum()
    }

    #[test]
    fn the_bytes_are_the_same_for_any_number_of_threads_and_memory_is_bounded() {
        let (_folder, file, all) = file(Compression::Lz4, 100, Some(50));
        for threads in [0, 1, 3] {
            let chunks = Chunks::with_threads(threads);
            for index in 0..100 {
                let found = read(&chunks, &file, &all, index);
                assert_eq!(found.is_err(), index == 50);
                found.iter().for_each(|bytes| assert!(*bytes == vec![index as u8; CHUNK_BYTES]));
                assert!(held(&chunks) <= KEPT_BYTES);
            }
            assert_eq!(chunks.threads(), threads);
            assert!(read(&chunks, &file, &all, 3).unwrap() == vec![3; CHUNK_BYTES], "and backward");
        }
    }

    #[test]
    fn chunks_are_ready_ahead_of_who_reads_them_one_after_the_other() {
        let (_folder, file, all) = file(Compression::Lz4, 20, None);
        let chunks = Chunks::with_threads(2);
        let is_ready = |index: u32| {
            let state = chunks.shared.lock();
            state.kept.iter().any(|k| k.place == (0, index.into()) && k.unpacked.get().is_some())
        };
        read(&chunks, &file, &all, 7).unwrap();
        read(&chunks, &file, &all, 3).unwrap();
        assert_eq!(chunks.threads(), 0, "reading here and there asks for nothing");
        read(&chunks, &file, &all, 4).unwrap();
        let clock = std::time::Instant::now();
        while !(5..=8).all(is_ready) {
            assert!(clock.elapsed().as_secs() < 60, "the next four chunks");
            std::thread::yield_now();
        }
        assert!(!is_ready(9));
    }

    #[test]
    fn a_file_without_compression_starts_no_thread() {
        let (_folder, file, all) = file(Compression::None, 10, None);
        let chunks = Chunks::with_threads(4);
        (0..10).for_each(|index| drop(read(&chunks, &file, &all, index).unwrap()));
        assert_eq!(chunks.threads(), 0);
    }
}
