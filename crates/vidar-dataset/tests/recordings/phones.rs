//! Recordings of phones: what is recognised, and what is made of units, signs and clocks.

use crate::common::*;
use nalgebra::Vector3;
use std::fmt::Write as _;
use std::path::Path;
use vidar_core::{BodyFrame, CameraId, LieGroup, SensorEvent};
use vidar_dataset::{CalibrationSource, OpenOptions, Recording, RecordingKind};

/// Frames of the clip that the readers of videos are tested with.
const FRAMES: usize = 15;
/// IMU samples, 5 ms apart, from 50 ms before the first frame.
const SAMPLES: i64 = 140;

fn clip(name: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../vidar-video/tests/fixtures");
    std::fs::read(folder.join(name)).unwrap()
}

/// Time of frame `i`, ms, in the clock of the phone.
fn frame_ms(i: usize) -> i64 {
    5_000_000 + 40 * i as i64
}

/// What the IMU of a phone at rest measures that is held in landscape, its right edge up: specific force, m/s², in its axes.
const UP: f64 = 9.80665;

/// Stray Scanner as its source writes it: the accelerometer in g, with Core Motion's sign.
fn stray(sign: f64) -> Folder {
    let f = Folder::new();
    f.write("rgb.mp4", clip("h264.mp4"))
        .write("camera_matrix.csv", "50.0, 0.0, 31.5\n0.0, 50.0, 23.5\n0.0, 0.0, 1.0");
    let mut odometry = String::from("timestamp, frame, x, y, z, qx, qy, qz, qw\n");
    for i in 0..FRAMES {
        // ARKit's world has y up, the camera's y points down: half a turn about x.
        let secs = frame_ms(i) as f64 * 1e-3;
        let _ = writeln!(odometry, "{secs}, {i:06}, {}, 1.5, 0.0, 1.0, 0.0, 0.0, 0.0", 0.1 * i as f64);
        f.write(&format!("depth/{i:06}.png"), gray16_png(8, 6, &[1500; 48]));
    }
    let levels: Vec<u8> = (0..48).map(|p| [0, 1, 2][p % 3]).collect();
    f.write("confidence/000001.png", png(8, 6, ::png::ColorType::Grayscale, ::png::BitDepth::Eight, &levels));
    let mut imu = String::from("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n");
    for i in 0..SAMPLES {
        let secs = (frame_ms(0) - 50 + 5 * i) as f64 * 1e-3;
        let _ = writeln!(imu, "{secs}, {}, 0.0, 0.0, 0.01, 0.02, 0.03", sign);
    }
    f.write("odometry.csv", odometry).write("imu.csv", imu);
    f
}

#[test]
fn stray_scanner_is_a_recording_with_arkits_poses_and_an_imu_in_g() {
    let f = stray(-1.0);
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.images.len()), (RecordingKind::StrayScanner, FRAMES));
    assert_eq!(d.images[3].time.nanos(), frame_ms(3) * 1_000_000, "the log's time, not the video's");
    assert_eq!(d.calibration, CalibrationSource::File(f.join("camera_matrix.csv")));
    let external = d.external_trajectory.as_ref().unwrap();
    assert_eq!(external.trajectory.body(), BodyFrame::Camera(CameraId(0)));
    assert_eq!(external.trajectory.len(), FRAMES);
    assert!(warning(&d, "accel-unit").message.contains("in g"));
    // Specific force up along the phone's +x, its image's −y.
    assert!((d.imu[60].accel.0 - Vector3::new(UP, 0.0, 0.0)).norm() < 1e-9, "{:?}", d.imu[60]);
    assert_eq!(d.imu[60].gyro.0, Vector3::new(0.01, 0.02, 0.03));
    let camera_from_body = d.rig.camera(d.camera).unwrap().body_from_camera.inverse();
    assert!((camera_from_body.rotation.act(&d.imu[60].accel.0) - Vector3::new(0.0, -UP, 0.0)).norm() < 1e-9);
    assert!(!kinds(&d).contains(&"mount-gravity") && !kinds(&d).contains(&"accel-sign"), "{:?}", kinds(&d));
    for kind in ["extrinsics-assumed", "poses-recorded", "imu-noise"] {
        warning(&d, kind);
    }
    // Depth of low confidence is none.
    assert!(d.load_depth(&d.depths[1]).unwrap().image()[(0, 0)].is_nan());
    assert_eq!(d.load_depth(&d.depths[1]).unwrap().image()[(1, 0)], 1.5);
    // Depth lies on the colour camera, whose intrinsics are scaled to its size.
    assert_eq!((d.depths.len(), d.load_depth(&d.depths[0]).unwrap().image()[(2, 2)]), (FRAMES, 1.5));
    assert!((d.depth_sensor.as_ref().unwrap().intrinsics.fx - 50.0 * 8.0 / 64.0).abs() < 1e-9);
}

