//! The robustness ladder for ordinary recordings: a rendered phone, one thing made worse at a time, through `vidar odometry` with its
//! adjustment after the end. Clock offset and readout are never given.
//!
//! The short rungs run with every test; all of them, which make the table of `docs/benchmark/odometry.md`, by
//! `cargo test -p vidar-cli --test program -- --ignored --nocapture every_rung_of_the_ladder`.

use crate::support::{ProgramOutput, command};
use serde_json::Value;
use std::path::Path;
use vidar::synth::{CalibrationKind, FlightKind, ImuTiming, SynthConfig, write_sequence};

/// What is made worse, and how.
#[derive(Clone, Copy)]
struct Rung {
    name: &'static str,
    worsen: fn(&mut SynthConfig),
    /// Of the path, the largest error of the final trajectory.
    error_of_path: f64,
    /// Seconds without IMU measurements, from the fifth second on.
    imu_gap_secs: f64,
}

const fn rung(name: &'static str, worsen: fn(&mut SynthConfig)) -> Rung {
    Rung { name, worsen, error_of_path: 0.01, imu_gap_secs: 0.0 }
}

/// Bounds of issue and spec: half a percent of the path with and one without calibration are asked of the *median*; a single rung
/// may have twice that.
const SHORT: [Rung; 3] = [
    rung("readout 33 ms, stamps 90 ms late", |c| {
        (c.device.readout_secs, c.device.stamp_delay_secs) = (0.033, 0.09);
    }),
    rung("frames at uneven times, 10 % missing, 5 % repeated", |c| {
        let device = &mut c.device;
        (device.frame_jitter, device.dropped_frames, device.repeated_frames) = (0.1, 0.1, 0.05);
    }),
    Rung {
        error_of_path: 0.02,
        ..rung("no calibration", |c| c.device.calibration = CalibrationKind::Absent)
    },
];

const REST: [Rung; 16] = [
    rung("as it is", |_| {}),
    rung("global shutter, clock right", |c| (c.device.readout_secs, c.device.stamp_delay_secs) = (0.0, 0.0)),
    rung("stamps 80 ms early", |c| c.device.stamp_delay_secs = -0.08),
    rung("calm hand", |c| c.flight = FlightKind::Handheld),
    rung("calm hand, three seconds of standing first", |c| {
        (c.flight, c.start) = (FlightKind::Handheld, vidar::synth::Start::Static { secs: 3.0 });
    }),
    rung("two thirds of the surfaces bare", |c| c.bare_share = 0.67),
    rung("JPEG of quality 40, noise of 6 grey levels", |c| {
        (c.device.jpeg_quality, c.image_noise_sigma) = (40, 6.0);
    }),
    rung("blur of 20 ms, exposure swings by half", |c| {
        (c.exposure_secs, c.blur_samples, c.exposure_drift) = (0.02, 4, 0.5);
    }),
    rung("gyroscope and accelerometer interleaved, gaps of 20 to 50 ms every two seconds", |c| {
        (c.device.imu_timing, c.device.imu_gaps_per_min) = (ImuTiming::Interleaved, 30.0);
    }),
    Rung { imu_gap_secs: 0.4, ..rung("0.4 s without IMU measurements", |_| {}) },
    rung("IMU noise of twice a phone's, gains 1 % off", |c| {
        (c.imu_noise_scale, c.device.imu_scale_sigma) = (2.0, 0.01);
    }),
    rung("stated IMU noise 30 times too large", |c| c.device.stated_noise_factor = 30.0),
    Rung {
        error_of_path: 0.02,
        ..rung("focal length alone, 1.5 % off", |c| c.device.calibration = CalibrationKind::Partial)
    },
    rung("640x480", |c| *c = c.clone().resized(640, 480)),
    rung("1920x1080", |c| *c = c.clone().resized(1920, 1080)),
    Rung {
        error_of_path: 0.02,
        ..rung(
            "all of it: no calibration, 33 ms, 90 ms late, JPEG 40, uneven times, interleaved, half bare",
            |c| {
                let device = &mut c.device;
                (device.calibration, device.readout_secs, device.stamp_delay_secs) =
                    (CalibrationKind::Absent, 0.033, 0.09);
                (device.jpeg_quality, device.frame_jitter, device.dropped_frames) = (40, 0.1, 0.1);
                (device.imu_timing, c.bare_share) = (ImuTiming::Interleaved, 0.5);
            },
        )
    },
];

