//! Every fault of a recording is reported: an error with place and cause, or a warning.

use crate::common::*;
use vidar_core::{CameraId, LieGroup};
use vidar_dataset::{
    CameraFlag, DatasetError, OpenOptions, TimeUnit, TrajectoryReadOptions, read_trajectory,
};

/// The error's text, which must contain all of `parts`.
#[track_caller]
fn fails<T: std::fmt::Debug>(result: Result<T, DatasetError>, parts: &[&str]) -> String {
    let text = result.unwrap_err().to_string();
    for part in parts {
        assert!(text.contains(part), "{part:?} not in: {text}");
    }
    text
}

#[test]
fn an_unknown_layout_is_refused_with_the_files_that_were_expected() {
    let f = Folder::new();
    fails(f.open(), &["an empty folder", "mav0/cam0/data.csv", "rgb.txt"]);
    f.write("readme.md", "hello");
    fails(f.open(), &["readme.md"]);
    fails(vidar_dataset::open(&f.join("readme.md"), &OpenOptions::default()), &["a file"]);
    fails(vidar_dataset::open(&f.join("nowhere"), &OpenOptions::default()), &["nowhere", "cannot read"]);
}

#[test]
fn a_missing_camera_names_those_there_are() {
    let f = euroc();
    let options = OpenOptions { camera: CameraId(1), ..Default::default() };
    fails(f.open_with(&options), &["no camera 1", "cam0"]);
    fails(tum().open_with(&options), &["no camera 1", "camera 0 only"]);
}

#[test]
fn a_camera_is_renumbered_with_a_warning_when_lower_numbers_are_missing() {
    let f = euroc();
    std::fs::rename(f.join("mav0/cam0"), f.join("mav0/cam1")).unwrap();
    let d = f.open_with(&OpenOptions { camera: CameraId(1), ..Default::default() }).unwrap();
    assert_eq!((d.camera, d.rig.cameras.len(), d.images[0].camera), (CameraId(0), 1, CameraId(0)));
    warning(&d, "camera-renumbered");
}

#[test]
fn a_broken_second_camera_does_not_stop_the_first() {
    let f = euroc();
    f.write("mav0/cam1/data.csv", "")
        .write("mav0/cam1/data/x", "")
        .write("mav0/cam1/sensor.yaml", ": : :\n- [");
    let d = f.open().unwrap();
    assert_eq!(d.rig.cameras.len(), 1);
    assert!(warning(&d, "camera-left-out").message.contains("cam1"));
}

#[test]
fn malformed_lists_are_reported_with_file_and_line() {
    let f = euroc();
    f.edit("mav0/imu0/data.csv", |s| s.replacen(",0.1,0,9.8\n", ",0.1,zero,9.8\n", 3));
    fails(f.open(), &["imu0/data.csv:2", "\"zero\"", "accel"]);
    let f = euroc();
    f.edit("mav0/imu0/data.csv", |s| s + "1403636581000000000,1,2,3\n");
    fails(f.open(), &["imu0/data.csv:122", "4 columns", "7 columns"]);
    let f = euroc();
    f.edit("mav0/cam0/data.csv", |s| s.replacen("14036365800", "l4036365800", 1));
    fails(f.open(), &["cam0/data.csv:2", "l4036", "a time in ns"]);
    let f = euroc();
    f.write("mav0/cam0/data.csv", [0xff, 0xd8, 0, 1, 2, b'\n', 0xfe]);
    fails(f.open(), &["cam0/data.csv:1", "not UTF-8"]);
    let f = euroc();
    f.write("mav0/cam0/data.csv", format!("#x\n{}\n", "1".repeat(20_000)));
    fails(f.open(), &["data.csv:2", "20000 bytes", "at most 16384"]);
    let f = euroc();
    f.edit("mav0/cam0/data.csv", |s| s + "1403636580500000000,../../../etc/passwd\n");
    fails(f.open(), &["data.csv:12", "inside the dataset"]);
    let f = euroc();
    f.write("mav0/imu0/data.csv", [0xff, 0xfe, b'1', 0]);
    fails(f.open(), &["UTF-16"]);
}

