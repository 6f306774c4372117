//! Every layout in its regular form.

use crate::common::*;
use nalgebra::Vector3;
use vidar_core::{BodyFrame, CameraId, Duration, FrameId, LieGroup, SensorEvent};
use vidar_dataset::{
    CalibrationSource, CameraFlag, OpenOptions, RecordingKind, TimeUnit, TrajectoryFormat,
    TrajectoryReadOptions, read_trajectory,
};

#[test]
fn a_clean_euroc_sequence_opens_without_a_warning() {
    let f = euroc();
    let d = f.open().unwrap();
    assert_eq!(kinds(&d), Vec::<&str>::new());
    assert_eq!((d.kind, d.images.len(), d.imu.len()), (RecordingKind::EurocAsl, 10, 120));
    assert_eq!(d.images[3].frame_id, FrameId(3));
    let camera = d.rig.camera(CameraId(0)).unwrap();
    assert_eq!(camera.rate_hz, Some(20.0));
    // T_BS maps camera to body: the camera's x axis points along the body's y axis.
    let moved = camera.body_from_camera.act(&Vector3::new(1.0, 0.0, 0.0));
    assert!((moved - Vector3::new(0.1, 1.2, 0.3)).norm() < 1e-12);
    assert_eq!(d.rig.imu.unwrap().gyro_noise_density, 1.6968e-4);
    assert_eq!(d.ground_truth.as_ref().unwrap().len(), 10);
    assert!(d.reason.contains("mav0"));
}

#[test]
fn one_camera_alone_is_a_euroc_dataset() {
    let f = euroc();
    let inner = f.join("mav0/cam0");
    std::fs::remove_dir_all(f.join("mav0/imu0")).unwrap();
    let d = vidar_dataset::open(&inner, &OpenOptions::default()).unwrap();
    assert_eq!((d.kind, d.images.len(), d.imu.len(), d.rig.imu), (RecordingKind::EurocAsl, 10, 0, None));
}

#[test]
fn euroc_without_a_list_takes_times_from_names() {
    let f = euroc();
    std::fs::remove_file(f.join("mav0/cam0/data.csv")).unwrap();
    let d = f.open().unwrap();
    assert_eq!((d.images.len(), d.images[9].time.nanos()), (10, frame_ns(9)));
    warning(&d, "list-missing");
}

#[test]
fn an_imu_that_is_not_the_body_moves_cameras_and_truth() {
    let f = euroc();
    f.edit("mav0/imu0/sensor.yaml", |s| s.replace("[1, 0, 0, 0, 0, 1,", "[1, 0, 0, 0.5, 0, 1,"));
    let d = f.open().unwrap();
    let camera = d.rig.camera(CameraId(0)).unwrap();
    assert!((camera.body_from_camera.translation - Vector3::new(-0.4, 0.2, 0.3)).norm() < 1e-12);
    let first = d.ground_truth.as_ref().unwrap().poses()[0].world_from_body;
    assert!((first.translation - Vector3::new(0.5, 0.0, 1.0)).norm() < 1e-12);
}

#[test]
fn a_laser_tracker_gives_positions_of_another_body() {
    let f = euroc();
    std::fs::remove_dir_all(f.join("mav0/state_groundtruth_estimate0")).unwrap();
    f.write(
        "mav0/leica0/data.csv",
        format!("#timestamp,p x,p y,p z\n{},1,2,3\n{},1,2,4\n", frame_ns(0), frame_ns(4)),
    );
    let d = f.open().unwrap();
    assert_eq!(d.ground_truth.as_ref().unwrap().body(), BodyFrame::Other);
}

#[test]
fn euroc_depth_has_its_own_camera_and_scale() {
    let f = euroc();
    let t = frame_ns(2);
    f.write("mav0/depth0/data.csv", format!("#timestamp [ns],filename\n{t},{t}.png\n"));
    f.write(&format!("mav0/depth0/data/{t}.png"), gray16_png(8, 6, &[2500; 48]));
    let yaml = CAM0.replace("[16, 12]", "[8, 6]").replace("[10.0, 11.0, 7.5, 5.5]", "[5, 5.5, 3.5, 2.5]");
    let yaml = yaml.replace("radial-tangential", "none").replace("[-0.1, 0.01, 0.0, 1e-05]", "[]");
    f.write("mav0/depth0/sensor.yaml", yaml.replace("0.0, 0.1,", "0.0, 0.4,") + "units_per_metre: 500\n");
    f.write("mav0/pointcloud0/data.ply", "ply\n");
    let d = f.open().unwrap();
    let sensor = d.depth_sensor.as_ref().unwrap();
    assert_eq!((sensor.units_per_metre, sensor.intrinsics.fy), (500.0, 5.5));
    // 0.3 m along the body's x is 0.3 m along the camera's −y.
    assert!((sensor.color_from_depth.translation - Vector3::new(0.0, -0.3, 0.0)).norm() < 1e-12);
    assert_eq!(d.load_depth(&d.depths[0]).unwrap().image()[(3, 3)], 5.0);
    assert_eq!(d.depth_for(d.images[2].time), Some(&d.depths[0]));
    assert_eq!(d.depth_for(d.images[3].time), None);
    assert!(d.reference_cloud.is_some());
}

