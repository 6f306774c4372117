//! The adjustment of whole recordings against the truth, over many simulated flights.
//!
//! The short forms are part of the suite. The long ones print what they find:
//! `cargo test --release -p vidar-odometry --test adjustment -- --ignored --nocapture`

#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout)] // helpers of tests are test code, though not marked so

use std::ops::ControlFlow;
use vidar_core::{ImuNoise, LieGroup, Se3, So3};
use vidar_odometry::bundle_adjustment::{Adjusted, AdjustmentError, AdjustmentFinding, CalibrationSigmas};
use vidar_odometry::simulate::{
    AdjustSettings, Course, CourseKind, Logged, Random, Simulation, SimulationConfig,
};

/// A consumer IMU, as phones have.
const CONSUMER: ImuNoise = ImuNoise {
    gyro_noise_density: 5e-4,
    gyro_random_walk: 2e-5,
    accel_noise_density: 5e-3,
    accel_random_walk: 1e-3,
    ..ImuNoise::EUROC
};

/// A flight of `secs` at `speed`, with gains that are off by `gain` (standard deviation, relative).
fn logged(seed: u64, secs: f64, speed: f64, gain: f64, settings: &AdjustSettings) -> Logged {
    let mut random = Random::new(900 + seed);
    let mut scale = || std::array::from_fn(|_| 1.0 + gain * random.normal());
    let course = Course { kind: CourseKind::Eight, secs: secs + 1.0, speed, phase: 0.37 * seed as f64 };
    let config = SimulationConfig {
        seed,
        tracks: 60,
        camera_rate_hz: 10.0,
        noise: CONSUMER,
        gyro_scale: scale(),
        accel_scale: scale(),
        ..SimulationConfig::default()
    };
    Logged::new(&Simulation::new(&course, 0.0, secs, &config), 2, seed, settings)
}

fn adjust(logged: &Logged, settings: &AdjustSettings) -> Adjusted {
    logged.adjust(settings, &mut |_| ControlFlow::Continue(())).unwrap()
}

fn settings() -> AdjustSettings {
    AdjustSettings { noise: CONSUMER, ..AdjustSettings::default() }
}

/// A camera whose place is told wrong, by so many metres and radians.
fn wrong(metres: f64, rad: f64, seed: u64) -> AdjustSettings {
    let mut random = Random::new(70 + seed);
    let mut direction = || random.normal3().normalize();
    let error = Se3::new(So3::exp(&(direction() * rad)), direction() * metres);
    AdjustSettings { camera_error: error, ..settings() }
}

#[test]
fn a_lever_arm_that_is_given_wrong_is_found_and_told() {
    let given = wrong(0.3, 0.0, 1);
    let flight = logged(1, 12.0, 1.4, 0.0, &given);
    let adjusted = adjust(&flight, &given);
    let error = flight.log_scale_error(&adjusted);
    assert!(error.abs() < 3.0 * adjusted.scale_std, "ln s {error} at σ {}", adjusted.scale_std);
    let told = adjusted.findings.iter().find_map(|f| match f {
        AdjustmentFinding::CameraPosition { given_m, found_m, sigma_m } => Some((given_m, found_m, sigma_m)),
        _ => None,
    });
    let (given_m, found_m, sigma_m) = told.unwrap_or_else(|| panic!("{:?}", adjusted.findings));
    let truth = Simulation::body_from_camera().translation;
    assert!((given_m - truth).norm() > 0.29, "{given_m}");
    let off = (found_m - truth).component_div(sigma_m);
    assert!(off.norm() < 5.0 && sigma_m.max() < 0.05, "{found_m} instead of {truth}, σ {sigma_m}");
}

#[test]
fn a_calibration_that_is_right_is_not_contradicted() {
    for seed in 0..4 {
        let adjusted = adjust(&logged(seed, 8.0, 1.0, 0.005, &settings()), &settings());
        assert!(adjusted.findings.is_empty(), "flight {seed}: {:?}", adjusted.findings);
        assert!(adjusted.is_consistent(), "{:?}", adjusted.report);
    }
}

