//! Bags as recordings: topics, calibration, poses, and what is said when they are not clear.

use std::path::{Path, PathBuf};
use vidar_core::{BodyFrame, SensorEvent};
use vidar_dataset::{CalibrationSource, OpenOptions, Recording, RecordingKind, open};

/// Made by third-party writers; see `make.py` there.
fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../vidar-bag/tests/fixtures").join(name)
}

fn with_topics(topics: &[&str]) -> OpenOptions {
    OpenOptions { topics: topics.iter().map(|t| t.parse().unwrap()).collect(), ..OpenOptions::default() }
}

fn open_bag(name: &str, topics: &[&str]) -> Recording {
    open(&fixture(name), &with_topics(topics)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

fn kinds(dataset: &Recording) -> Vec<&str> {
    dataset.warnings.iter().map(|w| w.kind.as_ref()).collect()
}

#[test]
fn every_container_is_the_same_recording() {
    let first = open_bag("ros1.bag", &[]);
    assert_eq!(first.kind, RecordingKind::Bag);
    assert_eq!(first.name, "ros1");
    assert_eq!((first.images.len(), first.imu.len()), (3, 8));
    assert_eq!(first.calibration, CalibrationSource::Topic("/cam0/camera_info".into()));
    let model = &first.rig.cameras[0].model;
    assert_eq!((model.name(), model.width(), model.height()), ("pinhole-radtan", 24, 20));
    // imu_from_camera of /tf_static.
    let mount = first.rig.cameras[0].body_from_camera;
    assert_eq!(mount.translation.as_slice(), [0.1, -0.05, 0.02]);
    let frames: Vec<_> = first.images.iter().map(|i| first.load_image(i).unwrap()).collect();
    for name in [
        "ros1_lz4.bag",
        "ros1_bz2.bag",
        "ros2_mcap",
        "ros2_sqlite",
        "ros2_sqlite_zstd",
        "mcap_ros1_lz4.mcap",
        "mcap_ros2_plain.mcap",
    ] {
        let other = open_bag(name, &[]);
        let times = |d: &Recording| d.images.iter().map(|i| i.time).collect::<Vec<_>>();
        assert_eq!((times(&other), &other.imu), (times(&first), &first.imu), "{name}");
        assert_eq!(other.rig, first.rig, "{name}");
        for (entry, frame) in other.images.iter().zip(&frames) {
            assert_eq!(other.load_image(entry).unwrap(), *frame, "{name}");
        }
    }
}

#[test]
fn events_come_in_the_order_of_time() {
    let dataset = open_bag("mcap_ros2_zstd.mcap", &["truth=/truth"]);
    let events: Vec<SensorEvent> = dataset.events().map(|e| e.unwrap()).collect();
    assert_eq!(events.len(), 3 + 8 + 3);
    assert!(events.windows(2).all(|w| w[0].time() <= w[1].time()));
}

#[test]
fn poses_are_used_as_the_user_says() {
    let without = open_bag("ros1.bag", &[]);
    assert!(without.ground_truth.is_none() && without.external_trajectory.is_none());
    assert!(kinds(&without).contains(&"poses-unused"));
    let truth = open_bag("ros1.bag", &["truth=/truth"]);
    let poses = truth.ground_truth.as_ref().unwrap();
    assert_eq!((poses.poses().len(), poses.body()), (3, BodyFrame::Imu));
    // A PoseStamped does not name its body.
    assert!(kinds(&truth).contains(&"trajectory-body"));
    assert_eq!(poses.poses()[1].world_from_body.translation.as_slice(), [0.5, 1.0, 1.75]);
    let used = open_bag("ros1.bag", &["trajectory=/truth"]);
    assert_eq!(used.external_trajectory.unwrap().trajectory, *poses);
    let error = open(&fixture("ros1.bag"), &with_topics(&["/truth"])).unwrap_err().to_string();
    assert!(error.contains("truth=/truth") && error.contains("trajectory=/truth"), "{error}");
}

#[test]
fn a_topic_that_is_not_there_is_answered_with_the_list() {
    let error = open(&fixture("ros2_mcap"), &with_topics(&["/cam7/image"])).unwrap_err().to_string();
    for part in ["/cam7/image", "/cam0/image_raw  sensor_msgs/Image  3", "/imu0  sensor_msgs/Imu  8"] {
        assert!(error.contains(part), "{part}: {error}");
    }
    let error = open(&fixture("ros2_mcap"), &with_topics(&["/tf_static"])).unwrap_err().to_string();
    assert!(error.contains("of a type that is not read"), "{error}");
}

#[test]
fn a_camera_that_is_not_there_is_named() {
    let options = OpenOptions { camera: vidar_core::CameraId(1), ..OpenOptions::default() };
    let error = open(&fixture("ros1.bag"), &options).unwrap_err().to_string();
    assert!(error.contains("no camera") && error.contains("/cam0/image_raw"), "{error}");
}

#[test]
fn foxglove_without_imu_is_a_recording_of_images() {
    let dataset = open_bag("foxglove_protobuf.mcap", &["/cam0/image", "truth=/truth"]);
    assert_eq!(dataset.images.len(), 3);
    assert!(dataset.imu.is_empty());
    assert_eq!(dataset.ground_truth.unwrap().body(), BodyFrame::Camera(vidar_core::CameraId(0)));
    assert_eq!(dataset.calibration, CalibrationSource::Topic("/cam0/calibration".into()));
    let with_imu = open_bag("foxglove_json.mcap", &[]);
    assert_eq!(with_imu.imu.len(), 8);
}

#[test]
fn a_folder_of_one_bag_is_the_bag() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(fixture("ros1_lz4.bag"), folder.path().join("flight.bag")).unwrap();
    let dataset = open(folder.path(), &OpenOptions::default()).unwrap();
    assert_eq!((dataset.kind, dataset.images.len()), (RecordingKind::Bag, 3));
    assert!(dataset.reason.contains("flight.bag"), "{}", dataset.reason);
}

#[test]
fn fingerprints_tell_recordings_apart() {
    let print = |name: &str| {
        let mut bytes = Vec::new();
        open_bag(name, &[]).write_fingerprint(&mut bytes).unwrap();
        bytes
    };
    assert_eq!(print("ros1.bag"), print("ros1.bag"));
    assert_ne!(print("ros1.bag"), print("ros1_lz4.bag"));
}

#[test]
fn a_cut_bag_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let whole = std::fs::read(fixture("ros1.bag")).unwrap();
    let path = folder.path().join("cut.bag");
    std::fs::write(&path, &whole[..whole.len() * 2 / 3]).unwrap();
    let dataset = open(&path, &OpenOptions::default()).unwrap();
    assert!(kinds(&dataset).contains(&"bag-cut-off"), "{:?}", kinds(&dataset));
}