#[test]
fn a_kalibr_chain_overrides_the_dataset_and_is_inverted() {
    let f = euroc();
    f.write("chain.yaml", "cam0:\n  T_cam_imu:\n  - [1, 0, 0, 0.5]\n  - [0, 0, 1, 0]\n  - [0, -1, 0, 0.2]\n  - [0, 0, 0, 1]\n  camera_model: ds\n  distortion_coeffs: []\n  distortion_model: none\n  intrinsics: [-0.2, 0.59, 9, 9.5, 7.5, 5.5]\n  resolution: [16, 12]\n  rostopic: /cam0\n  timeshift_cam_imu: -0.0125\n");
    f.write("imu.yaml", "imu0:\n  accelerometer_noise_density: 2e-2\n  accelerometer_random_walk: 3e-3\n  gyroscope_noise_density: 1e-3\n  gyroscope_random_walk: 2e-5\n  update_rate: 100\n");
    let options =
        OpenOptions { calibration: vec![f.join("chain.yaml"), f.join("imu.yaml")], ..Default::default() };
    let d = f.open_with(&options).unwrap();
    let camera = d.rig.camera(CameraId(0)).unwrap();
    assert_eq!(camera.model.name(), "double-sphere");
    assert_eq!(camera.time_offset, Duration::from_nanos(-12_500_000));
    // T_cam_imu maps the IMU's origin to (0.5, 0, 0.2) in the camera.
    let origin = camera.body_from_camera.act(&Vector3::new(0.5, 0.0, 0.2));
    assert!(origin.norm() < 1e-12, "{origin}");
    assert_eq!((d.rig.imu.unwrap().accel_noise_density, d.rig.imu.unwrap().rate_hz), (2e-2, 100.0));
    assert_eq!(d.calibration, CalibrationSource::File(f.join("chain.yaml")));
}

#[test]
fn tum_rgbd_opens_with_published_intrinsics_registered_depth_and_camera_poses() {
    let f = tum();
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::TumRgbd, 5, 5));
    assert!(warning(&d, "intrinsics-published").message.contains("ROS default"));
    assert_eq!(d.ground_truth.as_ref().unwrap().body(), BodyFrame::Camera(CameraId(0)));
    assert_eq!(d.load_depth(d.depth_for(d.images[1].time).unwrap()).unwrap().image()[(5, 5)], 1.0);
    assert_eq!(d.accelerometer.len(), 40);
    warning(&d, "imu-incomplete");
    assert!(!kinds(&d).contains(&"gravity-norm"));
    for (name, camera) in [("rgbd_dataset_freiburg1_xyz", "freiburg 1"), ("fr3 office", "freiburg 3")] {
        let inner = f.join(name);
        std::fs::create_dir(&inner).unwrap();
        for part in ["rgb", "depth", "rgb.txt", "depth.txt"] {
            std::os::unix::fs::symlink(f.join(part), inner.join(part)).unwrap();
        }
        let d = vidar_dataset::open(&inner, &OpenOptions::default()).unwrap();
        assert!(warning(&d, "intrinsics-published").message.contains(camera));
    }
}

#[test]
fn seven_scenes_may_have_separate_depth_and_colour_cameras() {
    let f = seven_scenes();
    let options = OpenOptions {
        camera_model: Some("pinhole:523,523,3.5,2.5".parse::<CameraFlag>().unwrap().0),
        color_from_depth: Some(vidar_core::Se3::from_translation(Vector3::new(-0.023, 0.012, 0.0))),
        ..Default::default()
    };
    let d = f.open_with(&options).unwrap();
    let sensor = d.depth_sensor.as_ref().unwrap();
    assert_eq!((sensor.intrinsics.fx, sensor.color_from_depth.translation.x), (585.0, -0.023));
    assert_eq!((d.rig.cameras[0].model.intrinsics().fx, d.rig.cameras[0].model.width()), (523.0, 8));
    let depth = d.load_depth(&d.depths[0]).unwrap();
    let row: Vec<f32> = depth.image().row(0)[..4].to_vec();
    assert!(row[0].is_nan() && row[1].is_nan() && row[2] == 1.5 && row[3] == 2.0, "{row:?}");
    assert_eq!(d.images[1].time.nanos(), 66_666_666);
    assert!(!kinds(&d).contains(&"color-is-depth-camera"));
    warning(&f.open().unwrap(), "color-is-depth-camera");
}

