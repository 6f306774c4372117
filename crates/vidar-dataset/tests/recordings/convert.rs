//! A recording that was written in another layout is the same recording.

use crate::common::*;
use std::path::{Path, PathBuf};
use std::process::Command;
use vidar_core::LieGroup;
use vidar_dataset::convert::{ConvertFormat, convert};
use vidar_dataset::{CalibrationSource, OpenOptions, Recording, RecordingKind, open};

fn opened(path: &Path) -> Recording {
    open(path, &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn written(from: &Recording, to: &Path) -> Recording {
    let done = convert(from, to, ConvertFormat::of_path(to), &|_, _| true).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(
        (done.images, done.imu_samples, done.depths),
        (from.images.len(), from.imu.len(), from.depths.len())
    );
    opened(to)
}

/// Times, pixels, samples and calibration to the bit; rotations to the rounding of a matrix.
#[track_caller]
fn assert_same(a: &Recording, b: &Recording) {
    assert_eq!(a.images.len(), b.images.len());
    for (x, y) in a.images.iter().zip(&b.images) {
        assert_eq!(x.time, y.time);
        assert!(a.load_image(x).unwrap() == b.load_image(y).unwrap(), "pixels of {}", y.location);
    }
    assert!(a.imu == b.imu, "the IMU's samples");
    assert_eq!(a.rig.imu, b.rig.imu);
    let (x, y) = (a.rig.camera(a.camera).unwrap(), b.rig.camera(b.camera).unwrap());
    assert_eq!(x.model, y.model);
    assert_eq!((x.time_offset, x.rate_hz, a.readout), (y.time_offset, y.rate_hz, b.readout));
    let apart = (x.body_from_camera.inverse() * y.body_from_camera).log().amax();
    assert!(apart < 1e-15, "the camera moved by {apart:e}");
    assert_eq!(a.depths.len(), b.depths.len());
    for (x, y) in a.depths.iter().zip(&b.depths) {
        assert_eq!(x.time, y.time);
        let (x, y) = (a.load_depth(x).unwrap(), b.load_depth(y).unwrap());
        let same = |(p, q): (&f32, &f32)| p == q || p.is_nan() && q.is_nan();
        assert!(x.image().data().iter().zip(y.image().data()).all(same), "depth");
    }
    let (x, y) = (a.ground_truth.as_ref(), b.ground_truth.as_ref());
    assert_eq!(x.map(|t| (t.body(), t.len())), y.map(|t| (t.body(), t.len())));
    for (p, q) in x.iter().flat_map(|t| t.poses()).zip(y.iter().flat_map(|t| t.poses())) {
        assert_eq!((p.time, p.world_from_body.translation), (q.time, q.world_from_body.translation));
        assert!((p.world_from_body.inverse() * q.world_from_body).log().amax() < 1e-15);
    }
}

/// EuRoC with what a layout can lose: textured 8-bit images, 16-bit depth of another unit, a clock, a rolling shutter, small numbers.
fn rich() -> Folder {
    let f = euroc();
    f.edit("mav0/cam0/sensor.yaml", |s| s + "timeshift_cam_imu: -0.0123456\nreadout_secs: 0.0211\n");
    f.edit("mav0/imu0/data.csv", |s| {
        s.replacen("0.01,0,-0.01,0.1", "0.010000000000000002,-1e-17,-0.01,0.1", 5)
    });
    let depth_yaml =
        CAM0.replace("[16, 12]", "[8, 6]").replace("[10.0, 11.0, 7.5, 5.5]", "[5, 5.5, 3.5, 2.5]");
    let depth_yaml =
        depth_yaml.replace("radial-tangential", "none").replace("[-0.1, 0.01, 0.0, 1e-05]", "[]");
    f.write(
        "mav0/depth0/sensor.yaml",
        depth_yaml.replace("0.0, 0.1,", "0.0, 0.4,") + "units_per_metre: 500\n",
    );
    let mut list = String::from("#timestamp [ns],filename\n");
    for i in 0..10 {
        let t = frame_ns(i);
        let pixels: Vec<u8> = (0..192u32).map(|p| (p * 7 + i as u32 * 31) as u8).collect();
        f.write(
            &format!("mav0/cam0/data/{t}.png"),
            png(16, 12, ::png::ColorType::Grayscale, ::png::BitDepth::Eight, &pixels),
        );
        let depth: Vec<u16> = (0..48).map(|p| [0, 65_535, 1500 + p, 40_000][p as usize % 4]).collect();
        f.write(&format!("mav0/depth0/data/{t}.png"), gray16_png(8, 6, &depth));
        list += &format!("{t},{t}.png\n");
    }
    f.write("mav0/depth0/data.csv", list);
    f
}

#[test]
fn euroc_to_mcap_to_euroc_is_the_same_recording() {
    let f = rich();
    let first = opened(f.path());
    assert_eq!((first.depths.len(), first.readout.is_some()), (10, true));
    let mcap = written(&first, &f.join("out.mcap"));
    assert_eq!(mcap.kind, RecordingKind::Bag);
    assert_same(&first, &mcap);
    assert!(
        !kinds(&mcap).contains(&"imu-noise") && !kinds(&mcap).contains(&"extrinsics-missing"),
        "{:?}",
        kinds(&mcap)
    );
    let again = written(&mcap, &f.join("again"));
    assert_eq!(again.kind, RecordingKind::EurocAsl);
    assert_same(&first, &again);
    assert_eq!(kinds(&again), Vec::<&str>::new());
    // EuRoC's own numbers come back: those of the second file are those of the first.
    let imu = |root: &Path| {
        let text = std::fs::read_to_string(root.join("mav0/imu0/data.csv")).unwrap();
        text.lines()
            .skip(1)
            .map(|l| l.split(',').map(|n| n.parse().unwrap()).collect())
            .collect::<Vec<Vec<f64>>>()
    };
    assert_eq!(imu(f.path()), imu(&f.join("again")));
}

#[test]
fn every_camera_model_and_kind_of_pixel_survives() {
    let f = Folder::new();
    for i in 0..3u8 {
        let data: Vec<u8> = (0..8 * 6 * 3).map(|p| ((p * 5) as u8).wrapping_add(i)).collect();
        f.write(&format!("rgb/{i}.png"), png(8, 6, ::png::ColorType::Rgb, ::png::BitDepth::Eight, &data));
        let wide: Vec<u16> = (0..48).map(|p| p * 1013 + u16::from(i)).collect();
        f.write(&format!("gray16/{i}.png"), gray16_png(8, 6, &wide));
    }
    let flags = [
        ("pinhole:6.5,6.25,3.5,2.5", "rgb"),
        ("radtan:6,6,3.5,2.5,-0.28,0.07,0.0002,1.8e-5,0.01", "gray16"),
        ("kb4:6,6,3.5,2.5,0.0034,0.0007,-0.002,0.0002", "rgb"),
        ("ds:6,6,3.5,2.5,-0.2,0.59", "gray16"),
        ("fov:6,6,3.5,2.5,0.9", "rgb"),
    ];
    for (number, (flag, folder)) in flags.into_iter().enumerate() {
        let model = flag.parse::<vidar_dataset::CameraFlag>().unwrap().0;
        let options = OpenOptions { camera_model: Some(model), ..Default::default() };
        let d = open(&f.join(folder), &options).unwrap();
        let mcap = written(&d, &f.join(&format!("{number}.mcap")));
        assert_same(&d, &mcap);
        assert_same(&d, &written(&mcap, &f.join(&format!("folder{number}"))));
    }
    // Without a calibration none is invented; invented times are told.
    let d = opened(&f.join("rgb"));
    let done = convert(&d, &f.join("bare.mcap"), ConvertFormat::Mcap, &|_, _| true).unwrap();
    let told: Vec<_> = done.warnings.iter().map(|w| w.kind.as_str()).collect();
    assert_eq!(told, ["convert-calibration", "convert-times"]);
    let bare = opened(&f.join("bare.mcap"));
    assert_eq!(bare.calibration, CalibrationSource::Guessed);
    assert!(!kinds(&bare).contains(&"stamp-missing"), "{:?}", kinds(&bare));
}

#[test]
fn poses_of_the_recording_stay_poses_of_the_recording() {
    let f = tum();
    let truth = f.join("groundtruth.txt");
    let options = OpenOptions {
        trajectory: Some(truth),
        trajectory_body: Some(vidar_core::BodyFrame::Camera(vidar_core::CameraId(0))),
        ..Default::default()
    };
    let d = f.open_with(&options).unwrap();
    let mcap = written(&d, &f.join("out.mcap"));
    assert_same(&d, &mcap);
    let (own, read) =
        (d.external_trajectory.unwrap().trajectory, mcap.external_trajectory.clone().unwrap().trajectory);
    assert_eq!(own, read);
    let folder = written(&mcap, &f.join("folder"));
    assert!(folder.external_trajectory.is_none());
    let options = OpenOptions { trajectory: Some(f.join("folder/trajectory.tum")), ..Default::default() };
    assert_eq!(open(&f.join("folder"), &options).unwrap().external_trajectory.unwrap().trajectory, own);
}

#[test]
fn nothing_is_overwritten_and_nothing_is_left_of_a_failure() {
    let f = euroc();
    let d = opened(f.path());
    f.write("out.mcap", "mine");
    let error = convert(&d, &f.join("out.mcap"), ConvertFormat::Mcap, &|_, _| true).unwrap_err().to_string();
    assert!(error.contains("nothing is overwritten"), "{error}");
    for (name, format) in [("a.mcap", ConvertFormat::Mcap), ("b", ConvertFormat::Euroc)] {
        let error = convert(&d, &f.join(name), format, &|done, _| done < 3).unwrap_err().to_string();
        assert!(error.contains("interrupted"), "{error}");
        // An image that cannot be read ends it, too.
        let broken = opened(f.path());
        let last = broken.images[9].location.path().to_path_buf();
        let bytes = std::fs::read(&last).unwrap();
        std::fs::write(&last, b"x").unwrap();
        assert!(convert(&broken, &f.join(name), format, &|_, _| true).is_err());
        std::fs::write(&last, bytes).unwrap();
        let left: Vec<_> = std::fs::read_dir(f.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(!left.iter().any(|n| n.to_string_lossy().contains(".part") || *n == *name), "{left:?}");
    }
}

/// The interpreter with the packages `mcap`, `mcap_ros2` and `rosbags`: `VIDAR_PYTHON`, else `python3`.
fn python() -> Option<PathBuf> {
    let python = std::env::var_os("VIDAR_PYTHON").map_or_else(|| PathBuf::from("python3"), PathBuf::from);
    let probe = Command::new(&python).args(["-c", "import mcap, mcap_ros2, rosbags"]).output();
    probe.is_ok_and(|o| o.status.success()).then_some(python)
}

const OTHER_READERS: &str = r#"
import sys
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from pathlib import Path
path = sys.argv[1]
seen = {}
with open(path, "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    summary = reader.get_summary()
    for schema, channel, message, ros in reader.iter_decoded_messages():
        seen.setdefault(channel.topic, []).append((message.log_time, ros))
    assert summary.statistics.message_count == sum(len(v) for v in seen.values()), summary.statistics
    names = [m.name for m in reader.iter_metadata()]
    assert names == ["vidar.recording"], names
imu = seen["/imu0"][0][1]
assert imu.header.frame_id == "imu0" and imu.linear_acceleration.z == 9.8, imu
image = seen["/cam0/image_raw"][3][1]
assert (image.width, image.height, image.encoding, len(image.data)) == (16, 12, "mono8", 192)
info = seen["/cam0/camera_info"][0][1]
assert list(info.k)[0] == 10.0 and list(info.d) == [-0.1, 0.01, 0.0, 1e-05, 0.0], info
tf = seen["/tf_static"][0][1].transforms[0]
assert (tf.header.frame_id, tf.child_frame_id) == ("imu0", "cam0")
assert abs(tf.transform.translation.y - 0.2) < 1e-15
assert seen["/ground_truth"][2][1].child_frame_id == "imu0"
with AnyReader([Path(path)]) as reader:
    counts = {c.topic: c.msgcount for c in reader.connections}
    for connection, time, raw in reader.messages():
        message = reader.deserialize(raw, connection.msgtype)
        stamp = message.transforms[0].header.stamp if connection.topic == "/tf_static" else message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == time, (connection.topic, stamp, time)
print(counts)
"#;

#[test]
fn other_readers_of_mcap_understand_what_is_written() {
    let Some(python) = python() else {
        eprintln!("NOT CHECKED: the Python packages mcap, mcap-ros2-support and rosbags are not installed");
        return;
    };
    let f = rich();
    let out = f.join("out.mcap");
    written(&opened(f.path()), &out);
    let ran = Command::new(python).args(["-c", OTHER_READERS]).arg(&out).output().unwrap();
    let (text, errors) = (String::from_utf8_lossy(&ran.stdout), String::from_utf8_lossy(&ran.stderr));
    assert!(ran.status.success(), "{text}\n{errors}");
    for count in ["'/imu0': 120", "'/cam0/image_raw': 10", "'/depth0/image_raw': 10", "'/ground_truth': 10"] {
        assert!(text.contains(count), "{count} in {text}");
    }
}
