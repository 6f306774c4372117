//! The user's own ffmpeg as the decoder, where this machine has one.

use std::path::{Path, PathBuf};
use std::process::Command;
use vidar_core::FrameImage;
use vidar_video::{Video, VideoDecoder};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn has_program() -> bool {
    let found = Command::new("ffmpeg").arg("-version").output().is_ok_and(|o| o.status.success());
    if !found {
        eprintln!("skipped: this machine has no ffmpeg");
    }
    found
}

fn bytes(video: &Video, number: usize) -> Vec<u8> {
    match video.frame(number).unwrap() {
        FrameImage::Rgb8(image) => image.data().as_flattened().to_vec(),
        other => panic!("{other:?}"),
    }
}

fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
}

#[test]
fn frames_and_times_are_those_of_the_built_in_decoders() {
    if !has_program() {
        return;
    }
    for name in ["h264.mp4", "h265.mp4", "rotated.mp4", "variable.mov", "fragmented.mp4"] {
        let own = Video::open(&fixture(name)).unwrap();
        let theirs = Video::open_with(&fixture(name), VideoDecoder::Ffmpeg).unwrap();
        assert_eq!(theirs.size(), own.size(), "{name}");
        assert_eq!(theirs.times().collect::<Vec<_>>(), own.times().collect::<Vec<_>>(), "{name}");
        // In order, and then in any: the program is started anew at the right frame.
        let last = own.frame_count() - 1;
        for number in (0..=last).chain([last, 3, last / 2, 0, 1]) {
            let difference = mean_difference(&bytes(&own, number), &bytes(&theirs, number));
            // The program smooths chroma where it enlarges it; a neighbouring frame differs more.
            assert!(difference < 4.0, "{name} frame {number}: {difference}");
        }
    }
}

#[test]
fn what_the_built_in_decoders_refuse_is_decoded() {
    if !has_program() {
        return;
    }
    let clip = fixture("other_codec.mp4");
    let refused = Video::open(&clip).unwrap_err().to_string();
    assert!(refused.contains("--decoder ffmpeg"), "{refused}");
    let video = Video::open_with(&clip, VideoDecoder::Ffmpeg).unwrap();
    assert!(video.frame_count() > 5, "{}", video.frame_count());
    let in_order: Vec<_> = (0..video.frame_count()).map(|n| bytes(&video, n)).collect();
    for number in [video.frame_count() - 1, 2, 4, 0] {
        assert_eq!(bytes(&video, number), in_order[number], "frame {number}");
    }
}

#[test]
fn another_container_has_the_times_of_its_packets() {
    if !has_program() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let clip = folder.path().join("-odd name:.mkv");
    let mut made = Command::new("ffmpeg");
    made.args(["-v", "error", "-i"]).arg(fixture("h264.mp4")).args(["-c", "copy"]);
    assert!(made.arg(format!("file:{}", clip.display())).status().unwrap().success());
    let (own, theirs) =
        (Video::open(&fixture("h264.mp4")).unwrap(), Video::open_with(&clip, VideoDecoder::Ffmpeg).unwrap());
    assert_eq!(theirs.frame_count(), own.frame_count());
    for (number, (a, b)) in own.times().zip(theirs.times()).enumerate() {
        // Matroska's times are whole milliseconds.
        assert!((a - b).abs().as_secs_f64() < 1.1e-3, "frame {number}: {a} and {b}");
        assert!(mean_difference(&bytes(&own, number), &bytes(&theirs, number)) < 4.0, "frame {number}");
    }
}

#[test]
fn what_the_program_cannot_read_is_said_in_its_words() {
    if !has_program() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("noise.mkv");
    std::fs::write(&file, [7; 4000]).unwrap();
    let error = Video::open_with(&file, VideoDecoder::Ffmpeg).unwrap_err().to_string();
    assert!(error.contains("it said:"), "{error}");
}
