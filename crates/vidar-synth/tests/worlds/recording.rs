//! Ordinary recordings: rolling shutter, clocks, compression, IMU timing, calibration files, bare walls, hand-held paths.

use std::path::Path;
use vidar_core::{FrameImage, Image, LieGroup, Timestamp};
use vidar_synth::{
    CalibrationKind, DeviceConfig, FlightKind, FlightPath, ImuTiming, Lens, Mount, Simulation, Start,
    SynthConfig, SynthView, render_views, simulate_imu, write_sequence,
};

/// A small lively recording without noise, blur or photometric effects.
fn exact(device: DeviceConfig) -> SynthConfig {
    let distortion = [0.05, -0.08, 0.0, 0.0];
    let lens = Lens::Radtan { focal_px: 70.0, centre_offset_px: [1.0, -2.0], distortion };
    SynthConfig {
        flight: FlightKind::HandheldLively,
        start: Start::InFlight,
        duration_secs: 2.0,
        camera_rate_hz: 2.0,
        width: 96,
        height: 72,
        exposure_secs: 0.0,
        blur_samples: 1,
        exposure_drift: 0.0,
        image_noise_sigma: 0.0,
        vignetting: 0.0,
        clutter: 15,
        depth: false,
        scan_spacing_m: 0.3,
        device: DeviceConfig { lens, mount: Mount::Phone, ..device },
        ..SynthConfig::default()
    }
}

fn write(out: &Path, config: &SynthConfig) {
    write_sequence(out, config, None, &|_, _| true).unwrap();
}

/// Stamps and files of cam0.
fn images(out: &Path) -> Vec<(i64, std::path::PathBuf)> {
    let text = std::fs::read_to_string(out.join("mav0/cam0/data.csv")).unwrap();
    let row = |line: &str| {
        let (stamp, name) = line.split_once(',').unwrap();
        (stamp.parse().unwrap(), out.join("mav0/cam0/data").join(name))
    };
    text.lines().skip(1).map(row).collect()
}

fn gray(path: &Path) -> image::GrayImage {
    image::open(path).unwrap().into_luma8()
}

/// Mean difference of grey levels in a row.
fn row_difference(a: &image::GrayImage, b: &Image<u8>, row: usize) -> f64 {
    let width = b.width();
    let off = |x: usize| f64::from(a.get_pixel(x as u32, row as u32).0[0]) - f64::from(b[(x, row)]);
    (0..width).map(|x| off(x).abs()).sum::<f64>() / width as f64
}

#[test]
fn a_row_of_a_rolling_shutter_is_the_global_image_at_its_own_time() {
    let folder = tempfile::tempdir().unwrap();
    let readout_secs = 0.033;
    let config = exact(DeviceConfig { readout_secs, ..DeviceConfig::default() });
    write(folder.path(), &config);
    let simulation = Simulation::open(folder.path()).unwrap();
    let camera = config.camera().unwrap();
    let (mut own, mut middle) = (0.0, 0.0);
    let images = images(folder.path());
    for (stamp, file) in &images {
        let rolling = gray(file);
        for row in [0, 9, 30, 53, 71] {
            let delay = (row as f64 / 71.0 - 0.5) * readout_secs;
            let at = |delay: f64| {
                let time = Timestamp::from_nanos(stamp + (delay * 1e9).round() as i64);
                let secs = (time.nanos() - images[0].0) as f64 * 1e-9;
                let world_from_camera = simulation.path().world_from_body(secs) * config.body_from_camera();
                let view = SynthView { world_from_camera, camera: camera.clone() };
                match render_views(simulation.world(), &[view], 1).unwrap().remove(0).image {
                    FrameImage::Gray8(image) => image,
                    other => panic!("{other:?}"),
                }
            };
            own += row_difference(&rolling, &at(delay), row);
            middle += row_difference(&rolling, &at(0.0), row);
        }
    }
    let n = 5.0 * images.len() as f64;
    // Two rows share a pose, which is half a row's time from each: 0.2 ms here.
    assert!(own / n < 1.0, "rows differ by {} grey levels from their own time", own / n);
    assert!(middle > 4.0 * own, "{middle} from the middle's time, {own} from their own");
}

