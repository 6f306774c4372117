use super::*;
use crate::config::SynthConfig;
use crate::flight::FlightPath;
use crate::rig::euroc_body_from_camera;
use nalgebra::Vector3;
use vidar_core::{LieGroup, umeyama_se3, umeyama_sim3};

const N: usize = 24;

/// Built once: most of the time goes into the world.
fn views() -> Vec<TrueView> {
    static VIEWS: std::sync::OnceLock<Vec<TrueView>> = std::sync::OnceLock::new();
    VIEWS.get_or_init(rendered).clone()
}

fn rendered() -> Vec<TrueView> {
    let config = SynthConfig { clutter: 12, ..SynthConfig::default() };
    let path = FlightPath::built_in(&config).unwrap();
    let world = World::build(&config, &path).unwrap();
    let intrinsics = Pinhole::new(62.0, 62.0, 39.5, 25.5, 80, 52).unwrap();
    let place = |k: usize| TruePlace {
        frame_id: FrameId(5 * k as u32),
        time: Timestamp::from_nanos(250_000_000 * k as i64),
        world_from_camera: path.world_from_body(0.25 * k as f64) * euroc_body_from_camera(),
    };
    true_views(&world, &(0..N).map(place).collect::<Vec<_>>(), &intrinsics)
}

fn centres(poses: &[Se3]) -> Vec<Vector3<f64>> {
    poses.iter().map(|p| p.translation).collect()
}

fn poses(prediction: &GeometryPrediction) -> Vec<Se3> {
    prediction.views.iter().map(|v| v.chunk_from_camera).collect()
}

/// ln(believed/true) of the pixels that have both.
fn log_errors(prediction: &GeometryPrediction, views: &[TrueView], view: usize) -> Vec<(f64, f64)> {
    let believed = &prediction.views[view];
    let pixels = believed.depth.image().data().iter().zip(views[view].depth.image().data());
    pixels
        .zip(believed.confidence.image().data())
        .filter(|((b, t), _)| b.is_finite() && t.is_finite())
        .map(|((b, t), c)| (f64::from(b / t).ln(), f64::from(*c)))
        .collect()
}

fn deviation(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / values.len() as f64).sqrt()
}

#[test]
fn without_errors_the_prediction_is_the_truth() {
    let views = views();
    let truth: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    for prior in [None, Some(&truth[..])] {
        let prediction = predict_chunk(ChunkId(3), &views, prior, &PredictionErrors::NONE, 9).unwrap();
        assert_eq!(prediction.views.len(), N);
        for (p, t) in prediction.views.iter().zip(&views) {
            assert!((p.chunk_from_camera.matrix() - t.world_from_camera.matrix()).amax() < 1e-12);
            assert_eq!(p.intrinsics, t.intrinsics);
            assert_eq!(p.frame_id, t.frame_id);
            for (a, b) in p.depth.image().data().iter().zip(t.depth.image().data()) {
                assert!(a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()));
            }
            let sure = p.confidence.image().data().iter().zip(p.depth.image().data());
            assert!(sure.into_iter().all(|(c, z)| *c == if z.is_nan() { 0.0 } else { 1.0 }));
        }
    }
}

#[test]
fn a_gauge_alone_is_undone_by_one_similarity() {
    let views = views();
    let errors = PredictionErrors {
        gauge_scale_sigma: 0.3,
        gauge_rotation_deg: 57.0,
        gauge_shift_m: 3.0,
        ..PredictionErrors::NONE
    };
    let truth: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    let mut scales = Vec::new();
    for chunk in 0..40 {
        let prediction = predict_chunk(ChunkId(chunk), &views, None, &errors, 1).unwrap();
        assert_eq!(prediction.frame, ChunkFrame::ModelNative);
        let world_from_chunk = umeyama_sim3(&centres(&poses(&prediction)), &centres(&truth)).unwrap();
        for (p, t) in prediction.views.iter().zip(&views) {
            let back = world_from_chunk.transform_pose(&p.chunk_from_camera);
            assert!((back.matrix() - t.world_from_camera.matrix()).amax() < 1e-9);
        }
        // Depth has the scale of the places.
        let all = log_errors(&prediction, &views, 0);
        assert!(all.iter().all(|(e, _)| (e + world_from_chunk.scale.ln()).abs() < 1e-5));
        scales.push(world_from_chunk.scale.ln());
    }
    let spread = deviation(&scales);
    assert!((0.2..0.42).contains(&spread), "spread of ln(scale) {spread}");
}

