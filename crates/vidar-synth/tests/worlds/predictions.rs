//! A written sequence is simulated again, and a network that sees it stands behind the trait of all models.

use nalgebra::Vector3;
use std::sync::Arc;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    BodyFrame, ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, GeometryModel, Image, LieGroup,
    ModelError, Pinhole, Se3, StampedPose, Timestamp, Trajectory,
};
use vidar_synth::predict::{Conditioning, PredictionErrors, SyntheticModel};
use vidar_synth::{Simulation, SynthConfig, SynthError, write_sequence};

fn tiny() -> SynthConfig {
    SynthConfig {
        width: 64,
        height: 40,
        duration_secs: 4.0,
        camera_rate_hz: 5.0,
        imu_rate_hz: 50.0,
        blur_samples: 1,
        clutter: 6,
        scan_spacing_m: 0.2,
        ..SynthConfig::default()
    }
}

fn given_flight() -> Trajectory {
    let pose = |k: i64| {
        let t = 0.05 * k as f64;
        let rotation = vidar_core::So3::from_axis_angle(&Vector3::new(0.1, 0.2, 1.0), 0.1 * t);
        let position = Vector3::new(0.5 * t + 0.123_456_789_012_345, t.sin(), 1.5);
        StampedPose {
            time: Timestamp::from_nanos(k * 50_000_000),
            world_from_body: Se3::new(rotation, position),
        }
    };
    Trajectory::new(BodyFrame::Imu, (0..100).map(pose).collect()).unwrap()
}

#[test]
fn a_written_sequence_is_simulated_again_exactly() {
    let flown = given_flight();
    for flight in [None, Some(&flown)] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("sequence");
        write_sequence(&out, &tiny(), flight, &|_, _| true).unwrap();
        assert_eq!(out.join("flight.csv").exists(), flight.is_some());
        let again = Simulation::open(&out).unwrap();
        let before = Simulation::new(&tiny(), flight).unwrap();
        for k in 0..15 {
            let time = again.frame_time(k);
            let (a, b) = (again.world_from_camera(time).unwrap(), before.world_from_camera(time).unwrap());
            assert!((a.matrix() - b.matrix()).amax() < 1e-12);
            let ray = |s: &Simulation, p: &Se3| {
                s.world().cast(&p.translation, &p.rotation.act(&Vector3::z())).unwrap().t
            };
            assert!((ray(&again, &a) - ray(&before, &b)).abs() < 1e-9);
        }
        assert!(again.world_from_camera(Timestamp::from_nanos(0)).is_none());
        assert!(again.world_from_camera(again.frame_time(1000)).is_none());
    }
}

#[test]
fn what_is_no_sequence_is_refused_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    assert!(matches!(Simulation::open(folder.path()), Err(SynthError::Read { .. })));
    std::fs::write(path("synth.toml"), "seed = \"one\"").unwrap();
    assert!(matches!(Simulation::open(folder.path()), Err(SynthError::BadSequence { .. })));
    std::fs::write(path("synth.toml"), "seed = 1").unwrap();
    for bad in [
        "1,2,3",
        "1,0,0,0,0,0,0,0",
        "x,0,0,0,0,0,0,1",
        "1,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1",
        "1,0,0,nan,0,0,0,1",
    ] {
        std::fs::write(path("flight.csv"), bad).unwrap();
        match Simulation::open(folder.path()).err() {
            Some(SynthError::BadSequence { .. } | SynthError::BadTrajectory { .. }) => {}
            other => panic!("{bad:?}: {other:?}"),
        }
    }
}

fn chunk(simulation: &Simulation, posed: bool) -> ChunkViews {
    let intrinsics = Pinhole::new(300.0, 300.0, 375.5, 239.5, 752, 480).unwrap();
    let view = |k: usize| {
        let time = simulation.frame_time(k);
        ChunkView {
            frame_id: FrameId(k as u32),
            time,
            image: FrameImage::Gray8(Image::filled(752, 480, 0)),
            intrinsics,
            world_from_camera: posed.then(|| simulation.world_from_camera(time).unwrap()),
        }
    };
    ChunkViews { id: ChunkId(2), views: (0..12).map(view).collect() }
}

#[test]
fn a_simulated_network_predicts_what_it_is_shown() {
    let simulation = Arc::new(Simulation::new(&tiny(), None).unwrap());
    let model = |errors: &PredictionErrors, conditioning| {
        SyntheticModel::new(Arc::clone(&simulation), errors.clone(), conditioning, 84, 3).unwrap()
    };
    let exact =
        model(&PredictionErrors::NONE, Conditioning::PoseFree).predict(&chunk(&simulation, false)).unwrap();
    assert_eq!((exact.frame, exact.views.len()), (ChunkFrame::ModelNative, 12));
    // 480 · 84/752 = 53.6: four patches of 14.
    assert_eq!((exact.views[0].intrinsics.width, exact.views[0].intrinsics.height), (84, 56));
    for (k, view) in exact.views.iter().enumerate() {
        let truth = simulation.world_from_camera(simulation.frame_time(k)).unwrap();
        assert!((view.chunk_from_camera.matrix() - truth.matrix()).amax() < 1e-12);
        let direction = truth.rotation.act(&view.intrinsics.ray(40.0, 30.0));
        let hit = simulation.world().cast(&truth.translation, &direction).unwrap();
        assert_eq!(view.depth.image()[(40, 30)], hit.t as f32);
    }
    let mut posed = model(&PredictionErrors::default(), Conditioning::PosesInjected);
    assert!(posed.info().needs_poses);
    assert_eq!(posed.predict(&chunk(&simulation, true)).unwrap().frame, ChunkFrame::PriorWorld);
    let lost = posed.predict(&chunk(&simulation, false)).unwrap_err();
    assert!(matches!(lost, ModelError::MissingPose { frame: FrameId(0) }), "{lost}");
    let wanted = posed.predict_views(&chunk(&simulation, true), 3..5, &|_| false).unwrap();
    assert_eq!(wanted.views.iter().map(|v| v.frame_id.0).collect::<Vec<_>>(), [3, 4]);
    let mut late = chunk(&simulation, true);
    late.views[4].time = simulation.frame_time(10_000);
    assert!(matches!(posed.predict(&late).unwrap_err(), ModelError::BadView { frame: FrameId(4), .. }));
    let none = posed.predict(&ChunkViews { id: ChunkId(0), views: Vec::new() }).unwrap_err();
    assert!(matches!(none, ModelError::TooFewViews { .. }));
}