#[test]
fn two_rows_may_share_a_pose_because_the_error_is_below_a_tenth_of_a_pixel() {
    for config in [SynthConfig::phone_slow(), SynthConfig::phone_fast(), SynthConfig::realsense()] {
        let path = FlightPath::built_in(&config).unwrap();
        let fastest =
            (0..3000).map(|k| path.state(0.01 * f64::from(k)).angular_rate.norm()).fold(0.0, f64::max);
        let half_row_secs = 0.5 * config.device.readout_secs / (config.height - 1) as f64;
        let error_px = fastest * half_row_secs * config.camera().unwrap().intrinsics().fx;
        assert!(error_px < 0.1, "{error_px} px at {fastest} rad/s");
    }
}

#[test]
fn late_stamps_change_names_and_nothing_that_is_seen() {
    let (exact_folder, late_folder) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let readout_secs = 0.02;
    write(exact_folder.path(), &exact(DeviceConfig { readout_secs, ..DeviceConfig::default() }));
    let late = exact(DeviceConfig { readout_secs, stamp_delay_secs: 0.044, ..DeviceConfig::default() });
    write(late_folder.path(), &late);
    for ((a, file_a), (b, file_b)) in images(exact_folder.path()).iter().zip(&images(late_folder.path())) {
        assert_eq!(b - a, 44_000_000);
        assert_eq!(std::fs::read(file_a).unwrap(), std::fs::read(file_b).unwrap());
    }
    let truth = std::fs::read_to_string(late_folder.path().join("truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
    assert_eq!(truth["camera"]["stamp_delay_secs"], 0.044);
    assert_eq!(truth["camera"]["imu_time_minus_stamp_secs"], -0.044);
    assert_eq!(truth["camera"]["readout_secs"], 0.02);
}

#[test]
fn jpegs_are_smaller_with_lower_quality_and_close_to_the_lossless_image() {
    let write_at = |jpeg_quality: u8| {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), &exact(DeviceConfig { jpeg_quality, ..DeviceConfig::default() }));
        let files = images(folder.path());
        let bytes: u64 = files.iter().map(|(_, f)| std::fs::metadata(f).unwrap().len()).sum();
        let pictures: Vec<image::GrayImage> = files.iter().map(|(_, f)| gray(f)).collect();
        let extension = files[0].1.extension().unwrap().to_str().unwrap().to_owned();
        (bytes, pictures, extension)
    };
    let (lossless, coarse, fine) = (write_at(0), write_at(70), write_at(90));
    assert_eq!([&lossless.2, &coarse.2, &fine.2], ["png", "jpg", "jpg"]);
    assert!(coarse.0 < fine.0 && fine.0 < lossless.0, "{} {} {}", coarse.0, fine.0, lossless.0);
    let difference = |a: &[image::GrayImage], b: &[image::GrayImage]| {
        let pixels = a.iter().zip(b).flat_map(|(a, b)| a.iter().zip(b.iter()));
        let (sum, n) = pixels.fold((0.0, 0.0), |(s, n), (a, b)| (s + f64::from(a.abs_diff(*b)), n + 1.0));
        sum / n
    };
    let (off_coarse, off_fine) = (difference(&coarse.1, &lossless.1), difference(&fine.1, &lossless.1));
    assert!(off_fine > 0.0 && off_fine < off_coarse && off_coarse < 8.0, "{off_fine} {off_coarse}");
}

