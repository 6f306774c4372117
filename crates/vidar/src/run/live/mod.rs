//! A live run: the odometry on a thread of its own, the map behind a bounded queue.
//!
//! ```text
//! arrival ─▶ odometry ─▶ poses (trajectory/live.tum)
//!            (thread)  └▶ queue ─▶ engine: keyframes ─▶ predict ─▶ align ─▶ growing surface (map/so_far.ply)
//! ```
//!
//! A recording that is replayed at its own rate does not wait. Where the map is behind, keyframes are no longer shown before their chunk
//! is predicted, then taken farther apart, in two steps, then none; where the odometry itself is, images are left to the IMU. All of it is said and counted. As fast as it goes, nothing is
//! left out, and the result has the bits of `vidar run` on live poses.

mod ending;
mod latency;
mod pose_file;
mod publish;
mod queue;
mod stream;
mod thinning;
mod tracker;

pub(super) use ending::{EndingCell, TrackedElsewhere};
pub use latency::Latency;
pub(super) use latency::SurfaceLatency;
pub(super) use publish::LivePublisher;
pub(super) use stream::{Incoming, LiveStream, fingerprint, kept, list};
pub use stream::{LiveInput, RECORDING};

use super::readers::{MAP, Readers};
use super::{Context, Plan, unreadable};
use crate::engine::{Engine, FrameStamp, MapEvent};
use crate::error::Error;
use crate::events::Event;
use crate::input::{self, Measurement};
use ending::Ending;
use pose_file::PoseFile;
use queue::{Closing, Item, Queue};
use serde::Serialize;
use std::time::{Duration, Instant};
use thinning::Thinning;
use thread_priority::{ThreadPriority, ThreadPriorityValue};
use tracker::{ArrivalClock, Counts, Tracker};
use vidar_core::{ModelError, Warning};
use vidar_dataset::DatasetError;

/// Keyframes that wait longer than this for the map's thread get no preview: it would make the others wait still longer. About what a
/// chunk takes, measured on two cores.
const MOST_DELAY_OF_PREVIEWS: Duration = Duration::from_millis(500);

/// How a live run goes.
#[derive(Clone, Copy, Debug)]
pub struct LiveOptions {
    /// Whether measurements arrive in the rhythm of their stamps, those of a stream when they come; otherwise each arrives when it is taken, and
    /// nothing is left out.
    pub is_realtime: bool,
    /// Threads of the odometry's own pool; the map uses the pool of the caller.
    pub odometry_threads: usize,
    /// Whether the threads of the caller's pool get a lower priority, and keep it, so that the map uses what the odometry leaves of all
    /// processors. Without, a caller leaves one of them free.
    pub is_map_low_priority: bool,
}

/// What a live run measured. Latencies count from the arrival of an image: of a recording that is replayed at its own rate its stamp,
/// of a robot's stream when its message came.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LiveReport {
    /// Whether measurements arrived in the rhythm of their stamps.
    pub is_realtime: bool,
    /// Images that arrived.
    pub images: usize,
    /// Images that the odometry left to the IMU, because it was late.
    pub images_not_tracked: usize,
    /// Keyframes left out because the map was behind and others are near.
    pub keyframes_thinned: usize,
    /// Keyframes left out because the queue was full.
    pub keyframes_dropped: usize,
    /// Poses that the map never got, because it was minutes behind.
    pub poses_dropped: usize,
    /// The most images that waited for the map.
    pub most_waiting: usize,
    /// From an image's arrival to its pose, s; none where no image got one.
    pub image_to_pose: Option<Latency>,
    /// The same from when the image and the IMU up to its instant had arrived, s.
    pub sensors_to_pose: Option<Latency>,
    /// From a keyframe's arrival to the first growing surface with its depth, s; none without `output.live_map`.
    pub keyframe_to_surface: Option<Latency>,
    /// The same from when an image had also arrived whose camera saw the keyframe's median depth under an angle of 0.02 rad, s: before, no
    /// depth can be seen.
    pub parallax_to_surface: Option<Latency>,
    /// Keyframes that no growing surface showed.
    pub keyframes_without_surface: usize,
}

