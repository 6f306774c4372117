//! `vidar inspect`: contents and health of a recording.

mod calibration;
mod motion;

pub use motion::Motion;

use crate::calibrate;
use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::imu_noise;
use serde::Serialize;
use std::path::Path;
use vidar_core::{Duration, FrameImage, Timestamp, Trajectory, Warning};
use vidar_dataset::{CalibrationSource, OpenOptions, Recording};
use vidar_odometry::calibration::SensorNoise;
use vidar_solve::statistics::median_upper;

/// Summary of a recording.
#[derive(Clone, Debug, Serialize)]
pub struct Inspection {
    /// Its name.
    pub name: String,
    /// Its layout.
    pub kind: String,
    /// Why this layout was chosen.
    pub reason: String,
    /// Streams with their rates.
    pub streams: Vec<Stream>,
    /// The camera in use, as text.
    pub camera: Vec<String>,
    /// The IMU, as text.
    pub imu: Vec<String>,
    /// Poses, as text.
    pub poses: Vec<String>,
    /// Brightness and sharpness of sampled images.
    pub images: Option<ImageHealth>,
    /// How the camera moved, where there is an IMU.
    pub motion: Option<Motion>,
    /// What the recording does not state.
    pub missing: Vec<String>,
    /// What of it was found from images and IMU, with standard deviations; or why it was not.
    pub found: Vec<String>,
    /// What to film differently next time.
    pub advice: Vec<String>,
    /// What can be done with the recording.
    pub possible: Vec<String>,
    /// Warnings.
    pub warnings: Vec<Warning>,
}

/// One stream of samples.
#[derive(Clone, Debug, Serialize)]
pub struct Stream {
    /// What it is.
    pub what: String,
    /// Number of samples.
    pub count: usize,
    /// Time of the first sample, s.
    pub start_secs: f64,
    /// Length, s.
    pub length_secs: f64,
    /// Median rate, Hz; null where times are invented.
    pub rate_hz: Option<f64>,
    /// Longest time between two samples, s.
    pub longest_gap_secs: f64,
}

/// Medians over sampled images.
#[derive(Clone, Debug, Serialize)]
pub struct ImageHealth {
    /// Number of sampled images.
    pub sampled: usize,
    /// Number of sampled images that could not be read.
    pub unreadable: usize,
    /// Median of mean brightness, 0…255.
    pub brightness: f64,
    /// Median share of pixels at 0 or 255, 0…1.
    pub clipped: f64,
    /// Median variance of the Laplacian; below about 20 an image is blurred or without texture.
    pub sharpness: f64,
}

/// Number of sampled images: enough for a median, few enough to be fast.
const SAMPLED_IMAGES: usize = 9;

/// What shows a calibration.
const CALIBRATION_ADVICE: &str = "turn the camera about all of its axes for some seconds, by 20° or more, while it sees texture: \
    that shows the calibration";