#[test]
fn a_posed_folder_pairs_lines_and_images() {
    let f = posed();
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.images.len(), d.depths.len()), (RecordingKind::PosedFolder, 4, 4));
    assert_eq!(d.images[0].time.nanos(), 100_000_000);
    assert_eq!(d.ground_truth.as_ref().unwrap().poses()[3].world_from_body.translation.x, 3.0);
    assert_eq!(d.load_depth(&d.depths[0]).unwrap().image()[(0, 0)], 1.5);
    assert!(warning(&d, "depth-scale").message.contains("1000"));
}

#[test]
fn an_image_folder_is_read_in_natural_order_whatever_the_case() {
    let f = Folder::new();
    for name in ["img10.PNG", "img9.png", "IMG1.Png", "img2.JPG.png", "notes.txt", ".hidden.png"] {
        f.write(name, gray_png(4, 4, 7));
    }
    let d = f.open().unwrap();
    let names: Vec<_> =
        d.images.iter().map(|i| i.location.path().file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["IMG1.Png", "img2.JPG.png", "img9.png", "img10.PNG"]);
    assert_eq!(d.calibration, CalibrationSource::Guessed);
    warning(&d, "intrinsics-guessed");
    warning(&d, "times-synthesised");
}

#[test]
fn files_of_times_are_read_in_every_form() {
    let forms = [
        ("t.txt", "1.5\n1.6\n1.7\n", 1_500_000_000),
        (
            "t.txt",
            "1403636580500000000\n1403636580600000000\n1403636580700000000\n",
            1_403_636_580_500_000_000,
        ),
        (
            "t.csv",
            "name,time_ms\na1.png,1403636580500\na2.png,1403636580600\na3.png,1403636580700\n",
            1_403_636_580_500_000_000,
        ),
        ("t.csv", "time,name\n1.5,a1.png\n1.6,a2.png\n1.7,a3.png\n", 1_500_000_000),
        ("t.txt", "a3.png 1.7\na2.png 1.6\na1.png 1.5\n", 1_500_000_000),
    ];
    for (name, text, first) in forms {
        let f = Folder::new();
        for i in 1..=3 {
            f.write(&format!("pictures/a{i}.png"), gray_png(4, 4, 7));
        }
        f.write(name, text);
        let options = OpenOptions { timestamps: Some(f.join(name)), ..Default::default() };
        let d = vidar_dataset::open(&f.join("pictures"), &options).unwrap();
        assert_eq!((d.images.len(), d.images[0].time.nanos()), (3, first), "{text}");
        assert!(d.images[0].location.path().ends_with("a1.png"));
        warning(&d, "time-unit");
    }
}

#[test]
fn names_that_are_times_are_read_in_their_unit() {
    for (stem, unit) in [("1403636580", "000000000"), ("1403636580", "000000"), ("1403636580", "000")] {
        let f = Folder::new();
        for i in 0..4 {
            f.write(&format!("{stem}{i}{}.png", &unit[1..]), gray_png(4, 4, 7));
        }
        let d = f.open().unwrap();
        assert_eq!((d.images[1].time - d.images[0].time).nanos(), 100_000_000, "{unit}");
        assert_eq!(d.images[0].time.nanos(), 1_403_636_580_000_000_000);
        warning(&d, "time-unit");
    }
}

#[test]
fn cutting_and_thinning_keep_frame_numbers() {
    let f = euroc();
    let options = OpenOptions {
        start: Some(Duration::from_millis(100)),
        end: Some(Duration::from_millis(350)),
        stride: 2,
        ..Default::default()
    };
    let d = f.open_with(&options).unwrap();
    let ids: Vec<u32> = d.images.iter().map(|i| i.frame_id.0).collect();
    assert_eq!(ids, [2, 4, 6]);
    let late = OpenOptions { start: Some(Duration::from_millis(9000)), ..Default::default() };
    assert!(f.open_with(&late).unwrap_err().to_string().contains("9.000 s"));
}

