//! The whole simulator at small size.

use crate::photometry::Photometry;
use crate::render::{RayTable, SynthView, expose, render_views};
use crate::scan::ScanPoint;
use crate::*;
use nalgebra::{Vector2, Vector3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use vidar_core::{
    BodyFrame, CameraModel, FrameImage, LieGroup, Pinhole, Se3, StampedPose, Timestamp, Trajectory,
};

fn small() -> SynthConfig {
    SynthConfig {
        width: 64,
        height: 40,
        duration_secs: 1.0,
        camera_rate_hz: 5.0,
        clutter: 20,
        scan_spacing_m: 0.08,
        ..SynthConfig::default()
    }
}

fn go(_: usize, _: usize) -> bool {
    true
}

/// The small room, built once for all tests.
fn room() -> &'static (FlightPath, World) {
    static ROOM: OnceLock<(FlightPath, World)> = OnceLock::new();
    ROOM.get_or_init(|| {
        let path = FlightPath::built_in(&small()).unwrap();
        let world = World::build(&small(), &path).unwrap();
        (path, world)
    })
}

fn camera_at(path: &FlightPath, secs: f64) -> Se3 {
    path.world_from_body(secs) * euroc_body_from_camera()
}

/// Every file below `root` with its bytes.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(root).unwrap().to_path_buf(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn read_png(path: &Path) -> (usize, usize, png::BitDepth, Vec<u8>) {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    (info.width as usize, info.height as usize, info.bit_depth, bytes)
}

fn read_ply(bytes: &[u8]) -> Vec<Vector3<f64>> {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let count: usize = header.split("vertex ").nth(1).unwrap().lines().next().unwrap().parse().unwrap();
    assert_eq!(bytes.len(), end + 15 * count);
    let float = |b: &[u8]| f64::from(f32::from_le_bytes(b.try_into().unwrap()));
    bytes[end..]
        .chunks_exact(15)
        .map(|c| Vector3::new(float(&c[..4]), float(&c[4..8]), float(&c[8..12])))
        .collect()
}

