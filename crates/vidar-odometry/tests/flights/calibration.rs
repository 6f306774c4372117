//! Calibration from nothing on simulated hand-held recordings: tracks with outliers, rolling shutter, a late clock, any
//! mount, a distorted lens, a consumer gyroscope.

use vidar_core::LieGroup;
use vidar_core::camera::Pinhole;
use vidar_odometry::calibration::{Calibration, CalibrationLog, KnownCamera, LensModel};
use vidar_odometry::simulate::Handheld;

/// Errors of one recording, and errors over standard deviations.
struct Errors {
    focal_percent: f64,
    clock_ms: f64,
    rotation_deg: f64,
    readout_ms: f64,
    sigmas: [f64; 4],
}

fn errors(truth: &Handheld, found: &Calibration) -> Errors {
    let focal = found.focal_px.value - truth.focal;
    let clock = found.time_offset_secs.value - truth.offset_secs;
    let readout = found.readout_secs.value - truth.readout_secs;
    let turn = (truth.body_from_camera.inverse() * found.body_from_camera).log();
    let worst = (0..3).map(|a| turn[a].abs() / found.rotation_sigmas[a]).fold(0.0, f64::max);
    Errors {
        focal_percent: 100.0 * focal.abs() / truth.focal,
        clock_ms: 1e3 * clock.abs(),
        rotation_deg: turn.norm().to_degrees(),
        readout_ms: 1e3 * readout.abs(),
        sigmas: [
            focal.abs() / found.focal_px.sigma,
            clock.abs() / found.time_offset_secs.sigma,
            worst,
            readout.abs() / found.readout_secs.sigma,
        ],
    }
}

fn log_of(truth: &Handheld) -> CalibrationLog {
    let recording = truth.record();
    let mut log = CalibrationLog::default();
    recording.samples.iter().for_each(|s| log.add_gyro(s));
    recording.images.into_iter().for_each(|(stamp, features)| log.add_image(stamp, features.into_iter()));
    log
}