#[test]
fn a_video_out_of_a_recording_points_to_its_folder() {
    let f = stray(-1.0);
    let d = vidar_dataset::open(&f.join("rgb.mp4"), &OpenOptions::default()).unwrap();
    assert_eq!(d.kind, RecordingKind::Video);
    warning(&d, "folder-beside");
}

/// A logger's tables in a folder of their own, named by the user.
#[test]
fn tables_of_the_imu_may_lie_elsewhere_and_are_named() {
    let (pictures, log) = (Folder::new(), Folder::new());
    pictures.write("clip.mp4", clip("h264.mp4"));
    let (mut gyro, mut accel, mut times) = (
        String::from("timestamp_ns,gx,gy,gz\n"),
        String::from("timestamp_ns,ax,ay,az\n"),
        String::from("timestamp_ns\n"),
    );
    for i in 0..SAMPLES {
        let nanos = (frame_ms(0) - 50 + 5 * i) * 1_000_000;
        let _ = writeln!(gyro, "{nanos},0.01,0.02,0.03");
        let _ = writeln!(accel, "{nanos},{UP},0.0,0.0");
    }
    for i in 0..FRAMES {
        let _ = writeln!(times, "{}", frame_ms(i) * 1_000_000);
    }
    log.write("gyro.csv", gyro).write("accel.csv", accel).write("frames.csv", times);
    let named = |tables: &[&str], timestamps: Option<&str>| OpenOptions {
        imu: tables.iter().map(|t| log.join(t)).collect(),
        timestamps: timestamps.map(|t| log.join(t)),
        ..OpenOptions::default()
    };
    let d = vidar_dataset::open(
        &pictures.join("clip.mp4"),
        &named(&["gyro.csv", "accel.csv"], Some("frames.csv")),
    )
    .unwrap();
    assert_eq!((d.kind, d.images.len()), (RecordingKind::ImuLog, FRAMES));
    assert_eq!(d.images[3].time.nanos(), frame_ms(3) * 1_000_000);
    assert_eq!(d.imu[60].gyro.0, Vector3::new(0.01, 0.02, 0.03));
    assert!((d.imu[60].accel.0 - Vector3::new(UP, 0.0, 0.0)).norm() < 1e-9);
    // The folder of the video does as well.
    let folder = vidar_dataset::open(pictures.path(), &named(&["accel.csv", "gyro.csv"], Some("frames.csv")));
    assert_eq!(folder.unwrap().imu, d.imu);

    let refused = |tables: &[&str]| {
        vidar_dataset::open(&pictures.join("clip.mp4"), &named(tables, None)).unwrap_err().to_string()
    };
    assert!(refused(&["gyro.csv"]).contains("1 tables of a gyroscope and 0 of an accelerometer"));
    assert!(refused(&["frames.csv"]).contains("no column of an IMU"), "{}", refused(&["frames.csv"]));
    let other = vidar_dataset::open(&log.join("gyro.csv"), &named(&["gyro.csv", "accel.csv"], None));
    assert!(other.unwrap_err().to_string().contains("a video or a folder of images"));
}

#[test]
fn poses_beside_images_are_no_imu() {
    let f = Folder::new();
    let mut poses = String::new();
    for i in 0..9 {
        f.write(&format!("{i}.png"), gray_png(16, 12, 9));
        let _ = writeln!(poses, "{i} 0.0 {i} 9.8 0.0 0.0 0.0 1.0");
    }
    f.write("trajectory.txt", poses);
    assert_eq!(f.open().unwrap().kind, RecordingKind::ImageFolder);
}

#[test]
fn a_sign_that_the_recorders_poses_contradict_is_turned() {
    // An older or other recorder that writes the specific force in g.
    let d = stray(1.0).open().unwrap();
    warning(&d, "accel-sign");
    assert!((d.imu[60].accel.0 - Vector3::new(UP, 0.0, 0.0)).norm() < 1e-9);
}

