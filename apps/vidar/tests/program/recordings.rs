//! Bags and videos through the program, and the things that are given by mistake.

use crate::support::{shared, vidar, vidar_in};
use std::path::{Path, PathBuf};

fn bag(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/vidar-bag/tests/fixtures").join(name)
}

fn clip(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/vidar-video/tests/fixtures").join(name)
}

fn inspect(path: &Path, more: &[&str]) -> crate::support::ProgramOutput {
    let mut args = vec!["inspect".as_ref(), path.as_os_str()];
    args.extend(more.iter().map(std::ffi::OsStr::new));
    vidar(&args)
}

#[test]
fn bags_of_every_kind_are_inspected() {
    for name in ["ros1_lz4.bag", "ros2_mcap", "ros2_sqlite", "mcap_ros1_lz4.mcap"] {
        let told = inspect(&bag(name), &[]).ends_with(0);
        assert!(told.stdout.contains("from the topic /cam0/camera_info"), "{name}: {}", told.stdout);
        let told = told.says(&["poses-unused", "--topic truth=/truth"]);
        assert!(told.stdout.contains("IMU"), "{}", told.stdout);
    }
    let told = inspect(&bag("ros1.bag"), &["--topic", "truth=/truth"]).ends_with(0);
    assert!(told.stdout.contains("ground truth"), "{}", told.stdout);
}

#[test]
fn a_topic_that_is_not_there_lists_those_that_are() {
    inspect(&bag("ros2_mcap"), &["--topic", "/cam9"]).ends_with(1).says(&[
        "/cam9",
        "its topics:\n  /cam0/camera_info  sensor_msgs/CameraInfo  1\n  /cam0/image_raw  sensor_msgs/Image  3\n",
        "--topic NAME",
    ]);
    inspect(&bag("ros2_mcap"), &["--topic", "of=/truth"]).ends_with(2).says(&["trajectory=NAME"]);
}

#[test]
fn a_video_is_a_recording_of_images() {
    let told = inspect(&clip("h264.mp4"), &[]).ends_with(0);
    assert!(told.stdout.contains("15") && told.stdout.contains("25.0 Hz"), "{}", told.stdout);
    let told = inspect(&clip("fragmented.mp4"), &[]).ends_with(0);
    assert!(told.stdout.contains("15") && told.stdout.contains("25.0 Hz"), "{}", told.stdout);
    // Without an IMU there is no scale; the message says what there is instead.
    for verb in ["odometry", "run"] {
        let words = ["E0208", "nor an IMU", "vidar depth", "--trajectory"];
        vidar(&[verb.as_ref(), clip("h264.mp4").as_os_str()]).ends_with(1).says(&words);
    }
    vidar(&["run".as_ref(), clip("h264.mp4").as_os_str()]).says(&["--mode pose-free --geometry da3-nano"]);
}

#[test]
fn a_video_without_calibration_is_mapped_pose_free_in_a_unit_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let clip = clip("h264.mp4");
    let args =
        ["run", clip.to_str().unwrap(), "--mode", "pose-free", "--geometry", "da3-nano", "--stride", "3"];
    let told = vidar_in(folder.path(), &[&args[..], &["-o", "map"]].concat());
    // Sixty-four pixels of a test pattern show no room, but the camera is no reason to refuse it.
    assert_eq!(told.code, 0, "{}", told.stderr);
    assert!(told.stdout.contains("arbitrary"), "{}", told.stdout);
}

