//! KITTI raw: `image_00/data`, `image_00/timestamps.txt`, …, `oxts/`, and the calibrations of the day in the folder above.
//!
//! The `_sync` recordings hold rectified images and one inertial record an image (10 Hz), the `_extract` ones raw images and records at
//! 100 Hz; the size of the images tells which calibration is theirs. The unit of oxts is the IMU and, by its poses, the reference.

use crate::draft::{Draft, DraftCamera};
use crate::error::DatasetError;
use crate::folder::{images_in, names_in};
use crate::kitti::{camera_of, chosen, missing_camera};
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::{self, Oxts, Source};
use crate::recording::CalibrationSource;
use crate::source::read_file_up_to;
use nalgebra::{Matrix3, Vector3};
use std::path::{Path, PathBuf};
use vidar_core::camera::RadTan;
use vidar_core::{
    AngularRate, BodyFrame, CameraModel, ImuSample, LieGroup, Pinhole, Se3, So3, SpecificForce, StampedPose,
    Timestamp, Trajectory, Warning,
};

/// A record has 30 numbers.
const MAX_RECORD_BYTES: u64 = 16 << 10;
/// Slowest IMU that odometry can use, Hz.
const MIN_IMU_HZ: f64 = 50.0;

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let first = *cameras_of(path).first()?;
    Some(format!("image_{first:02}/data with timestamps.txt"))
}

fn folder_of(path: &Path, camera: u32) -> PathBuf {
    path.join(format!("image_{camera:02}"))
}

fn cameras_of(path: &Path) -> Vec<u32> {
    let is_camera = |n: &u32| {
        let folder = folder_of(path, *n);
        folder.join("data").is_dir() && folder.join("timestamps.txt").is_file()
    };
    (0..4).filter(is_camera).collect()
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::KittiRaw, path, reason);
    let cameras = cameras_of(path);
    let wanted = match options.camera.0 {
        // Many download the colour cameras only; camera 0 is nobody's wish then.
        0 if !cameras.contains(&0) => cameras.first().copied().unwrap_or(0),
        other => other,
    };
    if !cameras.contains(&wanted) {
        return Err(missing_camera(path, options.camera, &cameras));
    }
    read_images(&mut draft, wanted)?;
    draft.cameras = vec![DraftCamera::unknown(wanted)];
    if let Some(file) = calibration(path, "calib_cam_to_cam.txt") {
        read_cameras(&mut draft, wanted, &file)?;
    }
    read_oxts(&mut draft)?;
    Ok(draft)
}

fn read_images(draft: &mut Draft, camera: u32) -> Result<(), DatasetError> {
    let folder = folder_of(&draft.root, camera);
    let list = folder.join("timestamps.txt");
    let bytes = draft.read(&list)?;
    let times = parse::times_of_day(&Source { path: &list, bytes: &bytes })?;
    let data = folder.join("data");
    let names = images_in(&data)?;
    draft.image_list = list.clone();
    draft.images = files(numbered(draft, times, names, &data, &list));
    Ok(())
}

/// Files with the times of their numbers: a recording may lack some files, and the list then still has their times.
fn numbered(
    draft: &mut Draft,
    times: Vec<Timestamp>,
    names: Vec<String>,
    folder: &Path,
    list: &Path,
) -> Vec<(Timestamp, PathBuf)> {
    let time_of = |name: &String| {
        let number = usize::try_from(crate::folder::frame_number(name)?).ok()?;
        times.get(number).copied()
    };
    let timed: Vec<_> = names.iter().filter_map(|n| Some((time_of(n)?, folder.join(n)))).collect();
    if timed.len() < times.len() || timed.len() < names.len() {
        let message = format!("{} times and {} files; {} have both", times.len(), names.len(), timed.len());
        draft.warnings.push(Warning::degraded("time-missing", message).at(list.display()));
    }
    timed
}

