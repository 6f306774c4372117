//! The aligner in every coupling, on a simulated room.

mod prior_world;

use crate::flat::*;
use vidar_align::aligner::RejectionReason;
use vidar_align::streaming::chunk_ranges;
use vidar_align::{Aligner, AlignerConfig, ChunkStatus, CouplingMode, Placement};
use vidar_core::{
    ChunkView, FrameId, FrameImage, GeometryPrediction, Image, LieGroup, RelativeDepth, Se3, Timestamp,
    umeyama_sim3,
};

fn run(mode: CouplingMode, truth: &[Se3], odometry: Option<&[Se3]>, model: Model, seed: u64) -> Placement {
    let mut noise = Noise::new(seed);
    let mut aligner = Aligner::new(mode, &AlignerConfig::default()).unwrap();
    for (k, range) in chunk_ranges(truth.len(), 12, 4).unwrap().into_iter().enumerate() {
        let prediction = predict(truth, range.frames, k as u32, model, &mut noise);
        aligner.push(observe(prediction, odometry, none)).unwrap();
    }
    aligner.finish()
}

#[test]
fn an_exact_model_gives_the_exact_world_in_every_metric_mode() {
    let truth = laps(40, 1.0);
    for mode in [
        CouplingMode::PoseConditioned,
        CouplingMode::GroundTruth,
        CouplingMode::Hybrid,
        CouplingMode::Coupled,
    ] {
        let placement = run(mode, &truth, Some(&truth), EXACT, 1);
        assert!(placement.is_metric && placement.mode == mode);
        assert_eq!(placement.views.len(), truth.len(), "{mode}");
        let error = absolute_error(&placement, &truth);
        assert!(error < 1e-4, "{mode}: {error}");
        assert!(placement.chunks.iter().all(|c| c.status.is_usable()));
        // The last chunk is short: its motion alone does not tell its scale to 3 %.
        let unexpected = placement.rejections.iter().find(|(g, _)| *g != RejectionReason::ScaleUnobservable);
        assert_eq!(unexpected, None, "{mode}");
        // A frame of an overlap belongs to the later chunk.
        let owners: Vec<u32> = placement.views.iter().map(|v| v.owner.0).collect();
        assert!(owners.windows(2).all(|o| o[0] <= o[1]) && owners[8] == 1, "{owners:?}");
    }
}