/// Opens the recording and summarises it. Where it has an IMU and no calibration, half a minute of it is calibrated, as
/// `vidar odometry` would do.
///
/// # Errors
/// The recording cannot be read.
pub fn inspect(
    path: &Path,
    options: &OpenOptions,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Inspection, Error> {
    let mut dataset = vidar_dataset::open(path, options)?;
    let noise = imu_noise::settle(&mut dataset);
    let streams = streams(&dataset);
    let motion = Motion::of(&dataset.imu);
    let images = image_health(&dataset);
    let needs_calibration = dataset.calibration == CalibrationSource::Guessed && !dataset.imu.is_empty();
    let calibration = needs_calibration.then(|| calibrate::found_in_words(&dataset, events, cancel));
    let is_refused = matches!(calibration, Some(Err(_)));
    let advice = motion.iter().flat_map(Motion::advice);
    let advice = advice.chain(images.iter().flat_map(motion::advice_of_images));
    let advice = advice.chain(is_refused.then(|| CALIBRATION_ADVICE.to_owned())).collect();
    let noise = noise.map(|noise| {
        let SensorNoise { gyro, accel, .. } = noise;
        format!(
            "noise of the IMU at most {gyro:.1e} rad/s/√Hz and {accel:.1e} m/s²/√Hz, as its samples show it"
        )
    });
    Ok(Inspection {
        missing: missing(&dataset),
        found: calibration.map(|c| c.unwrap_or_else(|refused| refused)).into_iter().chain(noise).collect(),
        advice,
        name: dataset.name.clone(),
        kind: dataset.kind.to_string(),
        reason: dataset.reason.clone(),
        streams,
        camera: calibration::describe_camera(&dataset),
        imu: describe_imu(&dataset, motion.as_ref()),
        motion,
        poses: describe_poses(&dataset),
        images,
        possible: possible(&dataset, is_refused),
        warnings: dataset.warnings.clone(),
    })
}

/// What a metric map needs and the recording does not state.
fn missing(dataset: &Recording) -> Vec<String> {
    let is_guessed = dataset.calibration == CalibrationSource::Guessed;
    let has_imu = !dataset.imu.is_empty();
    let warned = |kind: &str| dataset.warnings.iter().any(|w| w.kind == kind);
    let timing = dataset.rig.camera(dataset.camera).is_some_and(|c| c.time_offset == Duration::ZERO);
    let all = [
        (!has_imu, "IMU samples: lengths need a trajectory from elsewhere"),
        (is_guessed, "intrinsics of the camera"),
        (has_imu && (is_guessed || warned("extrinsics-identity")), "pose of the camera on the IMU"),
        (has_imu && timing, "clock offset between camera and IMU (taken as zero to begin with)"),
        (
            dataset.readout.is_none(),
            "readout time of the rolling shutter (a global one is assumed to begin with)",
        ),
        (has_imu && (dataset.rig.imu.is_none() || imu_noise::is_guessed(dataset)), "noise of the IMU"),
    ];
    all.into_iter().filter(|(is_missing, _)| *is_missing).map(|(_, what)| what.to_owned()).collect()
}

/// The streams of a recording with their rates.
pub fn streams(dataset: &Recording) -> Vec<Stream> {
    let images: Vec<Timestamp> = dataset.images.iter().map(|i| i.time).collect();
    let imu: Vec<Timestamp> = dataset.imu.iter().map(|s| s.time).collect();
    let depths: Vec<Timestamp> = dataset.depths.iter().map(|d| d.time).collect();
    let truth: Vec<Timestamp> = times(dataset.ground_truth.as_ref());
    let external: Vec<Timestamp> = times(dataset.external_trajectory.as_ref().map(|a| &a.trajectory));
    let camera = format!("images of camera {}", dataset.camera);
    [
        (camera.as_str(), images),
        ("IMU", imu),
        ("depth images", depths),
        ("ground truth", truth),
        ("trajectory", external),
    ]
    .into_iter()
    .filter_map(|(what, times)| stream(what, &times))
    // Poses of images have the images' times.
    .map(|s| Stream { rate_hz: s.rate_hz.filter(|_| !dataset.times_are_invented), ..s })
    .collect()
}

fn times(trajectory: Option<&Trajectory>) -> Vec<Timestamp> {
    trajectory.map(|t| t.poses().iter().map(|p| p.time).collect()).unwrap_or_default()
}

fn stream(what: &str, times: &[Timestamp]) -> Option<Stream> {
    let (first, last) = (*times.first()?, *times.last()?);
    let mut gaps: Vec<f64> = times.windows(2).map(|w| (w[1] - w[0]).nanos() as f64).collect();
    let median = median_upper(&mut gaps).unwrap_or(0.0);
    Some(Stream {
        what: what.to_owned(),
        count: times.len(),
        start_secs: first.as_secs_f64(),
        length_secs: (last - first).as_secs_f64(),
        rate_hz: Some(if median > 0.0 { 1e9 / median } else { 0.0 }),
        longest_gap_secs: gaps.iter().copied().fold(0.0, f64::max) * 1e-9,
    })
}

fn describe_imu(dataset: &Recording, motion: Option<&Motion>) -> Vec<String> {
    if dataset.imu.is_empty() {
        return vec!["none: the scale can only come from an external trajectory".into()];
    }
    let mut words = Vec::new();
    let n = dataset.imu.len() as f64;
    let accel: f64 = dataset.imu.iter().map(|s| s.accel.0.norm()).sum::<f64>() / n;
    let gyro: f64 = dataset.imu.iter().map(|s| s.gyro.0.norm()).sum::<f64>() / n;
    words.extend(motion.map(Motion::words));
    words.push(format!(
        "mean |specific force| {accel:.2} m/s2 (at rest: 9.8), mean |rate| {:.1} deg/s",
        gyro.to_degrees()
    ));
    match &dataset.rig.imu {
        Some(noise) => words.extend(calibration::describe_noise(noise)),
        None => words.push("noise: not in the calibration".into()),
    }
    words
}

fn describe_poses(dataset: &Recording) -> Vec<String> {
    let describe = |what: &str, t: &Trajectory| {
        format!("{what}: {} poses of the {}, path {:.1} m", t.len(), t.body(), t.path_length_m())
    };
    let mut words = Vec::new();
    words.extend(dataset.ground_truth.as_ref().map(|t| describe("ground truth", t)));
    words
        .extend(dataset.external_trajectory.as_ref().map(|a| describe("external trajectory", &a.trajectory)));
    if words.is_empty() {
        words.push("none".into());
    }
    words
}

fn image_health(dataset: &Recording) -> Option<ImageHealth> {
    let n = dataset.images.len();
    let chosen: Vec<usize> = (0..SAMPLED_IMAGES.min(n)).map(|i| i * n / SAMPLED_IMAGES.min(n)).collect();
    let loaded: Vec<Option<FrameImage>> =
        chosen.iter().map(|&i| dataset.load_image(&dataset.images[i]).ok()).collect();
    let unreadable = loaded.iter().filter(|i| i.is_none()).count();
    let measured: Vec<[f64; 3]> = loaded.iter().flatten().map(measure).collect();
    let median = |which: usize| median_upper(&mut measured.iter().map(|m| m[which]).collect::<Vec<_>>());
    Some(ImageHealth {
        sampled: chosen.len(),
        unreadable,
        brightness: median(0)?,
        clipped: median(1)?,
        sharpness: median(2)?,
    })
}

/// Mean brightness, share of clipped pixels, variance of the Laplacian.
fn measure(image: &FrameImage) -> [f64; 3] {
    let gray = image.to_gray8();
    let n = gray.data().len().max(1) as f64;
    let mean = gray.data().iter().map(|&p| f64::from(p)).sum::<f64>() / n;
    let clipped = gray.data().iter().filter(|&&p| p == 0 || p == 255).count() as f64 / n;
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for y in 1..gray.height().saturating_sub(1) {
        for x in 1..gray.width().saturating_sub(1) {
            let at = |dx: usize, dy: usize| f64::from(gray[(x + dx - 1, y + dy - 1)]);
            let laplacian = at(0, 1) + at(2, 1) + at(1, 0) + at(1, 2) - 4.0 * at(1, 1);
            sum += laplacian;
            squares += laplacian * laplacian;
            count += 1.0;
        }
    }
    let count = f64::max(count, 1.0);
    [mean, clipped, squares / count - (sum / count).powi(2)]
}

/// `is_refused`: there is no calibration, and the recording does not show one.
fn possible(dataset: &Recording, is_refused: bool) -> Vec<String> {
    let mut lines = Vec::new();
    if is_refused {
        lines.push(
            "vidar run, vidar odometry: not possible yet; give --calibration FILE or --camera-model".into(),
        );
        return lines;
    }
    if dataset.calibration == CalibrationSource::Guessed && !dataset.imu.is_empty() {
        lines.push(
            "vidar run, vidar odometry: calibrate from images and gyroscope first, as vidar calibrate does"
                .into(),
        );
        return lines;
    }
    if dataset.calibration == CalibrationSource::Guessed {
        lines.push(
            "vidar run: not possible yet; give --calibration FILE or --camera-model (the camera model is a guess)".into(),
        );
        return lines;
    }
    let has_imu = dataset.rig.imu.is_some() && !dataset.imu.is_empty();
    match (&dataset.external_trajectory, &dataset.ground_truth) {
        (None, _) if has_imu => {
            lines.push("vidar run: metric map with poses of VIDAR's odometry (camera and IMU)".into());
        }
        (Some(_), _) => lines.push("vidar run: metric map with poses of the external trajectory".into()),
        (None, Some(_)) => {
            lines.push("vidar run: metric map with poses of the ground truth (an upper bound)".into())
        }
        (None, None) => lines.push("vidar run: no metric poses; give --trajectory FILE, or use --mode pose-free with a network (not metric)".into()),
    }
    if dataset.reference_cloud.is_some() || dataset.depth_sensor.is_some() {
        lines.push("the map will be evaluated against the scan or the depth sensor".into());
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Image;

    #[test]
    fn a_stream_has_its_rate_and_longest_gap() {
        let times: Vec<Timestamp> =
            [0, 50, 100, 150, 400, 450].map(|ms| Timestamp::from_nanos(ms * 1_000_000)).into();
        let stream = stream("x", &times).unwrap();
        assert!((stream.rate_hz.unwrap() - 20.0).abs() < 1e-9);
        assert!((stream.longest_gap_secs - 0.25).abs() < 1e-9);
        assert!((stream.length_secs - 0.45).abs() < 1e-9);
    }

    #[test]
    fn a_flat_image_is_unsharp_and_a_checkerboard_is_sharp() {
        let flat = measure(&FrameImage::Gray8(Image::filled(20, 20, 100)));
        assert_eq!(flat, [100.0, 0.0, 0.0]);
        let board = FrameImage::Gray8(Image::from_fn(20, 20, |x, y| if (x + y) % 2 == 0 { 0 } else { 255 }));
        let [_, clipped, sharpness] = measure(&board);
        assert_eq!(clipped, 1.0);
        assert!(sharpness > 1e5);
    }
}
