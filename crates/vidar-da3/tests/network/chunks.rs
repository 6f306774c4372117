//! The network as a `GeometryModel`.

use crate::common::{tiny, tiny_json};
use nalgebra::Vector3;
use std::sync::Arc;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, GeometryModel, ModelError, Pinhole, Se3, Timestamp,
};
use vidar_da3::config::json;
use vidar_da3::preprocess::PreprocessConfig;
use vidar_da3::weights::synthetic::image_u8;
use vidar_da3::{Da3, Da3Model, Da3ModelConfig, Da3Options, PoseMode};

fn chunk(n: u32, has_poses: bool) -> ChunkViews {
    let view = |i: u32| {
        let t = f64::from(i);
        let place = Se3::from_translation(Vector3::new(0.4 * t, 0.1 * t * t, 5.0));
        ChunkView {
            frame_id: FrameId(100 + i),
            time: Timestamp::from_nanos(i64::from(i)),
            image: FrameImage::Rgb8(image_u8(u64::from(i) + 1, 112, 84)),
            intrinsics: Pinhole::new(100.0, 100.0, 55.5, 41.5, 112, 84).unwrap(),
            world_from_camera: has_poses.then_some(place),
        }
    };
    ChunkViews { id: ChunkId(7), views: (0..n).map(view).collect() }
}

fn model(mode: PoseMode) -> Da3Model {
    let preprocess = PreprocessConfig { process_size_px: 56, ..PreprocessConfig::default() };
    Da3Model::new(Arc::new(tiny()), Da3ModelConfig { mode, preprocess, ..Da3ModelConfig::default() }, None)
        .unwrap()
}

#[test]
fn pictures_alone_give_geometry_in_the_models_own_frame() {
    let mut model = model(PoseMode::Free);
    assert!(!model.info().needs_poses);
    let found = model.predict(&chunk(3, false)).unwrap();
    assert_eq!((found.chunk_id, found.frame, found.views.len()), (ChunkId(7), ChunkFrame::ModelNative, 3));
    for view in &found.views {
        let k = &view.intrinsics;
        assert_eq!((k.width, k.height, view.depth.image().width()), (56, 42, 56));
        // The decoder's principal point is the middle of the image: in VIDAR's convention half a pixel less.
        assert_eq!((k.cx, k.cy), (27.5, 20.5));
        assert!(view.confidence.image().data().iter().all(|c| (0.0..1.0).contains(c)));
        assert!(view.depth.image().data().iter().all(|d| *d > 0.0));
    }
}

#[test]
fn prior_poses_come_back_with_depth_in_their_unit() {
    let mut model = model(PoseMode::Conditioned);
    let chunk = chunk(4, true);
    let found = model.predict(&chunk).unwrap();
    assert_eq!(found.frame, ChunkFrame::PriorWorld);
    for (view, given) in found.views.iter().zip(&chunk.views) {
        assert_eq!(view.frame_id, given.frame_id);
        let (a, b) = (view.chunk_from_camera, given.world_from_camera.unwrap());
        assert!((a.translation - b.translation).norm() < 1e-9);
        let expected = given.intrinsics.resized(56, 42).unwrap();
        assert!(
            (view.intrinsics.cx - expected.cx).abs() < 1e-9
                && (view.intrinsics.fx - expected.fx).abs() < 1e-9
        );
    }
    // Twice the distances between cameras: twice the depth, but for what the network makes of it; poses twice as far.
    let lost = model.predict(&self::chunk(2, false)).unwrap_err();
    assert_eq!(lost.to_string(), "frame 100 has no prior pose, and this model needs one");
}

#[test]
fn one_prior_pose_shows_no_scale_and_the_answer_says_so() {
    let found = model(PoseMode::Conditioned).predict(&chunk(1, true)).unwrap();
    assert_eq!((found.frame, found.views.len()), (ChunkFrame::ModelNative, 1));
}

#[test]
fn wanted_views_are_those_of_the_whole_and_a_run_can_be_stopped() {
    let mut model = model(PoseMode::Conditioned);
    let chunk = chunk(4, true);
    let whole = model.predict(&chunk).unwrap();
    let part = model.predict_views(&chunk, 1..3, &|_| false).unwrap();
    assert_eq!(part.views.iter().map(|v| v.frame_id.0).collect::<Vec<_>>(), [101, 102]);
    assert_eq!(part.views[0].depth, whole.views[1].depth);
    assert!(matches!(model.predict_views(&chunk, 0..4, &|_| true), Err(ModelError::Cancelled)));
    assert!(model.predict_views(&chunk, 4..4, &|_| false).unwrap().views.is_empty());
    let none = ChunkViews { id: ChunkId(1), views: Vec::new() };
    assert!(matches!(model.predict(&none), Err(ModelError::TooFewViews { .. })));
}

#[test]
fn poses_from_rays_have_a_principal_point_of_their_own() {
    let config = Da3ModelConfig {
        use_ray_pose: true,
        preprocess: PreprocessConfig { process_size_px: 56, ..PreprocessConfig::default() },
        ..Da3ModelConfig::default()
    };
    let mut model = Da3Model::new(Arc::new(tiny()), config, None).unwrap();
    // Random rays are no pinhole: either a camera comes out or the view is named.
    match model.predict(&chunk(2, false)) {
        Ok(found) => assert_ne!(found.views[0].intrinsics.cx, 27.5),
        Err(error) => {
            assert!(error.to_string().contains("rays") || error.to_string().contains("frame"), "{error}")
        }
    }
}

#[test]
fn a_network_of_single_views_needs_to_be_metric_and_posed() {
    let config = json::parse(&tiny_json("tiny_metric_v2.safetensors"), "tiny").unwrap();
    let network = Arc::new(Da3::synthetic_of(config, &Da3Options::default()).unwrap());
    for mode in [PoseMode::Free, PoseMode::Conditioned] {
        let refused =
            Da3Model::new(Arc::clone(&network), Da3ModelConfig { mode, ..Da3ModelConfig::default() }, None);
        assert!(refused.is_err(), "a custom single-view network is not known to be metric");
    }
}
