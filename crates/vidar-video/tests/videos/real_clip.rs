//! A real action camera's clip: H.264 with telemetry (see the data's README; not part of the repository).

use std::path::PathBuf;
use vidar_core::FrameImage;
use vidar_video::Video;

fn clip() -> Option<PathBuf> {
    vidar_core::testing::shared_data("data/gopro_karma/karma.mp4")
}

fn grey(video: &Video, number: usize) -> Vec<u8> {
    match video.frame(number).unwrap() {
        FrameImage::Rgb8(image) => image.data().iter().map(|p| p[1]).collect(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn frames_times_and_telemetry_are_those_of_the_clip() {
    let Some(path) = clip() else { return };
    let video = Video::open(&path).unwrap();
    assert_eq!((video.frame_count(), video.size(), video.codec_name()), (362, (854, 480), "H.264"));
    let times: Vec<i64> = video.times().map(|t| t.nanos()).collect();
    assert_eq!(times[0], 0);
    // 30000/1001 Hz.
    assert!(times.windows(2).all(|w| (w[1] - w[0] - 33_366_667).abs() <= 1_000));
    let telemetry = video.telemetry().unwrap().unwrap();
    // Counts as ffprobe gives them, and the camera maker's numbers: gyroscope about 400 Hz, gravity in the accelerometer.
    assert!((telemetry.gyro_rate_hz - 400.0).abs() < 5.0, "{}", telemetry.gyro_rate_hz);
    let mean = telemetry.imu.iter().map(|s| s.accel.0.norm()).sum::<f64>() / telemetry.imu.len() as f64;
    assert!((mean - 9.81).abs() < 0.3, "mean specific force {mean}");
    assert_eq!(telemetry.units, ["rad/s", "m/s\u{b2}"]);
}

#[test]
fn a_frame_is_the_same_in_any_order() {
    let Some(path) = clip() else { return };
    let video = Video::open(&path).unwrap();
    let in_order: Vec<Vec<u8>> = (0..40).map(|n| grey(&video, n)).collect();
    let other = Video::open(&path).unwrap();
    for number in [37, 5, 36, 0, 12] {
        assert_eq!(grey(&other, number), in_order[number], "frame {number}");
    }
}

#[test]
fn a_clip_cut_off_or_damaged_is_an_error_of_its_frames() {
    let Some(path) = clip() else { return };
    let mut bytes = std::fs::read(&path).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.mp4");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let said = Video::open(&cut).map(|v| v.warnings().len()).map_err(|e| e.to_string());
    // This camera writes its table last.
    assert!(said.as_ref().is_err_and(|e| e.contains("moov")) || said == Ok(1), "{said:?}");
    // Noise in the middle of the pictures: other frames stay readable, and nothing panics or hangs.
    let middle = bytes.len() / 2;
    for (i, byte) in bytes[middle..middle + 4000].iter_mut().enumerate() {
        *byte = byte.wrapping_mul(31).wrapping_add(i as u8);
    }
    let damaged = folder.path().join("damaged.mp4");
    std::fs::write(&damaged, &bytes).unwrap();
    let video = Video::open(&damaged).unwrap();
    let read = (0..video.frame_count()).filter(|&n| video.frame(n).is_ok()).count();
    assert!(read > 300, "{read} of {} frames", video.frame_count());
}
