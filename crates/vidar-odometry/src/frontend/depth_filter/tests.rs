use super::*;
use crate::frontend::testbed::{Random, median, scene};

#[test]
fn a_belief_narrows_on_good_measurements_and_survives_wrong_ones() {
    let mut random = Random::new(1);
    let (mut converged, mut inside) = (0, 0);
    for _ in 0..200 {
        let truth = 0.2 + 0.6 * random.uniform();
        let mut seed = Seed::new(2.0, 1.0);
        for k in 0..30 {
            let sigma = 0.05;
            let measured =
                if k % 4 == 3 { 2.0 * random.uniform() } else { truth + sigma * random.gaussian() };
            seed.fuse(measured, sigma * sigma);
        }
        let error = (seed.mean - truth).abs();
        converged += usize::from(seed.variance.sqrt() < 0.02);
        inside += usize::from(error < 3.0 * seed.variance.sqrt());
        assert!(seed.inlier_ratio() > 0.5 && seed.inlier_ratio() < 0.95, "{seed:?}");
    }
    assert!(converged > 180 && inside > 180, "{converged} {inside}");
}

#[test]
fn only_wrong_measurements_make_a_seed_hopeless() {
    let mut random = Random::new(2);
    let filter = DepthFilter::new(DepthFilterConfig::default(), MatchingConfig::default());
    let mut seed = Seed::new(2.0, 1.0);
    assert!(!filter.is_converged(&seed) && !filter.is_hopeless(&seed));
    for _ in 0..25 {
        seed.miss();
    }
    assert!(filter.is_hopeless(&seed));
    let mut seed = Seed::new(2.0, 1.0);
    for _ in 0..60 {
        seed.fuse(2.0 * random.uniform(), 0.01 * 0.01);
    }
    assert!(!filter.is_converged(&seed) || seed.inlier_ratio() < 0.8, "{seed:?}");
}

/// Seeds of the scene's keyframe after its later views: relative errors, normalised errors, those that did not converge.
fn run(sigma_gray: f64) -> (Vec<f64>, Vec<f64>, usize) {
    let scene = scene();
    let mut filter = DepthFilter::new(DepthFilterConfig::default(), MatchingConfig::default());
    let keyframe = scene.spoiled(0, 1.0, sigma_gray);
    let features = scene.features(0);
    let depths: Vec<f64> = features.iter().map(|(_, inverse, _)| 1.0 / inverse).collect();
    let (typical, nearest) = (median(&depths), depths.iter().copied().fold(f64::INFINITY, f64::min));
    let mut seeds = vec![Seed::new(typical, nearest); features.len()];
    for view in 1..scene.views.len() {
        let current = scene.spoiled(view, 1.0, sigma_gray);
        let motion = scene.motion(0, view);
        for (seed, (feature, ..)) in seeds.iter_mut().zip(&features) {
            filter.update(seed, &scene.camera, feature, &keyframe, &current, &motion, sigma_gray);
        }
    }
    let (mut relative, mut normalised, mut open) = (Vec::new(), Vec::new(), 0);
    for (seed, (_, inverse, _)) in seeds.iter().zip(&features) {
        if filter.is_converged(seed) {
            relative.push((seed.mean / inverse - 1.0).abs());
            normalised.push((seed.mean - inverse).powi(2) / seed.variance);
        } else {
            open += 1;
        }
    }
    (relative, normalised, open)
}

#[test]
fn depths_of_a_rendered_room_are_found_by_a_few_images() {
    for (sigma_gray, typical) in [(0.0, 0.01), (8.0, 0.03)] {
        let (relative, normalised, open) = run(sigma_gray);
        let wrong = relative.iter().filter(|r| **r > 0.15).count();
        eprintln!(
            "noise {sigma_gray}: {} converged, {open} open, {wrong} wrong, relative error median {:.4}, normalised {:.2}",
            relative.len(),
            median(&relative),
            median(&normalised)
        );
        assert!(relative.len() > 30, "{} converged, {open} open", relative.len());
        assert!(median(&relative) < typical, "{}", median(&relative));
        assert!(wrong * 12 < relative.len(), "{wrong} wrong of {}", relative.len());
    }
}

#[test]
fn a_camera_that_only_turns_learns_no_depth() {
    let scene = scene();
    let mut filter = DepthFilter::new(DepthFilterConfig::default(), MatchingConfig::default());
    let image = scene.pyramid(0);
    for (feature, ..) in scene.features(0) {
        let mut seed = Seed::new(3.0, 1.0);
        let before = seed;
        let outcome = filter.update(&mut seed, &scene.camera, &feature, &image, &image, &Se3::IDENTITY, 0.0);
        assert!(
            seed.variance > 0.9 * before.variance && (seed.mean - before.mean).abs() < 0.05,
            "{outcome:?}"
        );
    }
}
