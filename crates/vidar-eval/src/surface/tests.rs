use super::*;
use proptest::prelude::*;
use vidar_core::{LieGroup, So3};

fn cloud(positions: Vec<[f32; 3]>) -> PointCloud {
    PointCloud::from_positions(positions)
}

/// Walls, floor and two boxes of a room of 6 m × 4 m × 3 m, points every `spacing` metres shifted by `phase`.
fn room(spacing: f32, phase: f32) -> Vec<[f32; 3]> {
    let mut points = Vec::new();
    let mut sheet = |origin: [f32; 3], a: [f32; 3], b: [f32; 3]| {
        let length = |v: [f32; 3]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        let (na, nb) = ((length(a) / spacing) as usize, (length(b) / spacing) as usize);
        for i in 0..na {
            for j in 0..nb {
                let (u, v) = ((i as f32 + phase) / na as f32, (j as f32 + phase) / nb as f32);
                points.push([0, 1, 2].map(|k| origin[k] + a[k] * u + b[k] * v));
            }
        }
    };
    let mut block = |o: [f32; 3], s: [f32; 3]| {
        let (x, y, z) = ([s[0], 0.0, 0.0], [0.0, s[1], 0.0], [0.0, 0.0, s[2]]);
        sheet(o, x, y);
        sheet(o, x, z);
        sheet(o, y, z);
        sheet([o[0] + s[0], o[1], o[2]], y, z);
        sheet([o[0], o[1] + s[1], o[2]], x, z);
        sheet([o[0], o[1], o[2] + s[2]], x, y);
    };
    block([-3.0, -2.0, 0.0], [6.0, 4.0, 3.0]);
    block([-2.0, -1.5, 0.0], [0.8, 1.2, 1.0]);
    block([0.9, 0.4, 0.0], [1.3, 0.7, 1.6]);
    points
}

/// The room as a method would have it whose world is elsewhere and whose metre is `1/scale` metres too long.
fn estimate_of_scale(scale: f64) -> (PointCloud, Se3) {
    let truth_from_estimate =
        Se3::new(So3::exp(&nalgebra::Vector3::new(0.1, -0.2, 1.0)), nalgebra::Vector3::new(2.0, 1.0, -0.5));
    let truth_from_scaled = Sim3 { scale, ..Sim3::from_se3(&truth_from_estimate) };
    let estimate_from_truth = truth_from_scaled.inverse();
    (cloud(transformed(&room(0.06, 0.3), &estimate_from_truth)), truth_from_estimate)
}

fn config() -> SurfaceEvalConfig {
    // Fewer points than by default keep the suite quick.
    SurfaceEvalConfig {
        icp: IcpConfig { max_points: 4_000, ..IcpConfig::default() },
        ..SurfaceEvalConfig::default()
    }
}