#[test]
fn drift_is_a_walk_of_the_stated_size_that_is_right_on_average() {
    let views = views();
    let errors = PredictionErrors {
        drift_rotation_deg: 0.12,
        drift_translation_share: 0.012,
        drift_scale_sigma: 0.0015,
        ..PredictionErrors::NONE
    };
    let truth: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    let (mut turns, mut slips) = (Vec::new(), Vec::new());
    for chunk in 0..20 {
        let prediction = predict_chunk(ChunkId(chunk), &views, None, &errors, 4).unwrap();
        let believed = poses(&prediction);
        let left = umeyama_se3(&centres(&believed), &centres(&truth)).unwrap();
        assert!((left.matrix() - Se3::IDENTITY.matrix()).amax() < 1e-9, "right on average");
        for (b, t) in believed.windows(2).zip(truth.windows(2)) {
            let (b, t) = (b[0].inverse() * b[1], t[0].inverse() * t[1]);
            turns.extend((t.rotation.inverse() * b.rotation).log().iter().map(|a| a.to_degrees()));
            slips.extend((b.translation - t.translation).iter().map(|d| d / t.translation.norm()));
        }
    }
    let (turn, slip) = (deviation(&turns), deviation(&slips));
    assert!((0.11..0.13).contains(&turn), "{turn}° per step");
    // The walk of scale adds to the 1.2 %.
    assert!((0.0115..0.0145).contains(&slip), "{slip} of the step");
}

#[test]
fn errors_of_depth_have_the_stated_size_and_bend_smoothly() {
    let views = views();
    let errors =
        PredictionErrors { deformation_sigma: 0.015, deformation_order: 3, ..PredictionErrors::NONE };
    let mut all = Vec::new();
    for chunk in 0..20 {
        let prediction = predict_chunk(ChunkId(chunk), &views, None, &errors, 2).unwrap();
        let field: Vec<f64> = log_errors(&prediction, &views, 5).iter().map(|e| e.0).collect();
        if field.len() == 80 * 52 {
            let step = field.chunks(80).flat_map(|row| row.windows(2)).map(|w| (w[1] - w[0]).abs());
            assert!(step.fold(0.0, f64::max) < 0.01, "neighbouring pixels bend alike");
        }
        all.extend(field);
    }
    let rms = (all.iter().map(|e| e * e).sum::<f64>() / all.len() as f64).sqrt();
    assert!((0.011..0.019).contains(&rms), "deformation of {rms}");
}

#[test]
fn the_images_own_deformation_is_the_same_in_each_chunk() {
    let views = views();
    let correlation = |share: f64| {
        let errors = PredictionErrors {
            deformation_sigma: 0.02,
            deformation_frame_share: share,
            ..PredictionErrors::NONE
        };
        let of = |chunk: u32, view: usize| -> Vec<f64> {
            let prediction = predict_chunk(ChunkId(chunk), &views, None, &errors, 6).unwrap();
            log_errors(&prediction, &views, view).iter().map(|e| e.0).collect()
        };
        let (mut product, mut a2, mut b2) = (0.0, 0.0, 0.0);
        for view in 0..N {
            for (x, y) in of(1, view).iter().zip(of(2, view)) {
                (product, a2, b2) = (product + x * y, a2 + x * x, b2 + y * y);
            }
        }
        product / (a2 * b2).sqrt()
    };
    assert!(correlation(1.0) > 0.999);
    let half = correlation(0.5);
    assert!((0.25..0.75).contains(&half), "{half}");
    assert!(correlation(0.0).abs() < 0.3);
}

