//! What images have of their own: a focal length, a shift, a delay.

use super::{adjust, ate_m, logged_with, settings, told};
use std::ops::ControlFlow;
use vidar_core::OdometryKeyframe;
use vidar_odometry::bundle_adjustment::{Adjusted, AdjustmentFinding, Focus, IMAGE_SHIFT_RAD, ImagePrior};
use vidar_odometry::simulate::{Logged, Simulation, SimulationConfig};

/// A flight and its adjustment.
fn flown(seed: u64, secs: f64, config: &SimulationConfig) -> (Logged, Adjusted) {
    let flight = logged_with(seed, secs, 1.0, 0.0, config, &settings());
    let adjusted = adjust(&flight, &settings());
    (flight, adjusted)
}

fn focus(finding: &AdjustmentFinding) -> Option<Focus> {
    if let AdjustmentFinding::FocalLength(focus) = finding { Some(*focus) } else { None }
}

#[test]
fn a_focal_length_that_changes_is_found_in_every_image() {
    let (mut ln_s_nees, flights) = (0.0, 4);
    let config = SimulationConfig { log_focal: [0.0, 0.015], ..SimulationConfig::default() };
    for seed in 0..flights {
        let (flight, adjusted) = flown(seed, 12.0, &config);
        let found = told(&adjusted, focus);
        // A sine has 0.7 of its amplitude.
        assert!(
            (found.spread - 0.0106).abs() < 0.001 && found.mean.abs() < 0.003,
            "flight {seed}: {found:?}"
        );
        let begin = flight.truth[0].1;
        for keyframe in &adjusted.keyframes {
            let at = (flight.truth[keyframe.frame_id.index()].1 - begin).as_secs_f64();
            let error = found.mean + keyframe.lens.log_focal - config.lens_at(at).log_focal;
            assert!(error.abs() < 0.004, "flight {seed}, {at} s: {error}");
        }
        ln_s_nees += (flight.log_scale_error(&adjusted) / adjusted.scale_std).powi(2);
        assert!(ate_m(&flight, &adjusted) < 0.03, "flight {seed}: {} m", ate_m(&flight, &adjusted));
    }
    // χ² of four at 99.9 %.
    assert!(ln_s_nees < 18.5, "{ln_s_nees} of {flights}");
}

#[test]
fn a_stabilised_lens_is_found_in_every_image() {
    let (mut ln_s_nees, flights) = (0.0, 2);
    let config = SimulationConfig { shift: 0.008, ..SimulationConfig::default() };
    for seed in 0..flights {
        let (flight, adjusted) = flown(seed, 12.0, &config);
        // Two sines in quadrature have one's amplitude.
        let rms = told(&adjusted, shift_rms);
        assert!((rms - 0.008).abs() < 0.001 && adjusted.findings.len() == 1, "{:?}", adjusted.findings);
        let begin = flight.truth[0].1;
        let off = |k: &OdometryKeyframe| {
            let at = (flight.truth[k.frame_id.index()].1 - begin).as_secs_f64();
            (k.lens.shift - config.lens_at(at).shift).norm_squared()
        };
        let count = adjusted.keyframes.len() as f64;
        let error = (adjusted.keyframes.iter().map(off).sum::<f64>() / count).sqrt();
        assert!(error < 0.003, "flight {seed}: {error}");
        ln_s_nees += (flight.log_scale_error(&adjusted) / adjusted.scale_std).powi(2);
        assert!(ate_m(&flight, &adjusted) < 0.03, "flight {seed}: {} m", ate_m(&flight, &adjusted));
    }
    // χ² of two at 99.9 %.
    assert!(ln_s_nees < 13.8, "{ln_s_nees} of {flights}");
}

fn shift_rms(finding: &AdjustmentFinding) -> Option<f64> {
    if let AdjustmentFinding::Shifted { rms } = finding { Some(*rms) } else { None }
}

/// Where it is known before, the same is found in fewer iterations: none is spent on states that take the shifts for motion.
#[test]
fn a_stabiliser_that_is_known_is_not_looked_for() {
    let config = SimulationConfig { shift: 0.02, ..SimulationConfig::default() };
    let flight = logged_with(1, 12.0, 1.0, 0.0, &config, &settings());
    let adjust = |images: ImagePrior| {
        let mut settings = settings();
        settings.sigmas.images = images;
        let mut iterations = 0;
        let mut count = |_| {
            iterations += 1;
            ControlFlow::Continue(())
        };
        let adjusted = flight.adjust(&settings, &mut count).unwrap();
        (adjusted, iterations)
    };
    let (asked, asked_iterations) = adjust(ImagePrior::default());
    let (known, iterations) = adjust(ImagePrior { shift: Some(IMAGE_SHIFT_RAD), ..ImagePrior::default() });
    println!(
        "{iterations} iterations, {asked_iterations} where it is asked; {:.4} m",
        ate_m(&flight, &known)
    );
    assert!(3 * iterations < asked_iterations, "{iterations} of {asked_iterations}");
    let apart = told(&known, shift_rms) - told(&asked, shift_rms);
    assert!(apart.abs() < 2e-4 && known.findings.len() == 1, "{apart}: {:?}", known.findings);
    assert!(ate_m(&flight, &known) < 0.03, "{} m", ate_m(&flight, &known));
}

#[test]
fn stamps_that_scatter_are_found_for_every_image() {
    let (mut ln_s_nees, flights) = (0.0, 3);
    let config = SimulationConfig { stamp_scatter_secs: 0.005, ..SimulationConfig::default() };
    for seed in 0..flights {
        let (flight, adjusted) = flown(seed, 12.0, &config);
        let rms = told(&adjusted, |f| match f {
            AdjustmentFinding::StampsScatter { rms_secs } => Some(*rms_secs),
            _ => None,
        });
        // The prior holds it back where a camera hardly turns.
        assert!((0.003..0.0055).contains(&rms) && adjusted.findings.len() == 1, "{:?}", adjusted.findings);
        assert!(adjusted.report.is_explained() && adjusted.is_consistent(), "{:?}", adjusted.report);
        ln_s_nees += (flight.log_scale_error(&adjusted) / adjusted.scale_std).powi(2);
        // Of every image, those between that took no part, too.
        assert!(ate_m(&flight, &adjusted) < 0.03, "flight {seed}: {} m", ate_m(&flight, &adjusted));
    }
    // χ² of three at 99.9 %.
    assert!(ln_s_nees < 16.3, "{ln_s_nees} of {flights}");
}

#[test]
fn a_focal_length_that_is_given_wrong_is_found_and_told() {
    for (seed, off) in [(1, 0.02), (2, -0.015)] {
        let config = SimulationConfig { log_focal: [off, 0.0], ..SimulationConfig::default() };
        let (flight, adjusted) = flown(seed, 10.0, &config);
        let found = told(&adjusted, focus);
        assert!((found.mean - off).abs() < 4.0 * found.mean_sigma.max(2e-4), "flight {seed}: {found:?}");
        assert!(found.spread < 0.2 * off.abs(), "flight {seed}: {found:?}");
        let [given, corrected] =
            [&Simulation::camera(), &adjusted.calibration.camera].map(|c| c.parameters()[0]);
        assert!(((corrected / given).ln() - found.mean).abs() < 1e-9);
        let error = flight.log_scale_error(&adjusted);
        assert!(error.abs() < 3.0 * adjusted.scale_std, "ln s {error} at σ {}", adjusted.scale_std);
    }
}
