//! Layouts of published datasets, written small: what is read, in which frame and unit.

use crate::common::*;
use nalgebra::Vector3;
use std::fmt::Write as _;
use vidar_core::{BodyFrame, CameraId, LieGroup};
use vidar_dataset::{CalibrationSource, OpenOptions, RecordingKind, open};

fn camera(number: u32) -> OpenOptions {
    OpenOptions { camera: CameraId(number), ..Default::default() }
}

#[test]
fn tum_vi_is_calibrated_by_its_camchain() {
    let f = euroc();
    for file in ["mav0/cam0/sensor.yaml", "mav0/imu0/sensor.yaml"] {
        std::fs::remove_file(f.join(file)).unwrap();
    }
    f.write("dso/camchain.yaml", "cam0:\n  T_cam_imu:\n  - [-1, 0, 0, 0.04]\n  - [0, 0, -1, -0.07]\n  - [0, -1, 0, -0.04]\n  - [0, 0, 0, 1]\n  camera_model: pinhole\n  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]\n  distortion_model: equidistant\n  intrinsics: [9.5, 9.6, 7.5, 5.5]\n  resolution: [16, 12]\n");
    f.write("dso/imu_config.yaml", "accelerometer_noise_density: 0.0028\naccelerometer_random_walk: 0.00086\ngyroscope_noise_density: 0.00016\ngyroscope_random_walk: 0.000022\nupdate_rate: 200.0\n");
    let d = f.open().unwrap();
    let first = d.rig.camera(CameraId(0)).unwrap();
    assert_eq!((first.model.name(), first.model.intrinsics().fx), ("pinhole-equidistant", 9.5));
    assert!((first.body_from_camera.inverse().translation - Vector3::new(0.04, -0.07, -0.04)).norm() < 1e-12);
    assert_eq!(d.rig.imu.unwrap().accel_noise_density, 0.0028);
    assert!(
        !kinds(&d).contains(&"imu-noise") && !kinds(&d).contains(&"intrinsics-guessed"),
        "{:?}",
        kinds(&d)
    );
}

/// A projection matrix with a baseline along x.
fn projection(baseline_m: f64) -> String {
    format!("10 0 7.5 {} 0 11 5.5 0 0 0 1 0", -10.0 * baseline_m)
}

#[test]
fn kitti_odometry_has_rectified_cameras_and_poses_of_the_first() {
    let f = Folder::new();
    let (mut times, mut poses) = (String::new(), String::new());
    for i in 0..4 {
        for n in [0, 2] {
            f.write(&format!("sequences/07/image_{n}/00000{i}.png"), gray_png(16, 12, 9));
        }
        let _ = writeln!(times, "{:e}", 0.103_736_2 * i as f64);
        let _ = writeln!(poses, "1 0 0 0 0 1 0 0 0 0 1 {i}");
    }
    let calib = format!("P0: {}\nP1: {}\nP2: {}\n", projection(0.0), projection(0.54), projection(-0.06));
    f.write("sequences/07/times.txt", times).write("sequences/07/calib.txt", calib);
    f.write("poses/07.txt", poses);
    let path = f.join("sequences/07");
    let d = open(&path, &camera(2)).unwrap();
    assert_eq!(
        (d.kind, d.images.len(), d.images[3].time.nanos()),
        (RecordingKind::KittiOdometry, 4, 311_208_600)
    );
    assert!(d.images[0].location.path().ends_with("image_2/000000.png"));
    // Camera 2 is 6 cm left of camera 0, which the poses are of.
    let chosen = d.rig.camera(d.camera).unwrap();
    assert!((chosen.body_from_camera.translation - Vector3::new(-0.06, 0.0, 0.0)).norm() < 1e-12);
    assert_eq!(chosen.model.intrinsics().fy, 11.0);
    let truth = d.ground_truth.as_ref().unwrap();
    assert_eq!((truth.body(), truth.len()), (BodyFrame::Camera(CameraId(0)), 4));
    assert_eq!(d.rig.camera(CameraId(0)).unwrap().body_from_camera.translation, Vector3::zeros());
    let error = open(&path, &camera(3)).unwrap_err().to_string();
    assert!(error.contains("available: camera 0, camera 2"), "{error}");
    f.write("sequences/07/calib.txt", "P0: 1 2 3\n");
    assert!(open(&path, &camera(0)).unwrap_err().to_string().contains("no projection of camera 0"));
}

const DAY: &str = "2011_09_26";