#[test]
fn repeated_frames_show_the_same_image_under_two_stamps() {
    let folder = tempfile::tempdir().unwrap();
    let device = DeviceConfig { repeated_frames: 0.4, dropped_frames: 0.1, ..DeviceConfig::default() };
    write(folder.path(), &SynthConfig { camera_rate_hz: 10.0, ..exact(device) });
    let truth = std::fs::read_to_string(folder.path().join("truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
    let repeated = truth["camera"]["repeated_stamps_nanos"].as_array().unwrap();
    assert!(!repeated.is_empty());
    let images = images(folder.path());
    assert!(images.len() < 20, "no frame was dropped");
    for pair in images.windows(2) {
        let same = std::fs::read(&pair[0].1).unwrap() == std::fs::read(&pair[1].1).unwrap();
        assert_eq!(same, repeated.iter().any(|stamp| stamp.as_i64() == Some(pair[1].0)));
    }
}

#[test]
fn the_calibration_is_given_partial_or_absent() {
    let sensor = |calibration: CalibrationKind| {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), &exact(DeviceConfig { calibration, ..DeviceConfig::default() }));
        let imu = folder.path().join("mav0/imu0/sensor.yaml").exists();
        (std::fs::read_to_string(folder.path().join("mav0/cam0/sensor.yaml")).ok(), imu)
    };
    let (given, imu) = sensor(CalibrationKind::Given);
    let given = given.unwrap();
    assert!(given.contains("T_BS") && given.contains("intrinsics: [70.0, 70.0, 48.5, 33.5]") && imu);
    let (partial, imu) = sensor(CalibrationKind::Partial);
    let partial = partial.unwrap();
    assert!(
        !partial.contains("T_BS")
            && partial.contains("distortion_coefficients: [0.0, 0.0, 0.0, 0.0]")
            && !imu
    );
    assert!(!partial.contains("intrinsics: [70.0,"), "the focal length is only about right");
    assert_eq!(sensor(CalibrationKind::Absent), (None, false));
}

#[test]
fn imu_samples_are_timed_as_asked_and_agree_with_the_motion() {
    let of = |device: DeviceConfig| {
        let config = SynthConfig { duration_secs: 20.0, imu_noise_scale: 0.0, ..exact(device) };
        let path = FlightPath::built_in(&config).unwrap();
        (simulate_imu(&path, &config), path)
    };
    for (imu_timing, rows) in [
        (ImuTiming::Regular, 4001..4002),
        (ImuTiming::Jittered, 4002..4030),
        (ImuTiming::Interleaved, 7900..8030),
    ] {
        let (record, path) = of(DeviceConfig { imu_timing, ..DeviceConfig::default() });
        assert!(rows.contains(&record.samples.len()), "{imu_timing:?}: {} rows", record.samples.len());
        let begin = record.samples[0].time.nanos() - record.samples[0].time.nanos() % 1_000_000_000;
        for pair in record.samples.windows(2) {
            assert!(pair[0].time <= pair[1].time, "{imu_timing:?}");
        }
        for sample in &record.samples {
            let secs = (sample.time.nanos() - begin) as f64 * 1e-9;
            // Linear interpolation between samples of the other sensor errs at second order only.
            assert!(
                (sample.gyro.0 - path.state(secs).angular_rate).norm() < 0.02,
                "{imu_timing:?} at {secs}"
            );
            assert!((sample.accel.0 - path.specific_force(secs)).norm() < 0.2, "{imu_timing:?} at {secs}");
        }
    }
    let (whole, _) = of(DeviceConfig::default());
    let (gapped, _) = of(DeviceConfig { imu_gaps_per_min: 15.0, ..DeviceConfig::default() });
    let gaps = gapped.samples.windows(2).filter(|w| (w[1].time - w[0].time).as_secs_f64() > 0.015).count();
    assert!((3..=5).contains(&gaps) && gapped.samples.len() < whole.samples.len(), "{gaps} gaps");
    let (scaled, _) = of(DeviceConfig { imu_scale_sigma: 0.01, ..DeviceConfig::default() });
    let ratio = scaled.samples[100].accel.0.x / whole.samples[100].accel.0.x;
    assert!((ratio - 1.0).abs() > 1e-4 && (ratio - 1.0).abs() < 0.05, "{ratio}");
}