fn render(rung: &Rung, seed: u64, folder: &Path) {
    let mut config = SynthConfig::phone_fast().resized(320, 240);
    (config.seed, config.duration_secs, config.camera_rate_hz) = (seed, 10.0, 20.0);
    (config.blur_samples, config.depth, config.scan_spacing_m) = (1, false, 0.5);
    (rung.worsen)(&mut config);
    write_sequence(folder, &config, None, &|_, _| true).unwrap();
    if rung.imu_gap_secs > 0.0 {
        let file = folder.join("mav0/imu0/data.csv");
        let text = std::fs::read_to_string(&file).unwrap();
        let time = |line: &str| line.split(',').next().and_then(|t| t.parse::<i64>().ok());
        let first = text.lines().find_map(time).unwrap();
        let is_kept = |line: &&str| {
            let secs = time(line).map_or(0.0, |t| (t - first) as f64 * 1e-9);
            !(5.0..5.0 + rung.imu_gap_secs).contains(&secs)
        };
        let kept: Vec<&str> = text.lines().filter(is_kept).collect();
        std::fs::write(&file, kept.join("\n")).unwrap();
    }
}

fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} in {value}"))
}

/// Tracks the rung's recording; a line of the table, and what is not within its bounds.
fn climb(rung: &Rung, seed: u64) -> (String, Vec<String>) {
    climb_in(tempfile::tempdir().unwrap().path(), rung, seed)
}

/// With the recording in `folder/recording` and the result in `folder/out`.
fn climb_in(folder: &Path, rung: &Rung, seed: u64) -> (String, Vec<String>) {
    let sequence = folder.join("recording");
    render(rung, seed, &sequence);
    let mut program = command();
    program.arg("odometry").arg(&sequence).arg("-o").arg(folder.join("out")).args(["--json", "-q"]);
    let ran: ProgramOutput = program.output().unwrap().into();
    let json = ran.json();
    if json["final"].is_null() {
        return (format!("| {} | – |", rung.name), vec![format!("no final trajectory: {}", ran.stderr)]);
    }
    let images = number(&json, "/images");
    let share = number(&json, "/final/images") / images;
    let first_secs = number(&json, "/first_state_secs");
    let path_m = number(&json, "/final/trajectory/matched_truth_path_m");
    let ate_m = number(&json, "/final/trajectory/ate_se3_m/rmse");
    let ln_s = number(&json, "/final/trajectory/scale_error");
    let sigma = number(&json, "/final/scale_std");
    let live_m = number(&json, "/trajectory/ate_se3_m/rmse");
    let live_ln_s = number(&json, "/trajectory/scale_error");
    let line = format!(
        "| {} | {first_secs:.2} | {live_m:.4} | {live_ln_s:.4} | {:.0} % | {ate_m:.4} ({:.2} %) | {ln_s:.4} ({:.4}) |",
        rung.name,
        100.0 * share,
        100.0 * ate_m / path_m,
        sigma
    );
    let mut wrong = Vec::new();
    let mut ask = |holds: bool, what: String| {
        if !holds {
            wrong.push(what);
        }
    };
    // Stamps that are off move images out of the IMU's time, at most two at either end; such have no pose.
    ask(images * (1.0 - share) < 4.5, format!("a final pose for {:.1} % of {images} images", 100.0 * share));
    ask(first_secs < 4.0, format!("first state after {first_secs} s"));
    ask(ate_m < rung.error_of_path * path_m, format!("ATE {ate_m} m over {path_m} m"));
    ask(ln_s < (3.0 * sigma).max(0.01), format!("|ln s| {ln_s} at a stated {sigma}"));
    ask(json["lost"] == serde_json::json!([]), format!("lost: {}", json["lost"]));
    (line, wrong)
}