/// A calibration of the day: in the folder above the recording, or beside its images.
fn calibration(path: &Path, name: &str) -> Option<PathBuf> {
    let absolute = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    [Some(path.join(name)), absolute.parent().map(|p| p.join(name))]
        .into_iter()
        .flatten()
        .find(|p| p.is_file())
}

fn read_cameras(draft: &mut Draft, wanted: u32, file: &Path) -> Result<(), DatasetError> {
    let bytes = draft.read(file)?;
    let source = Source { path: file, bytes: &bytes };
    let lines = parse::named_numbers(&source)?;
    let find = |name: String| lines.iter().find(|(n, _)| *n == name).map(|(_, v)| v.as_slice());
    let size_of = |name: String| match find(name) {
        Some(&[w, h]) => Some((w as usize, h as usize)),
        _ => None,
    };
    let Some((_, first)) = draft.images.first() else { return Ok(()) };
    let size = draft.media.size(first)?;
    let is_raw = size_of(format!("S_{wanted:02}")) == Some(size)
        && size_of(format!("S_rect_{wanted:02}")) != Some(size);
    draft.cameras.clear();
    if is_raw {
        draft.cameras.push(raw_camera(&source, wanted, &find)?);
    } else {
        for (name, projection) in parse::projection_matrices(&source)? {
            if let Some(number) = name.strip_prefix("P_rect_").and_then(|n| n.parse().ok()) {
                draft.cameras.push(camera_of(number, &projection, file)?);
            }
        }
    }
    draft.chosen = chosen(draft, wanted, file)?;
    let root = draft.root.clone();
    let mounts = calibration(&root, "calib_velo_to_cam.txt").zip(calibration(&root, "calib_imu_to_velo.txt"));
    let Some((velo_to_cam, imu_to_velo)) = mounts else {
        let message =
            "no calib_imu_to_velo.txt and calib_velo_to_cam.txt: the cameras' pose on the IMU is not known";
        draft.warnings.push(Warning::new("extrinsics-missing", message).at(root.display()));
        return Ok(());
    };
    let mut motion = |path: &Path| -> Result<Se3, DatasetError> {
        let bytes = draft.read(path)?;
        parse::rotation_and_translation(&Source { path, bytes: &bytes })
    };
    let first_from_imu = motion(&velo_to_cam)? * motion(&imu_to_velo)?;
    // R_rect_00 turns camera 0 to the rectified frame that the projections are of; raw cameras are posed on camera 0 itself.
    let rectification = find("R_rect_00".into()).filter(|r| r.len() == 9);
    let rectified = rectification.and_then(|r| So3::from_matrix(&Matrix3::from_row_slice(r)));
    let reference_from_imu = match rectified.filter(|_| !is_raw) {
        Some(rotation) => Se3::new(rotation, Vector3::zeros()) * first_from_imu,
        None => first_from_imu,
    };
    for camera in &mut draft.cameras {
        camera.body_from_camera = reference_from_imu.inverse() * camera.body_from_camera;
    }
    Ok(())
}

/// A camera before rectification: `K_NN`, `D_NN` (OpenCV's order), `R_NN` and `T_NN`, which map points of camera 0 to it.
fn raw_camera<'a>(
    source: &Source<'_>,
    number: u32,
    find: &dyn Fn(String) -> Option<&'a [f64]>,
) -> Result<DraftCamera, DatasetError> {
    let line = |name: &str, count: usize| {
        find(format!("{name}_{number:02}")).filter(|n| n.len() == count).ok_or_else(|| {
            source.malformed(
                0,
                format!("no {name}_{number:02} of {count} numbers"),
                "KITTI's camera calibration",
            )
        })
    };
    let bad = |e| DatasetError::BadCamera {
        path: source.path.to_path_buf(),
        key: format!("camera {number}"),
        source: e,
    };
    let (k, d, r, t) = (line("K", 9)?, line("D", 5)?, line("R", 9)?, line("T", 3)?);
    let pinhole = Pinhole::new(k[0], k[4], k[2], k[5], 1, 1).map_err(bad)?;
    let pinhole = Pinhole { width: 0, height: 0, ..pinhole };
    let model = RadTan::with_k3(pinhole, [d[0], d[1], d[2], d[3]], d[4]).map_err(bad)?;
    let rotation = So3::from_matrix(&Matrix3::from_row_slice(r)).ok_or_else(|| {
        source.malformed(0, format!("R_{number:02} is no rotation"), "an orthonormal 3x3 matrix")
    })?;
    let camera_from_first = Se3::new(rotation, Vector3::from_row_slice(t));
    Ok(DraftCamera {
        model: Some(CameraModel::RadTan(model)),
        source: CalibrationSource::File(source.path.to_path_buf()),
        body_from_camera: camera_from_first.inverse(),
        ..DraftCamera::unknown(number)
    })
}