#[test]
fn what_is_no_recording_is_named_with_the_nearest_way() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes, says, way) in [
        ("a.zip", &b"PK\x03\x04\x14\0\0\0rest"[..], "a zip archive", "unpack"),
        ("a.bag.gz", b"\x1f\x8brest", "compressed", "gunzip"),
        ("a.heic", b"\0\0\0\x18ftypheic\0\0", "HEIC", "JPEG"),
        ("b.zip", b"PK\x03\x04\x14\0\x01\0rest", "an encrypted zip archive", "password"),
        ("a.avif", b"\0\0\0\x18ftypavif\0\0", "AVIF", "PNG"),
        ("a.mkv", b"\x1a\x45\xdf\xa3rest", "Matroska", "ffmpeg"),
        ("a.jpg", b"\xff\xd8\xff\xe0", "one image", "vidar depth"),
        ("a.bag", b"\x9a\x11\x34garbage", "named as a bag", "encrypted"),
        ("a.bin", b"", "empty", "copy"),
        ("data.csv", b"#timestamp\n", "a text file", "folder"),
    ] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let error = open(&path, &OpenOptions::default()).unwrap_err().to_string();
        assert!(error.contains(says) && error.contains(way), "{name}: {error}");
    }
    let images = tempfile::tempdir().unwrap();
    ["1.webp", "2.webp"].iter().for_each(|name| std::fs::write(images.path().join(name), b"RIFF").unwrap());
    let error = open(images.path(), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("2 images of a kind that is not decoded (1.webp, 2.webp)"), "{error}");
    let error =
        open(Path::new("https://example.org/a.bag"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("URL") && error.contains("download"), "{error}");
}

