//! TUM RGB-D: `rgb.txt`, `depth.txt`, `groundtruth.txt`, `accelerometer.txt`; ETH3D SLAM, the same with `calibration.txt` and `imu.txt`.
//!
//! Depth is registered to the colour camera, in units of 1/5000 m; poses are the colour camera's. TUM's files hold no
//! calibration: the calibration that the dataset's authors publish for each of the three cameras is used, with a warning.

use crate::draft::{Draft, DraftDepth};
use crate::error::DatasetError;
use crate::inertial;
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind, TimeUnit, TrajectoryFormat, TrajectoryReadOptions};
use crate::parse::{self, Source, UnitRule};
use crate::recording::CalibrationSource;
use crate::seven_scenes::checked_pinhole;
use crate::trajectory_file::{ReadPoses, read_poses};
use std::path::{Path, PathBuf};
use vidar_core::camera::RadTan;
use vidar_core::{BodyFrame, CameraId, CameraModel, Pinhole, Timestamp, Warning};

/// Raw depth units per metre.
const DEPTH_UNITS: f64 = 5000.0;

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let has = |n: &str| path.join(n).is_file();
    let beside = ["depth.txt", "groundtruth.txt", "accelerometer.txt"].into_iter().find(|n| has(n));
    match (has("rgb.txt"), beside) {
        (true, Some(other)) => Some(format!("rgb.txt next to {other}")),
        (true, None) if path.join("rgb").is_dir() => Some("rgb.txt next to a folder rgb".into()),
        _ => None,
    }
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::TumRgbd, path, reason);
    let rule = UnitRule::given_or(options.time_unit, TimeUnit::Seconds);
    draft.image_list = path.join("rgb.txt");
    draft.images = files(read_list(&mut draft, &path.join("rgb.txt"), rule)?);
    if path.join("depth.txt").is_file() {
        draft.depths = files(read_list(&mut draft, &path.join("depth.txt"), rule)?);
        draft.depth = Some(DraftDepth {
            distorted: None,
            intrinsics: None,
            units_per_metre: Some(DEPTH_UNITS),
            default_units: DEPTH_UNITS,
            body_from_depth: None,
            invalid: vec![0],
            is_registered: true,
        });
    }
    read_calibration(&mut draft)?;
    let imu = path.join("imu.txt");
    if imu.is_file()
        && let Some(table) = inertial::imu_file_at(&imu)?
    {
        inertial::read_imu(&mut draft, &[table], options, "ETH3D")?;
        let message = "no pose of the camera on the IMU is given; assumed: the same position and axes";
        let warning = Warning::degraded("extrinsics-missing", message).at(imu.display());
        draft.warnings.push(
            warning
                .hint("--calibration camchain.yaml (Kalibr) gives it; `vidar calibrate` finds the rotation"),
        );
    }
    let list = path.join("accelerometer.txt");
    if list.is_file() {
        let bytes = draft.read(&list)?;
        let (samples, notes) = parse::accelerometer_list(&Source { path: &list, bytes: &bytes }, rule)?;
        draft.warnings.extend(notes);
        draft.accelerometer = samples;
        let message = "the accelerometer has no gyroscope, so there is no IMU; it is used for gravity only";
        draft.warnings.push(Warning::new("imu-incomplete", message).at(list.display()));
    }
    let truth = path.join("groundtruth.txt");
    if truth.is_file() {
        let bytes = draft.read(&truth)?;
        let read = TrajectoryReadOptions {
            format: Some(TrajectoryFormat::Tum),
            body: Some(BodyFrame::Camera(CameraId(0))),
            time_unit: None,
            times: None,
        };
        let ReadPoses { trajectory, notes, .. } = read_poses(&Source { path: &truth, bytes: &bytes }, &read)?;
        draft.warnings.extend(notes);
        draft.ground_truth = Some((trajectory, truth));
    }
    Ok(draft)
}

