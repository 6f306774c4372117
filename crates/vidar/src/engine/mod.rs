//! Sensor measurements in, a metric dense map out: the method as one push machine.
//!
//! ```text
//! push(SensorEvent) ─▶ track ─▶ select keyframes ─▶ predict ─▶ align ─┐
//! finish()          ─────────── the rest of it ───────────────────────┴▶ fuse (─▶ complete ─▶ fuse)
//! ```
//!
//! It is the paper's figure of the pipeline (section III-A). Images are tracked to metric poses by visual-inertial odometry
//! (or looked up in a given trajectory); frames that moved become keyframes; a chunk of keyframes is predicted by the
//! geometry model as soon as later keyframes no longer change it, and is aligned in the metric world. When the recording
//! ends, all chunks are placed by one graph and their depth is fused. The engine owns no thread, file or clock; what it needs
//! from outside it gets as traits ([`EngineSetup`]), and all that it finds out it reports as [`MapEvent`]s. Same input,
//! same bits. Memory is bounded by one window of keyframes, the aligner's samples and the fusion's budget.

mod complete;
mod cut;
mod events;
mod fuse;
mod growing;
mod mapping;
mod observe;
pub(crate) mod placed;
mod pose_source;
mod predict;
mod preview;
mod select;
mod settled;
mod setup;
mod stereo_landmarks;
mod track;
mod views;

pub use cut::ChunkRule;
pub use events::{FrameStamp, FrameState, MapEvent, MapKeyframe, ShownKeyframe, Step, Surface};
pub use pose_source::{GivenPoses, OdometryPoses, PoseReport, PoseSource};
pub use select::Selection;
pub use setup::{
    EngineSetup, GeometrySource, ImageSource, PlaceDescriber, PredictedFrame, Prediction, PredictionId,
    PredictionStore,
};
pub use track::{PosedFrame, longest_posed};

use crate::config::{Config, LandmarkSources};
use crate::error::Error;
use crate::input::trajectory::TrajectorySource;
use growing::GrowingSurface;
use observe::{LandmarkUse, Observer};
use predict::Predictor;
use preview::Preview;
use stereo_landmarks::StereoLandmarks;
use track::Track;
use vidar_align::Aligner;
use vidar_core::{CameraId, CameraModel, Duration, FrameId, SensorEvent, Warning};

/// Where the engine's events go. An error of a reader ends the run.
pub type Sink<'s> = dyn FnMut(MapEvent) -> Result<(), Error> + 's;

/// The machine.
pub struct Engine<'a> {
    name: String,
    config: &'a Config,
    camera: CameraId,
    camera_model: CameraModel,
    readout: Duration,
    cancelled: &'a (dyn Fn() -> bool + Sync),
    poses: Option<Box<dyn PoseSource + 'a>>,
    fallback: Option<Box<dyn PoseSource + 'a>>,
    track: Track,
    /// Images so far, and those of them that may become keyframes.
    images: usize,
    candidates: Vec<FrameStamp>,
    rule: ChunkRule,
    observer: Observer,
    predictor: Predictor<'a>,
    world: Option<World>,
    growing: Option<GrowingSurface>,
    preview: Option<Preview<'a>>,
    volume_budget_bytes: u64,
    step: Option<Step>,
}

/// What is mapped of one segment of the track.
struct World {
    /// None where there are no metric poses.
    segment: Option<u32>,
    /// Keyframes of the odometry that were taken so far.
    odometry_taken: usize,
    selection: Selection,
    keyframes: Vec<MapKeyframe>,
    frames: Vec<FrameId>,
    chunks: usize,
    aligner: Aligner,
    /// Whether chunks have moved with a settled scale since the surface was shown.
    is_resettled: bool,
    failures: Vec<String>,
}