#[test]
fn an_adjustment_can_be_broken_off_at_any_iteration() {
    let flight = logged(3, 5.0, 1.0, 0.0, &settings());
    for limit in [0, 3, 10] {
        let mut told = 0;
        let result = flight.adjust(&settings(), &mut |progress| {
            assert_eq!(progress.iterations, told);
            told += 1;
            if told > limit { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert_eq!(result, Err(AdjustmentError::Cancelled));
        assert_eq!(told, limit + 1);
    }
}

/// Speed of the flights of the tables.
const SPEED: f64 = 1.0;

/// Squared normalised errors and sizes over a set of flights.
#[derive(Default)]
struct Table {
    rows: usize,
    ln_s: f64,
    ln_s_nees: f64,
    lever_m: f64,
    lever_nees: f64,
    sigma: f64,
    chi2: f64,
    gyro_factor: f64,
    accel_factor: f64,
}

fn table(
    name: &str,
    flights: u64,
    secs: f64,
    gain: f64,
    settings_of: impl Fn(u64) -> AdjustSettings,
) -> Table {
    let mut t = Table::default();
    for seed in 0..flights {
        let settings = settings_of(seed);
        let flight = logged(seed, secs, SPEED, gain, &settings);
        let Ok(adjusted) = flight.adjust(&settings, &mut |_| ControlFlow::Continue(())) else { continue };
        let error = flight.log_scale_error(&adjusted);
        t.rows += 1;
        t.ln_s += error * error;
        t.ln_s_nees += (error / adjusted.scale_std).powi(2);
        t.sigma += adjusted.scale_std;
        t.chi2 += adjusted.report.inertial_chi2_per_dof;
        let lever =
            adjusted.calibration.body_from_camera.translation - Simulation::body_from_camera().translation;
        t.lever_m += lever.norm_squared();
        for k in 0..3 {
            let sigma = adjusted.calibration.sigmas[5 + k];
            t.lever_nees += if sigma > 0.0 { (lever[k] / sigma).powi(2) / 3.0 } else { f64::NAN };
        }
        t.gyro_factor += adjusted.imu.gyro_noise_density / CONSUMER.gyro_noise_density;
        t.accel_factor += adjusted.imu.accel_noise_density / CONSUMER.accel_noise_density;
    }
    let n = t.rows as f64;
    println!(
        "{name:<28} {:>3} |ln s| {:.4} nees {:.2} σ {:.4} lever {:.4} m nees {:.2} chi2 {:.3} noise ×{:.2} ×{:.2}",
        t.rows,
        (t.ln_s / n).sqrt(),
        t.ln_s_nees / n,
        t.sigma / n,
        (t.lever_m / n).sqrt(),
        t.lever_nees / n,
        t.chi2 / n,
        t.gyro_factor / n,
        t.accel_factor / n,
    );
    t
}

#[test]
#[ignore = "long: prints tables"]
fn tables() {
    let held = |s: AdjustSettings| {
        let sigmas =
            CalibrationSigmas { position_m: 0.0, gyro_gain: 0.0, accel_gain: 0.0, ..s.sigmas.clone() };
        AdjustSettings { sigmas, ..s }
    };
    let no_gain = |s: AdjustSettings| {
        let sigmas = CalibrationSigmas { gyro_gain: 0.0, accel_gain: 0.0, ..s.sigmas.clone() };
        AdjustSettings { sigmas, ..s }
    };
    for (metres, rad, gain) in
        [(0.0, 0.0, 0.0), (0.0, 0.0, 0.005), (0.1, 0.0, 0.005), (0.3, 0.0, 0.005), (0.0, 0.087, 0.005)]
    {
        {
            println!("lever {metres} m, turn {rad} rad, gain {gain}");
            table("  all held", 6, 12.0, gain, |s| held(wrong(metres, rad, s)));
            table("  lever free", 6, 12.0, gain, |s| no_gain(wrong(metres, rad, s)));
            table("  lever and gains free", 6, 12.0, gain, |s| wrong(metres, rad, s));
        }
    }
}