#[test]
fn lists_without_images_are_an_error() {
    let f = euroc();
    f.write("mav0/cam0/data.csv", "#timestamp [ns],filename\n");
    fails(f.open(), &["cam0/data.csv", "no image", "0 files listed"]);
    let f = euroc();
    std::fs::remove_dir_all(f.join("mav0/cam0/data")).unwrap();
    std::fs::create_dir(f.join("mav0/cam0/data")).unwrap();
    fails(f.open(), &["10 files listed", "none of them exists"]);
}

#[test]
fn missing_and_empty_images_are_left_out_and_counted() {
    let f = euroc();
    let name = |i: i64| format!("mav0/cam0/data/{}.png", frame_ns(i));
    std::fs::remove_file(f.join(&name(3))).unwrap();
    std::fs::remove_file(f.join(&name(4))).unwrap();
    f.write(&name(6), "");
    let d = f.open().unwrap();
    assert_eq!(d.images.len(), 7);
    assert!(warning(&d, "image-missing").message.starts_with("2 images"));
    assert!(warning(&d, "image-empty").message.contains("0 bytes"));
}

#[test]
fn truncated_images_fail_when_they_are_loaded() {
    let f = euroc();
    let d = f.open().unwrap();
    let whole = std::fs::read(d.images[5].location.path()).unwrap();
    for keep in [0, 4, 8, 30, whole.len() / 2, whole.len() - 20] {
        std::fs::write(d.images[5].location.path(), &whole[..keep]).unwrap();
        fails(d.load_image(&d.images[5]), &[&format!("{}.png", frame_ns(5)), "cannot decode"]);
    }
    std::fs::write(d.images[5].location.path(), "<html>not found</html>").unwrap();
    fails(d.load_image(&d.images[5]), &["neither PNG nor JPEG"]);
    let broken = d.events().filter(Result::is_err).count();
    assert_eq!(broken, 1, "the stream goes on after one bad image");
}

#[test]
fn an_image_of_another_size_is_left_out_and_told_and_one_that_changes_later_is_refused() {
    let f = euroc();
    let whole = f.open().unwrap();
    f.write(&format!("mav0/cam0/data/{}.png", frame_ns(5)), gray_png(12, 16, 0));
    fails(whole.load_image(&whole.images[5]), &["12x16", "16x12"]);
    let d = f.open().unwrap();
    assert_eq!(d.images.len() + 1, whole.images.len());
    assert!(warning(&d, "image-size").message.contains("the first is 12x16"), "{:?}", d.warnings);
    f.edit("mav0/cam0/sensor.yaml", |s| s.replace("[16, 12]", "[640, 480]"));
    fails(f.open(), &["image is 16x12", "camera is 640x480"]);
}

#[test]
fn unordered_times_duplicates_and_gaps_are_reported() {
    let f = euroc();
    f.edit("mav0/cam0/data.csv", |s| {
        let mut lines: Vec<&str> = s.lines().collect();
        lines.swap(2, 5);
        lines.insert(9, lines[8]);
        lines.join("\n")
    });
    f.edit("mav0/imu0/data.csv", |s| {
        let lines: Vec<&str> = s.lines().collect();
        [&lines[..40], &lines[70..]].concat().join("\n")
    });
    let d = f.open().unwrap();
    assert_eq!(d.images.len(), 10);
    assert!(d.images.windows(2).all(|w| w[0].time < w[1].time));
    assert!(warning(&d, "time-not-increasing").place.ends_with("cam0/data.csv"));
    assert!(warning(&d, "time-duplicate").message.starts_with("1 images"));
    assert!(warning(&d, "imu-gap").message.contains("0.155 s"), "{:?}", d.warnings);
    let f = euroc();
    for i in 2..8 {
        std::fs::remove_file(f.join(&format!("mav0/cam0/data/{}.png", frame_ns(i)))).unwrap();
    }
    assert!(warning(&f.open().unwrap(), "image-gap").message.contains("0.350 s"));
    let f = euroc();
    f.edit("mav0/imu0/data.csv", |s| s.lines().take(60).map(|l| format!("{l}\n")).collect());
    assert!(warning(&f.open().unwrap(), "imu-coverage").message.starts_with("5 of 10 images"));
}