#[test]
fn a_sequence_has_every_file_of_the_layout_and_agrees_with_the_world() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("a b/ü");
    let summary = write_sequence(&out, &small(), None, &go).unwrap();
    assert_eq!((summary.frames, summary.imu_samples), (5, 201));
    let all = files(&out);
    for name in [
        "synth.toml",
        "truth.json",
        "mav0/body.yaml",
        "mav0/cam0/sensor.yaml",
        "mav0/cam0/data.csv",
        "mav0/depth0/sensor.yaml",
        "mav0/depth0/data.csv",
        "mav0/imu0/sensor.yaml",
        "mav0/imu0/data.csv",
        "mav0/pointcloud0/data.ply",
        "mav0/pointcloud0/sensor.yaml",
        "mav0/state_groundtruth_estimate0/data.csv",
        "mav0/state_groundtruth_estimate0/sensor.yaml",
    ] {
        assert!(all.contains_key(Path::new(name)), "{name} is missing from {:?}", all.keys());
    }
    assert_eq!(all.len(), 13 + 10);
    let text = |name: &str| String::from_utf8(all[Path::new(name)].clone()).unwrap();
    assert!(text("mav0/cam0/sensor.yaml").starts_with("%YAML:1.0\n"));
    assert!(text("mav0/depth0/sensor.yaml").contains("units_per_metre: 5000\n"));
    let truth = text("mav0/state_groundtruth_estimate0/data.csv");
    assert!(truth.lines().skip(1).all(|l| l.split(',').count() == 17));
    let config: SynthConfig = toml::from_str(&text("synth.toml")).unwrap();
    assert_eq!(config, small());

    // Depth images against rays cast here.
    let (path, world) = room();
    let camera = euroc_camera(64, 40).unwrap();
    for k in 0..5 {
        let name = format!("{}.png", 1_600_000_000_000_000_000_i64 + k * 200_000_000);
        let (w, h, depth_bits, bytes) = read_png(&out.join("mav0/depth0/data").join(&name));
        assert_eq!((w, h, depth_bits), (64, 40, png::BitDepth::Sixteen));
        let world_from_camera = camera_at(path, 0.2 * k as f64);
        for (i, z) in
            bytes.chunks_exact(2).map(|b| f64::from(u16::from_be_bytes([b[0], b[1]])) / 5000.0).enumerate()
        {
            let ray = camera.unproject(&Vector2::new((i % 64) as f64, (i / 64) as f64)).unwrap();
            let direction = world_from_camera.rotation * (ray / ray.z);
            let hit = world.cast(&world_from_camera.translation, &direction).unwrap();
            assert!((hit.t - z).abs() < 1.1e-4, "frame {k} pixel {i}: {} m cast, {z} m written", hit.t);
        }
        let (_, _, bits, gray) = read_png(&out.join("mav0/cam0/data").join(&name));
        let mean = gray.iter().map(|&g| f64::from(g)).sum::<f64>() / gray.len() as f64;
        assert_eq!(bits, png::BitDepth::Eight);
        assert!((60.0..190.0).contains(&mean), "mean grey {mean}");
    }

    // The scan lies on the surface, was seen, and misses nothing that was seen.
    let points = read_ply(&all[Path::new("mav0/pointcloud0/data.ply")]);
    assert_eq!(points.len(), summary.scan_points);
    assert!(points.len() > 500);
    let poses: Vec<Se3> = (0..5).map(|k| camera_at(path, 0.2 * f64::from(k))).collect();
    for p in &points {
        assert!(world.clearance_m(p) < 1e-6, "{} m off the surface", world.clearance_m(p));
        let seen = poses.iter().any(|world_from_camera| {
            let pixel = camera.project(&(world_from_camera.inverse() * *p));
            let to_point = p - world_from_camera.translation;
            let open =
                world.cast(&world_from_camera.translation, &to_point).is_some_and(|h| h.t > 1.0 - 1e-5);
            open && pixel.is_some_and(|x| camera.contains(&x, 0.0))
        });
        assert!(seen, "{p:?} was never seen");
    }
    let (mut near, mut asked) = (0, 0);
    for world_from_camera in &poses {
        for i in (0..64 * 40).step_by(13) {
            let ray = camera.unproject(&Vector2::new((i % 64) as f64, (i / 64) as f64)).unwrap();
            let direction = world_from_camera.rotation * ray;
            let hit = world.cast(&world_from_camera.translation, &direction).unwrap();
            asked += 1;
            near += usize::from(points.iter().any(|p| (p - hit.point).norm() < 3.0 * 0.08));
        }
    }
    assert!(near as f64 > 0.97 * f64::from(asked), "{near} of {asked} seen places are in the scan");
}

#[test]
fn bytes_do_not_depend_on_threads_but_on_the_seed() {
    let folder = tempfile::tempdir().unwrap();
    let config = SynthConfig { width: 48, height: 32, duration_secs: 0.6, clutter: 10, ..small() };
    let make = |name: &str, threads: usize, seed: u64| {
        let out = folder.path().join(name);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| write_sequence(&out, &SynthConfig { seed, ..config.clone() }, None, &go)).unwrap();
        files(&out)
    };
    let one = make("one", 1, 3);
    assert_eq!(one, make("four", 4, 3));
    let other = make("other", 4, 4);
    for name in ["mav0/imu0/data.csv", "mav0/pointcloud0/data.ply", "mav0/cam0/data/1600000000000000000.png"]
    {
        assert_ne!(one[Path::new(name)], other[Path::new(name)], "{name}");
    }
}

