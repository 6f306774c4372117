//! One typed stream of what happens: the bar, JSON lines and the log are its readers.

use crate::engine::MapEvent;
use crate::input::TrajectorySource;
use serde::Serialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use vidar_align::ChunkStatus;
use vidar_align::aligner::LoopRejection;
use vidar_core::{ChunkId, FrameId, Warning};

/// Schema of a line of `log.jsonl` and of `--progress json`.
pub const EVENT_SCHEMA: &str = "vidar.event/1";

/// Something that happened in a run. Events of the engine are given in short; their results are in [`MapEvent`].
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
    /// A part of the chunk at hand is predicted.
    ChunkProgress {
        /// Roughly, 0…100.
        percent: usize,
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
    /// Mapping began, or began anew with a longer segment of the track: keyframes and chunks reported before are void.
    World {
        /// Where the metric poses come from; null without metric poses.
        poses: Option<TrajectorySource>,
        /// The segment of the track that is mapped.
        segment: u32,
    },
    /// An image was tracked.
    State {
        /// Which image.
        frame: FrameId,
        /// When it was taken, ns.
        time_ns: i64,
        /// Segment of the track.
        segment: u32,
        /// Position of the camera, m.
        position_m: [f64; 3],
    },
    /// Poses of odometry keyframes were estimated again.
    RevisedStates {
        /// How many.
        keyframes: usize,
    },
    /// A frame was selected as a keyframe.
    Keyframe {
        /// Which image.
        frame: FrameId,
        /// When it was taken, ns.
        time_ns: i64,
    },
    /// Depth of a chunk was predicted.
    ChunkPredicted {
        /// Chunk number.
        chunk: ChunkId,
        /// Keyframes whose depth was wanted.
        keyframes: usize,
        /// Keyframes that got depth.
        with_depth: usize,
        /// Whether an earlier run had predicted it.
        is_reused: bool,
    },
    /// A chunk was placed in the world.
    ChunkPlaced {
        /// Chunk number.
        chunk: ChunkId,
        /// Metres per chunk unit, as far as it is estimated by now.
        scale: Option<f64>,
        /// RMS distance of camera centres to their metric poses, m.
        center_rms_m: Option<f64>,
        /// How the chunk stands.
        status: ChunkStatus,
    },
    /// A revisit was measured.
    LoopMeasured {
        /// The later chunk.
        later: ChunkId,
        /// The earlier chunk.
        earlier: ChunkId,
        /// Share of point pairs that agree.
        inlier_ratio: Option<f64>,
        /// Why it was rejected; null where it was accepted.
        rejection: Option<LoopRejection>,
    },
    /// Chunks and keyframes were placed again.
    PlacementsRevised {
        /// Chunks placed.
        chunks: usize,
        /// Keyframes placed.
        keyframes: usize,
        /// Whether nothing will move any more.
        is_final: bool,
    },
    /// The surface changed (`output.live_map` after every chunk; always at the end).
    SurfaceChanged {
        /// Triangles in it.
        triangles: usize,
        /// Whether it is the map.
        is_final: bool,
    },
    /// A step of the engine was worked on for this long in all.
    StepFinished {
        /// `track`, `predict`, `align`, `fuse` or `complete`.
        step: &'static str,
        /// Wall time, s.
        seconds: f64,
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

impl Event {
    /// What log and progress show of an event of the engine.
    pub fn of(event: &MapEvent) -> Option<Self> {
        let finite = |v: f64| Some(v).filter(|v| v.is_finite());
        Some(match event {
            MapEvent::Step(_)
            | MapEvent::ChunkObserved { .. }
            | MapEvent::ViewsFused(_)
            | MapEvent::Tracked(_) => return None,
            MapEvent::World { source, segment } => Self::World { poses: source.clone(), segment: *segment },
            MapEvent::State(state) => Self::State {
                frame: state.frame_id,
                time_ns: state.time.nanos(),
                segment: state.segment,
                position_m: state.world_from_camera.translation.into(),
            },
            MapEvent::RevisedStates(revised) => Self::RevisedStates { keyframes: revised.len() },
            MapEvent::Keyframe(keyframe) => {
                Self::Keyframe { frame: keyframe.stamp.frame_id, time_ns: keyframe.stamp.time.nanos() }
            }
            MapEvent::ChunkPredicted { chunk, keyframes, with_depth, is_reused, .. } => {
                Self::ChunkPredicted {
                    chunk: *chunk,
                    keyframes: *keyframes,
                    with_depth: *with_depth,
                    is_reused: *is_reused,
                }
            }
            MapEvent::ChunkPlaced(report) => Self::ChunkPlaced {
                chunk: report.chunk_id,
                scale: report.world_from_chunk.map(|s| s.scale),
                center_rms_m: finite(report.center_rms_m),
                status: report.status,
            },
            MapEvent::LoopMeasured(report) => Self::LoopMeasured {
                later: report.later,
                earlier: report.earlier,
                inlier_ratio: finite(report.inlier_ratio),
                rejection: report.rejection,
            },
            MapEvent::PlacementsRevised { placement, is_final } => Self::PlacementsRevised {
                chunks: placement.chunks.len(),
                keyframes: placement.keyframes.len(),
                is_final: *is_final,
            },
            MapEvent::SurfaceChanged { surface, is_final, .. } => {
                Self::SurfaceChanged { triangles: surface.mesh.triangles.len(), is_final: *is_final }
            }
            MapEvent::Warning(warning) => Self::Warning { warning: warning.clone() },
        })
    }
}

/// Where events go. Cheap to clone; readers are called in order, on the emitting thread.
#[derive(Clone, Default)]
pub struct Events(Vec<Reader>);

type Reader = Arc<dyn Fn(&Event) + Send + Sync>;

impl Events {
    /// A stream without readers.
    pub fn none() -> Self {
        Self::default()
    }

    /// The same stream with one more reader.
    pub fn with(mut self, reader: impl Fn(&Event) + Send + Sync + 'static) -> Self {
        self.0.push(Arc::new(reader));
        self
    }

    /// Calls every reader.
    pub fn emit(&self, event: &Event) {
        for reader in &self.0 {
            reader(event);
        }
    }

    /// Emits a warning.
    pub fn warn(&self, warning: &Warning) {
        self.emit(&Event::Warning { warning: warning.clone() });
    }

    /// Runs `work` as a stage: started, finished, and how long. A stage that failed is not reported as finished.
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
    /// A token that is not cancelled.
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
