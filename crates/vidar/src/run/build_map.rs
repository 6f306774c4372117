//! The recording through the engine, and what the engine finds into the map.

use super::ahead::Ahead;
use super::live::{self, EndingCell, LivePublisher, LiveReport, SurfaceLatency, TrackedElsewhere};
use super::map::MetricMap;
use super::place_recognition::PlaceRecognition;
use super::plan::Plan;
use super::readers::{self, FINISH, MAP, Readers};
use super::source::Source;
use super::store::RunStore;
use super::{Context, camera_on_rig, readout, tracking};
use crate::engine::{Engine, EngineSetup, FrameStamp, ImageSource, MapEvent, PoseSource, PredictionStore};
use crate::error::Error;
use crate::events::Event;
use crate::input::{self, ImageFiles, Measurement};
use crate::odometry::TrackedPoses;
use vidar_core::{ChunkId, Warning};
use vidar_dataset::{DatasetError, Recording};

/// What the engine of a run is given besides configuration and poses.
pub(super) struct EngineParts<'e> {
    pub(super) geometry: &'e mut Source,
    pub(super) places: &'e PlaceRecognition,
    pub(super) images: &'e dyn ImageSource,
    pub(super) store: &'e dyn PredictionStore,
}

impl Context<'_> {
    /// The recording through the engine; its events become log, progress, files and map.
    pub(super) fn build_map(
        &self,
        plan: &Plan,
        source: &mut Source,
        tracked: Option<TrackedPoses>,
        places: &PlaceRecognition,
        ahead: Option<&Ahead>,
    ) -> Result<(MetricMap, Option<LiveReport>), Error> {
        let Self { config, dataset, folder, scene, events, cancel, .. } = *self;
        let images = ImageFiles(dataset, plan.masks.as_deref());
        let cancelled = || cancel.is_cancelled();
        let waiting = ahead.map(|ahead| |chunk| ahead.wait_for(chunk, &cancelled));
        let wait_for = waiting.as_ref().map(|wait| wait as &dyn Fn(ChunkId));
        let store = RunStore::new(folder.path(), self.fingerprint, plan, config).waiting(wait_for);
        let predicting = readers::chunk_progress(events);
        let images: &dyn ImageSource = self.stream.map_or(&images, |stream| stream);
        let parts = EngineParts { geometry: source, places, images, store: &store };
        let ending = EndingCell::default();
        let elsewhere = plan.poses.source().filter(|_| self.live.is_some());
        let elsewhere = elsewhere.map(|s| Box::new(TrackedElsewhere::new(s, ending.clone())) as _);
        let poses = tracked.map(|p| Box::new(p) as Box<dyn PoseSource>).or(elsewhere);
        let mut engine = self.engine(plan, poses, parts, &cancelled, &predicting)?;
        let publisher = match self.live {
            Some(_) => LivePublisher::open(config, &camera_on_rig(dataset, plan))?,
            None => None,
        };
        let mut readers = Readers::new(dataset, plan, config, folder, scene, events);
        readers.publisher = publisher.as_ref();
        readers.surfaces = self.live.map(|_| SurfaceLatency::default());
        let pushed = events.stage(MAP, dataset.images.len(), || match self.live {
            Some(options) => live::push(self, (plan, options), &ending, &mut engine, &mut readers).map(Some),
            None => self.push_recording(&mut engine, &mut |event| readers.read(event)).map(|()| None),
        })?;
        if let Some(stream) = self.stream {
            stream.tell(events);
        }
        readers.finishing();
        events
            .stage(FINISH, 0, || engine.finish(&mut |event| readers.read(event)))
            .map_err(|error| of_synthetic_weights(error, plan))?;
        let report = pushed.zip(readers.surfaces.take()).map(|(pushed, surfaces)| pushed.report(surfaces));
        let map = readers.finish(plan);
        if !cancel.is_cancelled() {
            tracking::forget(folder);
        }
        store.clean(config.output.keep_chunks || cancel.is_cancelled());
        Ok((map, report))
    }

    /// An engine that has seen nothing of the recording.
    pub(super) fn engine<'e>(
        &'e self,
        plan: &Plan,
        poses: Option<Box<dyn PoseSource + 'e>>,
        parts: EngineParts<'e>,
        cancelled: &'e (dyn Fn() -> bool + Sync),
        predicting: &'e (dyn Fn(f64) + Sync),
    ) -> Result<Engine<'e>, Error> {
        let Self { config, dataset, .. } = *self;
        let (live, fallback) = plan.poses.open(dataset, config)?;
        let poses = poses.or(live.map(|p| p as _));
        Engine::new(EngineSetup {
            name: dataset.name.clone(),
            config,
            camera_id: plan.camera_id,
            camera: camera_on_rig(dataset, plan),
            readout: readout(dataset, config),
            view: plan.view,
            poses,
            fallback,
            prescribed: plan.prescribed.clone(),
            geometry: parts.geometry,
            places: parts.places,
            images: parts.images,
            store: parts.store,
            volume_budget_bytes: plan.volume_budget_bytes,
            cancelled,
            predicting,
        })
    }

    /// Every measurement of the recording, until Ctrl-C.
    pub(super) fn push_recording(
        &self,
        engine: &mut Engine<'_>,
        sink: &mut dyn FnMut(MapEvent) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let (total, mut done) = (self.dataset.images.len(), 0);
        for measurement in input::measurements(self.dataset, engine.needs_sensors()) {
            if self.cancel.is_cancelled() {
                break;
            }
            let is_image = !matches!(&measurement, Measurement::Event(vidar_core::SensorEvent::Imu(_)));
            match measurement {
                Measurement::Event(event) => engine.push(event, sink)?,
                Measurement::Stamp(stamp) => engine.push_stamp(stamp, sink)?,
                Measurement::Unreadable(stamp, error) => {
                    sink(MapEvent::Warning(unreadable(self.dataset, stamp, &error)))?;
                    engine.push_stamp(stamp, sink)?;
                }
            }
            if is_image {
                done += 1;
                self.events.emit(&Event::Progress { stage: MAP, done, total });
            }
        }
        Ok(())
    }
}

/// An image that the odometry has to do without. It is tracked across; if it becomes a keyframe, that is a degradation.
pub(super) fn unreadable(dataset: &Recording, stamp: FrameStamp, error: &DatasetError) -> Warning {
    let entry = dataset.images.iter().find(|i| i.frame_id == stamp.frame_id);
    let warning = Warning::new("odometry-image-unreadable", error.to_string());
    entry.map_or(warning.clone(), |entry| warning.at(&entry.location))
}

/// Nothing was placed because the network's weights are synthetic: the error names them.
fn of_synthetic_weights(error: Error, plan: &Plan) -> Error {
    let identity = plan.network.as_ref().map(|n| &n.identity).filter(|i| !i.is_trained);
    match (error, identity) {
        (Error::Empty { keyframes, .. }, Some(i)) => Error::Untrained { keyframes, model: i.name.clone() },
        (error, _) => error,
    }
}