impl LiveReport {
    /// In words: latencies, then what was left out.
    pub fn words(&self) -> String {
        let figures = |l: &Latency, factor: f64, unit: &str| {
            let [a, b, c] = [l.median, l.p95, l.p99].map(|v| v * factor);
            format!("{a:.1} / {b:.1} / {c:.1} {unit}")
        };
        // Waiting that no computing shortens is told where it is a tenth of what most take.
        let latency = |name: &str, [whole, computing]: [&Option<Latency>; 2], once, factor, unit| {
            let Some(whole) = whole else { return format!("{name} not measured") };
            let computing = computing.filter(|c| c.p99 < 0.9 * whole.p99);
            let computing = computing.map(|c| format!(", {} once {once}", figures(&c, factor, unit)));
            format!("{name} {}{}", figures(whole, factor, unit), computing.unwrap_or_default())
        };
        let left_out = self.images_not_tracked + self.keyframes_thinned + self.keyframes_dropped;
        let left_out = match left_out {
            0 => "nothing left out".to_owned(),
            _ => format!(
                "left out: {} of {} images, {} keyframes near others, {} others",
                self.images_not_tracked, self.images, self.keyframes_thinned, self.keyframes_dropped
            ),
        };
        format!(
            "{}, {} (median / 95 % / 99 %); {left_out}",
            latency(
                "image to pose",
                [&self.image_to_pose, &self.sensors_to_pose],
                "its IMU is there",
                1e3,
                "ms"
            ),
            latency(
                "keyframe to surface",
                [&self.keyframe_to_surface, &self.parallax_to_surface],
                "the camera has moved",
                1.0,
                "s"
            ),
        )
    }
}

/// What is measured until the recording has ended.
pub(super) struct Pushed {
    is_realtime: bool,
    counts: Counts,
    thinning: Thinning,
    most_waiting: usize,
}

impl Pushed {
    /// The whole report; `surfaces` also saw the end of the map.
    pub fn report(&self, surfaces: SurfaceLatency) -> LiveReport {
        let surfaces = surfaces.finish();
        LiveReport {
            is_realtime: self.is_realtime,
            images: self.counts.images,
            images_not_tracked: self.counts.not_tracked,
            keyframes_thinned: self.thinning.thinned,
            keyframes_dropped: self.thinning.dropped,
            poses_dropped: self.thinning.poses_dropped,
            most_waiting: self.most_waiting,
            image_to_pose: Latency::of(&self.counts.seconds),
            sensors_to_pose: Latency::of(&self.counts.seconds_from_sensors),
            keyframe_to_surface: surfaces.keyframe_to_surface,
            parallax_to_surface: surfaces.parallax_to_surface,
            keyframes_without_surface: surfaces.without,
        }
    }
}

/// What was left out, once it is known how much.
pub(super) fn warning(report: &LiveReport) -> Option<Warning> {
    let (late, dropped) = (report.images_not_tracked, report.keyframes_dropped + report.poses_dropped);
    let mut parts = Vec::new();
    if late > 0 {
        parts.push(format!("{late} of {} images came too late to be tracked", report.images));
    }
    if report.keyframes_thinned > 0 {
        parts.push(format!("{} keyframes near others were left out", report.keyframes_thinned));
    }
    if dropped > 0 {
        parts.push(format!("{dropped} keyframes were left out because the map was behind"));
    }
    let message = parts.join(", ");
    let hint = "the same command without --realtime maps all of the recording";
    match (parts.is_empty(), late + dropped) {
        (true, _) => None,
        (_, 0) => Some(Warning::new("live-left-out", message).hint(hint)),
        _ => Some(Warning::degraded("live-left-out", message).hint(hint)),
    }
}

/// Pushes the recording into the engine, tracked on a thread of its own. `ending` is where the engine's source of poses finds the end.
pub(super) fn push(
    context: &Context<'_>,
    (plan, options): (&Plan, &LiveOptions),
    ending: &EndingCell,
    engine: &mut Engine<'_>,
    readers: &mut Readers<'_>,
) -> Result<Pushed, Error> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(options.odometry_threads);
    let pool = pool.thread_name(|i| format!("odometry {i}")).build();
    let pool = pool.map_err(|e| Error::Usage {
        what: format!("cannot start {} threads for the odometry: {e}", options.odometry_threads),
        hint: "give a smaller --threads".into(),
    })?;
    let queue = Queue::default();
    let pose_file = PoseFile::create(context.folder, context.events)?;
    let publisher = readers.publisher;
    let tracked = std::thread::scope(|scope| {
        let track = || {
            let _closing = Closing(&queue);
            pool.install(|| track(context, (plan, options), &queue, pose_file, publisher))
        };
        let thread = std::thread::Builder::new().name("odometry".into()).spawn_scoped(scope, track);
        let thread = thread.map_err(|e| Error::io("start", "the odometry's thread".as_ref(), e))?;
        if options.is_map_low_priority {
            // Threads inherit a priority: those that serve poses have started.
            rayon::broadcast(|_| lower_priority());
        }
        let mapped = map((context, options), &queue, engine, readers);
        let tracked = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        // Where the map failed, the odometry only stopped.
        mapped.and(tracked)
    })?;
    let (end, counts, thinning) = tracked;
    // The cell is new.
    let _ = ending.set(end);
    Ok(Pushed { is_realtime: options.is_realtime, counts, thinning, most_waiting: queue.most_images() })
}

/// Priority of the map's threads in per cent, a niceness of 9: where both want a processor, Linux gives the odometry nine tenths of it.
const PRIORITY_OF_MAP: u8 = 25;