/// A bag with an image and IMU topics `(name, has gyroscope, has accelerometer, period in ns)`, as a RealSense camera's driver writes them.
fn bag_with_imus(imus: &[(&str, bool, bool, i64)]) -> tempfile::TempDir {
    use vidar_bag::write::{McapWriter, encode};
    use vidar_bag::{Header, ImuMessage, Message, RawImage};
    use vidar_core::Timestamp;
    let folder = tempfile::tempdir().unwrap();
    let mut writer = McapWriter::new(Vec::new(), "test").unwrap();
    let mut put = |topic: &str, nanos: i64, message: &Message| {
        let (name, bytes) = encode(message).unwrap();
        let channel = writer.channel(topic, name).unwrap();
        writer.write(channel, Timestamp::from_nanos(nanos), &bytes).unwrap();
    };
    let header = |nanos: i64| Header { stamp: Timestamp::from_nanos(nanos), frame: "imu".into() };
    for (topic, gyro, accel, period) in imus {
        for k in 1..=40 {
            let nanos = k * period;
            let t = nanos as f64 * 1e-9;
            let message = Message::Imu(ImuMessage {
                header: header(nanos),
                angular_velocity: if *gyro { [0.1, t, 0.0] } else { [0.0; 3] },
                linear_acceleration: if *accel { [t, 0.0, 9.8] } else { [0.0; 3] },
            });
            put(topic, nanos, &message);
        }
    }
    let data: Vec<u8> = (0..24 * 20).map(|k| (k % 251) as u8).collect();
    let (width, height, row_bytes) = (24, 20, 24);
    for nanos in [100_000_000, 150_000_000] {
        let encoding = "mono8".to_owned();
        let header = header(nanos);
        let image =
            RawImage { header, width, height, encoding, row_bytes, is_big_endian: false, data: data.clone() };
        put("/camera/color/image_raw", nanos, &Message::Image(image));
    }
    let bytes = writer.finish().unwrap();
    std::fs::write(folder.path().join("realsense.mcap"), bytes).unwrap();
    folder
}

#[test]
fn gyroscope_and_accelerometer_on_topics_of_their_own_are_one_imu() {
    let (gyro, accel) = ("/camera/gyro/sample", "/camera/accel/sample");
    let apart = [(gyro, true, false, 5_000_000), (accel, false, true, 16_000_000)];
    let folder = bag_with_imus(&apart);
    let path = folder.path().join("realsense.mcap");
    let dataset = open(&path, &OpenOptions::default()).unwrap();
    // Samples of the gyroscope between the first and the last of the accelerometer: 20 to 200 ms.
    assert_eq!(dataset.imu.len(), 37);
    for sample in &dataset.imu {
        let t = sample.time.as_secs_f64();
        assert!((sample.gyro.0.y - t).abs() < 1e-12 && (sample.accel.0.x - t).abs() < 1e-9, "{sample:?}");
    }
    // A topic with both is preferred; two of them must be told apart by the user.
    let both = [apart[0], apart[1], ("/camera/imu", true, true, 5_000_000)];
    let folder = bag_with_imus(&both);
    let dataset = open(&folder.path().join("realsense.mcap"), &OpenOptions::default()).unwrap();
    assert_eq!(dataset.imu.len(), 40);
    let folder = bag_with_imus(&[both[2], ("/imu", true, true, 4_000_000), apart[0]]);
    let path = folder.path().join("realsense.mcap");
    let error = open(&path, &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("3 IMUs"), "{error}");
    assert_eq!(open(&path, &with_topics(&["/imu"])).unwrap().imu.len(), 40);
}