/// Records of the navigation unit: reference poses, and an IMU where they are frequent enough.
fn read_oxts(draft: &mut Draft) -> Result<(), DatasetError> {
    let folder = draft.root.join("oxts");
    let list = folder.join("timestamps.txt");
    if !list.is_file() {
        return Ok(());
    }
    let bytes = draft.read(&list)?;
    let times = parse::times_of_day(&Source { path: &list, bytes: &bytes })?;
    let data = folder.join("data");
    let mut names = names_in(&data)?;
    names.retain(|n| n.ends_with(".txt"));
    let mut records: Vec<(Timestamp, Oxts)> = Vec::new();
    for (time, path) in numbered(draft, times, names, &data, &list) {
        let bytes = read_file_up_to(&path, MAX_RECORD_BYTES)?;
        records.push((time, parse::oxts(&Source { path: &path, bytes: &bytes })?));
        draft.text_files.push(path);
    }
    let Some(origin_deg) = records.first().map(|(_, r)| r.place[0]) else { return Ok(()) };
    crate::checks::put_in_order(&mut records, |r| r.0, "records of oxts", &list, &mut draft.warnings);
    let pose = |(time, record): &(Timestamp, Oxts)| {
        Some(StampedPose { time: *time, world_from_body: record.world_from_unit(origin_deg)? })
    };
    let mut poses: Vec<StampedPose> = records.iter().filter_map(pose).collect();
    // Mercator coordinates have seven digits before the point; relative to the first record the digits are the motion's.
    if let Some(start) = poses.first().map(|p| p.world_from_body.translation) {
        poses.iter_mut().for_each(|p| p.world_from_body.translation -= start);
    }
    if !poses.is_empty() {
        let trajectory = Trajectory::new(BodyFrame::Imu, poses)
            .map_err(|e| DatasetError::NoPoses { path: list.clone(), found: e.to_string() })?;
        draft.ground_truth = Some((trajectory, list.clone()));
    }
    let sample = |(time, r): &(Timestamp, Oxts)| ImuSample {
        time: *time,
        gyro: AngularRate(Vector3::from(r.gyro)),
        accel: SpecificForce(Vector3::from(r.accel)),
    };
    let mut imu: Vec<ImuSample> = records.iter().map(sample).collect();
    imu.retain(|s| s.gyro.0.iter().chain(s.accel.0.iter()).all(|v| v.is_finite()));
    match crate::inertial::median_rate_hz(&imu) {
        Some(rate_hz) if rate_hz >= MIN_IMU_HZ => {
            draft.imu = imu;
            draft.assume_imu_noise("KITTI raw", rate_hz, &list.display().to_string());
        }
        rate => {
            let message = format!(
                "records at {:.0} Hz are too few for an IMU and are used as reference poses only",
                rate.unwrap_or(0.0)
            );
            let warning = Warning::new("imu-rate-low", message).at(list.display());
            draft.warnings.push(warning.hint("the _extract recordings hold 100 Hz"));
        }
    }
    Ok(())
}