#[test]
fn times_in_another_unit_are_corrected_with_a_warning() {
    for (digits, unit) in [(9, "s"), (6, "ms"), (3, "us")] {
        let f = euroc();
        // The same list with times in s, ms, µs: the decimal point moves left.
        f.edit("mav0/imu0/data.csv", |s| {
            let row = |l: &str| match l.split_once(',') {
                Some((t, rest)) if !l.starts_with('#') => {
                    let (whole, fraction) = t.split_at(t.len() - digits);
                    format!("{whole}.{fraction},{rest}\n")
                }
                _ => format!("{l}\n"),
            };
            s.lines().map(row).collect()
        });
        let d = f.open().unwrap();
        assert_eq!(d.imu[1].time.nanos(), frame_ns(0) - 45_000_000, "{unit}");
        let note = warning(&d, "unit-slip");
        assert!(note.message.contains(&format!("read as {unit}")), "{note}");
    }
    let f = euroc();
    let given = OpenOptions { time_unit: Some(TimeUnit::Nanoseconds), ..Default::default() };
    assert!(!kinds(&f.open_with(&given).unwrap()).contains(&"unit-slip"));
}

#[test]
fn imu_samples_that_are_not_finite_are_skipped() {
    let f = euroc();
    f.edit("mav0/imu0/data.csv", |s| {
        s.replacen("0.01,0,-0.01", "NaN,0,-0.01", 2).replacen("0.01,0,", "1e999,0,", 1)
    });
    let d = f.open().unwrap();
    assert_eq!(d.imu.len(), 117);
    assert!(warning(&d, "sample-not-finite").message.starts_with("3 samples"));
}

#[test]
fn a_wrong_gravity_norm_is_reported_with_its_likely_cause() {
    for (accel, guess) in [("1.0", "units of g"), ("0.02", "removed"), ("-19.0", "not 8.5 to 11")] {
        let f = euroc();
        f.edit("mav0/imu0/data.csv", |s| s.replace(",0.1,0,9.8", &format!(",0.01,0,{accel}")));
        let d = f.open().unwrap();
        assert!(warning(&d, "gravity-norm").message.contains(guess), "{:?}", d.warnings);
    }
    let f = euroc();
    f.edit("mav0/imu0/data.csv", |s| s.replace("0.01,0,-0.01", "60,0,-0.01"));
    warning(&f.open().unwrap(), "gyro-range");
}

#[test]
fn crlf_and_byte_order_marks_are_accepted_with_a_warning() {
    let f = euroc();
    f.edit("mav0/cam0/data.csv", |s| s.replace('\n', "\r\n"));
    f.edit("mav0/imu0/data.csv", |s| format!("\u{feff}{s}"));
    f.edit("mav0/cam0/sensor.yaml", |s| format!("\u{feff}{}", s.replace('\n', "\r\n")));
    let d = f.open().unwrap();
    assert_eq!((d.images.len(), d.imu.len()), (10, 120));
    assert!(warning(&d, "crlf").place.ends_with("cam0/data.csv"));
    warning(&d, "byte-order-mark");
}

#[test]
fn images_and_trajectory_without_common_time_report_both_ranges_and_the_likely_unit() {
    let f = euroc();
    let rows = |scale: f64, offset: f64| -> String {
        (0..10).map(|i| format!("{:.9} {i} 0 0 0 0 0 1\n", (offset + 0.05 * f64::from(i)) * scale)).collect()
    };
    for (text, words) in [
        (rows(1.0, 0.0), "starts near zero"),
        (rows(1.0, 1_403_636_680.0), "no overlap"),
        (rows(1e-3, 1_403_636_580.0), "another unit"),
    ] {
        f.write("t.txt", text);
        let d =
            f.open_with(&OpenOptions { trajectory: Some(f.join("t.txt")), ..Default::default() }).unwrap();
        let note = warning(&d, "no-overlap");
        assert!(note.message.contains(words) && note.message.contains("1403636580.000000000"), "{note}");
    }
    f.edit("mav0/state_groundtruth_estimate0/data.csv", |s| s.replace("\n1403", "\n1503"));
    assert!(warning(&f.open().unwrap(), "no-overlap").message.contains("ground truth"));
}