#[test]
fn cancellation_and_errors_leave_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    for limit in [0, 2, 5] {
        let out = folder.path().join("deep/er");
        let result = write_sequence(&out, &small(), None, &|done, _| done < limit);
        assert!(matches!(result, Err(SynthError::Cancelled)), "{result:?}");
        assert!(!folder.path().join("deep").exists(), "cancelled at {limit}");
    }
    let file = folder.path().join("file");
    std::fs::write(&file, "x").unwrap();
    let result = write_sequence(&file.join("below"), &small(), None, &go);
    assert!(matches!(result, Err(SynthError::Write { .. })), "{result:?}");
    let taken = folder.path().join("taken");
    std::fs::create_dir_all(taken.join("mav0")).unwrap();
    let result = write_sequence(&taken, &small(), None, &go);
    assert!(matches!(result, Err(SynthError::OutputExists { .. })), "{result:?}");
    assert_eq!(std::fs::read_dir(&taken).unwrap().count(), 1);
    // A failure midway: a scan of more points than are allowed.
    let dense = SynthConfig { scan_spacing_m: 0.002, duration_secs: 0.2, ..small() };
    let out = folder.path().join("dense");
    assert!(matches!(write_sequence(&out, &dense, None, &go), Err(SynthError::BadConfig { .. })));
    assert!(!out.exists());
}

#[test]
fn a_full_disk_is_an_error_and_not_a_short_file() {
    let full = Path::new("/dev/full");
    if !full.exists() {
        eprintln!("skipped: no /dev/full here");
        return;
    }
    assert!(image_file::write_gray8(full, 64, 64, &[7; 4096]).is_err());
    assert!(image_file::write_gray16(full, 64, 64, &[7; 4096]).is_err());
    assert!(layout::write_text(full, "text").is_err());
    let point = ScanPoint { position: Vector3::zeros(), gray: 1 };
    assert!(layout::write_ply(full, &[point; 3]).is_err());
}

#[test]
fn every_scene_keeps_clear_of_every_flight_and_fills_every_pixel() {
    for scene in [SceneKind::Room, SceneKind::Hall, SceneKind::Corridor] {
        for (flight, start) in [
            (FlightKind::Sweep, Start::InFlight),
            (FlightKind::Orbit, Start::Static { secs: 0.5 }),
            (FlightKind::Aggressive, Start::InFlight),
        ] {
            let config =
                SynthConfig { scene, flight, start, duration_secs: 5.0, width: 32, height: 20, ..small() };
            let path = FlightPath::built_in(&config).unwrap();
            let world = World::build(&config, &path).unwrap();
            assert!(world.shape_count() > 20, "{scene:?} {flight:?}: {} shapes", world.shape_count());
            for p in path.positions(0.01) {
                assert!(world.clearance_m(&p) >= 0.4, "{scene:?} {flight:?}: {} m", world.clearance_m(&p));
            }
            let camera = euroc_camera(32, 20).unwrap();
            let view = SynthView { world_from_camera: camera_at(&path, 2.5), camera };
            let seen = render_views(&world, &[view], 1).unwrap().remove(0);
            assert_eq!(seen.depth.valid_ratio(), 1.0);
        }
    }
}

#[test]
fn a_world_is_built_around_a_given_trajectory() {
    let poses = (0..100).map(|k| {
        let t = 0.05 * f64::from(k);
        let position = Vector3::new(100.0 + 3.0 * t, -20.0 + t.sin(), 5.0);
        let time = Timestamp::from_nanos(i64::from(k) * 50_000_000);
        StampedPose { time, world_from_body: Se3::from_translation(position) }
    });
    let trajectory = Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap();
    let config = SynthConfig { duration_secs: 100.0, ..small() };
    let path = FlightPath::new(&config, Some(&trajectory)).unwrap();
    let world = World::build(&config, &path).unwrap();
    for p in path.positions(0.01) {
        assert!(world.clearance_m(&p) >= 0.4);
        assert!(world.extent().distance(&p) == 0.0);
    }
}