/// Made by ffmpeg and third-party writers; see `make_compressed_video.py` there.
fn video_fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn greens(dataset: &Recording, number: usize) -> Vec<u8> {
    match dataset.load_image(&dataset.images[number]).unwrap() {
        vidar_core::FrameImage::Rgb8(image) => image.data().iter().map(|p| p[1]).collect(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn compressed_video_is_decoded_as_the_same_video_in_a_file() {
    let bag = open(&video_fixture("compressed_video.mcap"), &OpenOptions::default()).unwrap();
    let file = open(&video_fixture("compressed_video.mp4"), &OpenOptions::default()).unwrap();
    assert_eq!((bag.images.len(), file.images.len()), (30, 30));
    assert!(bag.reason.contains("/camera/video as H.264"), "{}", bag.reason);
    // Stamps of the messages, 20 Hz.
    assert!(bag.images.windows(2).all(|w| (w[1].time - w[0].time).nanos() == 50_000_000));
    assert_eq!(bag.images[0].time.nanos(), 1_700_000_000_000_000_000);
    let in_order: Vec<_> = (0..30).map(|n| greens(&bag, n)).collect();
    for number in (0..30).chain([29, 3, 17, 12, 11, 0]) {
        assert_eq!(greens(&bag, number), in_order[number], "picture {number}");
        assert_eq!(greens(&file, number), in_order[number], "picture {number}");
    }
    assert_ne!(in_order[3], in_order[17]);
    // A part of it alone, thinned.
    let secs = |s: f64| Some(vidar_core::Duration::from_secs_f64(s));
    let options = OpenOptions { start: secs(0.7), end: secs(1.2), stride: 3, ..OpenOptions::default() };
    let part = open(&video_fixture("compressed_video.mcap"), &options).unwrap();
    let numbers: Vec<usize> = part.images.iter().map(|i| i.frame_id.0 as usize).collect();
    assert_eq!(numbers, [14, 17, 20, 23]);
    for (at, number) in numbers.into_iter().enumerate() {
        assert_eq!(greens(&part, at), in_order[number], "picture {number}");
    }
}

#[test]
fn compressed_video_of_h265_in_json_shows_the_same_scene() {
    let h264 = open(&video_fixture("compressed_video.mcap"), &OpenOptions::default()).unwrap();
    let h265 = open(&video_fixture("compressed_video_json.mcap"), &OpenOptions::default()).unwrap();
    assert_eq!(h265.images.len(), 30);
    // In another order than that of the messages, too.
    for number in [0, 13, 29, 5, 6, 7] {
        let (a, b) = (greens(&h264, number), greens(&h265, number));
        let difference: u64 = a.iter().zip(&b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        let mean = difference as f64 / a.len() as f64;
        // Two lossy codings of the same pictures; of neighbouring pictures the difference is several times larger.
        assert!(mean < 5.0, "picture {number}: {mean}");
    }
}

#[test]
fn compressed_video_that_cannot_be_decoded_says_why() {
    // The only message of this topic is a start code.
    let options = with_topics(&["/video"]);
    let error = open(&fixture("foxglove_protobuf.mcap"), &options).unwrap_err().to_string();
    assert!(error.contains("no picture that stands alone"), "{error}");
}

#[test]
fn the_other_camera_of_a_stereo_bag_is_named_and_can_be_chosen() {
    use vidar_bag::{Header, Message, RawImage, write::McapWriter};
    let mut writer = McapWriter::new(Vec::new(), "test").unwrap();
    let time = |n: u32| vidar_core::Timestamp::from_nanos(1_000_000_000 + i64::from(n) * 50_000_000);
    for (topic, value) in [("/stereo/left/image_raw", 50u8), ("/stereo/right/image_raw", 200)] {
        let channel = writer.channel(topic, "sensor_msgs/msg/Image").unwrap();
        for number in 0..5 {
            let image = RawImage {
                header: Header { stamp: time(number), frame: "cam".into() },
                width: 8,
                height: 6,
                encoding: "mono8".into(),
                row_bytes: 8,
                is_big_endian: false,
                data: vec![value; 48],
            };
            let (_, bytes) = vidar_bag::write::encode(&Message::Image(image)).unwrap();
            writer.write(channel, time(number), &bytes).unwrap();
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stereo.mcap");
    std::fs::write(&path, writer.finish().unwrap()).unwrap();
    let of_camera = |number: u32| {
        let options = OpenOptions { camera: vidar_core::CameraId(number), ..OpenOptions::default() };
        let dataset = open(&path, &options).unwrap();
        match dataset.load_image(&dataset.images[0]).unwrap() {
            vidar_core::FrameImage::Gray8(image) => (dataset.reason, image[(0, 0)]),
            other => panic!("{other:?}"),
        }
    };
    let (reason, value) = of_camera(0);
    assert!(reason.contains("not those of /stereo/right/image_raw (--camera 1)") && value == 50, "{reason}");
    let (reason, value) = of_camera(1);
    assert!(reason.contains("images of /stereo/right/image_raw") && value == 200, "{reason}");
}

#[test]
fn depth_of_32_bits_is_metres_and_nobody_is_asked_for_its_unit() {
    use vidar_bag::write::{McapWriter, encode};
    use vidar_bag::{Header, Message, RawImage};
    use vidar_core::Timestamp;
    let (folder, mut writer) = (tempfile::tempdir().unwrap(), McapWriter::new(Vec::new(), "test").unwrap());
    let depth: Vec<u8> = [1.5f32, f32::INFINITY, 0.0, 2.0].iter().flat_map(|m| m.to_le_bytes()).collect();
    for (topic, encoding, row_bytes, data) in
        [("/cam/image_raw", "mono8", 2, vec![7; 4]), ("/cam/depth/image", "32FC1", 8, depth)]
    {
        let stamp = Timestamp::from_nanos(1_000_000_000);
        let header = Header { stamp, frame: "cam".into() };
        let encoding = encoding.to_string();
        let image = RawImage { header, width: 2, height: 2, encoding, row_bytes, is_big_endian: false, data };
        let (name, bytes) = encode(&Message::Image(image)).unwrap();
        let channel = writer.channel(topic, name).unwrap();
        writer.write(channel, stamp, &bytes).unwrap();
    }
    let path = folder.path().join("depth.mcap");
    std::fs::write(&path, writer.finish().unwrap()).unwrap();
    let dataset = open(&path, &OpenOptions::default()).unwrap();
    assert!(!kinds(&dataset).contains(&"depth-scale"), "{:?}", kinds(&dataset));
    let metres = dataset.load_depth(&dataset.depths[0]).unwrap();
    let metres = metres.image().data().to_vec();
    assert!(metres[0] == 1.5 && metres[1].is_nan() && metres[2].is_nan() && metres[3] == 2.0, "{metres:?}");
}