#[test]
fn edges_bleed_and_planes_do_not() {
    // A wall at 4 m, slanted, and a box at 2 m before its right half.
    let intrinsics = Pinhole::new(62.0, 62.0, 39.5, 25.5, 80, 52).unwrap();
    let z = |x: usize| if x < 40 { 1.0 / (0.25 + 0.001 * x as f32) } else { 2.0 };
    let view = TrueView {
        frame_id: FrameId(0),
        time: Timestamp::from_nanos(0),
        world_from_camera: Se3::IDENTITY,
        intrinsics,
        depth: MetricDepth::new(vidar_core::Image::from_fn(80, 52, |x, _| z(x))),
    };
    let errors = PredictionErrors { bleeding_px: 1.0, ..PredictionErrors::NONE };
    let prediction = predict_chunk(ChunkId(0), std::slice::from_ref(&view), None, &errors, 1).unwrap();
    let (depth, confidence) = (prediction.views[0].depth.image(), prediction.views[0].confidence.image());
    for x in (5..35).chain(45..75) {
        assert!((depth[(x, 20)] / z(x) - 1.0).abs() < 1e-5, "column {x}");
    }
    // Pixels at the edge float between both sides, and confidence is low there.
    assert!(depth[(39, 20)] < 3.2 && depth[(39, 20)] > 2.2, "{}", depth[(39, 20)]);
    assert!(depth[(40, 20)] > 2.1);
    assert!(confidence[(39, 20)] < 0.3 && confidence[(20, 20)] > 0.95);
}

#[test]
fn confidence_reflects_the_error_in_part() {
    let views = views();
    let errors = PredictionErrors { deformation_sigma: 0.0, bleeding_px: 1.0, ..PredictionErrors::default() };
    let prediction = predict_chunk(ChunkId(0), &views, None, &errors, 3).unwrap();
    // Rank correlation of |error| and confidence over the chunk.
    let mut pairs = Vec::new();
    for view in 0..N {
        let of_view = log_errors(&prediction, &views, view);
        let mut sorted: Vec<f64> = of_view.iter().map(|e| e.0).collect();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        pairs.extend(of_view.iter().map(|(e, c)| ((e - median).abs(), *c)));
    }
    let rank = |key: fn(&(f64, f64)) -> f64| {
        let mut order: Vec<usize> = (0..pairs.len()).collect();
        order.sort_by(|a, b| key(&pairs[*a]).total_cmp(&key(&pairs[*b])));
        let mut ranks = vec![0.0; pairs.len()];
        for (r, i) in order.into_iter().enumerate() {
            ranks[i] = r as f64 / pairs.len() as f64 - 0.5;
        }
        ranks
    };
    let (a, b) = (rank(|p| p.0), rank(|p| p.1));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let correlation = dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt();
    assert!((-0.9..-0.2).contains(&correlation), "rank correlation {correlation}");
}

#[test]
fn conditioned_predictions_keep_the_prior_poses_up_to_scale() {
    let views = views();
    // The poses given are 5 % too long.
    let prior: Vec<Se3> = views
        .iter()
        .map(|v| Se3::new(v.world_from_camera.rotation, v.world_from_camera.translation * 1.05))
        .collect();
    let errors = PredictionErrors { conditioned_scale_sigma: 0.04, ..PredictionErrors::NONE };
    let mut scales = Vec::new();
    for chunk in 0..30 {
        let prediction = predict_chunk(ChunkId(chunk), &views, Some(&prior), &errors, 8).unwrap();
        assert_eq!(prediction.frame, ChunkFrame::PriorWorld);
        let fit = umeyama_sim3(&centres(&prior), &centres(&poses(&prediction))).unwrap();
        assert!(fit.rotation.angle_rad() < 1e-9);
        // Depth follows the poses' scale and the chunk's own.
        let depth = log_errors(&prediction, &views, 2)[0].0;
        assert!((depth - (1.05_f64.ln() + fit.scale.ln())).abs() < 1e-5);
        scales.push(fit.scale.ln());
    }
    let spread = deviation(&scales);
    assert!((0.025..0.055).contains(&spread), "{spread}");
    let few = predict_chunk(ChunkId(0), &views, Some(&prior[1..]), &errors, 8).unwrap_err();
    assert!(few.to_string().contains("23 poses for 24 views"), "{few}");
}

