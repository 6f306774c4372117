//! The engine on a wall: a geometry model that is right, and sources that fail.

pub(in crate::engine) mod settled;
mod wall;

use super::*;
use crate::chunks::{MemoryStore, StoredChunk};
use crate::input::MetricTrajectory;
use nalgebra::Vector3;
use std::sync::atomic::{AtomicBool, Ordering};
use vidar_core::{
    BodyFrame, CameraModel, FrameImage, Image, Pinhole, RigCamera, Se3, Severity, StampedPose, Timestamp,
    Trajectory,
};
use wall::Wall;

const FRAMES: u32 = 40;

/// From image to image, m.
const STEP_M: f64 = 0.06;

fn pinhole() -> Pinhole {
    Pinhole::new(40.0, 40.0, 31.5, 23.5, 64, 48).unwrap()
}

fn stamp(i: u32) -> FrameStamp {
    let time = Timestamp::from_nanos(i64::from(i) * 100_000_000);
    FrameStamp { frame_id: FrameId(i), time, camera: CameraId(0) }
}

fn pose(i: u32) -> Se3 {
    Se3::from_translation(Vector3::new(f64::from(i) * STEP_M, 0.0, 0.0))
}

struct NoPlaces;

impl PlaceDescriber for NoPlaces {
    fn is_whitened(&self) -> bool {
        false
    }

    fn describe(&self, _: &mut StoredChunk, _: &[Vec<f32>]) -> Result<(), Error> {
        Ok(())
    }

    fn descriptors(&self, _: &StoredChunk) -> Vec<Vec<f32>> {
        Vec::new()
    }
}

struct GrayImages;

impl ImageSource for GrayImages {
    fn image(&self, _: &FrameStamp) -> Result<FrameImage, Warning> {
        Ok(FrameImage::Gray8(Image::filled(64, 48, 128)))
    }
}

/// What an odometry tells of each image.
struct Scripted(fn(&FrameStamp) -> PoseReport);

impl PoseSource for Scripted {
    fn source(&self) -> TrajectorySource {
        TrajectorySource::Odometry
    }

    fn needs_sensors(&self) -> bool {
        false
    }

    fn push(&mut self, _: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        Ok(Vec::new())
    }

    fn push_stamp(&mut self, stamp: &FrameStamp) -> Vec<PoseReport> {
        vec![(self.0)(stamp)]
    }

    fn finish(&mut self) -> Vec<PoseReport> {
        Vec::new()
    }

    fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    fn why_no_pose(&self) -> String {
        "no parallax".into()
    }
}

fn truth() -> GivenPoses {
    let poses = (0..FRAMES).map(|i| StampedPose { time: stamp(i).time, world_from_body: pose(i) }).collect();
    let camera_trajectory = Trajectory::new(BodyFrame::Camera(CameraId(0)), poses).unwrap();
    let trajectory = MetricTrajectory { source: TrajectorySource::GroundTruth, camera_trajectory };
    GivenPoses::new(trajectory, Duration::ZERO, Duration::from_millis(500))
}

fn config() -> Config {
    let mut config = Config::default();
    config.geometry.chunk_keyframes = 6;
    config.geometry.context_keyframes = 2;
    config.fusion.voxel_size_m = 0.1;
    config
}

/// Events of a run, and how many of them came before the recording ended.
fn run(
    poses: Box<dyn PoseSource>,
    fallback: Option<Box<dyn PoseSource>>,
    geometry: &mut Wall,
) -> (Result<(), Error>, Vec<MapEvent>, usize) {
    run_with(&config(), poses, fallback, geometry)
}

fn run_with(
    config: &Config,
    poses: Box<dyn PoseSource>,
    fallback: Option<Box<dyn PoseSource>>,
    geometry: &mut Wall,
) -> (Result<(), Error>, Vec<MapEvent>, usize) {
    run_until(&|_| false, config, (poses, fallback), geometry)
}

/// The same, stopped by the first event that is `last`.
fn run_until(
    last: &dyn Fn(&MapEvent) -> bool,
    config: &Config,
    (poses, fallback): (Box<dyn PoseSource>, Option<Box<dyn PoseSource>>),
    geometry: &mut Wall,
) -> (Result<(), Error>, Vec<MapEvent>, usize) {
    let is_stopped = AtomicBool::new(false);
    let cancelled = || is_stopped.load(Ordering::Relaxed);
    let (store, model) = (MemoryStore::default(), CameraModel::Pinhole(pinhole()));
    let camera =
        RigCamera { model, body_from_camera: Se3::IDENTITY, time_offset: Duration::ZERO, rate_hz: None };
    let mut engine = Engine::new(EngineSetup {
        name: "wall".into(),
        config,
        camera_id: CameraId(0),
        camera,
        readout: Duration::ZERO,
        view: pinhole(),
        poses: Some(poses),
        fallback,
        prescribed: None,
        geometry,
        places: &NoPlaces,
        images: &GrayImages,
        store: &store,
        volume_budget_bytes: 1 << 28,
        cancelled: &cancelled,
        predicting: &|_| {},
    })
    .unwrap();
    engine.preview_when_late(true);
    let mut events = Vec::new();
    for i in 0..FRAMES {
        engine
            .push_stamp(stamp(i), &mut |e| {
                events.push(e);
                Ok(())
            })
            .unwrap();
    }
    let during = events.len();
    let ended = engine.finish(&mut |e| {
        is_stopped.fetch_or(last(&e), Ordering::Relaxed);
        events.push(e);
        Ok(())
    });
    (ended, events, during)
}