fn calibrate(truth: &Handheld) -> Calibration {
    log_of(truth).calibrate(truth.size.0, truth.size.1, &KnownCamera::default()).unwrap()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Slow or short recordings may tell little, but what they tell holds.
#[test]
fn a_slow_hand_gives_what_its_standard_deviations_say_or_nothing() {
    for seed in 0..4 {
        let truth = Handheld { turning: 0.06, moving: 0.1, secs: 10.0, ..Handheld::draw(seed) };
        let nothing = KnownCamera::default();
        let Ok(found) = log_of(&truth).calibrate(truth.size.0, truth.size.1, &nothing) else { continue };
        let e = errors(&truth, &found);
        println!(
            "slow {seed}: f {:.2} % clock {:.2} ms turn {:.2} deg readout {:.2} ms {:.1?}",
            e.focal_percent, e.clock_ms, e.rotation_deg, e.readout_ms, e.sigmas
        );
        let observable = [
            found.focal_px.is_observable,
            found.time_offset_secs.is_observable,
            found.rotation_is_observable,
            found.readout_secs.is_observable,
        ];
        for (sigmas, is_observable) in e.sigmas.iter().zip(observable) {
            assert!(!is_observable || *sigmas < 4.0, "{seed}: {:?} {observable:?}", e.sigmas);
        }
    }
}

/// A lens that was measured, 0.5 % off, is believed where a hand turns little, and what is found with it is as far off as is said.
#[test]
fn a_given_lens_is_believed_as_far_as_it_is_worth() {
    let draws: u64 = std::env::var("VIDAR_CALIBRATION_DRAWS").map_or(6, |d| d.parse().unwrap());
    let (mut by_lens, mut by_nothing) = (Vec::new(), Vec::new());
    for seed in 0..draws {
        let truth = Handheld { turning: 0.06, moving: 0.1, secs: 10.0, ..Handheld::draw(seed) };
        let (width, height) = truth.size;
        let (focal, centre) = (1.005 * truth.focal, truth.centre);
        let pinhole = Pinhole::new(focal, focal, centre.x, centre.y, width, height).unwrap();
        let lens = LensModel::RadTan.camera(pinhole, truth.radial).unwrap();
        let log = log_of(&truth);
        let given = KnownCamera { lens: Some(&lens), ..KnownCamera::default() };
        let (Ok(with), Ok(without)) =
            (log.calibrate(width, height, &given), log.calibrate(width, height, &KnownCamera::default()))
        else {
            continue;
        };
        assert!(with.off_given_lens.is_some_and(|off| off < 2.0) && without.off_given_lens.is_none());
        let (with, without) = (errors(&truth, &with), errors(&truth, &without));
        for e in [&with, &without] {
            println!(
                "given {seed}: f {:.2} % clock {:.2} ms turn {:.2}° readout {:.2} ms {:.1?}",
                e.focal_percent, e.clock_ms, e.rotation_deg, e.readout_ms, e.sigmas
            );
        }
        by_lens.push(with);
        by_nothing.push(without);
    }
    assert!(2 * by_lens.len() as u64 > draws, "{} of {draws}", by_lens.len());
    let beyond = by_lens.iter().flat_map(|e| e.sigmas).filter(|s| *s > 3.0).count();
    assert!(50 * beyond <= 4 * by_lens.len(), "{beyond} beyond 3 sigma");
    let focal = |all: &[Errors]| median(all.iter().map(|e| e.focal_percent).collect());
    let (with, without) = (focal(&by_lens), focal(&by_nothing));
    assert!(with < without, "{with} with, {without} without");
}

/// Action cameras: recordings as many as `VIDAR_CALIBRATION_DRAWS` says, a few by default.
#[test]
fn a_fisheye_is_told_from_a_pinhole_and_calibrated() {
    let draws: u64 = std::env::var("VIDAR_CALIBRATION_DRAWS").map_or(4, |d| d.parse().unwrap());
    let (mut all, mut beyond) = (Vec::new(), 0);
    for seed in 0..draws {
        let truth = Handheld::draw_fisheye(seed);
        let found = calibrate(&truth);
        let e = errors(&truth, &found);
        println!(
            "fisheye {seed}: {:?} f/w {:.2} k1 {:+.3} ({:+.3}) f {:.2} % clock {:.2} ms turn {:.2}° readout {:.2} ms {:.1?}",
            found.lens,
            truth.focal / 640.0,
            truth.radial[0],
            found.radial[0].value - truth.radial[0],
            e.focal_percent,
            e.clock_ms,
            e.rotation_deg,
            e.readout_ms,
            e.sigmas
        );
        assert_eq!(found.lens, LensModel::Equidistant, "{seed}");
        beyond += e.sigmas.iter().filter(|s| **s > 3.0).count();
        all.push(e);
    }
    let of = |value: fn(&Errors) -> f64| median(all.iter().map(value).collect());
    let medians = [of(|e| e.focal_percent), of(|e| e.clock_ms), of(|e| e.rotation_deg), of(|e| e.readout_ms)];
    println!("medians {medians:.3?}, {beyond} of {} beyond 3 sigma", 4 * all.len());
    for (found, goal) in medians.iter().zip([1.5, 3.0, 1.0, 4.0]) {
        assert!(*found < goal, "median {found} above {goal}");
    }
    assert!(50 * beyond <= 4 * all.len(), "{beyond} beyond 3 sigma");
}

/// A stabiliser makes a picture move less than the camera turns, as a shorter focal length and a late clock would: it is found, and what it hides with it.
#[test]
fn a_stabilised_hand_shows_its_lens_and_clock() {
    let draws: u64 = std::env::var("VIDAR_CALIBRATION_DRAWS").map_or(4, |d| d.parse().unwrap());
    let (mut all, mut beyond) = (Vec::new(), 0);
    for seed in 0..draws {
        let hand = Handheld { turning: 0.2, pixel_noise: 0.15, outliers: 0.01, ..Handheld::draw(seed) };
        let truth = Handheld { stabilisation: 0.8, ..hand };
        let found = calibrate(&truth);
        let e = errors(&truth, &found);
        println!(
            "stabilised {seed}: {:.2?} | f {:.2} % clock {:.2} ms turn {:.2}° readout {:.2} ms {:.1?}",
            found.image_shift_rad.map(f64::to_degrees),
            e.focal_percent,
            e.clock_ms,
            e.rotation_deg,
            e.readout_ms,
            e.sigmas
        );
        beyond += e.sigmas.iter().filter(|s| **s > 3.0).count();
        all.push((found.image_shift_rad.is_some(), e));
    }
    let of = |value: fn(&Errors) -> f64| median(all.iter().map(|(_, e)| value(e)).collect());
    let medians = [of(|e| e.focal_percent), of(|e| e.clock_ms), of(|e| e.rotation_deg), of(|e| e.readout_ms)];
    let found = all.iter().filter(|(is_found, _)| *is_found).count();
    println!("medians {medians:.3?}, {beyond} of {} beyond 3 sigma, {found} found", 4 * all.len());
    for (error, goal) in medians.iter().zip([1.5, 3.0, 1.0, 4.0]) {
        assert!(*error < goal, "median {error} above {goal}");
    }
    assert!(50 * beyond <= 4 * all.len(), "{beyond} beyond 3 sigma");
    assert_eq!(found, all.len(), "found of all");
}

/// Recordings: a few by default, as many as `VIDAR_CALIBRATION_DRAWS` says for the table of docs/benchmark/odometry.md.
#[test]
fn twenty_seconds_by_hand_calibrate_camera_and_clock() {
    let draws: u64 = std::env::var("VIDAR_CALIBRATION_DRAWS").map_or(4, |d| d.parse().unwrap());
    let first: u64 = std::env::var("VIDAR_CALIBRATION_FIRST").map_or(1000, |d| d.parse().unwrap());
    let secs: f64 = std::env::var("VIDAR_CALIBRATION_SECS").map_or(20.0, |d| d.parse().unwrap());
    let mut all = Vec::new();
    for seed in first..first + draws {
        let truth = Handheld { secs, ..Handheld::draw(seed) };
        let begin = std::time::Instant::now();
        let found = calibrate(&truth);
        assert_eq!(found.lens, LensModel::RadTan, "{seed}");
        let e = errors(&truth, &found);
        println!(
            "{seed}: f/w {:.2} k1 {:+.2} turn {:.2} move {:.2} px {:.2} ({:.2}) | f {:.2} % k1 {:+.3} k2 {:+.3} clock {:.2} ms turn {:.2}° readout {:.2} ms | sigmas {:.1?} | {:.1} s",
            truth.focal / 640.0,
            truth.radial[0],
            truth.turning,
            truth.moving,
            truth.pixel_noise,
            found.pixel_sigma,
            e.focal_percent,
            found.radial[0].value - truth.radial[0],
            found.radial[1].value - truth.radial[1],
            e.clock_ms,
            e.rotation_deg,
            e.readout_ms,
            e.sigmas,
            begin.elapsed().as_secs_f64()
        );
        all.push(e);
    }
    let of = |value: fn(&Errors) -> f64| median(all.iter().map(value).collect());
    let medians = [of(|e| e.focal_percent), of(|e| e.clock_ms), of(|e| e.rotation_deg), of(|e| e.readout_ms)];
    let beyond = all.iter().flat_map(|e| e.sigmas).filter(|s| *s > 3.0).count();
    println!(
        "medians: f {:.3} %, clock {:.3} ms, rotation {:.3}°, readout {:.3} ms; {beyond} of {} beyond 3 sigma",
        medians[0],
        medians[1],
        medians[2],
        medians[3],
        4 * all.len()
    );
    for (found, goal) in medians.iter().zip([1.5, 3.0, 1.0, 4.0]) {
        assert!(*found < goal, "median {found} above {goal}");
    }
    assert!(50 * beyond <= 4 * all.len(), "{beyond} of {} beyond 3 sigma", 4 * all.len());
}