#[test]
fn an_accelerometer_without_gravity_gives_no_imu() {
    let d = stray(0.01).open().unwrap();
    assert!(d.imu.is_empty() && d.rig.imu.is_none());
    warning(&d, "accelerometer-without-gravity");
    assert_eq!(d.images.len(), FRAMES);
}

#[test]
fn frames_without_a_row_are_left_out_and_counted() {
    let f = stray(-1.0);
    f.edit("odometry.csv", |s| s.lines().take(9).collect::<Vec<_>>().join("\n"));
    let d = f.open().unwrap();
    assert_eq!(d.images.len(), 8);
    assert!(warning(&d, "frame-times").message.contains("8 times for the 15 frames"));
    // A row that is no number names its line.
    f.edit("odometry.csv", |s| s.replacen("1.5", "x", 1));
    assert!(f.open().unwrap_err().to_string().contains("odometry.csv:2"));
}

/// Spectacular AI's format, gyroscope and accelerometer at their own times.
fn spectacular() -> Folder {
    let f = Folder::new();
    let mut lines = String::new();
    for i in 0..SAMPLES {
        let secs = (frame_ms(0) - 50 + 5 * i) as f64 * 1e-3;
        let _ =
            writeln!(lines, r#"{{"sensor":{{"type":"gyroscope","values":[0.1,0.2,{}]}},"time":{secs}}}"#, i);
        if i % 2 == 0 {
            let later = secs + 0.002;
            let _ = writeln!(
                lines,
                r#"{{"sensor":{{"type":"accelerometer","values":[{UP},0,{}]}},"time":{later}}}"#,
                i as f64 * 0.01
            );
        }
        if i % 8 == 0 && i / 8 < FRAMES as i64 {
            let (number, secs) = (i / 8, frame_ms((i / 8) as usize) as f64 * 1e-3);
            let _ = writeln!(
                lines,
                r#"{{"frames":[{{"cameraInd":0,"features":[]}},{{"cameraInd":1}}],"number":{number},"time":{secs}}}"#
            );
            let _ = writeln!(
                lines,
                r#"{{"arkit":{{"position":{{"x":{number},"y":0,"z":0}},"orientation":{{"x":0,"y":0,"z":0,"w":1}}}},"time":{secs}}}"#
            );
        }
    }
    lines.push_str("{\"gps\":{\"latitude\":60.1,\"longitude\":24.9,\"altitude\":14.1,\"accuracy\":4.0},\"time\":5000.1}\n");
    f.write("data.jsonl", lines).write("data.mp4", clip("h264.mp4")).write("data2.mp4", clip("h264.mp4"));
    let camera = |fx: f64, lever: f64| {
        format!(
            r#"{{"focalLengthX":{fx},"focalLengthY":51.0,"principalPointX":31.5,"principalPointY":23.5,"model":"kannala-brandt4",
            "distortionCoefficients":[-0.02,0.002,-0.005,0.0004],"imageWidth":64,"imageHeight":48,
            "imuToCamera":[[0,-1,0,0],[-1,0,0,{lever}],[0,0,-1,0],[0,0,0,1]]}}"#
        )
    };
    f.write("calibration.json", format!("{{\"cameras\":[{},{}]}}", camera(50.0, 0.03), camera(52.0, 0.04)));
    f
}

#[test]
fn spectacular_ai_is_a_calibrated_recording_with_both_sensors_as_one() {
    let f = spectacular();
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.images.len()), (RecordingKind::SpectacularAi, FRAMES));
    assert_eq!(d.images[5].time.nanos(), frame_ms(5) * 1_000_000);
    let camera = d.rig.camera(CameraId(0)).unwrap();
    assert_eq!((camera.model.name(), camera.model.intrinsics().fx), ("pinhole-equidistant", 50.0));
    assert!((camera.body_from_camera.inverse().translation - Vector3::new(0.0, 0.03, 0.0)).norm() < 1e-12);
    // The accelerometer at 5 i + 2 ms for even i, read at 5 i: 0.01·(i − 0.4) by the straight line between its samples.
    let sample = d.imu.iter().find(|s| s.gyro.0.z == 60.0).unwrap();
    assert!((sample.accel.0.z - 0.01 * 59.6).abs() < 1e-6, "{:?}", sample);
    assert_eq!(d.external_trajectory.as_ref().unwrap().trajectory.body(), BodyFrame::Imu);
    let second = f.open_with(&OpenOptions { camera: CameraId(1), ..Default::default() }).unwrap();
    assert_eq!(second.rig.cameras[0].model.intrinsics().fx, 52.0);
    let error =
        f.open_with(&OpenOptions { camera: CameraId(2), ..Default::default() }).unwrap_err().to_string();
    assert!(error.contains("available: camera 0, camera 1"), "{error}");
}