impl<'a> Engine<'a> {
    /// An engine that has seen nothing.
    ///
    /// # Errors
    /// Settings that a stage refuses.
    pub fn new(setup: EngineSetup<'a>) -> Result<Self, Error> {
        let config = setup.config;
        let overlaps = setup.geometry.overlaps();
        let rule = chunk_rule(config, overlaps, setup.prescribed);
        let wait = Duration::from_secs_f64(config.output.live_map_wait_secs);
        let preview = match rule {
            ChunkRule::WithContext { size, context } if wait > Duration::ZERO => {
                Some(Preview::new(wait, (size, context), setup.images, (&setup.camera.model, &setup.view)))
            }
            _ => None,
        };
        let mut predictor = Predictor::new(
            setup.geometry,
            setup.places,
            (setup.images, setup.store),
            (&setup.camera, &setup.view),
            (setup.cancelled, setup.predicting),
        );
        // Chunks without overlaps are stereo's: their unit is that of the poses already.
        let is_fitted = setup.poses.is_some() && overlaps;
        if is_fitted && config.coupling.uses_landmarks(LandmarkSources::Stereo) {
            predictor.stereo_landmarks = Some(StereoLandmarks::new(config)?);
        }
        Ok(Self {
            name: setup.name,
            config,
            camera: setup.camera_id,
            camera_model: setup.camera.model.clone(),
            readout: setup.readout,
            cancelled: setup.cancelled,
            poses: setup.poses,
            fallback: setup.fallback,
            track: Track::new(Duration::from_secs_f64(config.input.max_pose_gap_secs)),
            images: 0,
            candidates: Vec::new(),
            rule,
            observer: Observer::new(&setup.camera, setup.view, LandmarkUse::new(&config.coupling, overlaps)),
            predictor,
            world: None,
            growing: config.output.live_map.then(|| GrowingSurface::new(config)).transpose()?,
            preview,
            volume_budget_bytes: setup.volume_budget_bytes,
            step: None,
        })
    }

    /// Whether every measurement must be pushed whole. Otherwise poses are given, and [`Engine::push_stamp`] suffices.
    pub fn needs_sensors(&self) -> bool {
        self.poses.as_ref().is_some_and(|p| p.needs_sensors())
    }

    /// Takes a measurement. Measurements come in the order of time; at equal times the IMU comes first.
    ///
    /// # Errors
    /// What a stage cannot go on with, and what a reader of the events returns.
    pub fn push(&mut self, event: SensorEvent, sink: &mut Sink<'_>) -> Result<(), Error> {
        if let SensorEvent::Image(frame) = &event {
            if frame.camera != self.camera {
                return Ok(());
            }
            self.add_image(FrameStamp { frame_id: frame.id, time: frame.time, camera: frame.camera });
        }
        self.enter(Step::Track, sink)?;
        let reports = self.poses.as_mut().map_or_else(|| Ok(Vec::new()), |p| p.push(event))?;
        self.advance(reports, false, sink)
    }

    /// Takes an image without its pixels: poses are given, or the image cannot be read.
    ///
    /// # Errors
    /// As [`Engine::push`].
    pub fn push_stamp(&mut self, stamp: FrameStamp, sink: &mut Sink<'_>) -> Result<(), Error> {
        self.add_image(stamp);
        let reports = self.poses.as_mut().map_or_else(Vec::new, |p| p.push_stamp(&stamp));
        self.advance(reports, false, sink)
    }

    /// Takes images, and what was found of their poses elsewhere: on a thread of its own, say, so that tracking waits for no
    /// prediction. Images come in the order of time, each before its report; the source of poses of the setup gives what is
    /// left at the end. The result is that of [`Engine::push`] with the same reports.
    ///
    /// # Errors
    /// As [`Engine::push`].
    pub fn push_tracked(
        &mut self,
        images: &[FrameStamp],
        reports: Vec<PoseReport>,
        sink: &mut Sink<'_>,
    ) -> Result<(), Error> {
        images.iter().for_each(|stamp| self.add_image(*stamp));
        self.enter(Step::Track, sink)?;
        self.advance(reports, false, sink)
    }