fn placed(events: &[MapEvent]) -> Vec<u32> {
    let chunk = |e: &MapEvent| match e {
        MapEvent::ChunkPlaced(report) => Some(report.chunk_id.0),
        _ => None,
    };
    events.iter().filter_map(chunk).collect()
}

fn degradations(events: &[MapEvent]) -> Vec<String> {
    let kind = |e: &MapEvent| match e {
        MapEvent::Warning(w) if w.severity == Severity::Degraded => Some(w.kind.clone()),
        _ => None,
    };
    events.iter().filter_map(kind).collect()
}

fn surface(events: &[MapEvent]) -> &Surface {
    match events.last() {
        Some(MapEvent::SurfaceChanged { surface, is_final: true, .. }) => surface,
        other => panic!("the last event is {other:?}"),
    }
}

#[test]
fn chunks_are_placed_while_the_recording_goes_on_and_the_surface_is_the_wall() {
    let (ended, events, during) = run(Box::new(truth()), None, &mut Wall::new(&[]));
    ended.unwrap();
    assert_eq!(placed(&events), (0..7).collect::<Vec<_>>());
    // The last chunk is short, and the one before it waits for its context.
    assert_eq!(placed(&events[..during]).len(), 6);
    let keyframes = events.iter().filter(|e| matches!(e, MapEvent::Keyframe(_))).count();
    let states = events.iter().filter(|e| matches!(e, MapEvent::State(_))).count();
    assert_eq!((keyframes, states), (FRAMES as usize, FRAMES as usize));
    assert!(degradations(&events).is_empty());
    let surface = surface(&events);
    assert!(surface.mesh.triangles.len() > 500, "{}", surface.mesh.triangles.len());
    assert!(surface.mesh.positions.iter().all(|p| (p[2] - 2.0).abs() < 0.05));
}

/// Each keyframe with how many images had come when the growing surface showed it first.
fn shown(events: &[MapEvent]) -> Vec<(u32, u32)> {
    let mut images = 0;
    let mut shown = Vec::new();
    for event in events {
        match event {
            MapEvent::State(_) => images += 1,
            MapEvent::SurfaceChanged { shown: frames, is_final: false, .. } => {
                shown.extend(frames.iter().map(|f| (f.frame_id.0, images)));
            }
            _ => {}
        }
    }
    shown.sort_unstable();
    shown
}

#[test]
fn a_keyframe_that_waits_for_its_chunk_is_shown_before_and_the_map_is_the_same() {
    let watched = |wait, failing: &[u32]| {
        let mut config = config();
        config.output.live_map = true;
        config.output.live_map_wait_secs = wait;
        let (ended, events, _) = run_with(&config, Box::new(truth()), None, &mut Wall::new(failing));
        ended.unwrap();
        events
    };
    let (patient, soon) = (watched(0.0, &[]), watched(0.25, &[]));
    let frames = |events| shown(events).iter().map(|(f, _)| *f).collect::<Vec<_>>();
    for events in [&patient, &soon] {
        assert_eq!(frames(events), (0..FRAMES).collect::<Vec<_>>(), "each keyframe once");
    }
    let most_wait = |events| shown(events).iter().map(|(f, images)| images - 1 - f).max();
    // Chunks of six and two more after them; 0.25 s and the next image, or the four views that the first preview needs.
    assert_eq!((most_wait(&patient), most_wait(&soon)), (Some(7), Some(3)));
    let surfaces = [surface(&patient), surface(&soon)].map(|s| &s.mesh);
    assert!(surfaces[0] == surfaces[1], "the map does not know of it");

    // What was shown of a chunk that is lost is taken away again.
    let grown = |events: &[MapEvent]| {
        let of = |e: &MapEvent| match e {
            MapEvent::SurfaceChanged { surface, is_final: false, .. } => Some(surface.mesh.triangles.len()),
            _ => None,
        };
        events.iter().filter_map(of).collect::<Vec<_>>()
    };
    let lost = watched(0.25, &[1]);
    let sizes = grown(&lost);
    assert!(sizes.windows(2).any(|pair| pair[1] < pair[0]), "{sizes:?}");
    assert!(grown(&soon).windows(2).all(|pair| pair[1] >= pair[0]));
}