#[test]
fn two_views_agree_on_what_they_see() {
    let (path, world) = room();
    let camera = CameraModel::Pinhole(Pinhole::new(110.0, 110.0, 79.5, 59.5, 160, 120).unwrap());
    let view = |secs| SynthView { world_from_camera: camera_at(path, secs), camera: camera.clone() };
    let views = [view(0.3), view(0.6)];
    let rendered = render_views(world, &views, 1).unwrap();
    let gray = |k: usize| match &rendered[k].image {
        FrameImage::Gray8(image) => image,
        other => panic!("{other:?}"),
    };
    let (mut differences, mut n) = (0.0, 0);
    for y in (0..120).step_by(3) {
        for x in (0..160).step_by(3) {
            let z = f64::from(rendered[0].depth.image()[(x, y)]);
            let point = views[0].world_from_camera * (camera.intrinsics().ray(x as f64, y as f64) * z);
            let (a, b) = (views[0].world_from_camera.translation, views[1].world_from_camera.translation);
            let Some(pixel) = camera.project(&(views[1].world_from_camera.inverse() * point)) else {
                continue;
            };
            let (from_a, from_b) =
                (world.cast(&a, &(point - a)).unwrap(), world.cast(&b, &(point - b)).unwrap());
            assert!((from_a.t - 1.0).abs() < 1e-5, "depth leads back to the surface");
            if (from_b.t - 1.0).abs() > 1e-5 || !camera.contains(&pixel, 2.0) {
                continue;
            }
            let (texture_a, texture_b) = (world.radiance(&from_a, 0.02), world.radiance(&from_b, 0.02));
            assert!((texture_a - texture_b).abs() < 2e-3, "{texture_a} {texture_b}");
            let near = gray(1)[(pixel.x.round() as usize, pixel.y.round() as usize)];
            differences += (f64::from(gray(0)[(x, y)]) - f64::from(near)).abs();
            n += 1;
        }
    }
    assert!(n > 500, "only {n} places are seen by both");
    let mean = differences / f64::from(n);
    assert!(mean < 12.0, "mean difference of the pictures {mean}");
}

#[test]
fn long_exposures_blur_and_short_ones_do_not() {
    let (_, world) = room();
    let rays = RayTable::new(&euroc_camera(64, 40).unwrap(), 5);
    let still = camera_at(&room().0, 0.5);
    let shaken: Vec<Se3> = (0..5)
        .map(|s| still.plus(&nalgebra::Vector6::new(0.0, 0.06 * f64::from(s - 2), 0.0, 0.0, 0.0, 0.0)))
        .collect();
    let (sharp, blurred) = (expose(world, &rays, |_, _| still), expose(world, &rays, |s, _| shaken[s]));
    let edges = |image: &[f32]| image.windows(2).map(|w| (w[1] - w[0]).abs()).sum::<f32>();
    assert!(edges(&blurred.radiance) < 0.85 * edges(&sharp.radiance));
    assert_eq!(sharp.depth, blurred.depth, "depth is that of the middle of the exposure");
}

#[test]
fn sensor_noise_has_the_stated_size_and_exposure_drifts_within_its_amplitude() {
    let config = SynthConfig { width: 300, height: 200, image_noise_sigma: 3.0, vignetting: 0.0, ..small() };
    let photometry = Photometry::new(&SynthConfig { exposure_drift: 0.0, ..config.clone() });
    for (level, expected) in [(128.0, 3.0), (32.0, 3.0 * (0.5_f64 + 0.5 * 0.25).sqrt())] {
        let image = photometry.develop(&vec![level as f32 / 255.0; 60_000], 0, 1.0);
        let mean = image.iter().map(|&g| f64::from(g)).sum::<f64>() / 6e4;
        let variance = image.iter().map(|&g| (f64::from(g) - mean).powi(2)).sum::<f64>() / 6e4;
        // Rounding to whole levels adds 1/12.
        let sigma = (variance - 1.0 / 12.0).sqrt();
        assert!(
            (mean - level).abs() < 0.1 && (sigma / expected - 1.0).abs() < 0.02,
            "{mean} {sigma} {expected}"
        );
    }
    assert_ne!(photometry.develop(&[0.5; 100], 0, 1.0), photometry.develop(&[0.5; 100], 1, 1.0));
    let drifting = Photometry::new(&SynthConfig { exposure_drift: 0.2, ..config });
    let gains: Vec<f64> = (0..600).map(|k| drifting.gain(0.1 * f64::from(k))).collect();
    assert!(gains.iter().all(|g| (0.8..=1.2).contains(g)));
    assert!(gains.iter().any(|&g| g < 0.92) && gains.iter().any(|&g| g > 1.08));
    assert!(gains.windows(2).all(|w| (w[1] - w[0]).abs() < 0.03), "it drifts slowly");
}

