//! Recordings that third-party writers made (tests/fixtures/make.py), whole and damaged.

use serde::Deserialize;
use std::path::{Path, PathBuf};
use vidar_bag::{Bag, BagError, Message, Pixels, Pose, Topic};
use vidar_core::FrameImage;

#[derive(Deserialize)]
struct Expected {
    width: usize,
    height: usize,
    images: Vec<ExpectedImage>,
    imu: Vec<ExpectedSample>,
    d: Vec<f64>,
    k: Vec<f64>,
    imu_from_camera: ExpectedTransform,
    poses: Vec<ExpectedPose>,
}

#[derive(Deserialize)]
struct ExpectedImage {
    time: i64,
    sum: u64,
}

#[derive(Deserialize)]
struct ExpectedSample {
    time: i64,
    gyro: [f64; 3],
    accel: [f64; 3],
}

#[derive(Deserialize)]
struct ExpectedTransform {
    t: [f64; 3],
    q: [f64; 4],
}

#[derive(Deserialize)]
struct ExpectedPose {
    time: i64,
    position: [f64; 3],
    orientation: [f64; 4],
}

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures")
}

fn expected() -> Expected {
    serde_json::from_str(&std::fs::read_to_string(fixtures().join("expected.json")).unwrap()).unwrap()
}

fn topic<'a>(bag: &'a Bag, ending: &str) -> &'a Topic {
    bag.topics().iter().find(|t| t.message_type.ends_with(ending)).unwrap_or_else(|| panic!("no {ending}"))
}

fn read_all(bag: &Bag, ending: &str) -> Vec<Message> {
    topic(bag, ending).messages.iter().map(|m| bag.read(m).unwrap()).collect()
}

fn check_images(bag: &Bag, ending: &str) {
    let expected = expected();
    let images = read_all(bag, ending);
    assert_eq!(images.len(), expected.images.len());
    for (message, expected_image) in images.iter().zip(&expected.images) {
        let Message::Image(image) = message else { panic!("{message:?}") };
        assert_eq!((image.header.stamp.nanos(), image.header.frame.as_str()), (expected_image.time, "cam0"));
        let Pixels::Image(FrameImage::Gray8(pixels)) = image.pixels().unwrap() else { panic!("not grey") };
        assert_eq!((pixels.width(), pixels.height()), (expected.width, expected.height));
        assert_eq!(pixels.data().iter().map(|&p| u64::from(p)).sum::<u64>(), expected_image.sum);
    }
}

fn check_imu(bag: &Bag) {
    let expected = expected();
    let samples = read_all(bag, "Imu");
    assert_eq!(samples.len(), expected.imu.len());
    for (message, sample) in samples.iter().zip(&expected.imu) {
        let Message::Imu(found) = message else { panic!("{message:?}") };
        assert_eq!(found.header.stamp.nanos(), sample.time);
        assert_eq!((found.angular_velocity, found.linear_acceleration), (sample.gyro, sample.accel));
    }
}

fn check_rest(bag: &Bag, [calibration, transforms, pose]: [&str; 3]) {
    let expected = expected();
    let Message::CameraInfo(info) = &read_all(bag, calibration)[0] else { panic!("no calibration") };
    assert_eq!((info.distortion_model.as_str(), &info.distortion), ("plumb_bob", &expected.d));
    assert_eq!(info.k.as_slice(), expected.k);
    let Message::Transforms(found) = &read_all(bag, transforms)[0] else { panic!("no transforms") };
    assert_eq!((found[0].parent.frame.as_str(), found[0].child.as_str()), ("imu", "cam0"));
    let ExpectedTransform { t: position, q: orientation } = expected.imu_from_camera;
    assert_eq!(found[0].pose, Pose { position, orientation });
    let poses = read_all(bag, pose);
    assert_eq!(poses.len(), expected.poses.len());
    for (message, expected) in poses.iter().zip(&expected.poses) {
        let Message::Poses(found) = message else { panic!("{message:?}") };
        let (position, orientation) = (expected.position, expected.orientation);
        assert_eq!(found[0].header.stamp.nanos(), expected.time);
        assert_eq!(found[0].pose, Pose { position, orientation });
    }
}

const ROS: [&str; 3] = ["CameraInfo", "TFMessage", "PoseStamped"];

