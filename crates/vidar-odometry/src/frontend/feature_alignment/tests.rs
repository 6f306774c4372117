use super::*;
use crate::frontend::config::MatchingConfig;
use crate::frontend::template::Warp;
use crate::frontend::testbed::{Random, Scene, full_scene, median, rms, scene};

#[derive(Default)]
struct Score {
    errors: Vec<f64>,
    edge_errors: Vec<f64>,
    outliers: usize,
    tried: usize,
    normalised: Vec<f64>,
    failures: std::collections::BTreeMap<String, usize>,
}

/// Aligns the keyframe's features in `view` from a start that is off by about `disturb_px`.
fn score(scene: &Scene, view: usize, gain: f64, sigma: f64, disturb_px: f64, smooth: bool) -> Score {
    let (keyframe, current) = (
        scene.spoiled(0, 1.0, sigma),
        if gain == 1.0 && sigma == 0.0 { scene.pyramid(view) } else { scene.spoiled(view, gain, sigma) },
    );
    let config = MatchingConfig::default();
    let motion = scene.motion(0, view);
    let mut random = Random::new(5);
    let mut template = Template::empty();
    let mut result = Score::default();
    for (feature, inverse_distance, _) in scene.features(0) {
        if smooth && !scene.is_smooth(0, &feature.pixel, 5 << feature.level) {
            continue;
        }
        let Some(truth) = scene.truth(0, view, &feature.pixel) else { continue };
        let Some(warp) = Warp::new(&scene.camera, &feature, inverse_distance, &motion) else { continue };
        assert!((warp.pixel - truth).norm() < 1e-6);
        result.tried += 1;
        if !template.fill(&keyframe, &feature, &warp) {
            *result.failures.entry("template".into()).or_default() += 1;
            continue;
        }
        let start = warp.pixel + Vector2::new(random.gaussian(), random.gaussian()) * disturb_px;
        match align_feature(&template, &current, &start, sigma, &config) {
            Ok(found) => {
                let error = found.measurement.pixel - truth;
                let w = found.measurement.whitening();
                match template.normal {
                    Some(n) => {
                        // A start off along the edge is no error of the alignment.
                        result.edge_errors.push(n.dot(&error));
                        if n.dot(&error).abs() > 1.5 {
                            result.outliers += 1;
                        }
                    }
                    None => {
                        if error.norm() > 1.5 {
                            result.outliers += 1;
                        } else {
                            result.errors.push(error.norm());
                            result.normalised.push((w * error).norm_squared());
                        }
                    }
                }
            }
            Err(failure) => *result.failures.entry(format!("{failure:?}")).or_default() += 1,
        }
    }
    result
}

#[test]
#[ignore = "experiment: prints accuracy of feature alignment"]
fn explore() {
    for (smooth, view, disturb) in
        [(false, 1, 0.5), (false, 4, 0.5), (true, 1, 0.0), (true, 1, 0.5), (true, 1, 1.0), (true, 4, 0.5)]
    {
        for (gain, sigma) in [(1.0, 0.0), (1.0, 2.0), (1.0, 8.0), (2.0, 0.0), (0.5, 2.0)] {
            let s = score(
                if std::env::var("FULL").is_ok() { full_scene() } else { scene() },
                view,
                gain,
                sigma,
                disturb,
                smooth,
            );
            println!(
                "smooth {smooth} disturb {disturb} view {view} gain {gain} sigma {sigma}: tried {} found {} + {} rms {:.3} median {:.3} edge rms {:.3} outliers {} nees {:.2} median {:.2} {:?}",
                s.tried,
                s.errors.len(),
                s.edge_errors.len(),
                rms(&s.errors),
                median(&s.errors),
                rms(&s.edge_errors),
                s.outliers,
                s.normalised.iter().sum::<f64>() / s.normalised.len() as f64,
                median(&s.normalised),
                s.failures
            );
        }
    }
}

#[test]
#[ignore = "experiment"]
fn explore_worst() {
    let scene = scene();
    let (keyframe, current) = (scene.pyramid(0), scene.pyramid(1));
    let motion = scene.motion(0, 1);
    let mut template = Template::empty();
    for (feature, inverse_distance, d) in scene.features(0) {
        if !scene.is_smooth(0, &feature.pixel, 5 << feature.level) {
            continue;
        }
        let Some(truth) = scene.truth(0, 1, &feature.pixel) else { continue };
        let Some(warp) = Warp::new(&scene.camera, &feature, inverse_distance, &motion) else { continue };
        if !template.fill(&keyframe, &feature, &warp) {
            println!("no template {feature:?}");
            continue;
        }
        let mut config = MatchingConfig { max_iterations: 50, ..MatchingConfig::default() };
        config.max_shift_px = 8.0;
        let (levels, weak) = (template.level, crate::frontend::feature::eigen(&template.hessian));
        match align_feature(&template, &current, &warp.pixel, 0.0, &config) {
            Ok(f) => {
                let e = f.measurement.pixel - truth;
                if e.norm() > 0.4 {
                    println!(
                        "bad {:.2} at {:.0},{:.0} level {} search {} strength {:.1} eig {:.0} {:.0} ncc {:.3} resid {:.1} sigma {:.2} {:.2}",
                        e.norm(),
                        feature.pixel.x,
                        feature.pixel.y,
                        feature.level,
                        levels,
                        d.strength,
                        weak[0],
                        weak[1],
                        f.ncc,
                        f.residual_gray,
                        f.measurement.covariance().m11.sqrt(),
                        f.measurement.covariance().m22.sqrt()
                    );
                }
            }
            Err(e) => println!(
                "{e:?} at {:.0},{:.0} level {} search {} strength {:.1} eig {:.0} {:.0} energy {:.0}",
                feature.pixel.x,
                feature.pixel.y,
                feature.level,
                levels,
                d.strength,
                weak[0],
                weak[1],
                template.energy
            ),
        }
    }
}
