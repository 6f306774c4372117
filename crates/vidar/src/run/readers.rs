//! Readers of the engine's events: log and progress, times of the steps, the map, the growing surface, and files of views.

use super::live::{LivePublisher, SurfaceLatency};
use super::map::{MapCollector, MetricMap};
use super::plan::Plan;
use super::scene::SceneWriter;
use super::views::write_views;
use crate::config::Config;
use crate::engine::{MapEvent, Step};
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::RunFolder;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use vidar_core::Pinhole;
use vidar_dataset::Recording;

/// File of the growing surface.
const SO_FAR: &str = "map/so_far.ply";
/// The stages of `vidar run` in which the engine works.
pub(super) const MAP: &str = "map";
pub(super) const FINISH: &str = "finish";

/// All of them.
pub(super) struct Readers<'a> {
    events: &'a Events,
    config: &'a Config,
    folder: &'a RunFolder,
    dataset: &'a Recording,
    view: Pinhole,
    scene: Option<&'a SceneWriter>,
    collector: MapCollector<'a>,
    times: StepTimes,
    /// Keyframes predicted and fused, once the recording has ended.
    finishing: Option<(usize, usize)>,
    predicted: usize,
    /// Of a live run.
    pub(super) surfaces: Option<SurfaceLatency>,
    /// Who else hears of a live run.
    pub(super) publisher: Option<&'a LivePublisher>,
}

impl<'a> Readers<'a> {
    pub(super) fn new(
        dataset: &'a Recording,
        plan: &'a Plan,
        config: &'a Config,
        folder: &'a RunFolder,
        scene: Option<&'a SceneWriter>,
        events: &'a Events,
    ) -> Self {
        let collector = MapCollector::new(dataset, &plan.poses);
        let times = StepTimes::default();
        Self {
            events,
            config,
            folder,
            dataset,
            view: plan.view,
            scene,
            collector,
            times,
            finishing: None,
            predicted: 0,
            surfaces: None,
            publisher: None,
        }
    }

    /// The recording has ended: progress is that of predicting and fusing what is left.
    pub(super) fn finishing(&mut self) {
        self.finishing = Some((self.predicted, 0));
    }

    /// Takes an event.
    pub(super) fn read(&mut self, event: MapEvent) -> Result<(), Error> {
        if let Some(shown) = Event::of(&event) {
            self.events.emit(&shown);
        }
        self.times.read(&event);
        self.collector.read(&event)?;
        if let Some(publisher) = self.publisher {
            publisher.read(&event);
        }
        if let Some(scene) = self.scene {
            scene.read(&event, self.dataset, &self.view, self.events);
        }
        match &event {
            MapEvent::World { .. } => self.predicted = 0,
            MapEvent::ChunkPredicted { with_depth, .. } => self.predicted += with_depth,
            MapEvent::SurfaceChanged { surface, is_final: false, .. } => {
                let target = self.folder.file(SO_FAR)?;
                let comments = vec!["VIDAR map so far: provisional poses".to_owned()];
                vidar_export::atomic::write_atomically(&target, |w| {
                    vidar_export::write_ply_mesh(w, &surface.mesh, &comments)
                })?;
            }
            MapEvent::ViewsFused(views) => {
                let stored = write_views(views, self.config, self.folder, self.events)?;
                if let Some((_, fused)) = &mut self.finishing {
                    *fused += stored.len();
                }
                self.collector.add_stored(stored);
            }
            _ => {}
        }
        if let (Some((_, fused)), MapEvent::ChunkPredicted { .. } | MapEvent::ViewsFused(_)) =
            (self.finishing, &event)
        {
            // Each keyframe is predicted once and fused once; overlaps are predicted twice.
            let keyframes = self.collector.map().keyframes.len();
            let done = self.predicted.min(keyframes) + fused.min(keyframes);
            self.events.emit(&Event::Progress { stage: FINISH, done, total: 2 * keyframes });
        }
        if let Some(surfaces) = &mut self.surfaces {
            surfaces.read(&event, Instant::now());
        }
        Ok(())
    }

    /// The map; times of the steps are reported.
    pub(super) fn finish(self, plan: &Plan) -> MetricMap {
        for (step, time) in self.times.finish() {
            self.events.emit(&Event::StepFinished { step: step.name(), seconds: time.as_secs_f64() });
        }
        // What cannot be removed is only left behind.
        let _ = std::fs::remove_file(self.folder.path().join(SO_FAR));
        self.collector.finish(plan.camera_id)
    }
}

/// Tells how much of a chunk is predicted, in steps.
pub(super) fn chunk_progress(events: &Events) -> impl Fn(f64) + Sync {
    const STEP_PERCENT: usize = 5;
    let told = AtomicUsize::new(0);
    move |share| {
        let percent = (100.0 * share) as usize / STEP_PERCENT * STEP_PERCENT;
        if told.swap(percent, Ordering::Relaxed) != percent {
            events.emit(&Event::ChunkProgress { percent });
        }
    }
}

/// How long the engine worked on each step.
#[derive(Default)]
struct StepTimes {
    current: Option<(Step, Instant)>,
    total: Vec<(Step, Duration)>,
}

impl StepTimes {
    fn read(&mut self, event: &MapEvent) {
        if let MapEvent::Step(step) = event {
            self.stop();
            self.current = Some((*step, Instant::now()));
        }
    }

    fn stop(&mut self) {
        let Some((step, since)) = self.current.take() else { return };
        match self.total.iter_mut().find(|(s, _)| *s == step) {
            Some((_, total)) => *total += since.elapsed(),
            None => self.total.push((step, since.elapsed())),
        }
    }

    fn finish(mut self) -> Vec<(Step, Duration)> {
        self.stop();
        self.total
    }
}
