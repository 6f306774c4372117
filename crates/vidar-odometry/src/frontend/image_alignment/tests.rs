use super::*;
use crate::frontend::testbed::{Scene, scene};
use nalgebra::{SVector, Vector2};
use vidar_core::random::SplitMix64;
use vidar_core::testing::check_jacobian;

fn points(scene: &Scene, view: usize) -> Vec<AlignmentPoint> {
    let point = |(f, inverse_distance, _): &(crate::frontend::Feature, f64, _)| AlignmentPoint {
        pixel: f.pixel,
        bearing: f.bearing,
        inverse_distance: *inverse_distance,
    };
    scene.features(view).iter().map(point).collect()
}

fn prediction(truth: &Se3, off: &Vector6<f64>) -> MotionPrediction {
    MotionPrediction { current_from_anchor: truth.plus(off), information: Matrix6::zeros() }
}

/// Rotation (deg) and translation (m) between two motions.
fn apart(a: &Se3, b: &Se3) -> (f64, f64) {
    let d = a.minus(b);
    (d.fixed_rows::<3>(0).norm().to_degrees(), d.fixed_rows::<3>(3).norm())
}

#[test]
fn the_motion_is_found_from_a_wrong_prediction() {
    let scene = scene();
    let points = points(scene, 0);
    let keyframe = scene.pyramid(0);
    let reference =
        AlignmentReference { pyramid: &keyframe, anchor_from_reference: Se3::IDENTITY, points: &points };
    let mut aligner = ImageAligner::new(1);
    for view in [1, 2, 3] {
        let truth = scene.motion(0, view);
        let off = Vector6::new(0.01, -0.012, 0.015, 0.03, -0.03, 0.03);
        let found =
            aligner.align(&scene.camera, &[reference], &scene.pyramid(view), &prediction(&truth, &off));
        let (turn, shift) = apart(&found.current_from_anchor, &truth);
        eprintln!(
            "view {view}: {turn:.3} deg, {shift:.4} m, {} patches, {} it, {:.2} grey",
            found.patches, found.iterations, found.residual_gray
        );
        assert!(
            found.converged && turn < 0.12 && shift < 0.012,
            "view {view}: {turn} deg, {shift} m, {found:?}"
        );
        assert!((found.gain[0] - 1.0).abs() < 0.05, "{found:?}");
    }
}

#[test]
fn two_references_share_one_motion_and_exposures_are_their_own() {
    let scene = scene();
    let (from_key, from_last) = (points(scene, 0), points(scene, 2));
    let (keyframe, last) = (scene.degraded(0, 0.6, 2.0), scene.degraded(2, 0.9, 2.0));
    let current = scene.degraded(3, 1.1, 2.0);
    // The anchor is the last frame.
    let references = [
        AlignmentReference { pyramid: &last, anchor_from_reference: Se3::IDENTITY, points: &from_last },
        AlignmentReference {
            pyramid: &keyframe,
            anchor_from_reference: scene.motion(0, 2),
            points: &from_key,
        },
    ];
    let truth = scene.motion(2, 3);
    let off = Vector6::new(0.01, 0.01, -0.01, 0.02, 0.02, -0.02);
    let found = ImageAligner::new(1).align(&scene.camera, &references, &current, &prediction(&truth, &off));
    let (turn, shift) = apart(&found.current_from_anchor, &truth);
    assert!(found.converged && turn < 0.15 && shift < 0.015, "{turn} {shift} {found:?}");
    assert!(
        (found.gain[0] - 1.1 / 0.9).abs() < 0.06 && (found.gain[1] - 1.1 / 0.6).abs() < 0.09,
        "{found:?}"
    );
}

#[test]
fn hard_images_are_aligned_within_a_pixel() {
    let scene = scene();
    let points = points(scene, 0);
    let degraded = |gain, sigma| scene.degraded(2, gain, sigma);
    for (name, sigma, current) in [
        ("exposure doubled", 2.0, degraded(2.0, 2.0)),
        ("noise 8", 8.0, degraded(1.0, 8.0)),
        ("exposure halved", 2.0, degraded(0.5, 2.0)),
        ("blur of 9 px", 0.0, scene.blurred(2, 9)),
    ] {
        let keyframe = scene.degraded(0, 1.0, sigma);
        let reference =
            AlignmentReference { pyramid: &keyframe, anchor_from_reference: Se3::IDENTITY, points: &points };
        let truth = scene.motion(0, 2);
        let off = Vector6::new(0.01, 0.01, -0.01, 0.02, 0.02, -0.02);
        let found =
            ImageAligner::new(1).align(&scene.camera, &[reference], &current, &prediction(&truth, &off));
        let mut worst: Vec<f64> = points
            .iter()
            .filter_map(|p| {
                let at = |t: &Se3| {
                    scene.camera.project(&(t.rotation * p.bearing + t.translation * p.inverse_distance))
                };
                Some((at(&found.current_from_anchor)? - at(&truth)?).norm())
            })
            .collect();
        worst.sort_by(f64::total_cmp);
        let high = worst[worst.len() * 9 / 10];
        eprintln!("{name}: 90 % of predictions within {high:.2} px, gain {:.2}", found.gain[0]);
        assert!(found.converged && high < 1.0, "{name}: {high} px, {found:?}");
    }
}

