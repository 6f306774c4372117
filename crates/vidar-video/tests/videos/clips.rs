//! Clips that ffmpeg made (tests/fixtures/make.py), compared with what ffmpeg decodes of them.

use proptest::prelude::*;
use serde_json::Value;
use std::path::{Path, PathBuf};
use vidar_core::FrameImage;
use vidar_video::{Video, VideoError};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn expected() -> Value {
    serde_json::from_str(&std::fs::read_to_string(fixture("expected.json")).unwrap()).unwrap()
}

/// Mean red, green and blue of the four quarters.
fn quarters(image: &FrameImage) -> Vec<f64> {
    let FrameImage::Rgb8(image) = image else { panic!("no colour") };
    let (w, h) = (image.width(), image.height());
    let mut sums = [0.0; 12];
    for y in 0..h {
        for x in 0..w {
            for c in 0..3 {
                sums[((y * 2 / h) * 2 + x * 2 / w) * 3 + c] += f64::from(image[(x, y)][c]);
            }
        }
    }
    sums.iter().map(|s| s / (w * h) as f64 * 4.0).collect()
}

/// A mean over a quarter may differ by the roundings of two conversions to RGB.
const TOLERANCE: f64 = 0.75;

fn check(name: &str) {
    let expected = &expected()[name];
    let video = Video::open(&fixture(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    assert!(video.warnings().is_empty(), "{name}: {:?}", video.warnings());
    let size = (expected["width"].as_u64().unwrap() as usize, expected["height"].as_u64().unwrap() as usize);
    assert_eq!(video.size(), size, "{name}");
    let times: Vec<f64> = expected["times"].as_array().unwrap().iter().map(|t| t.as_f64().unwrap()).collect();
    assert_eq!(video.frame_count(), times.len(), "{name}");
    for (number, (found, time)) in video.times().zip(&times).enumerate() {
        assert!((found.as_secs_f64() - time).abs() < 2e-6, "{name} frame {number}: {found} for {time}");
    }
    // In order, and each alone, which decodes from the picture before it that stands alone.
    for (number, alone) in (0..times.len()).map(|n| (n, false)).chain((0..times.len()).map(|n| (n, true))) {
        let opened = alone.then(|| Video::open(&fixture(name)).unwrap());
        let found = quarters(&opened.as_ref().unwrap_or(&video).frame(number).unwrap());
        for (i, value) in found.iter().enumerate() {
            let truth = expected["quarters"][number][i].as_f64().unwrap();
            assert!(
                (value - truth).abs() < TOLERANCE,
                "{name} frame {number} value {i}: {value:.2} for {truth:.2}"
            );
        }
    }
}

#[test]
fn frames_of_h264_are_those_of_ffmpeg() {
    check("h264.mp4");
    check("h264_10bit.mp4");
}

#[cfg(feature = "h265")]
#[test]
fn frames_of_h265_are_those_of_ffmpeg() {
    check("h265.mp4");
    check("h265_10bit.mp4");
    check("h265_full.mp4");
}

#[test]
fn rotation_and_variable_rate_are_followed() {
    check("rotated.mp4");
    check("variable.mov");
}

#[test]
fn what_is_not_decoded_is_named() {
    let error = |name: &str| Video::open(&fixture(name)).unwrap_err().to_string();
    let codec = error("other_codec.mp4");
    assert!(codec.contains("mp4v") && codec.contains("ffmpeg"), "{codec}");
    assert!(error("sound.mp4").contains("without a video track"));
}

#[test]
fn a_clip_in_fragments_is_read_up_to_where_it_breaks_off() {
    check("fragmented.mp4");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mp4");
    let whole = std::fs::read(fixture("fragmented.mp4")).unwrap();
    let moof =
        |nth: usize| whole.windows(4).enumerate().filter(|(_, w)| w == b"moof").nth(nth).unwrap().0 - 4;
    let said = |end: usize| -> (usize, Vec<String>) {
        std::fs::write(&path, &whole[..end]).unwrap();
        let video = Video::open(&path).unwrap();
        (0..video.frame_count()).for_each(|n| drop(video.frame(n).unwrap()));
        (video.frame_count(), video.warnings().iter().map(|w| format!("{} {}", w.kind, w.message)).collect())
    };
    // Between two fragments nothing is missing that the file announces.
    assert_eq!(said(moof(1)), (8, Vec::new()));
    // In the table of the second, and in its pictures.
    let (count, warnings) = said(moof(1) + 40);
    assert!(
        count == 8 && warnings[0].contains("video-cut-off") && warnings[0].contains("table"),
        "{warnings:?}"
    );
    let (count, warnings) = said(whole.windows(4).rposition(|w| w == b"mfra").unwrap() - 24);
    assert!((9..15).contains(&count) && warnings[0].contains("of 15 pictures"), "{count} {warnings:?}");
    // A fragment whose table contradicts itself.
    let mut damaged = whole.clone();
    let run = whole.windows(4).rposition(|w| w == b"trun").unwrap();
    damaged[run + 8..run + 12].copy_from_slice(&[0xff; 4]);
    std::fs::write(&path, &damaged).unwrap();
    let video = Video::open(&path).unwrap();
    assert!(
        video.frame_count() >= 8 && video.warnings()[0].message.contains("damaged"),
        "{:?}",
        video.warnings()
    );
}

#[test]
fn a_clip_that_was_cut_off_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mp4");
    let whole = std::fs::read(fixture("h264.mp4")).unwrap();
    std::fs::write(&path, &whole[..whole.len() - 200]).unwrap();
    let error = Video::open(&path).unwrap_err();
    assert!(
        matches!(&error, VideoError::Unsupported { .. }) && error.to_string().contains("moov"),
        "{error}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn damage_never_takes_the_program_down(
        which in 0..4usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..16),
    ) {
        let mut bytes = std::fs::read(fixture(["h264.mp4", "h265.mp4", "variable.mov", "fragmented.mp4"][which])).unwrap();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), &bytes).unwrap();
        if let Ok(video) = Video::open(file.path()) {
            (0..video.frame_count().min(20)).for_each(|n| drop(video.frame(n)));
            drop(video.telemetry());
        }
    }
}