/// Lets others go before this thread. Where the system refuses, they share the processors.
fn lower_priority() {
    let priority = ThreadPriorityValue::try_from(PRIORITY_OF_MAP).map(ThreadPriority::Crossplatform);
    let _ = priority.map(ThreadPriority::set_for_current);
}

/// The odometry's thread.
fn track(
    context: &Context<'_>,
    (plan, options): (&Plan, &LiveOptions),
    queue: &Queue,
    pose_file: PoseFile<'_>,
    publisher: Option<&LivePublisher>,
) -> Result<(Ending, Counts, Thinning), Error> {
    let Context { dataset, config, cancel, .. } = *context;
    let (poses, _) = plan.poses.open(dataset, config)?;
    let needs_sensors = poses.as_ref().is_some_and(|p| p.needs_sensors());
    let unreadable = |stamp: FrameStamp, error: &DatasetError| unreadable(dataset, stamp, error);
    let mut tracker = Tracker {
        poses,
        queue,
        arrival: match (options.is_realtime, context.stream) {
            (false, _) => ArrivalClock::Taken,
            (true, None) => ArrivalClock::Stamped(None),
            (true, Some(_)) => ArrivalClock::Came(Some(Instant::now())),
        },
        thinning: Thinning::new(&config.keyframes),
        pose_file,
        publisher,
        unreadable: &unreadable,
        counts: Counts::default(),
        waiting: Default::default(),
    };
    let go_on = || !cancel.is_cancelled() && !queue.is_closed_within(Duration::ZERO);
    let measurements: Box<dyn Iterator<Item = (Measurement, Option<Instant>)>> = match context.stream {
        Some(stream) => Box::new(stream.measurements(needs_sensors, &go_on)),
        None => Box::new(input::measurements(dataset, needs_sensors).map(|m| (m, None))),
    };
    let end = tracker.run(measurements, &|| cancel.is_cancelled())?;
    let Tracker { counts, thinning, pose_file, .. } = tracker;
    pose_file.finish();
    Ok((end, counts, thinning))
}

/// The map's side. Where no worker elsewhere answers any more, the map ends and the poses of a robot do not.
fn map(
    (context, options): (&Context<'_>, &LiveOptions),
    queue: &Queue,
    engine: &mut Engine<'_>,
    readers: &mut Readers<'_>,
) -> Result<(), Error> {
    let _closing = Closing(queue);
    // Of a recording that is replayed as fast as it goes nobody sees the surface grow, nor waits for poses.
    let is_watched = options.is_realtime || context.stream.is_some();
    let mapped = map_queue((context, is_watched), queue, engine, readers);
    if let (Err(error @ Error::Geometry(ModelError::OutOfReach(_))), true) = (&mapped, is_watched) {
        let message = format!("the map has stopped, poses go on: {error}");
        let hint = "the same command with --resume maps the recording once workers answer";
        readers.read(MapEvent::Warning(Warning::degraded("map-stopped", message).hint(hint)))?;
        while queue.pop().is_some() {}
    }
    mapped
}

/// What is tracked into the engine, until the odometry ends or the engine cannot go on.
fn map_queue(
    (context, is_watched): (&Context<'_>, bool),
    queue: &Queue,
    engine: &mut Engine<'_>,
    readers: &mut Readers<'_>,
) -> Result<(), Error> {
    let (total, mut done) = (context.dataset.images.len(), 0);
    while let Some(item) = queue.pop() {
        match item {
            Item::Warning(warning) => readers.read(MapEvent::Warning(warning))?,
            Item::Tracked { images, report, .. } => {
                images.iter().for_each(|(stamp, at)| readers.arrived(stamp.frame_id, *at));
                let stamps: Vec<FrameStamp> = images.iter().map(|(stamp, _)| *stamp).collect();
                let reports = report.into_iter().map(|report| *report).collect();
                engine.preview_when_late(is_watched && queue.load().delay < MOST_DELAY_OF_PREVIEWS);
                let (began, mut predicted) = (Instant::now(), 0);
                engine.push_tracked(&stamps, reports, &mut |event| {
                    if let MapEvent::ChunkPredicted { keyframes, .. } = &event {
                        predicted += keyframes;
                    }
                    readers.read(event)
                })?;
                queue.took(began.elapsed(), predicted);
                done += stamps.len();
                // How long a stream goes on is not known.
                let total = context.stream.map_or(total, |_| done);
                context.events.emit(&Event::Progress { stage: MAP, done, total });
            }
        }
    }
    Ok(())
}

impl Readers<'_> {
    /// An image arrived that may become a keyframe.
    fn arrived(&mut self, frame: vidar_core::FrameId, at: Instant) {
        if let Some(surfaces) = &mut self.surfaces {
            surfaces.arrived(frame, at);
        }
    }
}
