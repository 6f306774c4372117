//! Closed-form alignment: recovery, optimality, and every degenerate input.

use nalgebra::Vector3;
use proptest::prelude::*;
use vidar_core::{LieGroup, Se3, Sim3, So3, UmeyamaError, umeyama_se3, umeyama_sim3, umeyama_sim3_weighted};

type Points = Vec<Vector3<f64>>;

fn vector(size: f64) -> impl Strategy<Value = Vector3<f64>> {
    (-size..size, -size..size, -size..size).prop_map(|(x, y, z)| Vector3::new(x, y, z))
}

fn rotation() -> impl Strategy<Value = So3> {
    vector(2.5).prop_map(|w| So3::exp(&w))
}

/// A similarity with scale 1e-3…1e3 and translation to 100.
fn similarity() -> impl Strategy<Value = Sim3> {
    (rotation(), vector(100.0), -3.0..3.0_f64).prop_map(|(rotation, translation, log10)| Sim3 {
        rotation,
        translation,
        scale: 10f64.powf(log10),
    })
}

/// A cloud stretched along three axes: full, planar, or almost on a line.
fn cloud() -> impl Strategy<Value = Points> {
    let extents = prop::sample::select(vec![
        Vector3::new(1.0, 1.0, 1.0),
        Vector3::new(3.0, 1.0, 0.0),
        Vector3::new(5.0, 0.01, 0.01),
        Vector3::new(5.0, 0.01, 0.0),
    ]);
    let corners = [Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::z()];
    (prop::collection::vec(vector(1.0), 0..30), extents, rotation()).prop_map(
        move |(points, extent, turn)| {
            corners.iter().chain(&points).map(|p| turn * p.component_mul(&extent)).collect()
        },
    )
}

fn moved(by: &Sim3, points: &[Vector3<f64>]) -> Points {
    points.iter().map(|p| by.act(p)).collect()
}

fn cost(by: &Sim3, source: &[Vector3<f64>], target: &[Vector3<f64>], weights: &[f64]) -> f64 {
    (0..source.len()).map(|i| weights[i] * (target[i] - by.act(&source[i])).norm_squared()).sum()
}