#[test]
fn without_pose_priors_the_world_is_right_up_to_one_similarity() {
    let truth = laps(40, 1.0);
    for mode in [CouplingMode::Da3Streaming, CouplingMode::PoseFree, CouplingMode::Coupled] {
        let placement = run(mode, &truth, None, EXACT, 2);
        assert!(!placement.is_metric);
        let (placed, exact): (Vec<_>, Vec<_>) = placement
            .views
            .iter()
            .map(|v| (v.world_from_camera.translation, truth[v.frame_id.index()].translation))
            .unzip();
        let onto = umeyama_sim3(&placed, &exact).unwrap();
        let worst = placed.iter().zip(&exact).map(|(p, e)| (onto.act(p) - e).norm()).fold(0.0, f64::max);
        assert!(worst < 1e-4, "{mode}: {worst}");
        for view in &placement.views {
            let chunk = placement.chunk(view.owner).unwrap();
            assert!((view.metres_per_unit / chunk.world_from_chunk.scale - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn pose_priors_change_nothing_where_the_mode_does_not_use_them() {
    let truth = laps(30, 1.0);
    let with = run(CouplingMode::PoseFree, &truth, Some(&truth), REAL, 3);
    let without = run(CouplingMode::PoseFree, &truth, None, REAL, 3);
    assert_eq!(with.views, without.views);
    assert!(
        with.rejections.of(RejectionReason::NoOverlap) == 0 && with.chunks[0].status == ChunkStatus::Chained
    );
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let truth = laps(40, 1.5);
    let odometry = drifting(&truth, 1.0, &mut Noise::new(9));
    for mode in CouplingMode::ALL {
        let once = run(mode, &truth, Some(&odometry), REAL, 4);
        let again = run(mode, &truth, Some(&odometry), REAL, 4);
        assert_eq!(once.views, again.views, "{mode}");
    }
}

/// A depth that leans across the image, as no similarity of a chunk can repair.
fn lean(prediction: &mut GeometryPrediction) {
    for view in &mut prediction.views {
        let depth = view.depth.image().clone();
        let leaning = Image::from_fn(WIDTH, HEIGHT, |x, y| {
            let across = x as f32 / (WIDTH - 1) as f32 - 0.5;
            depth[(x, y)] * (0.12 * across).exp()
        });
        view.depth = RelativeDepth::new(leaning);
    }
}

#[test]
fn landmarks_straighten_a_leaning_depth_and_determine_the_scale() {
    let truth = laps(24, 0.6);
    let mut noise = Noise::new(11);
    let mut points = Noise::new(12);
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default()).unwrap();
    let mut predictions = Vec::new();
    for (k, range) in chunk_ranges(24, 12, 4).unwrap().into_iter().enumerate() {
        let mut prediction = predict(&truth, range.frames.clone(), k as u32, EXACT, &mut noise);
        lean(&mut prediction);
        predictions.push(prediction.clone());
        let seen: Vec<_> =
            range.frames.map(|i| (i, landmarks(&truth[i], i, 80, 0.02, 0.05, &mut points))).collect();
        let of = |i: usize| seen.iter().find(|s| s.0 == i).map_or(Vec::new(), |s| s.1.clone());
        aligner.push(observe(prediction, Some(&truth), of)).unwrap();
    }
    let placement = aligner.finish();
    assert!(placement.views.iter().all(|v| v.field.is_some()));
    let kept = placement.views.len()
        - placement.rejections.of(RejectionReason::DepthFieldRejected).min(placement.views.len());
    assert!(kept * 2 > placement.views.len(), "{kept} of {}", placement.views.len());
    let (mut before, mut after, mut count) = (0.0, 0.0, 0.0);
    for prediction in predictions {
        let raw = prediction.clone();
        for view in placement.aligned_views(prediction, &[]).unwrap() {
            let place = placement.view(view.frame_id()).unwrap();
            let exact = depth(&truth[view.frame_id().index()]);
            let rough = raw.views.iter().find(|v| v.frame_id == view.frame_id()).unwrap();
            for (k, z) in exact.data().iter().enumerate() {
                let unit = rough.depth.image().data()[k] as f64 * place.metres_per_unit;
                before += (unit / f64::from(*z)).ln().abs();
                after += f64::from(view.depth().image().data()[k] / z).ln().abs();
                count += 1.0;
            }
        }
    }
    assert!(after < 0.75 * before, "{} before, {} after", before / count, after / count);
}

#[test]
fn memory_grows_by_a_few_kilobytes_per_view_and_no_more() {
    let truth = laps(200, 3.0);
    let mut noise = Noise::new(13);
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default()).unwrap();
    let mut sizes = Vec::new();
    for (k, range) in chunk_ranges(200, 12, 4).unwrap().into_iter().enumerate() {
        let prediction = predict(&truth, range.frames, k as u32, REAL, &mut noise);
        aligner.push(observe(prediction, Some(&truth), none)).unwrap();
        sizes.push(aligner.memory_bytes());
    }
    let growth = (sizes[sizes.len() - 1] - sizes[1]) as f64 / ((sizes.len() - 2) * 12) as f64;
    assert!(growth < 6000.0, "{growth} bytes per view");
}

/// Placements while chunks come: near what the whole estimate would be, and estimated far fewer times.
#[test]
fn a_provisional_placement_has_every_view_and_is_estimated_less_often_the_longer_it_is() {
    let truth = laps(400, 4.0);
    let mut noise = Noise::new(17);
    let odometry = drifting(&truth, 0.01, &mut noise);
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default()).unwrap();
    let (mut estimated, mut chunks) = (Vec::new(), 0);
    for (k, range) in chunk_ranges(truth.len(), 12, 4).unwrap().into_iter().enumerate() {
        let prediction = predict(&truth, range.frames.clone(), k as u32, REAL, &mut noise);
        aligner.push(observe(prediction, Some(&odometry), none)).unwrap();
        for candidate in aligner.loop_candidates() {
            aligner.push_loop(&candidate, None).unwrap();
        }
        let provisional = aligner.provisional_placement();
        chunks = k + 1;
        assert_eq!(provisional.chunks.len(), chunks);
        assert_eq!(provisional.views.len(), range.frames.end, "every view has a place");
        let inside = provisional.graph.as_ref().unwrap().chunks;
        assert!(inside + inside / 16 >= chunks, "{inside} of {chunks}");
        estimated.push(inside);
        let error = absolute_error(&provisional, &truth);
        assert!(error < 0.25, "chunk {k}: {error} m");
    }
    estimated.dedup();
    assert_eq!(estimated[..16], (1..=16).collect::<Vec<_>>(), "at first with every chunk");
    assert!(estimated.len() < chunks * 3 / 4, "{} estimates for {chunks} chunks", estimated.len());
}

#[test]
fn settings_out_of_range_are_named_and_modes_have_their_names() {
    let mut config = AlignerConfig::default();
    config.validate().unwrap();
    config.loops.top_k = 0;
    let error = Aligner::new(CouplingMode::Coupled, &config).unwrap_err();
    assert_eq!(error.to_string(), "align.loops.top_k must be between 1 and 20, found 0");
    for mode in CouplingMode::ALL {
        let word = serde_json::to_string(&mode).unwrap();
        assert_eq!(word, format!("\"{mode}\""));
    }
}

#[test]
fn a_metric_scale_that_jumps_between_neighbours_is_clamped_and_counted() {
    let truth = laps(60, 1.0);
    // Between frames 17 and 27 the odometry takes steps for 1.6 times as long as they are.
    let mut odometry = vec![truth[0]];
    for (i, pair) in truth.windows(2).enumerate() {
        let mut step = pair[0].inverse() * pair[1];
        if (17..27).contains(&i) {
            step.translation *= 1.6;
        }
        odometry.push(odometry[i] * step);
    }
    let mut noise = Noise::new(21);
    let mut aligner = Aligner::new(CouplingMode::PoseConditioned, &AlignerConfig::default()).unwrap();
    let mut gauges = Vec::new();
    for (k, range) in chunk_ranges(60, 12, 4).unwrap().into_iter().enumerate() {
        gauges.push(Noise(noise.0.clone()).gauge());
        let prediction = predict(&truth, range.frames, k as u32, EXACT, &mut noise);
        aligner.push(observe(prediction, Some(&odometry), none)).unwrap();
    }
    let placement = aligner.finish();
    assert!(placement.rejections.of(RejectionReason::ScaleOutOfRange) >= 1, "{:?}", placement.rejections);
    let jump = placement.chunks[2].world_from_chunk.scale / gauges[2].scale;
    assert!((jump - 1.0).abs() < 0.2, "{jump}");
}

#[test]
fn metric_views_have_the_colours_and_times_of_their_images() {
    let truth = laps(12, 0.2);
    let mut aligner = Aligner::new(CouplingMode::PoseConditioned, &AlignerConfig::default()).unwrap();
    let prediction = predict(&truth, 0..12, 0, EXACT, &mut Noise::new(1));
    aligner.push(observe(prediction.clone(), Some(&truth), none)).unwrap();
    let image = |i: u32| ChunkView {
        frame_id: FrameId(i),
        time: Timestamp::from_nanos(i64::from(i)),
        image: FrameImage::Gray8(Image::filled(2 * WIDTH, 2 * HEIGHT, 9)),
        intrinsics: camera(),
        world_from_camera: None,
    };
    let images: Vec<ChunkView> = (0..12).map(image).collect();
    let views = aligner.finish().aligned_views(prediction, &images).unwrap();
    assert_eq!(views.len(), 12);
    assert_eq!(views[5].color().unwrap()[(1, 1)], [9, 9, 9]);
    assert_eq!(views[5].time(), Timestamp::from_nanos(5));
    assert!((views[5].world_from_camera().translation - truth[5].translation).norm() < 1e-6);
}