#[test]
fn holes_sky_and_failures_come_as_often_as_stated() {
    let views = views();
    let errors = PredictionErrors { hole_share: 0.2, ..PredictionErrors::default() };
    let prediction = predict_chunk(ChunkId(0), &views, None, &errors, 3).unwrap();
    for view in &prediction.views {
        let holes = view.depth.image().data().iter().filter(|z| z.is_nan()).count();
        assert!((800..870).contains(&holes), "{holes} of 4160");
        let pixels = view.depth.image().data().iter().zip(view.confidence.image().data());
        assert!(pixels.into_iter().all(|(z, c)| z.is_nan() == (*c == 0.0)));
    }
    let sky = PredictionErrors { sky_beyond_m: 2.5, ..PredictionErrors::NONE };
    let prediction = predict_chunk(ChunkId(0), &views, None, &sky, 3).unwrap();
    for (p, t) in prediction.views.iter().zip(&views) {
        let pixels = p.depth.image().data().iter().zip(t.depth.image().data());
        assert!(pixels.into_iter().all(|(p, t)| p.is_nan() == (*t >= 2.5)));
    }
    let failing = PredictionErrors { failed_share: 0.25, ..PredictionErrors::NONE };
    let failed = (0..200)
        .filter(|&k| {
            let prediction = predict_chunk(ChunkId(k), &views[..2], None, &failing, 3).unwrap();
            prediction.views[0].chunk_from_camera != views[0].world_from_camera
        })
        .count();
    assert!((30..70).contains(&failed), "{failed} of 200");
}

#[test]
fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
    let views = views();
    let errors = PredictionErrors { hole_share: 0.05, ..PredictionErrors::default() };
    let bits = |threads: usize, seed: u64, chunk: u32| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let prediction = pool.install(|| predict_chunk(ChunkId(chunk), &views, None, &errors, seed)).unwrap();
        let view = |v: &ViewGeometry| {
            let pixels = v.depth.image().data().iter().chain(v.confidence.image().data());
            let pose = v.chunk_from_camera.matrix();
            let pixels: Vec<u32> = pixels.map(|x| x.to_bits()).collect();
            (pixels, pose.iter().map(|x| x.to_bits()).collect::<Vec<u64>>())
        };
        prediction.views.iter().map(view).collect::<Vec<_>>()
    };
    assert_eq!(bits(1, 5, 2), bits(4, 5, 2));
    assert_ne!(bits(4, 5, 2), bits(4, 6, 2));
    assert_ne!(bits(4, 5, 2), bits(4, 5, 3));
}

#[test]
fn standing_still_and_single_views_have_predictions() {
    let all = views();
    let still: Vec<TrueView> = (0..4).map(|_| all[0].clone()).collect();
    for views in [&all[..1], &all[..2], &still[..]] {
        let prior: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
        for prior in [None, Some(&prior[..])] {
            let prediction =
                predict_chunk(ChunkId(0), views, prior, &PredictionErrors::default(), 3).unwrap();
            assert!(prediction.views.iter().all(|v| v.chunk_from_camera.is_finite()));
        }
    }
    assert!(predict_chunk(ChunkId(0), &[], None, &PredictionErrors::default(), 3).unwrap().views.is_empty());
}

#[test]
fn each_bad_key_is_named() {
    type Corrupt = fn(&mut PredictionErrors);
    let cases: [(&str, Corrupt); 5] = [
        ("errors.gauge_scale_sigma", |e| e.gauge_scale_sigma = f64::NAN),
        ("errors.deformation_order", |e| e.deformation_order = 0),
        ("errors.hole_share", |e| e.hole_share = 1.0),
        ("errors.confidence_tolerance", |e| e.confidence_tolerance = 0.0),
        ("errors.failed_share", |e| e.failed_share = -0.1),
    ];
    for (name, corrupt) in cases {
        let mut errors = PredictionErrors::default();
        corrupt(&mut errors);
        let refused = predict_chunk(ChunkId(0), &[], None, &errors, 0).unwrap_err();
        assert!(refused.to_string().contains(name), "{refused}");
    }
    PredictionErrors::default().validate().unwrap();
    PredictionErrors::NONE.validate().unwrap();
}