/// KITTI raw with images of 16×12; `records` of oxts for every image.
fn kitti_raw(records: usize) -> (Folder, std::path::PathBuf) {
    let f = Folder::new();
    let drive = format!("{DAY}/{DAY}_drive_0001");
    let stamp = |micros: usize| format!("2011-09-26 13:02:25.{micros:06}123\n");
    let (mut times, mut oxts) = (String::new(), String::new());
    for i in 0..5 {
        f.write(&format!("{drive}/image_02/data/{i:010}.png"), gray_png(16, 12, 9));
        times += &stamp(100_000 * i);
        for k in 0..records {
            let number = records * i + k;
            oxts += &stamp(100_000 * i + 100_000 / records * k);
            // 1e-5° to the north is 1.113 m; yaw 90° looks north.
            let north = 49.0 + 1e-5 * number as f64;
            let record = format!(
                "{north} 8.4 110 0 0 1.5707963267948966 1 2 3 4 5 0.1 0.2 9.81 7 8 9 0.01 0.02 0.03 1 2 3 0.1 0.2 4 5 6 7 8"
            );
            f.write(&format!("{drive}/oxts/data/{number:010}.txt"), record);
        }
    }
    f.write(&format!("{drive}/image_02/timestamps.txt"), times);
    f.write(&format!("{drive}/oxts/timestamps.txt"), oxts);
    let identity = "1 0 0 0 1 0 0 0 1";
    let calib = format!(
        "calib_time: 09-Jan-2012 13:57:47\nS_02: 18 14\nK_02: 9 0 8 0 9 6 0 0 1\nD_02: -0.3 0.1 0 0 -0.01\nR_02: {identity}\nT_02: 0.06 0 0\nR_rect_00: {identity}\nS_rect_02: 16 12\nP_rect_00: {}\nP_rect_02: {}\n",
        projection(0.0),
        projection(-0.06)
    );
    f.write(&format!("{DAY}/calib_cam_to_cam.txt"), calib);
    f.write(&format!("{DAY}/calib_imu_to_velo.txt"), format!("R: {identity}\nT: -0.8 0.3 -0.8\n"));
    // The camera looks along the lidar's x: right is −y, down is −z.
    f.write(&format!("{DAY}/calib_velo_to_cam.txt"), "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\ndelta_f: 0 0\n");
    let path = f.join(&drive);
    (f, path)
}

#[test]
fn kitti_raw_synchronised_has_reference_poses_and_no_imu() {
    let (f, path) = kitti_raw(1);
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len(), d.imu.len()), (RecordingKind::KittiRaw, 5, 0));
    assert_eq!(d.images[1].time.nanos(), 1_317_042_145_100_000_123);
    warning(&d, "imu-rate-low");
    let truth = d.ground_truth.as_ref().unwrap();
    assert_eq!(truth.body(), BodyFrame::Imu);
    let last = truth.poses()[4].world_from_body;
    assert!((last.translation - Vector3::new(0.0, 4.0 * 1.1132, 0.0)).norm() < 1e-2, "{}", last.translation);
    // The unit's x, forward, points north.
    assert!((last.rotation.act(&Vector3::x()) - Vector3::y()).norm() < 1e-9);
    let chosen = d.rig.camera(d.camera).unwrap();
    assert_eq!((chosen.model.name(), chosen.model.intrinsics().cy), ("pinhole", 5.5));
    // Camera 2's view is forward; it lies ahead of the unit and 6 cm left of camera 0.
    assert!((chosen.body_from_camera.rotation.act(&Vector3::z()) - Vector3::x()).norm() < 1e-9);
    let place = chosen.body_from_camera.translation;
    assert!((place - Vector3::new(0.8 + 0.27, -0.3 + 0.06, 0.8)).norm() < 1e-9, "{place}");
    std::fs::remove_file(f.join(&format!("{DAY}/calib_imu_to_velo.txt"))).unwrap();
    warning(&open(&path, &OpenOptions::default()).unwrap(), "extrinsics-missing");
}

#[test]
fn kitti_raw_unsynchronised_has_distorted_images_and_an_imu() {
    let (f, path) = kitti_raw(10);
    for i in 0..5 {
        f.write(&format!("{DAY}/{DAY}_drive_0001/image_02/data/{i:010}.png"), gray_png(18, 14, 9));
    }
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!((d.imu.len(), d.imu[3].accel.0), (50, Vector3::new(0.1, 0.2, 9.81)));
    assert!((d.rig.imu.unwrap().rate_hz - 100.0).abs() < 1e-6);
    let chosen = d.rig.camera(d.camera).unwrap();
    assert_eq!((chosen.model.name(), chosen.model.width()), ("pinhole-radtan", 18));
    // A file that is missing takes its time with it.
    std::fs::remove_file(path.join("image_02/data/0000000002.png")).unwrap();
    let d = open(&path, &OpenOptions::default()).unwrap();
    assert_eq!(d.images[2].time.nanos() % 1_000_000_000, 300_000_123);
    warning(&d, "time-missing");
}

fn replica() -> Folder {
    let f = Folder::new();
    let mut poses = String::new();
    for i in 0..4 {
        f.write(&format!("room0/results/frame00000{i}.png"), gray_png(12, 8, 9));
        f.write(&format!("room0/results/depth00000{i}.png"), gray16_png(12, 8, &[13107; 96]));
        let _ = writeln!(poses, "1 0 0 {i} 0 1 0 0 0 0 1 0.5 0 0 0 1");
    }
    f.write("room0/traj.txt", poses);
    f.write(
        "cam_params.json",
        r#"{"camera": {"w": 12, "h": 8, "fx": 6.0, "fy": 6.0, "cx": 5.5, "cy": 3.5, "scale": 6553.5}}"#,
    );
    f
}

