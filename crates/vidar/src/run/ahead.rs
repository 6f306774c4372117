//! Chunks of one recording at several workers at a time.
//!
//! ```text
//! run ─▶ chunk 0, then asks the store for 1, 2, then predicts 3, …      (worker a)
//! thread 1 ─▶ chunks 1, 4, 7, … into the run folder                     (worker b)
//! thread 2 ─▶ chunks 2, 5, 8, … into the run folder                     (worker c)
//! ```
//!
//! The chunks of a recording whose poses are known do not depend on one another. Each thread predicts a part of them, as a batch's
//! process does, and the run finds them in its folder, so that its map has the same bits. What a thread cannot predict, the run does.

use super::Context;
use super::parts::{Part, predict_part};
use super::place_recognition::PlaceRecognition;
use super::plan::Plan;
use super::remote::{RemoteSource, WorkerGroup};
use super::source::Source;
use super::store::RunStore;
use crate::engine::PredictionId;
use crate::error::Error;
use crate::events::Events;
use crate::odometry::TrackedPoses;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use vidar_core::{ChunkId, Warning};
use vidar_link::geometry::RemoteReport;

/// The most workers that one run asks at a time: each has an engine beside it, and the run aligns in less than an eighth of the time of a
/// prediction.
const MOST: usize = 8;
/// How often a wait looks whether the run was cancelled.
const LOOK: Duration = Duration::from_millis(50);

/// What threads predict beside a run.
pub(super) struct Ahead {
    parts: usize,
    progress: Mutex<Progress>,
    changed: Condvar,
    /// The run needs no more.
    is_over: AtomicBool,
}

#[derive(Default)]
struct Progress {
    predicted: BTreeSet<ChunkId>,
    /// Parts whose thread has ended.
    ended: BTreeSet<usize>,
    warnings: Vec<Warning>,
    reports: Vec<RemoteReport>,
}

/// What the threads had to say.
#[derive(Default)]
pub(super) struct AheadReport {
    /// Warnings, of which the run may have said some itself.
    pub warnings: Vec<Warning>,
    /// What went over each link.
    pub reports: Vec<RemoteReport>,
}

impl Ahead {
    fn locked(&self) -> MutexGuard<'_, Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, change: impl FnOnce(&mut Progress)) {
        change(&mut self.locked());
        self.changed.notify_all();
    }

    /// Waits until a thread has predicted the chunk, or will not.
    pub(super) fn wait_for(&self, chunk: ChunkId, is_cancelled: &dyn Fn() -> bool) {
        let part = chunk.0 as usize % self.parts;
        let mut progress = self.locked();
        while part != 0
            && !progress.predicted.contains(&chunk)
            && !progress.ended.contains(&part)
            && !is_cancelled()
        {
            let waited = self.changed.wait_timeout(progress, LOOK);
            progress = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Does `work` while threads predict beside it: where several workers are asked, and all poses are known.
pub(super) fn beside<T>(
    context: &Context<'_>,
    (plan, places): (&Plan, &PlaceRecognition),
    group: Option<&WorkerGroup>,
    tracked: Option<&TrackedPoses>,
    work: impl FnOnce(Option<&Ahead>) -> Result<T, Error>,
) -> Result<(T, AheadReport), Error> {
    let is_known = context.live.is_none() && (tracked.is_some() || !plan.poses.is_odometry());
    let parts = group.map_or(1, |group| group.workers.min(MOST));
    let Some(group) = group.filter(|_| is_known && parts > 1) else {
        return Ok((work(None)?, AheadReport::default()));
    };
    let (progress, changed, is_over) = Default::default();
    let ahead = Ahead { parts, progress, changed, is_over };
    let made = std::thread::scope(|scope| {
        for index in 1..parts {
            let ahead = &ahead;
            let part = Part { index, of: parts };
            let thread = move || {
                let ended = Ended(ahead, index);
                if let Err(error) = predict(context, plan, places, (group, tracked.cloned()), part, ahead) {
                    let message = format!("a thread that asked workers ahead ended: {error}");
                    let hint = "the run asked for its chunks itself";
                    ahead.change(|p| p.warnings.push(Warning::new("not-ahead", message).hint(hint)));
                }
                drop(ended);
            };
            if std::thread::Builder::new().name(format!("ahead {index}")).spawn_scoped(scope, thread).is_err()
            {
                drop(Ended(ahead, index));
            }
        }
        let made = work(Some(&ahead));
        ahead.is_over.store(true, Ordering::Relaxed);
        made
    });
    let Progress { warnings, reports, .. } = std::mem::take(&mut *ahead.locked());
    Ok((made?, AheadReport { warnings, reports }))
}

/// Says that the thread of a part has ended, however it did.
struct Ended<'a>(&'a Ahead, usize);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        self.0.change(|p| {
            p.ended.insert(self.1);
        });
    }
}

/// The chunks of one part.
fn predict(
    context: &Context<'_>,
    plan: &Plan,
    places: &PlaceRecognition,
    (group, tracked): (&WorkerGroup, Option<TrackedPoses>),
    part: Part,
    ahead: &Ahead,
) -> Result<(), Error> {
    let is_over = || ahead.is_over.load(Ordering::Relaxed) || context.cancel.is_cancelled();
    let mut config = context.config.clone();
    config.output.live_map = false;
    let events = Events::none();
    let context = Context { config: &config, events: &events, scene: None, stream: None, ..*context };
    let mut source = Source::Remote(Box::new(group.join(&config, part.index)?));
    let store = RunStore::new(context.folder.path(), context.fingerprint, plan, &config);
    let kept = |id: PredictionId, _: &[std::path::PathBuf]| {
        if let PredictionId::Chunk(chunk) = id {
            ahead.change(|p| {
                p.predicted.insert(chunk);
            });
        }
        Ok(())
    };
    let warned = |warning: Warning| ahead.change(|p| p.warnings.push(warning));
    let parts = (&mut source, places, &store);
    let predicted = predict_part(&context, plan, parts, tracked, (part, &kept), &is_over, &warned);
    ahead.change(|p| p.reports.extend(source.remote().map(RemoteSource::report)));
    predicted.map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    fn ahead() -> Ahead {
        let (progress, changed, is_over) = Default::default();
        Ahead { parts: 3, progress, changed, is_over }
    }

    #[test]
    fn the_run_waits_for_a_chunk_until_its_thread_has_it_or_ends_and_for_its_own_never() {
        let ahead = ahead();
        let never = || -> bool { panic!("asked whether to stop: it waits") };
        ahead.wait_for(ChunkId(3), &never);
        ahead.change(|p| {
            p.predicted.insert(ChunkId(4));
        });
        ahead.wait_for(ChunkId(4), &never);
        drop(Ended(&ahead, 2));
        ahead.wait_for(ChunkId(5), &never);
        let clock = Instant::now();
        ahead.wait_for(ChunkId(7), &|| clock.elapsed() > Duration::from_millis(120));
        assert!(
            clock.elapsed() > Duration::from_millis(120),
            "its thread has neither predicted it nor ended"
        );
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(30));
                drop(Ended(&ahead, 1));
            });
            ahead.wait_for(ChunkId(7), &|| false);
        });
        assert!(ahead.locked().ended.contains(&1));
    }
}