#[test]
fn a_prior_holds_what_the_image_does_not_know_and_too_few_patches_change_nothing() {
    let scene = scene();
    let points = points(scene, 0);
    let keyframe = scene.pyramid(0);
    let truth = scene.motion(0, 1);
    let wrong = truth.plus(&Vector6::new(0.02, 0.0, 0.0, 0.0, 0.0, 0.0));
    let sure = MotionPrediction { current_from_anchor: wrong, information: Matrix6::identity() * 1e12 };
    let mut aligner = ImageAligner::new(ImageAligner::FINEST_LEVEL);
    let reference =
        AlignmentReference { pyramid: &keyframe, anchor_from_reference: Se3::IDENTITY, points: &points };
    let held = aligner.align(&scene.camera, &[reference], &scene.pyramid(1), &sure);
    assert!(apart(&held.current_from_anchor, &wrong).0 < 0.02);
    let few = AlignmentReference { points: &points[..4], ..reference };
    let unchanged = aligner.align(&scene.camera, &[few], &scene.pyramid(1), &sure);
    assert!(!unchanged.converged && unchanged.current_from_anchor == wrong, "{unchanged:?}");
    let none = aligner.align(&scene.camera, &[], &scene.pyramid(1), &sure);
    assert!(!none.converged && none.information == sure.information);
}

#[test]
fn the_derivative_of_a_pixel_by_the_anchor_is_the_numeric_one() {
    let scene = scene();
    let mut random = SplitMix64::new(6);
    let anchor_from_reference = Se3::exp(&Vector6::from_fn(|_, _| 0.2 * random.normal()));
    for p in points(scene, 0).iter().take(20) {
        let patch =
            Patch::new(&scene.camera, 0, &anchor_from_reference, p.pixel, &p.bearing, p.inverse_distance)
                .unwrap();
        let f = |d: &SVector<f64, 6>| -> Vector2<f64> {
            let in_anchor = Se3::exp(d) * (anchor_from_reference * (p.bearing / p.inverse_distance));
            scene.camera.project(&(anchor_from_reference.inverse() * in_anchor)).unwrap()
        };
        check_jacobian("anchor", &patch.d_pixel_d_anchor, f, &Vector6::zeros(), 1e-6).unwrap();
    }
}

#[test]
fn the_gradient_of_the_cost_is_the_numeric_one() {
    // The cost through moments against the cost by pixels, and its derivatives by gain and offset.
    let scene = scene();
    let points = points(scene, 0);
    let keyframe = scene.pyramid(0);
    let references =
        [AlignmentReference { pyramid: &keyframe, anchor_from_reference: Se3::IDENTITY, points: &points }];
    let mut aligner = ImageAligner::new(ImageAligner::FINEST_LEVEL);
    aligner.collect(&scene.camera, &references);
    for patch in &mut aligner.patches {
        patch.prepare(&keyframe, 2);
        patch.weight = 1.0;
    }
    let state = State { current_from_anchor: scene.motion(0, 1), gain: [1.1, 1.0], offset: [3.0, 0.0] };
    let seen = aligner.look(&scene.camera, &references, &scene.pyramid(1), 2, &state);
    assert!(seen > 20);
    let system = aligner.image_terms(&state);
    let cost = |x: &SVector<f64, 2>| {
        let sum: f64 = aligner.patches.iter().filter_map(|p| p.squared_residual(x[0], x[1])).sum();
        nalgebra::Vector1::new(0.5 * sum / 1e4)
    };
    let analytic = nalgebra::RowVector2::new(-system.gradient[6], -system.gradient[7]) / 1e4;
    check_jacobian("exposure", &analytic, cost, &SVector::<f64, 2>::new(1.1, 3.0), 1e-6).unwrap();
}