#[test]
fn replica_has_exact_depth_and_poses() {
    let f = replica();
    let d = open(&f.join("room0"), &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::Replica, 4, 4));
    assert_eq!(d.load_depth(&d.depths[1]).unwrap().image()[(3, 3)], 2.0);
    assert_eq!(
        d.ground_truth.as_ref().unwrap().poses()[3].world_from_body.translation,
        Vector3::new(3.0, 0.0, 0.5)
    );
    assert_eq!(d.rig.cameras[0].model.intrinsics().fx, 6.0);
    assert!(matches!(&d.calibration, CalibrationSource::File(p) if p.ends_with("cam_params.json")));
    f.write("cam_params.json", r#"{"camera": {"fx": 6, "fy": 6, "cx": 5, "cy": 3, "scale": 0}}"#);
    let error = open(&f.join("room0"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("scale: 0"), "{error}");
}

fn icl() -> Folder {
    let f = Folder::new();
    let (mut list, mut truth) = (String::new(), String::new());
    for i in 0..3 {
        f.write(&format!("rgb/{i}.png"), gray_png(640, 480, 9));
        f.write(&format!("depth/{i}.png"), gray16_png(640, 480, &vec![5000; 640 * 480]));
        let _ = writeln!(list, "{i} depth/{i}.png {i} rgb/{i}.png");
        let _ = writeln!(truth, "{} 0.{i} 1.5 -2.25 0.0 0.0 0.0 1.0", i + 1);
    }
    f.write("associations.txt", list).write("livingRoom0.gt.freiburg", truth);
    f
}

#[test]
fn icl_nuim_is_mirrored_so_that_its_focal_length_is_positive() {
    let f = icl();
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::IclNuim, 3, 3));
    let k = d.rig.cameras[0].model.intrinsics();
    assert_eq!((k.fx, k.fy, d.calibration.clone()), (481.2, 480.0, CalibrationSource::DatasetDefault));
    let truth = d.ground_truth.as_ref().unwrap();
    // Poses are numbered from 1, images from 0.
    assert_eq!(truth.poses()[0].time, d.images[1].time);
    assert_eq!(truth.poses()[0].world_from_body.translation, Vector3::new(0.0, -1.5, -2.25));
    assert_eq!(d.load_depth(&d.depths[0]).unwrap().image()[(5, 5)], 1.0);
    f.write("associations.txt", "0 ../x.png 0 rgb/0.png\n");
    assert!(f.open().unwrap_err().to_string().contains("a file name inside the dataset"));
}

#[test]
fn eth3d_is_tum_rgbd_with_a_calibration_and_an_imu() {
    let f = tum();
    std::fs::remove_file(f.join("accelerometer.txt")).unwrap();
    f.write("calibration.txt", "726.21 726.30 359.2 202.5\n");
    let mut imu = String::new();
    (0..400).for_each(|i| {
        writeln!(imu, "{:.4} 0.1 0.2 0.3 0.0 -9.8 0.4", 1_305_031_101.0 + 0.01 * i as f64).unwrap()
    });
    f.write("imu.txt", imu);
    let d = f.open().unwrap();
    assert_eq!(
        (d.kind, d.imu.len(), d.rig.cameras[0].model.intrinsics().fx),
        (RecordingKind::TumRgbd, 400, 726.21)
    );
    assert_eq!(d.imu[0].accel.0, Vector3::new(0.0, -9.8, 0.4));
    assert_eq!(d.calibration, CalibrationSource::File(f.join("calibration.txt")));
    warning(&d, "extrinsics-missing");
}

#[test]
fn hostile_files_of_datasets_end_in_an_error_or_a_warning() {
    let garbage: [&[u8]; 6] = [
        b"",
        b"\xff\xfe\0t",
        &[b'1'; 40_000],
        b"P0: nan\nR: 1\nT: 1e999 0 0\n",
        b"{\"camera\": {}}",
        b"2011-99-99 1:2:3\n",
    ];
    for content in garbage {
        for name in ["calib_cam_to_cam.txt", "calib_imu_to_velo.txt", "calib_velo_to_cam.txt"] {
            let (f, path) = kitti_raw(1);
            f.write(&format!("{DAY}/{name}"), content);
            let _ = open(&path, &OpenOptions::default());
        }
        for name in ["image_02/timestamps.txt", "oxts/timestamps.txt", "oxts/data/0000000001.txt"] {
            let (f, path) = kitti_raw(1);
            f.write(&format!("{DAY}/{DAY}_drive_0001/{name}"), content);
            let _ = open(&path, &OpenOptions::default());
        }
        for name in ["room0/traj.txt", "cam_params.json", "room0/results/frame000000.png"] {
            let f = replica();
            f.write(name, content);
            let _ = open(&f.join("room0"), &OpenOptions::default());
        }
        for name in ["associations.txt", "livingRoom0.gt.freiburg"] {
            let f = icl();
            f.write(name, content);
            let _ = f.open();
        }
    }
}