#[test]
fn poses_of_a_lost_tracker_are_left_out_and_wrong_columns_are_an_error() {
    let f = Folder::new();
    let read = |text: &str| {
        f.write("t.txt", text);
        read_trajectory(&f.join("t.txt"), &TrajectoryReadOptions::default())
    };
    let good = "1.0 0 0 0 0 0 0 1\n1.1 1 0 0 0 0 0 1\n";
    let (t, notes) =
        read(&format!("{good}1.2 nan nan nan nan nan nan nan\n1.3 0 0 0 0 0 0 0\n1.05 0 0 0 0 0 0 1\n"))
            .unwrap();
    assert_eq!(t.len(), 3);
    assert!(
        notes.iter().any(|n| n.kind == "pose-not-finite"
            && n.message.starts_with("2 poses")
            && n.place.ends_with(":3"))
    );
    assert!(notes.iter().any(|n| n.kind == "time-not-increasing"));
    fails(read(&format!("{good}1.2 0 0 0 0 0 0 2\n")), &["t.txt:3", "length 2.0000", "unit quaternion"]);
    fails(read("1.0 nan 0 0 0 0 0 1\n"), &["no valid pose", "1 rows"]);
    fails(read(""), &["no valid pose", "empty"]);
    fails(read("hello world\n"), &["no known trajectory format"]);
    fails(read("1.0 0 0 0 0 0 0 1\n1.1 0 0 0\n"), &["t.txt:2", "4 columns"]);
    fails(read(&"1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(3)), &["3 poses", "0 times"]);
    fails(read("1 0 0 0 0 2 0 0 0 0 1 0\n"), &["t.txt:1", "rigid motion", "determinant 2"]);
}

#[test]
fn an_invalid_calibration_is_reported_with_its_key() {
    let with = |from: &str, to: &str| {
        let f = euroc();
        f.edit("mav0/cam0/sensor.yaml", |s| s.replace(from, to));
        f.open()
    };
    fails(with("[10.0, 11.0, 7.5, 5.5]", "[0.0, 11.0, 7.5, 5.5]"), &["sensor.yaml", "fx", "positive"]);
    fails(with("[10.0, 11.0, 7.5, 5.5]", "[.nan, 11.0, 7.5, 5.5]"), &["sensor.yaml"]);
    fails(with("[10.0, 11.0, 7.5, 5.5]", "[10.0, 11.0, 7.5]"), &["3 intrinsics", "4: fu, fv, cu, cv"]);
    fails(with("[10.0, 11.0, 7.5, 5.5]", "[10.0, eleven, 7.5, 5.5]"), &["sensor.yaml:14", "eleven"]);
    fails(with("0.0, 0.0, 1.0, 0.3", "0.0, 0.0, -1.0, 0.3"), &["T_BS (line 4)", "determinant -1"]);
    fails(with("1.0, 0.0, 0.0, 0.2", "1.5, 0.0, 0.0, 0.2"), &["T_BS", "deviates from the identity"]);
    fails(with("0.0, 0.0, 0.0, 1.0]", "0.0, 1.0]"), &["14 numbers", "16 numbers"]);
    fails(with("[16, 12]", "[16, -12]"), &["resolution"]);
    fails(with("camera_model: pinhole", "camera_model: omni"), &["omni", "not supported"]);
    fails(with("radial-tangential", "rational"), &["rational", "not supported"]);
    fails(with("intrinsics: [10.0", "intrinsics: [[10.0"), &["sensor.yaml"]);
    let f = euroc();
    f.write("chain.yaml", "cam0: {camera_model: omni, intrinsics: [1,2,3,4,5], distortion_model: radtan}\n");
    let options = OpenOptions { calibration: vec![f.join("chain.yaml")], ..Default::default() };
    fails(f.open_with(&options), &["chain.yaml", "omni"]);
    f.write("chain.yaml", "robot: {arms: 2}\n");
    fails(f.open_with(&options), &["the keys robot", "cam0"]);
    f.write("chain.yaml", "a: &a [*a, *a]\n");
    assert!(f.open_with(&options).is_err());
    let f = posed();
    f.write("K.txt", "9 0 3.5 0 0 2.5 0 0 1");
    fails(f.open(), &["K.txt", "fy"]);
    f.write("K.txt", "9 0 3.5 0 9");
    fails(f.open(), &["K.txt", "5 numbers"]);
    f.write("K.txt", "9 2 3.5 0 9 2.5 0 0 1");
    fails(f.open(), &["not a pinhole"]);
}

#[test]
fn placeholder_poses_of_seven_scenes_are_skipped_and_a_real_pose_at_the_origin_is_kept() {
    let f = seven_scenes();
    f.write("seq-01/frame-000002.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    f.write("seq-01/frame-000004.pose.txt", "nan nan nan nan\n".repeat(4));
    let d = f.open().unwrap();
    assert_eq!(d.ground_truth.as_ref().unwrap().len(), 2);
    assert!(warning(&d, "pose-not-finite").message.starts_with("2 poses"));
    let f = seven_scenes();
    for (i, x) in [(0, 0.0), (2, 0.01), (4, 0.02)] {
        f.write(
            &format!("seq-01/frame-00000{i}.pose.txt"),
            format!("1 0 0 {x}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        );
    }
    assert_eq!(f.open().unwrap().ground_truth.unwrap().len(), 4);
    f.write("seq-01/frame-000002.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1\n");
    fails(f.open(), &["frame-000002.pose.txt", "11 numbers"]);
}

#[test]
fn a_posed_folder_needs_one_pose_an_image() {
    let f = posed();
    f.edit("poses.txt", |s| s.lines().skip(1).map(|l| format!("{l}\n")).collect());
    fails(f.open(), &["poses.txt", "3 poses", "4 times"]);
    let f = posed();
    f.edit("poses.txt", |s| s.replace("0 0 0 1\n", "0 0 0 2\n"));
    fails(f.open(), &["poses.txt:1", "last row"]);
    let f = posed();
    f.edit("poses.txt", |s| s.replacen("1 0 0 2", "1 0 0 nan", 1));
    let d = f.open().unwrap();
    assert_eq!((d.images.len(), d.ground_truth.as_ref().unwrap().len()), (4, 3));
}

#[test]
fn invalid_options_are_refused() {
    let f = euroc();
    fails(f.open_with(&OpenOptions { stride: 0, ..Default::default() }), &["stride", "1 or more"]);
    fails(f.open_with(&OpenOptions { depth_scale: Some(0.0), ..Default::default() }), &["depth scale"]);
    let rotation = vidar_core::So3::exp(&nalgebra::Vector3::zeros());
    let bad = vidar_core::Se3::new(rotation, nalgebra::Vector3::new(f64::NAN, 0.0, 0.0));
    fails(f.open_with(&OpenOptions { color_from_depth: Some(bad), ..Default::default() }), &["finite"]);
    let model = "pinhole:9,9,7,5".parse::<CameraFlag>().unwrap().0;
    let d = f.open_with(&OpenOptions { camera_model: Some(model), ..Default::default() }).unwrap();
    assert_eq!(d.rig.cameras[0].model.width(), 16);
    // The camera's pose on the rig is still that of the file.
    assert_eq!(d.rig.cameras[0].body_from_camera.translation.x, 0.1);
}

#[test]
fn tum_lists_in_nanoseconds_and_wrong_accelerometer_units_are_reported() {
    let f = tum();
    f.edit("rgb.txt", |s| s.replace(".5 rgb", "500000000 rgb"));
    f.edit("accelerometer.txt", |s| s.replace("-9.7", "-0.99"));
    let d = f.open().unwrap();
    assert_eq!(d.images[0].time.nanos(), 1_305_031_100_500_000_000);
    warning(&d, "unit-slip");
    assert!(warning(&d, "gravity-norm").message.contains("units of g"));
}

#[test]
fn a_list_of_times_must_fit_the_images() {
    let f = Folder::new();
    for i in 0..3 {
        f.write(&format!("a{i}.png"), gray_png(4, 4, 7));
    }
    f.write("timestamps.txt", "1.0\n1.1\n");
    fails(f.open(), &["timestamps.txt", "3 poses", "2 times"]);
    f.write("timestamps.txt", "a0.png 1.0\na1.png 1.1\nb.png 1.2\n");
    let d = f.open().unwrap();
    assert_eq!(d.images.len(), 2);
    warning(&d, "time-missing");
    warning(&d, "image-missing");
    f.write("timestamps.txt", "a0.png one\n");
    fails(f.open(), &["timestamps.txt:1", "one"]);
}