#[test]
fn scores_of_seven_points_are_those_computed_by_hand() {
    // On a line no placement can be refined, so the clouds are evaluated as placed.
    let reference = cloud([0.0, 1.0, 2.0, 3.0].map(|x| [x, 0.0, 0.0]).to_vec());
    let estimate = cloud([0.04, 1.25, 2.0].map(|x| [x, 0.0, 0.0]).to_vec());
    let config = SurfaceEvalConfig { thresholds_m: vec![0.05, 0.25], keep_point_errors: true, ..config() };
    let report = evaluate_surface(&estimate, &reference, &Se3::IDENTITY, &config).unwrap();
    assert!(
        !report.placement.accepted && report.placement.reason.contains("degenerate"),
        "{:?}",
        report.placement
    );
    // A distance of exactly 0.25 m is not below 0.25 m, so both thresholds give the same.
    for scores in &report.native {
        assert!((scores.precision - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!(scores.recall, 0.5);
        assert!((scores.f - 4.0 / 7.0).abs() < 1e-12);
    }
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-7, "{a} is not {b}");
    close(report.chamfer.accuracy_mean_m, 0.29 / 3.0);
    close(report.chamfer.accuracy_median_m, 0.04);
    close(report.chamfer.completeness_mean_m, 1.29 / 4.0);
    close(report.chamfer.completeness_median_m, 0.145);
    close(report.chamfer.chamfer_m, 0.5 * (0.29 / 3.0 + 1.29 / 4.0));
    let errors = report.point_errors.unwrap();
    assert_eq!(errors.estimate_m.len(), 3);
    close(f64::from(errors.estimate_m[1]), 0.25);
    close(f64::from(errors.reference_m[3]), 1.0);
}

#[test]
fn inflation_of_a_tenth_is_seen_by_the_rigid_fit_and_refined_away_by_the_bounded_one() {
    let (estimate, start) = estimate_of_scale(1.10);
    let report = evaluate_surface(&estimate, &cloud(room(0.05, 0.5)), &start, &config()).unwrap();
    assert!(report.placement.accepted, "{:?}", report.placement);
    assert!((report.scale_native - 1.10).abs() < 0.01, "{:?}", report.placement);
    assert!(report.native[0].f > 0.97, "{:?}", report.native);
    assert!(report.rigid[0].f < 0.6, "{:?}", report.rigid);
    assert!(report.delta_f_rigid > 0.1, "{}", report.delta_f_rigid);
    assert!((report.rigid_placement.scale - 1.0).abs() < 1e-12);
    assert!(report.chamfer.chamfer_m > 0.03, "{:?}", report.chamfer);
    assert!(report.warnings.iter().any(|w| w.kind == "scale-refined"), "{:?}", report.warnings);
    assert!(report.delta_f.abs() < 1e-12 && report.scale_free == report.scale_native);
    assert!(report.placement.rms_after_m < report.placement.rms_before_m);
}

#[test]
fn a_scale_of_one_point_three_is_refused_natively_and_borrowed_freely() {
    let (estimate, rigid) = estimate_of_scale(1.3);
    let similarity = Sim3 { scale: 1.3, ..Sim3::from_se3(&rigid) };
    let start = PlacementStart { truth_from_estimate: rigid, truth_from_estimate_sim3: Some(similarity) };
    let report = evaluate_surface_from(&estimate, &cloud(room(0.05, 0.5)), &start, &config()).unwrap();
    assert!(!report.placement.accepted, "{:?}", report.placement);
    assert_eq!(report.scale_native, 1.0);
    assert_eq!(report.placement.truth_from_estimate.to_se3(), Some(rigid));
    assert!((report.scale_free - 1.3).abs() < 0.01, "{}", report.scale_free);
    assert!(report.delta_f > 0.5, "{} from {:?} and {:?}", report.delta_f, report.native, report.free);
    assert!((report.delta_f - (report.free[1].f - report.native[1].f)).abs() < 1e-15);
    assert!(report.warnings.iter().any(|w| w.kind == "refinement-rejected"), "{:?}", report.warnings);
}

#[test]
fn bounds_decide_what_is_refused_and_rigid_refinement_can_follow() {
    let (estimate, start) = estimate_of_scale(1.10);
    let reference = cloud(room(0.05, 0.5));
    // 0.15 m off, which a rigid refinement repairs as far as the scale allows.
    let off = Se3 { translation: start.translation + nalgebra::Vector3::new(0.15, 0.0, 0.0), ..start };
    let narrow = SurfaceEvalConfig { scale_bounds: ScaleBounds { min: 0.95, max: 1.05 }, ..config() };
    let kept = evaluate_surface(&estimate, &reference, &off, &narrow).unwrap();
    assert!(!kept.placement.accepted && kept.scale_native == 1.0);
    let refine = SurfaceEvalConfig { on_rejection: OnRejection::RefineRigid, ..narrow };
    let refined = evaluate_surface(&estimate, &reference, &off, &refine).unwrap();
    assert_eq!(refined.scale_native, 1.0);
    // The closest pairs decide the refinement, not F, which a wrong scale may even lower.
    assert_ne!(refined.placement.truth_from_estimate, kept.placement.truth_from_estimate);
    // The rigid placement is refined either way.
    assert_eq!(refined.rigid, kept.rigid);
    // The rejected refinement is still a candidate of the free placement.
    assert!(
        kept.delta_f > 0.3 && (kept.scale_free - 1.1).abs() < 0.01,
        "{} {}",
        kept.delta_f,
        kept.scale_free
    );
}

#[test]
fn unusable_points_are_dropped_counted_and_told() {
    let (mut estimate, start) = estimate_of_scale(1.0);
    let mut reference = room(0.05, 0.5);
    let clean = evaluate_surface(&estimate, &cloud(reference.clone()), &start, &config()).unwrap();
    estimate.positions.push([f32::NAN, 0.0, 0.0]);
    estimate.positions.push([0.0, f32::INFINITY, 0.0]);
    reference.push([0.0, 0.0, f32::NEG_INFINITY]);
    let config = SurfaceEvalConfig { keep_point_errors: true, ..config() };
    let report = evaluate_surface(&estimate, &cloud(reference), &start, &config).unwrap();
    assert_eq!((report.estimate_points_not_finite, report.reference_points_not_finite), (2, 1));
    // A true scale is not told to be wrong.
    assert!(clean.rigid[0].f > 0.97 && clean.warnings.is_empty(), "{:?} {:?}", clean.rigid, clean.warnings);
    assert_eq!(report.native, clean.native);
    assert_eq!(report.warnings.iter().filter(|w| w.kind == "points-not-finite").count(), 2);
    let errors = report.point_errors.unwrap();
    assert_eq!(errors.estimate_m.len(), estimate.len());
    assert!(errors.estimate_m[estimate.len() - 1].is_nan());
}

#[test]
fn clouds_without_a_usable_point_are_errors() {
    let some = cloud(vec![[0.0; 3]]);
    let nan = cloud(vec![[f32::NAN; 3]; 2]);
    let error =
        |e: &PointCloud, r: &PointCloud| evaluate_surface(e, r, &Se3::IDENTITY, &config()).unwrap_err();
    assert_eq!(error(&cloud(Vec::new()), &some), EvalError::EmptyCloud { which: "estimated", given: 0 });
    assert_eq!(error(&some, &nan), EvalError::EmptyCloud { which: "reference", given: 2 });
    let far = cloud(vec![[100.0, 0.0, 0.0]]);
    let crop = SurfaceEvalConfig { crop_margin_m: Some(1.0), ..config() };
    let error = evaluate_surface(&far, &some, &Se3::IDENTITY, &crop).unwrap_err();
    assert_eq!(error, EvalError::NothingInBounds { margin_m: 1.0 });
    let adrift = Se3::from_translation(nalgebra::Vector3::new(f64::NAN, 0.0, 0.0));
    assert_eq!(evaluate_surface(&some, &some, &adrift, &config()), Err(EvalError::BadPlacement));
}

#[test]
fn cropping_leaves_out_what_the_reference_cannot_judge() {
    let (mut estimate, _) = estimate_of_scale(1.0);
    estimate.positions = room(0.06, 0.3);
    let given = estimate.len();
    // Half as many points again, seen through a window 5 m away.
    estimate
        .positions
        .extend((0..given / 2).map(|i| [8.0 + (i % 50) as f32 * 0.02, (i / 50) as f32 * 0.02, 1.0]));
    let reference = cloud(room(0.05, 0.5));
    let evaluate = |crop_margin_m| {
        let config = SurfaceEvalConfig { crop_margin_m, ..config() };
        let config = SurfaceEvalConfig { icp: IcpConfig { keep_ratio: 0.6, ..config.icp }, ..config };
        evaluate_surface(&estimate, &reference, &Se3::IDENTITY, &config).unwrap()
    };
    let (all, cropped) = (evaluate(None), evaluate(Some(0.5)));
    assert_eq!((all.estimate_points_cropped, cropped.estimate_points_cropped), (0, given / 2));
    assert!((all.native[1].precision - 2.0 / 3.0).abs() < 0.01, "{:?}", all.native);
    assert!(cropped.native[1].precision > 0.99, "{:?}", cropped.native);
    assert_eq!(all.native[1].recall, cropped.native[1].recall);
}

#[test]
fn voxels_weigh_crowded_places_like_others() {
    // Ten good points and one wrong point that occurs a thousand times.
    let good: Vec<[f32; 3]> = (0..10).map(|i| [i as f32, 0.0, 0.0]).collect();
    let mut crowded = good.clone();
    crowded.extend((0..1000).map(|i| [4.5 + i as f32 * 1e-6, 0.0, 0.0]));
    let precision = |voxel_size_m| {
        let config = SurfaceEvalConfig { voxel_size_m, ..config() };
        let report =
            evaluate_surface(&cloud(crowded.clone()), &cloud(good.clone()), &Se3::IDENTITY, &config).unwrap();
        (report.estimate_points_evaluated, report.native[0].precision)
    };
    assert_eq!(precision(None), (1010, 10.0 / 1010.0));
    assert_eq!(precision(Some(0.02)), (11, 10.0 / 11.0));
    let config = SurfaceEvalConfig { voxel_size_m: Some(1e-9), ..config() };
    let result = evaluate_surface(&cloud(crowded), &cloud(good), &Se3::IDENTITY, &config);
    assert!(matches!(result, Err(EvalError::VoxelTooSmall { .. })), "{result:?}");
}

#[test]
fn one_thread_and_four_give_the_same_report() {
    let (estimate, start) = estimate_of_scale(1.05);
    let reference = cloud(room(0.05, 0.5));
    let config = SurfaceEvalConfig { voxel_size_m: Some(0.04), keep_point_errors: true, ..config() };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| evaluate_surface(&estimate, &reference, &start, &config).unwrap())
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn the_report_has_stable_keys() {
    let (estimate, start) = estimate_of_scale(1.0);
    let report = evaluate_surface(&estimate, &estimate, &Se3::IDENTITY, &config()).unwrap();
    assert_eq!(report.native[0].f, 1.0);
    let value = serde_json::to_value(&report).unwrap();
    let keys =
        |value: &serde_json::Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>().join(" ");
    assert_eq!(
        keys(&value),
        "rigid native free delta_f_rigid delta_f delta_f_threshold_m scale_native scale_free chamfer rigid_placement estimate_points reference_points \
         estimate_points_not_finite reference_points_not_finite estimate_points_cropped estimate_points_evaluated \
         reference_points_evaluated placement free_placement warnings"
    );
    assert_eq!(keys(&value["native"][0]), "threshold_m precision recall f");
    assert_eq!(
        keys(&value["placement"]),
        "truth_from_estimate accepted reason refined_scale iterations converged rms_before_m rms_after_m"
    );
    assert_eq!(keys(&value["free_placement"]), "start truth_from_estimate");
    let again: SurfaceReport = serde_json::from_value(value).unwrap();
    assert_eq!(again.native, report.native);
    assert!(start.is_finite());
}

#[test]
fn settings_out_of_range_are_named() {
    let base = config;
    let key = |config: SurfaceEvalConfig| match config.validate() {
        Err(EvalError::Config { key, .. }) => key,
        other => panic!("{other:?}"),
    };
    assert_eq!(key(SurfaceEvalConfig { thresholds_m: vec![], ..base() }), "thresholds_m");
    assert_eq!(key(SurfaceEvalConfig { thresholds_m: vec![0.1, 0.0], ..base() }), "thresholds_m");
    assert_eq!(
        key(SurfaceEvalConfig { scale_bounds: ScaleBounds { min: 1.2, max: 1.3 }, ..base() }),
        "scale_bounds.min"
    );
    assert_eq!(key(SurfaceEvalConfig { voxel_size_m: Some(f64::NAN), ..base() }), "voxel_size_m");
    assert_eq!(key(SurfaceEvalConfig { crop_margin_m: Some(-1.0), ..base() }), "crop_margin_m");
    for icp in [
        IcpConfig { keep_ratio: 0.0, ..IcpConfig::default() },
        IcpConfig { max_iterations: 0, ..IcpConfig::default() },
        IcpConfig { max_points: 3, ..IcpConfig::default() },
        IcpConfig { tolerance_m: f64::INFINITY, ..IcpConfig::default() },
    ] {
        assert!(key(SurfaceEvalConfig { icp, ..base() }).starts_with("icp."));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn scores_are_shares_and_swapping_the_clouds_swaps_them(
        a in prop::collection::vec(prop::array::uniform3(0.0_f32..0.6), 1..80),
        b in prop::collection::vec(prop::array::uniform3(0.0_f32..0.6), 1..80),
    ) {
        let here = |estimated: &[[f32; 3]], reference: &[[f32; 3]]| {
            score(estimated, &Reference::new(reference.to_vec()).unwrap(), &Sim3::IDENTITY, &config()).unwrap()
        };
        let (there, back) = (here(&a, &b), here(&b, &a));
        for (x, y) in there.scores.iter().zip(&back.scores) {
            prop_assert!((0.0..=1.0).contains(&x.precision) && (0.0..=1.0).contains(&x.recall));
            prop_assert!(x.f <= x.precision.max(x.recall) + 1e-12 && x.f >= 0.0);
            prop_assert_eq!((x.precision, x.recall, x.f), (y.recall, y.precision, y.f));
        }
        prop_assert!(there.scores[0].f <= there.scores[1].f + 1e-12);
        prop_assert!((there.chamfer.chamfer_m - back.chamfer.chamfer_m).abs() < 1e-12);
    }

    #[test]
    fn the_free_placement_is_never_worse_than_the_native_one(
        a in prop::collection::vec(prop::array::uniform3(0.0_f32..1.0), 10..60),
        scale in 0.4_f64..2.5,
    ) {
        let estimate = cloud(a.iter().map(|p| p.map(|v| v * scale as f32)).collect());
        let report = evaluate_surface(&estimate, &cloud(a), &Se3::IDENTITY, &config()).unwrap();
        prop_assert!(report.delta_f >= 0.0);
        prop_assert!(report.scale_native == 1.0 || config().scale_bounds.contains(report.scale_native));
    }
}