/// ETH3D's `calibration.txt`: `fx fy cx cy` of images without distortion.
fn read_calibration(draft: &mut Draft) -> Result<(), DatasetError> {
    let file = draft.root.join("calibration.txt");
    if !file.is_file() {
        return Ok(());
    }
    let bytes = draft.read(&file)?;
    let intrinsics = parse::intrinsics_matrix(&Source { path: &file, bytes: &bytes })?;
    draft.cameras[0].model = Some(CameraModel::Pinhole(checked_pinhole(intrinsics, &file)?));
    draft.cameras[0].source = CalibrationSource::File(file);
    Ok(())
}

fn read_list(
    draft: &mut Draft,
    list: &Path,
    rule: UnitRule,
) -> Result<Vec<(Timestamp, PathBuf)>, DatasetError> {
    let bytes = draft.read(list)?;
    let (files, notes) = parse::file_list(&Source { path: list, bytes: &bytes }, rule)?;
    draft.warnings.extend(notes);
    let folder = list.parent().unwrap_or(Path::new("."));
    Ok(files.into_iter().map(|f| (f.time, folder.join(f.name))).collect())
}

/// A published colour camera: name, `[fx, fy, cx, cy]`, `[k1, k2, p1, p2, k3]`.
type Published = (&'static str, [f64; 4], [f64; 5]);

/// From the dataset's page "Intrinsic Camera Calibration of the Kinect".
const CAMERAS: [Published; 4] = [
    ("freiburg 1", [517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    ("freiburg 2", [520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    ("freiburg 3", [535.4, 539.2, 320.1, 247.6], [0.0; 5]),
    ("ROS default", [525.0, 525.0, 319.5, 239.5], [0.0; 5]),
];

/// The published model for a dataset named like TUM's, for images of 640×480.
pub(crate) fn published_model(
    root: &Path,
    kind: RecordingKind,
    size: (usize, usize),
) -> Option<(CameraModel, CalibrationSource, Warning)> {
    let absolute = root.canonicalize().unwrap_or_else(|_| root.to_path_buf());
    let name = absolute.file_name()?.to_string_lossy().to_ascii_lowercase();
    let named = (1..=3).find(|i| {
        name.contains(&format!("freiburg{i}")) || (name.contains("fr") && has_word(&name, &format!("fr{i}")))
    });
    let index = match (named, kind) {
        (Some(i), _) => i - 1,
        (None, RecordingKind::TumRgbd) => 3,
        _ => return None,
    };
    if size != (640, 480) {
        return None;
    }
    let (camera, [fx, fy, cx, cy], distortion) = CAMERAS[index];
    let pinhole = Pinhole::new(fx, fy, cx, cy, size.0, size.1).ok()?;
    let model = published_camera(pinhole, distortion)?;
    let warning = Warning::new(
        "intrinsics-published",
        format!("no calibration file; the published {camera} camera is used (f {fx}, {fy}, c {cx}, {cy})"),
    )
    .at(root.display())
    .hint("--camera-model, or --calibration FILE");
    Some((model, CalibrationSource::DatasetDefault, warning))
}

fn has_word(name: &str, word: &str) -> bool {
    name.split(|c: char| !c.is_ascii_alphanumeric()).any(|part| part == word)
}

fn published_camera(pinhole: Pinhole, [k1, k2, p1, p2, k3]: [f64; 5]) -> Option<CameraModel> {
    if [k1, k2, p1, p2, k3] == [0.0; 5] {
        return Some(CameraModel::Pinhole(pinhole));
    }
    RadTan::with_k3(pinhole, [k1, k2, p1, p2], k3).ok().map(CameraModel::RadTan)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    #[test]
    fn every_pixel_of_a_published_camera_has_a_ray() {
        for (name, [fx, fy, cx, cy], distortion) in CAMERAS {
            let pinhole = Pinhole::new(fx, fy, cx, cy, 640, 480).unwrap();
            let model = published_camera(pinhole, distortion).unwrap();
            for pixel in [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0), (320.0, 240.0)] {
                let pixel = Vector2::new(pixel.0, pixel.1);
                let ray = model.unproject(&pixel).unwrap_or_else(|| panic!("{pixel:?} of {name}"));
                assert!((model.project(&ray).unwrap() - pixel).norm() < 1e-9, "{pixel:?} of {name}");
            }
        }
    }
}
