use super::*;
use proptest::prelude::*;
use vidar_core::{Confidence, FrameImage, Image, Pinhole, RelativeDepth, So3, Timestamp, ViewGeometry};

fn intrinsics() -> Pinhole {
    Pinhole::new(4.0, 4.0, 1.5, 1.0, 4, 3).unwrap()
}

fn prediction(frame: ChunkFrame, poses: &[Se3]) -> GeometryPrediction {
    let views = poses
        .iter()
        .enumerate()
        .map(|(i, &chunk_from_camera)| ViewGeometry {
            frame_id: FrameId(i as u32),
            chunk_from_camera,
            intrinsics: intrinsics(),
            depth: RelativeDepth::new(Image::filled(4, 3, 2.0)),
            confidence: Confidence::full(4, 3),
        })
        .collect();
    GeometryPrediction { chunk_id: ChunkId(7), frame, views }
}

fn camera_path() -> Vec<Se3> {
    (0..6)
        .map(|i| {
            let t = f64::from(i);
            Se3::new(
                So3::exp(&Vector3::new(0.1 * t, 0.2, -0.05 * t)),
                Vector3::new(t, (t * 0.7).sin(), 0.3 * t * t),
            )
        })
        .collect()
}

fn anchors(world_from_chunk: &Sim3, poses: &[Se3]) -> Vec<Anchor> {
    poses
        .iter()
        .enumerate()
        .map(|(i, p)| Anchor {
            frame_id: FrameId(i as u32),
            world_from_camera: world_from_chunk.transform_pose(p),
        })
        .collect()
}

proptest! {
    #[test]
    fn a_native_chunk_is_carried_onto_its_anchors(
        w in prop::array::uniform3(-3.0..3.0f64), t in prop::array::uniform3(-50.0..50.0f64), scale in 0.01..100.0f64,
    ) {
        let truth = Sim3::new(So3::exp(&Vector3::from(w)), Vector3::from(t), scale).unwrap();
        let poses = camera_path();
        let alignment = place_chunk(
            &prediction(ChunkFrame::ModelNative, &poses), &anchors(&truth, &poses), &AlignConfig::default(),
        ).unwrap();
        prop_assert_eq!(alignment.verdict, Verdict::Fitted);
        prop_assert!((alignment.world_from_chunk.scale / scale - 1.0).abs() < 1e-9);
        prop_assert!(alignment.center_rms_m < 1e-9 * scale.max(1.0));
    }
}

#[test]
fn depth_becomes_metric_with_the_scale_and_keeps_its_colour() {
    let truth = Sim3::new(So3::IDENTITY, Vector3::new(1.0, 2.0, 3.0), 2.5).unwrap();
    let poses = camera_path();
    let chunk = prediction(ChunkFrame::ModelNative, &poses);
    let alignment = place_chunk(&chunk, &anchors(&truth, &poses), &AlignConfig::default()).unwrap();
    let views: Vec<ChunkView> = (0..6)
        .map(|i| ChunkView {
            frame_id: FrameId(i),
            time: Timestamp::from_nanos(i64::from(i)),
            image: FrameImage::Gray8(Image::filled(4, 3, 9)),
            intrinsics: intrinsics(),
            world_from_camera: None,
        })
        .collect();
    let aligned = aligned_views(chunk, &alignment, &views).unwrap();
    assert_eq!(aligned.len(), 6);
    assert!((aligned[5].depth().image()[(0, 0)] - 5.0).abs() < 1e-5);
    assert_eq!(aligned[5].color().unwrap()[(1, 1)], [9, 9, 9]);
    assert_eq!(aligned[5].time(), Timestamp::from_nanos(5));
    let expected = truth.act(&poses[5].translation);
    assert!((aligned[5].world_from_camera().translation - expected).norm() < 1e-9);
}

#[test]
fn cameras_on_a_line_leave_the_chunk_where_it_is_and_say_so() {
    let poses: Vec<Se3> = (0..5).map(|i| Se3::from_translation(Vector3::x() * f64::from(i))).collect();
    let truth = Sim3::new(So3::IDENTITY, Vector3::zeros(), 3.0).unwrap();
    let alignment = place_chunk(
        &prediction(ChunkFrame::ModelNative, &poses),
        &anchors(&truth, &poses),
        &AlignConfig::default(),
    )
    .unwrap();
    assert_eq!(alignment.verdict, Verdict::RankDeficient);
    assert_eq!(alignment.world_from_chunk, Sim3::IDENTITY);
    assert!(!alignment.verdict.is_usable());
}

#[test]
fn a_prior_world_chunk_is_checked_but_not_moved() {
    let poses = camera_path();
    let exact = anchors(&Sim3::IDENTITY, &poses);
    let chunk = prediction(ChunkFrame::PriorWorld, &poses);
    assert_eq!(place_chunk(&chunk, &exact, &AlignConfig::default()).unwrap().verdict, Verdict::PriorWorld);
    let off = Sim3::new(So3::IDENTITY, Vector3::new(2.0, 0.0, 0.0), 1.0).unwrap();
    let alignment = place_chunk(&chunk, &anchors(&off, &poses), &AlignConfig::default()).unwrap();
    assert_eq!(alignment.verdict, Verdict::Inconsistent);
    assert!((alignment.center_rms_m - 2.0).abs() < 1e-9);
}

#[test]
fn missing_anchors_and_bad_configuration_are_error_values() {
    let chunk = prediction(ChunkFrame::PriorWorld, &camera_path());
    assert!(matches!(place_chunk(&chunk, &[], &AlignConfig::default()), Err(AlignError::NoAnchor { .. })));
    let config = AlignConfig { max_center_rms_m: f64::NAN };
    assert!(matches!(place_chunk(&chunk, &[], &config), Err(AlignError::BadConfig { .. })));
}

#[test]
fn colours_follow_the_depth_to_another_size() {
    let ramp = Image::from_fn(8, 6, |x, _| (x * 20) as u8);
    let small = color_at_size(&FrameImage::Gray8(ramp), 4, 3);
    // Pixel 1 of 4 has its centre at (1.5 · 2) − 0.5 = 2.5 of 8.
    assert_eq!(small[(1, 1)], [50, 50, 50]);
    assert_eq!((small.width(), small.height()), (4, 3));
}