    /// Whether there is time to show keyframes in the growing surface before their chunk is predicted (`output.live_map_wait_secs`). Not
    /// before this is called; it changes nothing in the map.
    pub fn preview_when_late(&mut self, has_time: bool) {
        if let Some(preview) = &mut self.preview {
            preview.has_time = has_time;
        }
    }

    /// Maps what is left, places everything once more, and fuses it.
    ///
    /// # Errors
    /// There is no pose, no keyframe or no placed chunk; and as [`Engine::push`].
    pub fn finish(mut self, sink: &mut Sink<'_>) -> Result<(), Error> {
        let rest = self.poses.as_mut().map_or_else(Vec::new, |p| p.finish());
        self.add_reports(rest, sink)?;
        self.track.finish();
        self.fall_back(sink)?;
        self.advance(Vec::new(), true, sink)?;
        let placement = self.place(sink)?;
        self.fuse(&placement, sink)
    }

    /// The method: track → select keyframes → predict → align.
    fn advance(
        &mut self,
        reports: Vec<PoseReport>,
        is_complete: bool,
        sink: &mut Sink<'_>,
    ) -> Result<(), Error> {
        self.add_reports(reports, sink)?;
        if !self.select_keyframes(is_complete, sink)? && !is_complete {
            return self.preview(sink);
        }
        while let Some((id, chunk)) = self.next_chunk(is_complete)? {
            let Some(prediction) = self.predict(id, &chunk, sink)? else { break };
            self.align(id, &chunk, prediction, sink)?;
        }
        if is_complete { Ok(()) } else { self.preview(sink) }
    }

    fn add_image(&mut self, stamp: FrameStamp) {
        if self.images.is_multiple_of(self.config.input.stride.max(1)) {
            self.candidates.push(stamp);
            self.track.add_candidate(stamp);
        }
        self.images += 1;
    }

    /// Track: poses of images.
    fn add_reports(&mut self, reports: Vec<PoseReport>, sink: &mut Sink<'_>) -> Result<(), Error> {
        for report in reports {
            if let PoseReport::Posed { state, revised, settled, .. } = &report {
                let all = [revised.as_slice(), settled].concat();
                all.iter().for_each(|r| self.observer.revise(r));
                if !settled.is_empty() {
                    self.settle(state, settled);
                }
                if !all.is_empty() {
                    sink(MapEvent::RevisedStates(all))?;
                }
            }
            if let Some(state) = self.track.add(report) {
                sink(MapEvent::State(state))?;
            }
        }
        Ok(())
    }

    /// When the recording has ended without a track, the fallback's poses are used, or none where the coupling needs none.
    fn fall_back(&mut self, sink: &mut Sink<'_>) -> Result<(), Error> {
        let Some(poses) = &self.poses else { return Ok(()) };
        for warning in poses.warnings() {
            sink(MapEvent::Warning(warning))?;
        }
        if let Some(quality) = poses.quality() {
            sink(MapEvent::Tracked(Box::new(quality.clone())))?;
        }
        if self.track.longest().is_some() || (self.cancelled)() {
            return Ok(());
        }
        let reason = poses.why_no_pose();
        let is_needed = self.config.coupling.mode.uses_pose_priors();
        match self.fallback.take() {
            Some(mut fallback) => {
                let message =
                    format!("the odometry gave no metric pose ({reason}): {} is used", fallback.source());
                let hint = "scores are an upper bound; --set input.poses=odometry fails instead";
                sink(MapEvent::Warning(Warning::degraded("odometry-not-used", message).hint(hint)))?;
                self.track = Track::new(Duration::from_secs_f64(self.config.input.max_pose_gap_secs));
                let candidates = self.candidates.clone();
                for stamp in &candidates {
                    self.track.add_candidate(*stamp);
                    let reports = fallback.push_stamp(stamp);
                    self.add_reports(reports, sink)?;
                }
                self.track.finish();
                self.poses = Some(fallback);
                Ok(())
            }
            None if is_needed => Err(Error::NoOdometry { name: self.name.clone(), reason }),
            None => {
                let message =
                    format!("the odometry gave no metric pose ({reason}): keyframes are selected by time");
                sink(MapEvent::Warning(Warning::degraded("odometry-not-used", message)))?;
                self.poses = None;
                Ok(())
            }
        }
    }