#[test]
fn every_container_of_ros_gives_the_same_messages() {
    for name in [
        "ros1.bag",
        "ros1_bz2.bag",
        "ros1_lz4.bag",
        "ros2_mcap",
        "ros2_sqlite",
        "ros2_sqlite/ros2_sqlite.db3",
        "ros2_sqlite_zstd",
        "mcap_ros1_lz4.mcap",
        "mcap_ros2_zstd.mcap",
        "mcap_ros2_plain.mcap",
    ] {
        let bag = Bag::open(&fixtures().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(bag.warnings().is_empty(), "{name}: {:?}", bag.warnings());
        check_images(&bag, "/Image");
        check_imu(&bag);
        check_rest(&bag, ROS);
    }
}

#[test]
fn messages_in_a_write_ahead_log_are_read() {
    let bag = Bag::open(&fixtures().join("cut_wal")).unwrap();
    assert_eq!(bag.warnings().len(), 1);
    assert_eq!(bag.warnings()[0].kind, "bag-not-closed");
    check_images(&bag, "/Image");
    check_imu(&bag);
}

#[test]
fn schemas_of_foxglove_are_read_as_protobuf_and_json() {
    for name in ["foxglove_protobuf.mcap", "foxglove_json.mcap"] {
        let bag = Bag::open(&fixtures().join(name)).unwrap();
        assert!(bag.warnings().is_empty(), "{name}: {:?}", bag.warnings());
        check_images(&bag, "RawImage");
        check_rest(&bag, ["CameraCalibration", "FrameTransforms", "PoseInFrame"]);
    }
    check_imu(&Bag::open(&fixtures().join("foxglove_json.mcap")).unwrap());
    let bag = Bag::open(&fixtures().join("foxglove_protobuf.mcap")).unwrap();
    let Message::CompressedImage(jpeg) = &read_all(&bag, "CompressedImage")[0] else { panic!() };
    assert_eq!((jpeg.format.as_str(), jpeg.data.as_slice()), ("jpeg", &b"no real jpeg"[..]));
    let Message::CompressedVideo(video) = &read_all(&bag, "CompressedVideo")[0] else { panic!() };
    assert_eq!((video.format.as_str(), video.data.as_slice()), ("h264", &[0, 0, 0, 1][..]));
}

#[test]
fn a_cut_bag_is_read_to_its_last_whole_chunk() {
    let folder = tempfile::tempdir().unwrap();
    for name in [
        "ros1.bag",
        "ros1_bz2.bag",
        "ros1_lz4.bag",
        "mcap_ros1_lz4.mcap",
        "mcap_ros2_zstd.mcap",
        "mcap_ros2_plain.mcap",
        "ros2_sqlite/ros2_sqlite.db3",
    ] {
        let whole = std::fs::read(fixtures().join(name)).unwrap();
        let all: usize =
            Bag::open(&fixtures().join(name)).unwrap().topics().iter().map(|t| t.messages.len()).sum();
        let mut last = 0;
        let mut most_of_the_cut = 0;
        for keep in (0..whole.len()).step_by(whole.len() / 97) {
            let path = folder.path().join(Path::new(name).file_name().unwrap());
            std::fs::write(&path, &whole[..keep]).unwrap();
            match Bag::open(&path) {
                Ok(bag) => {
                    let found: usize = bag.topics().iter().map(|t| t.messages.len()).sum();
                    // More of the file never gives fewer messages, and all of them can be read.
                    assert!(found >= last, "{name} cut at {keep}: {found} messages after {last}");
                    last = found;
                    let says = bag.warnings().iter().any(|w| w.kind == "bag-cut-off");
                    assert!(says || found == all, "{name} cut at {keep}: no warning");
                    most_of_the_cut = most_of_the_cut.max(if says { found } else { 0 });
                    for topic in bag.topics() {
                        topic.messages.iter().for_each(|m| drop(bag.read(m).unwrap()));
                    }
                }
                Err(BagError::Empty { .. } | BagError::NotABag { .. } | BagError::Malformed { .. }) => {
                    assert_eq!(last, 0, "{name} cut at {keep} is refused, less of it was read");
                }
                Err(e) => panic!("{name} cut at {keep}: {e}"),
            }
        }
        assert!(2 * most_of_the_cut > all, "{name}: only {most_of_the_cut} of {all} messages when cut");
    }
}

#[test]
fn split_files_are_one_recording_and_others_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let part = fixtures().join("mcap_ros2_plain.mcap");
    for name in ["flight_0.mcap", "flight_1.mcap"] {
        std::fs::copy(&part, folder.path().join(name)).unwrap();
    }
    let bag = Bag::open(folder.path()).unwrap();
    let one = Bag::open(&part).unwrap();
    assert_eq!(topic(&bag, "/Imu").messages.len(), 2 * topic(&one, "/Imu").messages.len());
    assert_eq!(bag.topics().len(), one.topics().len());
    std::fs::copy(&part, folder.path().join("other.mcap")).unwrap();
    let error = Bag::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("3 bags") && error.contains("other.mcap"), "{error}");
}

#[test]
fn the_wrong_thing_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.bag");
    let message = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        Bag::open(&path).unwrap_err().to_string()
    };
    assert!(message(b"").contains("0 bytes"));
    assert!(message(b"#ROSBAG V1.2\n").contains("before 2.0"));
    assert!(message(b"PK\x03\x04and more").contains("[50, 4b"));
    let header = |fields: &[&[u8]]| {
        let mut fields_bytes = Vec::new();
        for field in fields {
            fields_bytes.extend((field.len() as u32).to_le_bytes());
            fields_bytes.extend(*field);
        }
        let mut all = b"#ROSBAG V2.0\n".to_vec();
        all.extend((fields_bytes.len() as u32).to_le_bytes());
        all.extend(fields_bytes);
        all.extend(0u32.to_le_bytes());
        all
    };
    let encrypted = message(&header(&[b"op=\x03", b"encryptor=rosbag/AesCbcEncryptor"]));
    assert!(encrypted.contains("encrypted") && encrypted.contains("AesCbc"), "{encrypted}");
    let unknown = message(&header(&[b"op=\x05", b"compression=lzma", b"size=\0\0\0\0"]));
    assert!(unknown.contains("lzma") && unknown.contains("bz2"), "{unknown}");
    let huge = message(&header(&[b"op=\x05", b"compression=bz2", b"size=\xff\xff\xff\xff"]));
    assert!(huge.contains("4294967295"), "{huge}");
}

#[test]
fn whole_files_under_zstd_are_refused_with_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let text = "rosbag2_bagfile_information:\n  relative_file_paths: [a.db3.zstd]\n  compression_format: zstd\n  compression_mode: FILE\n";
    std::fs::write(folder.path().join("metadata.yaml"), text).unwrap();
    let error = Bag::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("zstd -d"), "{error}");
    std::fs::write(
        folder.path().join("metadata.yaml"),
        text.replace("FILE", "").replace("a.db3.zstd", "../../etc/passwd"),
    )
    .unwrap();
    let error = Bag::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("passwd") && !error.contains("cannot read"), "{error}");
}