#[test]
fn a_still_imu_shows_the_noise_of_its_data_sheet() {
    let config =
        SynthConfig { start: Start::Static { secs: 60.0 }, duration_secs: 60.0, ..SynthConfig::default() };
    let path = FlightPath::built_in(&config).unwrap();
    let record = simulate_imu(&path, &config);
    assert_eq!(record.samples.len(), 12_001);
    let noise = config.imu_noise;
    let gyro: Vec<Vector3<f64>> = record.samples.iter().map(|s| s.gyro.0).collect();
    let accel: Vec<Vector3<f64>> = record.samples.iter().map(|s| s.accel.0).collect();
    // Allan deviation at τ: white noise of density σ gives σ/√τ.
    let allan = |values: &[Vector3<f64>], per_cluster: usize| {
        let clusters: Vec<Vector3<f64>> = values
            .chunks_exact(per_cluster)
            .map(|c| c.iter().sum::<Vector3<f64>>() / per_cluster as f64)
            .collect();
        let sum: f64 = clusters.windows(2).map(|w| (w[1] - w[0]).norm_squared() / 3.0).sum();
        (0.5 * sum / (clusters.len() - 1) as f64).sqrt()
    };
    for per_cluster in [1, 10] {
        let tau = per_cluster as f64 / 200.0;
        let found = [allan(&gyro, per_cluster), allan(&accel, per_cluster)].map(|a| a * tau.sqrt());
        let sheet = [noise.gyro_noise_density, noise.accel_noise_density];
        for k in 0..2 {
            assert!((found[k] / sheet[k] - 1.0).abs() < 0.04, "τ = {tau} s: {} for {}", found[k], sheet[k]);
        }
    }
    for (bias, sheet) in
        [(&record.gyro_bias, noise.gyro_random_walk), (&record.accel_bias, noise.accel_random_walk)]
    {
        let steps: f64 = bias.windows(2).map(|w| (w[1] - w[0]).norm_squared() / 3.0).sum();
        let found = (steps / 12_000.0 * 200.0).sqrt();
        assert!((found / sheet - 1.0).abs() < 0.02, "{found} for {sheet}");
    }
    // Without noise: gravity along the body's x, nothing else.
    let exact = simulate_imu(&path, &SynthConfig { imu_noise_scale: 0.0, ..config });
    let still = exact.samples[100];
    assert_eq!(still.gyro.0, Vector3::zeros());
    assert!((still.accel.0.norm() - 9.81).abs() < 1e-12);
}

#[test]
fn the_camera_is_eurocs_at_full_size_and_keeps_its_middle_when_cut() {
    let full = euroc_camera(752, 480).unwrap();
    assert!((full.intrinsics().fx - 458.654).abs() < 1e-9 && (full.intrinsics().cy - 248.375).abs() < 1e-9);
    let half = euroc_camera(376, 240).unwrap();
    let ray = full.unproject(&Vector2::new(300.5, 100.5)).unwrap();
    let pixel = half.project(&ray).unwrap();
    assert!((pixel - Vector2::new(150.0, 50.0)).norm() < 1e-6, "{pixel}");
    let square = euroc_camera(480, 480).unwrap();
    assert!((square.intrinsics().cx - (367.215 - 136.0)).abs() < 1e-9);
}