    /// Select keyframes: those of the longest segment that moved far enough. Whether there are new ones.
    fn select_keyframes(&mut self, is_complete: bool, sink: &mut Sink<'_>) -> Result<bool, Error> {
        let segment = match &self.poses {
            Some(_) => match self.track.longest() {
                Some(longest) => Some(longest.id),
                None => return Ok(false),
            },
            None => None,
        };
        if self.world.as_ref().is_none_or(|w| w.segment != segment) {
            self.begin_world(segment, sink)?;
        }
        let Some(world) = &mut self.world else { return Ok(false) };
        let selected = match self.track.longest().filter(|_| segment.is_some()) {
            Some(track) => {
                for keyframe in &track.odometry[world.odometry_taken..] {
                    self.observer.add(keyframe);
                }
                world.odometry_taken = track.odometry.len();
                world.selection.among_posed(&track.frames, &self.rule, is_complete)
            }
            None => world.selection.among_unposed(&self.candidates, &self.rule, is_complete),
        };
        let is_any = !selected.is_empty();
        for keyframe in selected {
            world.frames.push(keyframe.stamp.frame_id);
            world.keyframes.push(keyframe.clone());
            sink(MapEvent::Keyframe(keyframe))?;
        }
        Ok(is_any)
    }

    /// A map without keyframes of this segment.
    fn begin_world(&mut self, segment: Option<u32>, sink: &mut Sink<'_>) -> Result<(), Error> {
        let mode = self.config.coupling.mode;
        let mut aligner = Aligner::new(mode, &self.config.align)?;
        if self.predictor.places.is_whitened() {
            aligner = aligner.with_whitened_descriptors();
        }
        // Landmarks matter where chunks have a scale of their own. All couplings get the same keyframes, used or not.
        let prefers_odometry = self.predictor.geometry.overlaps();
        self.world = Some(World {
            segment,
            odometry_taken: 0,
            selection: Selection::new(&self.config.keyframes, prefers_odometry),
            keyframes: Vec::new(),
            frames: Vec::new(),
            chunks: 0,
            aligner,
            is_resettled: false,
            failures: Vec::new(),
        });
        if let Some(preview) = &mut self.preview {
            preview.reset();
        }
        self.observer.reset();
        self.predictor.reset();
        if let Some(growing) = &mut self.growing {
            growing.reset()?;
        }
        let source: Option<TrajectorySource> = self.poses.as_ref().map(|p| p.source());
        sink(MapEvent::World { source, segment: segment.unwrap_or(0) })
    }

    fn enter(&mut self, step: Step, sink: &mut Sink<'_>) -> Result<(), Error> {
        match self.step.replace(step) == Some(step) {
            true => Ok(()),
            false => sink(MapEvent::Step(step)),
        }
    }
}

/// How keyframes are cut into chunks: as a recording prescribes, overlapping for models that find poses, with context for
/// stereo.
pub fn chunk_rule(config: &Config, overlaps: bool, prescribed: Option<Vec<Vec<FrameId>>>) -> ChunkRule {
    let geometry = &config.geometry;
    let size = geometry.chunk_keyframes;
    match (prescribed, overlaps) {
        (Some(chunks), _) => ChunkRule::Prescribed(chunks),
        (None, true) => ChunkRule::Overlapping { size, overlap: geometry.overlap_keyframes },
        (None, false) => ChunkRule::WithContext { size, context: geometry.context_keyframes },
    }
}

#[cfg(test)]
mod tests;