#[test]
fn damaged_records_are_skipped_and_counted() {
    let f = spectacular();
    f.edit("data.jsonl", |s| s.replacen("{\"sensor\"", "{\"sensor", 3) + "{\"time\":1e400}\n");
    let d = f.open().unwrap();
    assert!(warning(&d, "record-unreadable").message.starts_with("4 lines"));
    f.edit("calibration.json", |s| s.replace("[0,-1,0,0]", "[0,-2,0,0]"));
    assert!(f.open().unwrap_err().to_string().contains("imuToCamera is not a rigid motion"));
}

fn opens_as_log(f: &Folder) -> Recording {
    let d = f.open().unwrap();
    assert_eq!(d.kind, RecordingKind::ImuLog, "{}", d.reason);
    assert_eq!(d.images.len(), FRAMES);
    assert_eq!(d.images[7].time.nanos(), frame_ms(7) * 1_000_000);
    d
}

#[test]
fn mars_logger_is_read_with_its_focal_length() {
    let f = Folder::new();
    let mut imu = String::from(
        "Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],Unix time[nanosec]\n",
    );
    for i in 0..SAMPLES {
        let t = (frame_ms(0) - 50 + 5 * i) * 1_000_000;
        let _ = writeln!(imu, "{t},0.1,0.2,0.3,0.0,-{UP},0.0,{}", t + 1_700_000_000_000_000_000);
    }
    let mut times = String::from("Frame timestamp[nanosec],Unix time[nanosec]\n");
    let mut metadata = String::from("Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec]\n");
    for i in 0..FRAMES {
        let t = frame_ms(i) * 1_000_000;
        let _ = writeln!(times, "{t},{}", t + 1_700_000_000_000_000_000);
        let _ = writeln!(metadata, "{},{},55.5,{i},5000000", t - 1, if i == 0 { 999.0 } else { 55.0 });
    }
    f.write("gyro_accel.csv", imu).write("frame_timestamps.txt", times).write("movie_metadata.csv", metadata);
    f.write("movie.mp4", clip("rotated.mp4"));
    let d = opens_as_log(&f);
    let camera = d.rig.camera(CameraId(0)).unwrap();
    // The focal lengths are the sensor's; the picture is turned. Without its centre it is a guess.
    assert_eq!((camera.model.intrinsics().fx, camera.model.intrinsics().fy), (55.5, 55.0));
    assert_eq!(d.calibration, CalibrationSource::Guessed);
    // The phone stands on its head, and its video is turned (three quarters clockwise) to be upright: the force is upward in it.
    let in_camera = camera.body_from_camera.inverse().rotation.act(&d.imu[50].accel.0);
    assert!((in_camera - Vector3::new(0.0, -UP, 0.0)).norm() < 1e-9, "{in_camera}");
    assert!(d.events().filter(|e| matches!(e, Ok(SensorEvent::Image(_)))).count() == FRAMES);
    // iOS states the centre, too: 5 px right of the sensor's, which is up in a picture turned by three quarters.
    let metadata = std::fs::read_to_string(f.join("movie_metadata.csv")).unwrap();
    let with_centre =
        metadata.replace("Frame No.", "cx[px],cy[px],Frame No.").replace(",55.5,", ",55.5,36.5,23.5,");
    f.write("movie_metadata.csv", with_centre);
    let d = opens_as_log(&f);
    assert!(matches!(&d.calibration, CalibrationSource::File(p) if p.ends_with("movie_metadata.csv")));
    assert_eq!(
        (d.rig.cameras[0].model.intrinsics().cx, d.rig.cameras[0].model.intrinsics().cy),
        (23.5, 26.5)
    );
    // A focal length of 1 stands for none.
    f.write("movie_metadata.csv", metadata.replace("55", "1"));
    assert!(!kinds(&opens_as_log(&f)).contains(&"intrinsics-driver"));
}

