//! The run as robotics viewers show it: events become messages of an MCAP file (`--mcap`).

use crate::engine::MapEvent;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::odometry::TrackedFrame;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use vidar_core::{Health, LieGroup, OdometryKeyframe, Pinhole, Severity, Timestamp, Warning};
use vidar_dataset::{Location, Recording};
use vidar_export::scene::{LogLevel, Scene, SceneImage, SceneStatus};
use vidar_export::{ExportError, thinned_vertices};

/// The most points of a cloud of a surface that grows, 3 MB; the final one has all.
const MOST_POINTS: usize = 200_000;
/// An image file's bytes are taken over as they are up to this size; larger ones are compressed anew.
const MAX_IMAGE_BYTES: u64 = 32 << 20;

/// The file that is written; none once it failed. Clones share it.
#[derive(Clone)]
pub(super) struct SceneWriter(Arc<Mutex<Option<Scene>>>);

impl SceneWriter {
    /// Begins the file of this recording.
    ///
    /// # Errors
    /// It exists, or cannot be made.
    pub fn create(path: &Path, recording: &Recording) -> Result<Self, Error> {
        if path.exists() {
            return Err(Error::OutputExists { path: path.to_owned() });
        }
        let begin = recording.images.first().map_or(Timestamp::from_nanos(0), |image| image.time);
        Ok(Self(Arc::new(Mutex::new(Some(Scene::create(path, begin)?)))))
    }

    /// Writes something, unless writing has failed before. The first failure is told, and the run goes on.
    fn write(&self, events: &Events, write: impl FnOnce(&mut Scene) -> Result<(), ExportError>) {
        let failure = {
            let mut guard = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let failure = guard.as_mut().and_then(|scene| write(scene).err());
            if failure.is_some() {
                *guard = None;
            }
            failure
        };
        if let Some(error) = failure {
            events.warn(&not_written(&error));
        }
    }

    /// The events, with warnings and times of stages written, too.
    pub fn listen(&self, events: Events) -> Events {
        let shared = self.0.clone();
        events.with(move |event| {
            let mut guard = shared.lock().unwrap_or_else(PoisonError::into_inner);
            let Some(scene) = guard.as_mut() else { return };
            match event {
                Event::Warning { warning } => {
                    let level = if warning.severity == Severity::Degraded {
                        LogLevel::Warning
                    } else {
                        LogLevel::Info
                    };
                    scene.log(level, &warning.kind, &warning.message);
                }
                Event::StageFinished { stage, seconds } | Event::StepFinished { step: stage, seconds } => {
                    scene.stage(stage, *seconds);
                }
                _ => {}
            }
        })
    }

    /// What the odometry said of each image when it came.
    pub fn tracked(&self, frames: &[TrackedFrame], events: &Events) {
        self.write(events, |scene| {
            for frame in frames {
                let (output, health) = (&frame.output, frame.output.health());
                let Some(tracking) = output.tracking() else { continue };
                let status = status(output.time, tracking.segment, health, tracking.scale_std);
                scene.live(output.time, &tracking.state.world_from_body, &status);
            }
            Ok(())
        });
    }

    /// Takes an event of the engine. `view` is the camera of undistorted views.
    pub fn read(&self, event: &MapEvent, dataset: &Recording, view: &Pinhole, events: &Events) {
        self.write(events, |scene| match event {
            MapEvent::State(state) => {
                scene.camera_pose(state.time, &state.world_from_camera);
                Ok(())
            }
            MapEvent::Keyframe(keyframe) => {
                let time = keyframe.stamp.time;
                if let Some(odometry) = &keyframe.odometry {
                    landmarks(scene, time, odometry, dataset);
                }
                image(scene, keyframe.stamp.frame_id, dataset)
            }
            MapEvent::PlacementsRevised { placement, .. } => {
                let placed = || placement.keyframes.iter();
                scene.keyframes(view, placed().map(|k| (k.frame_id.0, &k.world_from_camera)));
                scene.trajectory(placed().map(|k| &k.world_from_camera));
                Ok(())
            }
            MapEvent::ViewsFused(views) => views.iter().try_for_each(|view| scene.view(view)),
            MapEvent::SurfaceChanged { surface, is_final, .. } => {
                match is_final {
                    true => scene.points(&surface.cloud),
                    false => scene.points(&thinned_vertices(&surface.mesh, MOST_POINTS)),
                }
                scene.mesh(&surface.mesh, *is_final);
                Ok(())
            }
            _ => Ok(()),
        });
    }

    /// Ends the file.
    pub fn finish(&self, events: &Events) {
        let scene = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(Err(error)) = scene.map(Scene::finish) {
            events.warn(&not_written(&error));
        }
    }
}

fn not_written(error: &ExportError) -> Warning {
    Warning::degraded("mcap-not-written", error.to_string())
        .hint("the run folder is not concerned; run again with another --mcap")
}

fn status(time: Timestamp, segment: u32, health: Health, scale_std: f64) -> SceneStatus<'static> {
    let scale_std = Some(scale_std).filter(|s| s.is_finite());
    SceneStatus { time_ns: time.nanos(), segment, health: health.as_str(), scale_std }
}

/// The landmarks that a keyframe sees, in the world, as the odometry had them then.
fn landmarks(scene: &mut Scene, time: Timestamp, keyframe: &OdometryKeyframe, dataset: &Recording) {
    let Some(camera) = dataset.rig.camera(dataset.camera) else { return };
    let place = |l: &vidar_core::SparseLandmark| {
        let ray = camera.model.unproject(&l.pixel)?;
        let in_camera = ray * (1.0 / (ray.z * l.inverse_depth));
        let in_world = keyframe.world_from_camera.act(&in_camera);
        Some((in_world.cast::<f32>().into(), (l.inverse_depth_std / l.inverse_depth) as f32))
    };
    scene.landmarks(time, keyframe.landmarks.iter().filter_map(place));
}

/// A keyframe's image as it was taken. One that cannot be read is reported by the stage that needs it.
fn image(scene: &mut Scene, frame: vidar_core::FrameId, dataset: &Recording) -> Result<(), ExportError> {
    let Some(entry) = dataset.images.iter().find(|i| i.frame_id == frame) else { return Ok(()) };
    let Some(camera) = dataset.rig.camera(entry.camera).map(|c| c.model.clone()) else { return Ok(()) };
    if let Location::File(path) = &entry.location
        && let Some((bytes, format)) = encoded_image(path)
    {
        return scene.image(entry.time, &camera, &SceneImage::Encoded(&bytes, format));
    }
    match dataset.load_image(entry) {
        Ok(pixels) => scene.image(entry.time, &camera, &SceneImage::Pixels(&pixels.to_rgb8())),
        Err(_) => Ok(()),
    }
}

/// The bytes of a file that viewers decode themselves, and its format.
pub(crate) fn encoded_image(path: &Path) -> Option<(Vec<u8>, &'static str)> {
    let format = match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
        "jpg" | "jpeg" => "jpeg",
        "png" => "png",
        _ => return None,
    };
    Some((crate::system::read_up_to(path, MAX_IMAGE_BYTES).ok()?, format))
}