#[test]
fn images_between_keyframes_help_where_those_are_few_and_who_got_no_depth_is_tried_again() {
    // A keyframe every five images, of six centimetres each.
    let watched = |least_span_m| {
        let mut config = config();
        config.keyframes.min_translation_m = 0.29;
        config.output.live_map = true;
        config.output.live_map_wait_secs = 0.25;
        let mut wall = Wall { least_span_m, ..Wall::new(&[]) };
        let (ended, events, _) = run_with(&config, Box::new(truth()), None, &mut wall);
        ended.unwrap();
        events
    };
    let waits = |events| shown(events).iter().map(|(f, images)| images - 1 - f).collect::<Vec<_>>();
    let events = watched(0.0);
    let frames = shown(&events).iter().map(|(f, _)| *f).collect::<Vec<_>>();
    assert_eq!(frames, (0..FRAMES).step_by(5).collect::<Vec<_>>(), "no image that helped is shown");
    assert_eq!(waits(&events), [3; 8], "none waits for a fourth keyframe");
    // Three images are .18 m: the first keyframe is tried after them, and again after two more, with the second one.
    assert_eq!(waits(&watched(0.25))[..2], [5, 0]);
}

#[test]
fn a_later_segment_that_grows_longer_takes_the_map_over() {
    let two = |stamp: &FrameStamp| {
        let i = stamp.frame_id.0;
        let segment = (i != 12).then_some(u32::from(i > 12));
        PoseReport::known(stamp, segment.map(|segment| (segment, pose(i))), None)
    };
    let (ended, events, _) = run(Box::new(Scripted(two)), None, &mut Wall::new(&[]));
    ended.unwrap();
    let worlds: Vec<usize> =
        (0..events.len()).filter(|i| matches!(events[*i], MapEvent::World { .. })).collect();
    assert_eq!(worlds.len(), 2);
    assert!(!placed(&events[..worlds[1]]).is_empty(), "the first segment was mapped as it came");
    let frames = |e: &MapEvent| match e {
        MapEvent::Keyframe(k) => Some(k.stamp.frame_id.0),
        _ => None,
    };
    let last: Vec<u32> = events[worlds[1]..].iter().filter_map(frames).collect();
    assert_eq!(last, (13..FRAMES).collect::<Vec<_>>());
    let fused: Vec<u32> = events
        .iter()
        .flat_map(|e| match e {
            MapEvent::ViewsFused(views) => views.iter().map(|v| v.frame_id().0).collect(),
            _ => Vec::new(),
        })
        .collect();
    assert_eq!(fused, last);
}

#[test]
fn a_chunk_that_could_not_be_predicted_degrades_the_map_and_the_others_are_fused() {
    let (ended, events, _) = run(Box::new(truth()), None, &mut Wall::new(&[1]));
    ended.unwrap();
    assert_eq!(degradations(&events), ["chunk-failed"]);
    assert_eq!(placed(&events), [0, 2, 3, 4, 5, 6]);
    assert!(surface(&events).mesh.triangles.len() > 300);
}

#[test]
fn a_run_that_is_stopped_tells_every_view_that_its_surface_is_made_of() {
    let views = |events: &[MapEvent]| -> usize {
        let count = |e: &MapEvent| if let MapEvent::ViewsFused(views) = e { views.len() } else { 0 };
        events.iter().map(count).sum()
    };
    let stopped_at = |last: &dyn Fn(&MapEvent) -> bool| {
        let mut wall = Wall::new(&[]);
        wall.completes = true;
        let (ended, events, _) = run_until(last, &config(), (Box::new(truth()), None), &mut wall);
        ended.unwrap();
        assert!(!surface(&events).mesh.triangles.is_empty());
        views(&events)
    };
    let all = stopped_at(&|_| false);
    assert_eq!(all, stopped_at(&|e| matches!(e, MapEvent::Step(Step::Complete))));
    assert_eq!(all, stopped_at(&|e| matches!(e, MapEvent::ViewsFused(_))));
    assert!(all > 20, "{all}");
}

#[test]
fn ground_truth_in_place_of_failed_odometry_is_a_degradation_and_without_it_an_error() {
    let nothing = || Box::new(Scripted(|stamp| PoseReport::NotPosed { time: stamp.time }));
    let (ended, events, during) = run(nothing(), Some(Box::new(truth())), &mut Wall::new(&[]));
    ended.unwrap();
    assert_eq!(degradations(&events), ["odometry-not-used"]);
    assert!(placed(&events[..during]).is_empty());
    assert_eq!(placed(&events).len(), 7);
    let source = events.iter().find_map(|e| match e {
        MapEvent::World { source, .. } => source.clone(),
        _ => None,
    });
    assert_eq!(source, Some(TrajectorySource::GroundTruth));
    let (ended, _, _) = run(nothing(), None, &mut Wall::new(&[]));
    let error = ended.unwrap_err().to_string();
    assert!(error.contains("no parallax"), "{error}");
}