#[test]
fn events_are_ordered_and_the_imu_comes_first_at_equal_times() {
    let f = euroc();
    let d = f.open().unwrap();
    let events: Vec<SensorEvent> = d.events().collect::<Result<_, _>>().unwrap();
    assert_eq!(events.len(), 10 + 120 + 10);
    let rank = |e: &SensorEvent| match e {
        SensorEvent::Imu(_) => 0,
        SensorEvent::GroundTruth { .. } => 1,
        SensorEvent::Depth { .. } => 2,
        SensorEvent::Image(_) => 3,
    };
    assert!(events.windows(2).all(|w| (w[0].time(), rank(&w[0])) <= (w[1].time(), rank(&w[1]))));
}

#[test]
fn external_trajectories_are_read_in_three_formats() {
    let f = euroc();
    let secs = |i: i64| format!("{}.{:09}", frame_ns(i) / 1_000_000_000, frame_ns(i) % 1_000_000_000);
    let tum: String = (0..10).map(|i| format!("{} {i} 0 0 0 0 0 1\n", secs(i))).collect();
    let euroc_csv: String = (0..10).map(|i| format!("{},{i},0,0,1,0,0,0\n", frame_ns(i))).collect();
    let kitti: String = (0..10).map(|i| format!("1 0 0 {i} 0 1 0 0 0 0 1 0\n")).collect();
    let marked = format!("# world_from_body, body = camera0\n{tum}");
    for (name, text, body) in [
        ("tum.txt", tum, BodyFrame::Imu),
        ("marked.txt", marked, BodyFrame::Camera(CameraId(0))),
        ("euroc.csv", euroc_csv, BodyFrame::Imu),
        ("kitti.txt", kitti, BodyFrame::Camera(CameraId(0))),
    ] {
        f.write(name, text);
        let d = f.open_with(&OpenOptions { trajectory: Some(f.join(name)), ..Default::default() }).unwrap();
        let external = d.external_trajectory.as_ref().unwrap();
        assert_eq!((external.trajectory.len(), external.trajectory.body()), (10, body), "{name}");
        assert_eq!(external.trajectory.poses()[3].time, d.images[3].time, "{name}");
        assert_eq!(external.trajectory.poses()[3].world_from_body.translation.x, 3.0, "{name}");
        // A header that names the body needs no assumption.
        assert_eq!(kinds(&d).contains(&"trajectory-body"), name != "marked.txt");
    }
    let given = TrajectoryReadOptions {
        format: Some(TrajectoryFormat::Tum),
        body: Some(BodyFrame::Camera(CameraId(2))),
        ..Default::default()
    };
    let (t, _) = read_trajectory(&f.join("tum.txt"), &given).unwrap();
    assert_eq!(t.body(), BodyFrame::Camera(CameraId(2)));
}

#[test]
fn names_of_options_are_read_back() {
    for kind in RecordingKind::ALL {
        assert_eq!(kind.to_string().parse::<RecordingKind>().unwrap(), kind);
    }
    for unit in TimeUnit::ALL {
        assert_eq!(unit.to_string().parse::<TimeUnit>().unwrap(), unit);
    }
    for format in TrajectoryFormat::ALL {
        assert_eq!(format.to_string().parse::<TrajectoryFormat>().unwrap(), format);
    }
    let error = "eurok".parse::<RecordingKind>().unwrap_err().to_string();
    let expected = "euroc, tum-rgbd, 7scenes, kitti-raw, kitti, replica, icl-nuim, posed-folder, bag, stray-scanner, \
                    spectacular-ai, imu-log, video, images";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn the_format_flag_overrides_detection() {
    let f = posed();
    let options = OpenOptions { format: Some(RecordingKind::ImageFolder), ..Default::default() };
    let d = f.open_with(&options).unwrap();
    assert_eq!((d.kind, d.images.len(), d.ground_truth.is_none()), (RecordingKind::ImageFolder, 4, true));
    let wrong = OpenOptions { format: Some(RecordingKind::EurocAsl), ..Default::default() };
    assert!(f.open_with(&wrong).is_err());
}

/// What identifies a dataset.
fn fingerprint(dataset: &vidar_dataset::Recording) -> Vec<u8> {
    let mut bytes = Vec::new();
    dataset.write_fingerprint(&mut bytes).unwrap();
    bytes
}

#[test]
fn the_fingerprint_changes_with_every_kind_of_change() {
    let f = euroc();
    let print = || fingerprint(&f.open().unwrap());
    let before = print();
    assert!(before == print(), "nothing changed");
    f.edit("mav0/imu0/data.csv", |s| s.replacen("0.01,0,-0.01", "0.02,0,-0.01", 1));
    assert!(before != print(), "an IMU sample changed");
    let then = print();
    f.write(&format!("mav0/cam0/data/{}.png", frame_ns(4)), [gray_png(16, 12, 9), vec![0; 9]].concat());
    assert!(then != print(), "an image changed");
}
