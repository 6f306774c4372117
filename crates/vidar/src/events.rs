//! One typed stream of what happens: the bar, JSON lines and the log are its readers.

use serde::Serialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use vidar_core::Warning;

/// Schema of a line of `log.jsonl` and of `--progress json`.
pub const EVENT_SCHEMA: &str = "vidar.event/1";

/// Something worth telling.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum Event {
    /// A stage began; `total` steps are expected (0 = unknown).
    StageStarted {
        /// Stage name.
        stage: &'static str,
        /// Steps expected.
        total: usize,
    },
    /// Steps of a stage are done.
    Progress {
        /// Stage name.
        stage: &'static str,
        /// Steps done.
        done: usize,
        /// Steps expected.
        total: usize,
    },
    /// A stage ended.
    StageFinished {
        /// Stage name.
        stage: &'static str,
        /// Wall time, s.
        seconds: f64,
    },
    /// Something the user should know.
    Warning {
        /// The warning.
        #[serde(flatten)]
        warning: Warning,
    },
    /// A chunk was placed in the world.
    ChunkAligned {
        /// Chunk number.
        chunk: u32,
        /// Metres per chunk unit, as far as it is known by now.
        scale: Option<f64>,
        /// RMS distance of camera centres to their anchors, m.
        center_rms_m: Option<f64>,
        /// The judgement.
        status: vidar_align::ChunkStatus,
    },
    /// The map so far was written (`output.live_map`); the path is relative to the run folder.
    MapGrew {
        /// Where.
        path: String,
        /// How large, bytes.
        bytes: u64,
        /// Triangles in it.
        triangles: usize,
    },
    /// A file was written; the path is relative to the run folder.
    ArtifactWritten {
        /// Where.
        path: String,
        /// How large, bytes.
        bytes: u64,
    },
    /// The run ended.
    Finished {
        /// Exit status as a number.
        exit: i32,
        /// Wall time, s.
        seconds: f64,
    },
}

/// Where events go. Cheap to clone; readers are called in order, on the emitting thread.
#[derive(Clone, Default)]
pub struct Events(Vec<Reader>);

type Reader = Arc<dyn Fn(&Event) + Send + Sync>;

impl Events {
    /// Nobody listens.
    pub fn none() -> Self {
        Self::default()
    }

    /// The same stream with one more reader.
    pub fn with(mut self, reader: impl Fn(&Event) + Send + Sync + 'static) -> Self {
        self.0.push(Arc::new(reader));
        self
    }

    /// Tells every reader.
    pub fn emit(&self, event: &Event) {
        for reader in &self.0 {
            reader(event);
        }
    }

    /// Tells of a warning.
    pub fn warn(&self, warning: &Warning) {
        self.emit(&Event::Warning { warning: warning.clone() });
    }

    /// Runs `work` as a stage: started, finished, and how long. A stage that failed is not told as finished.
    pub fn stage<T, E>(
        &self,
        stage: &'static str,
        total: usize,
        work: impl FnOnce() -> Result<T, E>,
    ) -> Result<T, E> {
        let start = std::time::Instant::now();
        self.emit(&Event::StageStarted { stage, total });
        let result = work();
        if result.is_ok() {
            self.emit(&Event::StageFinished { stage, seconds: start.elapsed().as_secs_f64() });
        }
        result
    }
}

/// Asks a run to finish its files and stop.
#[derive(Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// A token that nobody has used.
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks for the stop.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the stop was asked for.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