#[test]
fn opencamera_sensors_has_tables_without_header_in_a_folder_beside_the_video() {
    let f = Folder::new();
    let (mut gyro, mut accel, mut times) = (String::new(), String::new(), String::new());
    for i in 0..SAMPLES {
        let t = (frame_ms(0) - 50 + 5 * i) * 1_000_000;
        let _ = writeln!(gyro, "0.1,0.2,0.3,{t}");
        let _ = writeln!(accel, "0.0,{UP},0.1,{}", t + 1_000_000);
    }
    (0..FRAMES).for_each(|i| writeln!(times, "{}", frame_ms(i) * 1_000_000).unwrap());
    f.write("VID_1.mp4", clip("h264.mp4")).write("VID_1/VID_1_gyro.csv", gyro);
    f.write("VID_1/VID_1_accel.csv", accel).write("VID_1/VID_1_timestamps.csv", times);
    let d = opens_as_log(&f);
    // The last sample of the gyroscope is before the accelerometer's last, the first before its first.
    assert_eq!(d.imu.len(), 139);
    assert_eq!((d.imu[0].gyro.0.y, d.imu[0].accel.0.y), (0.2, UP));
    assert!(warning(&d, "imu-columns").message.contains("time column 4"));
    assert_eq!(d.calibration, CalibrationSource::Guessed);
}

#[test]
fn one_table_may_hold_two_sensors_row_by_row_in_degrees_and_milliseconds() {
    let f = Folder::new();
    let mut table =
        String::from("time_ms,gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s),acc_x (g),acc_y (g),acc_z (g)\n");
    for i in 0..70 {
        let t = frame_ms(0) - 50 + 10 * i;
        // Irregular: two of the gyroscope for one of the accelerometer, and a row without anything.
        let _ =
            writeln!(table, "{t},180,0,0,,,\n{},0,90,0,,,\n{},,,,0,1.0,0.02\n{},,,,,,", t + 3, t + 6, t + 7);
    }
    for i in 0..FRAMES {
        f.write(&format!("frames/{}.png", frame_ms(i) * 1_000_000), gray_png(16, 12, 9));
    }
    f.write("sensors.csv", table);
    let d = opens_as_log(&f);
    assert!(
        (d.imu[0].gyro.0 - Vector3::new(std::f64::consts::PI, 0.0, 0.0)).norm() < 1e-12,
        "{:?}",
        d.imu[0]
    );
    // The header says g: the sign of the values is kept.
    assert!((d.imu[10].accel.0.y - UP).abs() < 1e-9);
    warning(&d, "gyro-unit");
    assert_eq!(d.imu.len(), 138, "two before the first of the accelerometer are not invented");
}

#[test]
fn a_video_without_a_log_of_frame_times_says_so() {
    let f = Folder::new();
    let mut imu = String::from("timestamp,gx,gy,gz,ax,ay,az\n");
    (0..SAMPLES).for_each(|i| writeln!(imu, "{:.3},0,0,0.1,0,{UP},0", 0.005 * i as f64).unwrap());
    f.write("clip.mp4", clip("h264.mp4")).write("imu.csv", &imu);
    let d = f.open().unwrap();
    assert_eq!(d.kind, RecordingKind::ImuLog);
    warning(&d, "frame-clock");
    // What only looks like a log of times is told, and not used.
    f.write("frame_timestamps.txt", "begin\nend\n");
    assert!(warning(&f.open().unwrap(), "frame-times").message.contains("not used"));
    std::fs::remove_file(f.join("frame_timestamps.txt")).unwrap();
    // Two tables of the same sensor: it is not clear which is meant, and a video alone remains.
    f.write("imu.csv", imu.replace("gx,gy,gz", "a,b,c")).write("acc2.csv", imu.replace("gx,gy,gz", "a,b,c"));
    assert_eq!(f.open().unwrap().kind, RecordingKind::Video);
}

#[test]
fn hostile_folders_of_phones_end_in_an_error_or_a_warning() {
    let garbage: [&[u8]; 5] =
        [b"", b"\xff\xfe\0t", &[b'1'; 40_000], b"timestamp,frame\n1,2\n", b"{\"time\":1}\n{"];
    for content in garbage {
        for name in ["odometry.csv", "camera_matrix.csv", "imu.csv", "rgb.mp4"] {
            let f = stray(-1.0);
            f.write(name, content);
            let _ = f.open();
        }
        for name in ["data.jsonl", "calibration.json", "data.mp4"] {
            let f = spectacular();
            f.write(name, content);
            let _ = f.open();
        }
    }
}