fn climb_all(rungs: &[Rung], seeds: &[u64]) {
    let mut wrong = Vec::new();
    eprintln!(
        "| rung | first state, s | live SE(3) m | live \\|ln s\\| | final: images | SE(3) m (of the path) | \\|ln s\\| (σ) |"
    );
    for (k, rung) in rungs.iter().enumerate() {
        for seed in seeds {
            let (line, found) = climb(rung, seed + k as u64);
            eprintln!("{line}");
            wrong.extend(
                found.into_iter().map(|what| format!("{}, seed {}: {what}", rung.name, seed + k as u64)),
            );
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn the_short_rungs_of_the_ladder_hold() {
    climb_all(&SHORT, &[9500]);
}

#[test]
#[ignore = "long form: cargo test -p vidar-cli --test program -- --ignored --nocapture every_rung_of_the_ladder"]
fn every_rung_of_the_ladder_holds() {
    let all: Vec<Rung> = REST.into_iter().chain(SHORT).collect();
    climb_all(&all, &[9600, 9700, 9800]);
}

/// Numbers of a file's rows; what is no number is left out.
fn rows(file: &Path) -> Vec<Vec<f64>> {
    let text = std::fs::read_to_string(file).unwrap();
    let data = text.lines().filter(|line| !line.starts_with('#'));
    data.map(|line| line.split([',', ' ']).filter_map(|word| word.parse().ok()).collect()).collect()
}

/// |ln s| of the last five seconds of live states, by the scatter of their positions, and σ as the last one told it.
fn live_scale_at_the_end(folder: &Path) -> (f64, f64) {
    let live = rows(&folder.join("out/trajectory/odometry_body.tum"));
    let truth = rows(&folder.join("recording/mav0/state_groundtruth_estimate0/data.csv"));
    let end = live.last().unwrap()[0];
    let late: Vec<&Vec<f64>> = live.iter().filter(|row| row[0] > end - 5.0).collect();
    // Truth has 200 rows a second: the nearest is 2 mm away at most.
    let true_at =
        |secs: f64| truth[truth.partition_point(|row| 1e-9 * row[0] < secs).min(truth.len() - 1)].clone();
    let scatter = |places: Vec<[f64; 3]>| {
        let mean = |axis: usize| places.iter().map(|p| p[axis]).sum::<f64>() / places.len() as f64;
        let mean = [mean(0), mean(1), mean(2)];
        places.iter().flat_map(|p| (0..3).map(move |k| (p[k] - mean[k]).powi(2))).sum::<f64>().sqrt()
    };
    let place = |row: &[f64]| [row[1], row[2], row[3]];
    let told = scatter(late.iter().map(|row| place(row)).collect());
    let real = scatter(late.iter().map(|row| place(&true_at(row[0]))).collect());
    let health = std::fs::read_to_string(folder.join("out/odometry/health.csv")).unwrap();
    let sigma = health.lines().last().unwrap().split(',').nth(5).unwrap().parse().unwrap();
    ((told / real).ln().abs(), sigma)
}

/// A body that moves steadily shows its scale late: the state begins without it, adjustments on the way settle it, and the one after the end
/// finds it. In this hall rounds of the adjustment that ended with too much damping had left it 24 % off, and the live scale of such halls was
/// up to 70 % off in the end at a stated 9 %.
#[test]
fn a_steady_walk_through_a_hall_has_a_trajectory_and_a_scale() {
    let steady = rung("a steady walk through a hall", |c| {
        (c.scene, c.flight, c.duration_secs) = (vidar::synth::SceneKind::Hall, FlightKind::Sweep, 20.0);
        (c.device.readout_secs, c.device.stamp_delay_secs) = (0.03, 0.025);
    });
    let folder = tempfile::tempdir().unwrap();
    let (line, wrong) = climb_in(folder.path(), &steady, 32);
    assert!(wrong.is_empty(), "{line} {wrong:#?}");
    let (ln_s, sigma) = live_scale_at_the_end(folder.path());
    eprintln!("{line} live in the end: {ln_s:.4} ({sigma:.4})");
    assert!(sigma < 0.2 && ln_s < 2.5 * sigma, "the live scale is {ln_s} off in the end at a stated {sigma}");
}

#[test]
fn what_the_imu_does_not_bridge_is_told_and_joined_by_no_guess() {
    let folder = tempfile::tempdir().unwrap();
    let sequence = folder.path().join("recording");
    render(&Rung { imu_gap_secs: 0.6, ..rung("0.6 s without IMU measurements", |_| {}) }, 9808, &sequence);
    let mut program = command();
    program.arg("odometry").arg(&sequence).arg("-o").arg(folder.path().join("out")).args(["--json", "-q"]);
    let ran =
        ProgramOutput::from(program.output().unwrap()).ends_with(3).says(&["no IMU measurement for 0.6"]);
    let json = ran.json();
    let path_m = number(&json, "/final/trajectory/matched_truth_path_m");
    let ate_m = number(&json, "/final/trajectory/ate_se3_m/rmse");
    assert!(ate_m < 0.01 * path_m, "ATE {ate_m} m over {path_m} m: {}", json["final"]);
}
