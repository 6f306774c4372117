use super::*;
use vidar_core::LieGroup;
use vidar_core::random::SplitMix64;

const SIGMA: f64 = 0.5 / 458.0;

/// Pairs of rays of a cloud (or a plane), with noise and outliers.
fn pairs(motion: &Se3, n: usize, outliers: usize, plane: bool, seed: u64) -> Vec<RayPair> {
    let mut random = SplitMix64::new(seed);
    (0..n)
        .map(|k| {
            let z = if plane { 4.0 } else { 2.0 + 6.0 * random.uniform() };
            let p = Vector3::new(random.normal() * 0.5 * z, random.normal() * 0.4 * z, z);
            let p = if plane { p + Vector3::new(0.0, 0.0, 0.2 * p.x) } else { p };
            let mut noise = || random.normal3() * SIGMA;
            let (na, nb) = (noise(), noise());
            let b = if k < outliers { random.normal3() + Vector3::z() * 2.0 } else { *motion * p };
            RayPair { a: (p.normalize() + na).normalize(), b: (b.normalize() + nb).normalize() }
        })
        .collect()
}

fn direction_error_deg(found: &Se3, truth: &Se3) -> f64 {
    let t = truth.translation.normalize();
    found.translation.cross(&t).norm().atan2(found.translation.dot(&t)).to_degrees()
}

fn motion() -> Se3 {
    Se3::new(So3::exp(&Vector3::new(0.05, -0.12, 0.2)), Vector3::new(0.5, -0.1, 0.15))
}

#[test]
fn five_points_give_rotation_and_direction_for_clouds_and_planes() {
    for plane in [false, true] {
        for seed in 0..10 {
            let all = pairs(&motion(), 120, 30, plane, seed);
            let mut solver = TwoViewSolver::default();
            let found = solver.solve(&all, SIGMA).unwrap();
            let turn = (found.b_from_a.rotation.inverse() * motion().rotation).angle_rad().to_degrees();
            let direction = direction_error_deg(&found.b_from_a, &motion());
            let (turn_limit, direction_limit) = if plane { (0.8, 5.0) } else { (0.3, 2.0) };
            assert!(
                turn < turn_limit && direction < direction_limit,
                "plane {plane} seed {seed}: {turn} {direction} {found:?}"
            );
            assert!(found.inliers >= 84, "{found:?}");
        }
    }
}

#[test]
fn pure_rotation_is_told_from_motion() {
    let turn = Se3::new(motion().rotation, Vector3::zeros());
    let all = pairs(&turn, 100, 5, false, 1);
    let mut solver = TwoViewSolver::default();
    let found = solver.solve(&all, SIGMA);
    assert!(found.is_err(), "{found:?}");
}

#[test]
fn nonsense_and_too_few_pairs_are_refused() {
    let mut solver = TwoViewSolver::default();
    let few = solver.solve(&pairs(&motion(), 4, 0, false, 1), SIGMA);
    assert!(matches!(few, Err(TwoViewFailure::TooFewPairs { found: 4, .. })));
    let nonsense = solver.solve(&pairs(&motion(), 80, 80, false, 1), SIGMA);
    assert!(matches!(nonsense, Err(TwoViewFailure::NoConsensus { .. })), "{nonsense:?}");
}

#[test]
fn the_same_pairs_give_the_same_bits() {
    let all = pairs(&motion(), 100, 30, false, 4);
    let solve = || TwoViewSolver::default().solve(&all, SIGMA).unwrap();
    assert_eq!(solve(), solve());
}