#[test]
fn what_is_given_by_mistake_is_named_with_the_nearest_way() {
    let folder = shared().root.join("mistakes");
    std::fs::create_dir_all(&folder).unwrap();
    let whole = std::fs::read(clip("h264.mp4")).unwrap();
    let cut = &whole[..whole.len() - 300];
    for (name, bytes, words) in [
        ("photos.zip", &b"PK\x03\x04rest"[..], ["zip archive", "unpack"]),
        ("image.heic", b"\0\0\0\x18ftypheic\0\0\0\0", ["HEIC", "JPEG"]),
        ("clip.mkv", b"\x1a\x45\xdf\xa3rest", ["Matroska", "-c copy"]),
        ("cut.mp4", cut, ["moov", "cut off"]),
        ("locked.bag", b"\x13\x37 nothing of a bag", ["not those of one", "encrypted"]),
        ("empty.mcap", b"", ["empty file", "copy"]),
    ] {
        std::fs::write(folder.join(name), bytes).unwrap();
        vidar_in(&folder, &["inspect", name]).ends_with(1).says(&words);
    }
    vidar_in(&folder, &["run", "https://example.org/flight.bag"]).ends_with(1).says(&["URL", "download"]);
    for (folder_name, files, words) in [
        ("photos", &["IMG_1.HEIC", "IMG_2.HEIC"][..], ["2 HEIC images", "JPEG"]),
        ("dcim", &["a.mp4", "b.MOV"], ["2 videos (a.mp4, b.MOV)", "give one of them"]),
        ("download", &["scan.zip", "notes.txt"], ["an archive (scan.zip)", "unpack"]),
    ] {
        let inside = folder.join(folder_name);
        std::fs::create_dir_all(&inside).unwrap();
        files.iter().for_each(|name| std::fs::write(inside.join(name), b"x").unwrap());
        vidar_in(&folder, &["inspect", folder_name]).ends_with(1).says(&words);
    }
    // A codec that is not decoded, a file of sound, a bag without images.
    inspect(&clip("other_codec.mp4"), &[]).ends_with(1).says(&["mp4v", "ffmpeg"]);
    inspect(&clip("sound.mp4"), &[]).ends_with(1).says(&["without a video track"]);
    std::fs::write(folder.join("cut.bag"), &std::fs::read(bag("ros1.bag")).unwrap()[..5200]).unwrap();
    let told = vidar_in(&folder, &["inspect", "cut.bag"]);
    assert!(told.code == 1 && !told.stderr.contains("panicked"), "{}", told.stderr);
}

fn from_input(bytes: &[u8], args: &[&str]) -> crate::support::ProgramOutput {
    use std::io::Write;
    use std::process::Stdio;
    let mut command = crate::support::command();
    command.args(args).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    // A program that refuses before it reads closes the pipe.
    let _ = input.write_all(bytes);
    drop(input);
    child.wait_with_output().unwrap().into()
}

#[test]
fn a_bag_on_standard_input_is_read_and_one_that_ends_early_says_so() {
    for name in ["ros1_lz4.bag", "mcap_ros1_lz4.mcap"] {
        let whole = std::fs::read(bag(name)).unwrap();
        let told = from_input(&whole, &["inspect", "-"]).ends_with(0);
        assert!(told.stdout.contains("from the topic /cam0/camera_info"), "{name}: {}", told.stdout);
        from_input(&whole[..whole.len() * 2 / 3], &["inspect", "-"]).ends_with(0).says(&["bag-cut-off"]);
    }
    from_input(b"hello", &["inspect", "-"]).ends_with(1).says(&["kind that is not known"]);
    from_input(b"", &["odometry", "-"]).ends_with(1).says(&["empty file"]);
    from_input(b"", &["run", "-"]).ends_with(2).says(&["vidar convert -"]);
}

#[test]
fn compressed_video_of_a_bag_is_a_recording_of_images() {
    let video = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/vidar-dataset/tests/fixtures");
    for (name, codec) in [("compressed_video.mcap", "H.264"), ("compressed_video_json.mcap", "H.265")] {
        let told = inspect(&video.join(name), &[]).ends_with(0);
        let words = ["30", "20.0 Hz", codec, "0 of "];
        assert!(words.iter().all(|w| told.stdout.contains(w)), "{name}: {}", told.stdout);
    }
}

/// A program called ffmpeg is on this machine; says so where it is not.
fn has_ffmpeg() -> bool {
    let found =
        std::process::Command::new("ffmpeg").arg("-version").output().is_ok_and(|o| o.status.success());
    if !found {
        vidar_core::testing::skipped(&"this machine has no ffmpeg");
    }
    found
}

#[test]
fn the_users_own_ffmpeg_decodes_what_the_program_refuses() {
    let clip = clip("other_codec.mp4");
    inspect(&clip, &[]).ends_with(1).says(&["mp4v", "--decoder ffmpeg"]);
    inspect(&clip, &["--decoder", "vlc"]).ends_with(2).says(&["built-in or ffmpeg"]);
    // Without the program on the path.
    let folder = tempfile::tempdir().unwrap();
    let mut command = crate::support::command();
    command.env("PATH", folder.path()).arg("inspect").arg(&clip).args(["--decoder", "ffmpeg"]);
    crate::support::ProgramOutput::from(command.output().unwrap())
        .ends_with(1)
        .says(&["not on this machine"]);
    if has_ffmpeg() {
        let told = inspect(&clip, &["--decoder", "ffmpeg"]).ends_with(0);
        assert!(
            told.stdout.contains("decoded by ffmpeg") && told.stdout.contains("0 of "),
            "{}",
            told.stdout
        );
        inspect(&self::clip("variable.mov"), &["--decoder", "ffmpeg"]).ends_with(0);
    }
}