#[test]
fn hand_held_paths_are_slow_stay_in_the_room_and_differ_by_seed() {
    let mut ends = Vec::new();
    for (flight, limit) in
        [(FlightKind::Handheld, (0.8, 1.6, 3.0)), (FlightKind::HandheldLively, (2.6, 3.5, 12.0))]
    {
        for seed in 0..6 {
            let config = SynthConfig { seed, flight, duration_secs: 60.0, ..exact(DeviceConfig::default()) };
            let path = FlightPath::built_in(&config).unwrap();
            let states: Vec<_> = (0..6000).map(|k| path.state(0.01 * f64::from(k))).collect();
            let speeds: Vec<f64> = states.iter().map(|s| s.velocity_in_world.norm()).collect();
            let fastest = speeds.iter().copied().fold(0.0, f64::max);
            let rate = states.iter().map(|s| s.angular_rate.norm()).fold(0.0, f64::max);
            let acceleration = states.iter().map(|s| s.acceleration_in_world.norm()).fold(0.0, f64::max);
            assert!(
                fastest < limit.0 && rate < limit.1 && acceleration < limit.2,
                "{flight:?} {seed}: {fastest} m/s, {rate} rad/s, {acceleration} m/s²"
            );
            let slow = speeds.iter().filter(|v| **v < 0.2).count();
            assert!(flight != FlightKind::Handheld || slow > 2000, "stands or turns for {slow} of 6000");
            for state in &states {
                let p = state.world_from_body.translation;
                assert!(p.x.abs() < 3.0 && p.y.abs() < 3.0 && (1.1..1.8).contains(&p.z), "{p}");
            }
            ends.push(path.world_from_body(60.0).translation);
        }
    }
    assert!(ends.windows(2).all(|w| (w[1] - w[0]).norm() > 0.01));
}

#[test]
fn a_static_start_holds_the_hand_nearly_still() {
    let start = Start::Static { secs: 3.0 };
    let config = SynthConfig { start, duration_secs: 8.0, ..SynthConfig::realsense() };
    let path = FlightPath::built_in(&config).unwrap();
    let moved = |from: f64, until: f64| {
        let difference = path.world_from_body(from).inverse() * path.world_from_body(until);
        difference.translation.norm()
    };
    assert!((0..28).all(|k| moved(0.0, 0.1 * f64::from(k)) < 0.02));
    assert!((0..80).any(|k| moved(0.0, 0.1 * f64::from(k)) > 0.05));
}

#[test]
fn bare_surfaces_cover_the_asked_share_of_what_a_path_sees() {
    let base = SynthConfig { duration_secs: 1.0, clutter: 0, ..exact(DeviceConfig::default()) };
    // Share of directions in which the surface's grey level changes by more than 3 of 255 within 0.01 rad.
    let textured = |bare_share: f64| {
        let simulation = Simulation::new(&SynthConfig { bare_share, ..base.clone() }, None).unwrap();
        let room = simulation.world().extent();
        let eye = (room.min + room.max) * 0.5;
        let radiance = |angle: f64, rise: f64| {
            let direction = nalgebra::Vector3::new(angle.cos(), angle.sin(), rise);
            let hit = simulation.world().cast(&eye, &direction).unwrap();
            simulation.world().radiance(&hit, 0.004)
        };
        let (mut found, mut all) = (0.0, 0.0);
        for k in 0..40_000 {
            let (angle, rise) = (f64::from(k) * 2.399_963, 3.0 * (f64::from(k) / 20_000.0 - 1.0));
            let differs = (radiance(angle, rise) - radiance(angle + 0.01, rise)).abs();
            found += if differs > 0.012 { 1.0 } else { 0.0 };
            all += 1.0;
        }
        found / all
    };
    let (none, third, whole) = (textured(0.0), textured(0.34), textured(1.0));
    assert!(whole < 0.2 * none, "{none} textured, {whole} of it when all is bare");
    // Faces differ in how much texture they have.
    assert!(third < 0.85 * none && third > 0.45 * none, "{none} {third} {whole}");
}

#[test]
fn other_mounts_move_the_body_and_not_the_camera() {
    let at = |mount: Mount| {
        let device = DeviceConfig { mount, ..DeviceConfig::default() };
        let config =
            SynthConfig { flight: FlightKind::Orbit, device, duration_secs: 3.0, ..SynthConfig::default() };
        FlightPath::built_in(&config).unwrap().world_from_body(1.0) * config.body_from_camera()
    };
    let euroc = at(Mount::Euroc);
    for mount in [Mount::TumVi, Mount::Phone, Mount::AnyAxes] {
        let off = euroc.inverse() * at(mount);
        // The spline of another point of the body is another curve by a little.
        assert!(off.translation.norm() < 2e-3 && off.rotation.angle_rad() < 2e-3, "{mount:?}: {off:?}");
    }
}