/// Largest distance between what the two make of the points, over the size of the image.
fn difference(a: &Sim3, b: &Sim3, points: &[Vector3<f64>], reach: f64) -> f64 {
    let error = points.iter().map(|p| (a.act(p) - b.act(p)).norm()).fold(0.0, f64::max);
    error / reach
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..Default::default() })]

    #[test]
    fn noise_free_pairs_give_back_the_similarity(truth in similarity(), source in cloud(), far in 0..3_usize) {
        // Also for clouds 1e3 and 1e6 away from the origin, as coordinates in a national grid are.
        let offset = Vector3::new(1.0, -2.0, 0.5) * [0.0, 1e3, 1e6][far];
        let source: Points = source.iter().map(|p| p + offset).collect();
        let target = moved(&truth, &source);
        let found = umeyama_sim3(&source, &target).unwrap();
        let reach = truth.translation.norm() + truth.scale * (6.0 + offset.norm());
        let error = difference(&found, &truth, &source, reach);
        // Of 12 000 draws the worst is 1.2e-13, for the reason that stands at the rigid fit.
        prop_assert!(error < 1e-12, "{error:.2e}");
        // Coordinates carry 1e-16 of their distance from the origin; the finest cloud spans only 1e-2 across.
        let digits = 1e-13 + 1e-15 * (offset.norm() + truth.translation.norm() / truth.scale);
        prop_assert!((found.scale / truth.scale - 1.0).abs() < digits, "{} {}", found.scale, truth.scale);
        let angle = (found.rotation.inverse() * truth.rotation).angle_rad();
        // About the long axis of a thin cloud the covariance knows the angle by the square of its extents' ratio, 2.5e5.
        prop_assert!(angle < 1e4 * digits, "{angle:.2e}");
    }

    #[test]
    fn rigid_fit_gives_back_the_motion(truth in similarity(), source in cloud()) {
        let truth = Se3::new(truth.rotation, truth.translation);
        let target: Points = source.iter().map(|p| truth * *p).collect();
        let found = umeyama_se3(&source, &target).unwrap();
        // Of 400 000 draws the worst is 3.1e-14: covariance squares the ratio of a thin cloud's extents.
        let reach = truth.translation.norm() + 6.0;
        let error = difference(&Sim3::from_se3(&found), &Sim3::from_se3(&truth), &source, reach);
        prop_assert!(error < 5e-14, "{error:.2e}");
    }

    #[test]
    fn no_neighbour_of_the_result_has_a_lower_cost(
        truth in similarity(), source in prop::collection::vec(vector(2.0), 4..20),
        noise in prop::collection::vec(vector(1.0), 20), weights in prop::collection::vec(0.1..10.0_f64, 20),
        delta in prop::collection::vec(-1.0..1.0_f64, 7), log10 in -4.0..0.0_f64,
    ) {
        // Noise as large as the cloud: the result is still the minimum.
        let weights = &weights[..source.len()];
        let target: Points = (0..source.len()).map(|i| truth.act(&source[i]) + noise[i] * truth.scale).collect();
        let Ok(found) = umeyama_sim3_weighted(&source, &target, weights) else { return Ok(()) };
        let least = cost(&found, &source, &target, weights);
        let mut delta = nalgebra::SVector::<f64, 7>::from_column_slice(&delta) * 10f64.powf(log10);
        let other = cost(&found.plus(&delta), &source, &target, weights);
        prop_assert!(other >= least * (1.0 - 1e-12), "{other} < {least}");
        // With equal weights and the scale held at 1, the rigid fit is the minimum.
        let weights = vec![1.0; source.len()];
        delta[6] = 0.0;
        let rigid = umeyama_se3(&source, &target).unwrap();
        let rigid = Sim3::from_se3(&rigid);
        let (least, other) =
            (cost(&rigid, &source, &target, &weights), cost(&rigid.plus(&delta), &source, &target, &weights));
        prop_assert!(other >= least * (1.0 - 1e-12), "rigid {other} < {least}");
    }

    #[test]
    fn a_mirror_image_gives_a_proper_rotation(
        source in prop::collection::vec(vector(2.0), 4..20), turn in rotation(), others in prop::collection::vec(rotation(), 20),
    ) {
        let mirrored: Points = source.iter().map(|p| turn * Vector3::new(p.x, p.y, -p.z)).collect();
        let Ok(found) = umeyama_sim3(&source, &mirrored) else { return Ok(()) };
        prop_assert!((found.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
        let weights = vec![1.0; source.len()];
        let least = cost(&found, &source, &mirrored, &weights);
        for rotation in others {
            // For this rotation the best scale and translation.
            let mean = |p: &[Vector3<f64>]| p.iter().sum::<Vector3<f64>>() / p.len() as f64;
            let (source_mean, target_mean) = (mean(&source), mean(&mirrored));
            let centred = || source.iter().map(|x| rotation * (x - source_mean));
            let along: f64 = centred().zip(&mirrored).map(|(x, y)| (y - target_mean).dot(&x)).sum();
            let scale = along / centred().map(|x| x.norm_squared()).sum::<f64>();
            if !(scale > 0.0) {
                continue;
            }
            let translation = target_mean - rotation * source_mean * scale;
            let other = cost(&Sim3 { rotation, translation, scale }, &source, &mirrored, &weights);
            prop_assert!(other >= least * (1.0 - 1e-9), "{other} < {least}");
        }
    }

    #[test]
    fn any_input_gives_a_finite_result_or_an_error(
        source in prop::collection::vec((any::<f64>(), any::<f64>(), any::<f64>()), 0..6),
        target in prop::collection::vec((any::<f64>(), any::<f64>(), any::<f64>()), 0..6),
        weights in prop::collection::vec(any::<f64>(), 0..6),
    ) {
        let points = |p: &[(f64, f64, f64)]| p.iter().map(|&(x, y, z)| Vector3::new(x, y, z)).collect::<Points>();
        let (source, target) = (points(&source), points(&target));
        if let Ok(found) = umeyama_sim3(&source, &target) {
            prop_assert!(found.is_finite());
        }
        if let Ok(found) = umeyama_se3(&source, &target) {
            prop_assert!(found.is_finite());
        }
        if let Ok(found) = umeyama_sim3_weighted(&source, &target, &weights) {
            prop_assert!(found.is_finite());
        }
    }
}

fn line(n: usize) -> Points {
    (0..n).map(|i| Vector3::new(1.0, 2.0, -0.5) * i as f64 * 0.1).collect()
}

#[test]
fn degenerate_points_are_an_error_value() {
    let square = vec![Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::x() + Vector3::y()];
    let degenerate = |source: &[Vector3<f64>], target: &[Vector3<f64>]| {
        for result in [umeyama_sim3(source, target).err(), umeyama_se3(source, target).err()] {
            assert!(matches!(result, Some(UmeyamaError::Degenerate { .. })), "{result:?}");
        }
    };
    let turn = Sim3 { rotation: So3::exp(&Vector3::new(0.3, 1.0, -0.2)), scale: 2.0, ..Sim3::IDENTITY };
    for offset in [0.0, 1.0, 1e6] {
        let offset = Vector3::new(1.0, -1.0, 3.0) * offset;
        let shift = |points: &[Vector3<f64>]| points.iter().map(|p| p + offset).collect::<Points>();
        let straight = shift(&line(20));
        degenerate(&straight, &moved(&turn, &straight));
        let place = vec![Vector3::new(0.1, 0.2, 0.3) + offset; 4];
        degenerate(&place, &place);
        degenerate(&place, &shift(&square));
        degenerate(&shift(&square), &place);
        degenerate(&shift(&square), &straight[..4]);
    }
    // The mirror image of a regular cross: infinitely many rotations are equally good.
    let cross: Points =
        [1.0, -1.0].iter().flat_map(|&s| [Vector3::x() * s, Vector3::y() * s, Vector3::z() * s]).collect();
    degenerate(&cross, &cross.iter().map(|p| -p).collect::<Points>());
}

#[test]
fn a_plane_is_enough() {
    let square = [Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::x() + Vector3::y()];
    let truth = Sim3::exp(&nalgebra::SVector::from([0.5, -1.0, 2.0, 3.0, 4.0, 5.0, -0.7]));
    for n in [3, 4] {
        let found = umeyama_sim3(&square[..n], &moved(&truth, &square[..n])).unwrap();
        assert!(difference(&found, &truth, &[Vector3::z()], 1.0) < 1e-13);
    }
}

#[test]
fn bad_input_is_named() {
    let good = vec![Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::z()];
    let mut bad = good.clone();
    bad[2].y = f64::NAN;
    assert_eq!(umeyama_sim3(&good, &bad), Err(UmeyamaError::NotFinite { index: 2 }));
    bad[2].y = f64::INFINITY;
    assert_eq!(umeyama_se3(&bad, &good), Err(UmeyamaError::NotFinite { index: 2 }));
    assert_eq!(umeyama_sim3(&good[..2], &good[..2]), Err(UmeyamaError::TooFewPoints { found: 2 }));
    assert_eq!(umeyama_sim3(&[], &[]), Err(UmeyamaError::TooFewPoints { found: 0 }));
    let mismatch = UmeyamaError::LengthMismatch { source_len: 4, target_len: 3 };
    assert_eq!(umeyama_sim3(&good, &good[..3]), Err(mismatch));
    let weighted = |weights: &[f64]| umeyama_sim3_weighted(&good, &good, weights).map(|s| s.scale);
    assert_eq!(weighted(&[1.0; 3]), Err(UmeyamaError::WeightCountMismatch { points: 4, weights: 3 }));
    assert_eq!(weighted(&[1.0, -1.0, 1.0, 1.0]), Err(UmeyamaError::BadWeight { index: 1, found: -1.0 }));
    assert!(matches!(weighted(&[1.0, 1.0, f64::NAN, 1.0]), Err(UmeyamaError::BadWeight { index: 2, .. })));
    assert_eq!(weighted(&[1.0, 1.0, 0.0, 0.0]), Err(UmeyamaError::TooFewPoints { found: 2 }));
}

#[test]
fn weights_count_as_repetitions_and_zero_leaves_out() {
    let source: Points =
        (0..5).map(|i| Vector3::new(i as f64, (i * i) as f64 * 0.3, 1.0 / (i + 1) as f64)).collect();
    let target: Points =
        source.iter().enumerate().map(|(i, p)| p * 1.7 + Vector3::y() * (i % 2) as f64).collect();
    let repeat =
        |points: &Points| points.iter().enumerate().flat_map(|(i, p)| vec![*p; i]).collect::<Points>();
    let weighted = umeyama_sim3_weighted(&source, &target, &[0.0, 1e300, 2e300, 3e300, 4e300]).unwrap();
    let repeated = umeyama_sim3(&repeat(&source), &repeat(&target)).unwrap();
    assert!(difference(&weighted, &repeated, &source, 1.0) < 1e-12);
}
