//! Rendered rooms with exact depth and poses: Replica as NICE-SLAM renders it, and ICL-NUIM.

use crate::draft::{Draft, DraftDepth};
use crate::error::DatasetError;
use crate::folder::{frame_number, images_in, names_in, synthetic_time, synthetic_warning};
use crate::options::{OpenOptions, RecordingKind, TimeUnit, TrajectoryFormat, TrajectoryReadOptions};
use crate::parse::{self, Source};
use crate::recording::CalibrationSource;
use crate::seven_scenes::checked_pinhole;
use crate::trajectory_file::{ReadPoses, read_poses};
use std::path::{Path, PathBuf};
use vidar_core::{
    BodyFrame, CameraId, CameraModel, Pinhole, Se3, StampedPose, Timestamp, Trajectory, Warning,
};

const CAMERA: BodyFrame = BodyFrame::Camera(CameraId(0));

fn registered_depth(units_per_metre: f64) -> DraftDepth {
    DraftDepth {
        distorted: None,
        intrinsics: None,
        units_per_metre: Some(units_per_metre),
        default_units: units_per_metre,
        body_from_depth: None,
        invalid: vec![0, u16::MAX],
        is_registered: true,
    }
}

/// Looks for Replica's layout at `path`: frames and depth in `results`, a pose for each.
pub(crate) fn detect_replica(path: &Path) -> Option<String> {
    let names = names_in(&path.join("results")).ok()?;
    let has_frames = names.iter().any(|n| n.starts_with("frame") && parse::is_image_name(n));
    (has_frames && path.join("traj.txt").is_file()).then(|| "results/frame* beside traj.txt".into())
}

/// Reads `results/frame*.jpg`, `results/depth*.png`, `traj.txt` (one row-major `world_from_camera` a frame) and `cam_params.json`.
pub(crate) fn open_replica(path: &Path, reason: String, _: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::Replica, path, reason);
    let folder = path.join("results");
    draft.image_list = folder.clone();
    let mut numbers = Vec::new();
    for name in images_in(&folder)? {
        let Some(number) = frame_number(&name) else { continue };
        let place = (synthetic_time(number), folder.join(&name).into());
        if name.starts_with("frame") {
            draft.images.push(place);
            numbers.push(number);
        } else if name.starts_with("depth") {
            draft.depths.push(place);
        }
    }
    draft.warnings.push(Warning { hint: None, ..synthetic_warning(&folder) });
    let poses = path.join("traj.txt");
    let bytes = draft.read(&poses)?;
    let (rows, notes) = parse::matrix_poses(&Source { path: &poses, bytes: &bytes })?;
    draft.warnings.extend(notes);
    // Row n is the pose of frame n.
    let pose = |n: &u64| {
        let world_from_body = (*rows.get(usize::try_from(*n).ok()?)?)?;
        Some(StampedPose { time: synthetic_time(*n), world_from_body })
    };
    let stamped: Vec<StampedPose> = numbers.iter().filter_map(pose).collect();
    if stamped.len() < numbers.len() {
        let message = format!("{} of {} frames have a pose", stamped.len(), numbers.len());
        draft.warnings.push(Warning::new("pose-not-finite", message).at(poses.display()));
    }
    if !stamped.is_empty() {
        let trajectory = Trajectory::new(CAMERA, stamped)
            .map_err(|e| DatasetError::NoPoses { path: poses.clone(), found: e.to_string() })?;
        draft.ground_truth = Some((trajectory, poses));
    }
    read_replica_camera(&mut draft)?;
    Ok(draft)
}

/// `cam_params.json` beside the room or in the folder of all rooms.
fn read_replica_camera(draft: &mut Draft) -> Result<(), DatasetError> {
    let absolute = draft.root.canonicalize().unwrap_or_else(|_| draft.root.clone());
    let beside = absolute.parent().map(|p| p.join("cam_params.json"));
    let places: [Option<PathBuf>; 2] = [Some(draft.root.join("cam_params.json")), beside];
    let Some(file) = places.into_iter().flatten().find(|p| p.is_file()) else {
        // The scale that all rooms of this rendering have; the intrinsics are guessed and said to be.
        draft.depth = Some(registered_depth(6553.5));
        return Ok(());
    };
    let bytes = draft.read(&file)?;
    let stated = parse::replica_camera(&Source { path: &file, bytes: &bytes })?;
    let pinhole = checked_pinhole(stated.intrinsics, &file)?;
    draft.cameras[0].model = Some(CameraModel::Pinhole(pinhole));
    draft.cameras[0].source = CalibrationSource::File(file);
    draft.depth = Some(registered_depth(stated.units_per_metre));
    Ok(())
}

/// Intrinsics of every ICL-NUIM sequence, `[fx, fy, cx, cy]`, as its page states them: fy is negative, because the y axis of its camera
/// points up.
const ICL_CAMERA: [f64; 4] = [481.2, -480.0, 319.5, 239.5];
const ICL_SIZE: (usize, usize) = (640, 480);
/// "TUM RGB-D compatible" depth.
const ICL_UNITS: f64 = 5000.0;

/// Looks for ICL-NUIM at `path`: the trajectory's name tells it from TUM RGB-D.
pub(crate) fn detect_icl(path: &Path) -> Option<String> {
    let truth = icl_truth(path)?;
    let name = truth.file_name()?.to_string_lossy().into_owned();
    path.join("associations.txt").is_file().then(|| format!("associations.txt beside {name}"))
}

fn icl_truth(path: &Path) -> Option<PathBuf> {
    let name = names_in(path).ok()?.into_iter().find(|n| n.ends_with(".gt.freiburg"))?;
    Some(path.join(name))
}

/// Reads `associations.txt` (`n depth/n.png n rgb/n.png`) and the trajectory, whose times are numbers of frames at 30 Hz.
///
/// A point (x, y, z) of that camera, whose y is up, is (x, −y, z) of a camera of computer vision. With F = diag(1, −1, 1) the same images
/// come from `F·world_from_camera·F` and a positive fy, in a world that is mirrored in y like the camera.
pub(crate) fn open_icl(path: &Path, reason: String, _: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::IclNuim, path, reason);
    let list = path.join("associations.txt");
    let bytes = draft.read(&list)?;
    draft.image_list = list.clone();
    for pair in parse::associations(&Source { path: &list, bytes: &bytes })? {
        draft.depths.push((synthetic_time(pair.depth_frame), path.join(pair.depth).into()));
        draft.images.push((synthetic_time(pair.color_frame), path.join(pair.color).into()));
    }
    draft.warnings.push(Warning { hint: None, ..synthetic_warning(path) });
    let [fx, fy, cx, cy] = ICL_CAMERA;
    let Some((_, first)) = draft.images.first() else { return Ok(draft) };
    if draft.media.size(first).is_ok_and(|size| size == ICL_SIZE)
        && let Ok(pinhole) = Pinhole::new(fx, -fy, cx, cy, ICL_SIZE.0, ICL_SIZE.1)
    {
        draft.cameras[0].model = Some(CameraModel::Pinhole(pinhole));
        draft.cameras[0].source = CalibrationSource::DatasetDefault;
        let message = "no calibration file; the published camera is used (f 481.2, -480), with the world mirrored in y so that fy is positive";
        draft.warnings.push(Warning::new("intrinsics-published", message).at(path.display()));
    }
    draft.depth = Some(registered_depth(ICL_UNITS));
    if let Some(truth) = icl_truth(path) {
        read_icl_truth(&mut draft, truth)?;
    }
    Ok(draft)
}

fn read_icl_truth(draft: &mut Draft, truth: PathBuf) -> Result<(), DatasetError> {
    let bytes = draft.read(&truth)?;
    let source = Source { path: &truth, bytes: &bytes };
    let read = TrajectoryReadOptions {
        format: Some(TrajectoryFormat::Tum),
        body: Some(CAMERA),
        time_unit: Some(TimeUnit::Seconds),
        times: None,
    };
    // Numbers of frames in the column of seconds: gaps of a second are no gaps.
    let ReadPoses { trajectory, mut notes, .. } = read_poses(&source, &read)?;
    notes.retain(|n| n.kind != "pose-gap");
    draft.warnings.extend(notes);
    let frame = |time: Timestamp| u64::try_from(time.nanos() / 1_000_000_000).ok();
    let pose = |p: &StampedPose| {
        Some(StampedPose {
            time: synthetic_time(frame(p.time)?),
            world_from_body: mirrored(&p.world_from_body),
        })
    };
    let poses: Vec<StampedPose> = trajectory.poses().iter().filter_map(pose).collect();
    let trajectory = Trajectory::new(CAMERA, poses)
        .map_err(|e| DatasetError::NoPoses { path: truth.clone(), found: e.to_string() })?;
    draft.ground_truth = Some((trajectory, truth));
    Ok(())
}

/// F·T·F with F = diag(1, −1, 1): a rotation's axis turns as a mirrored axial vector does.
fn mirrored(pose: &Se3) -> Se3 {
    let [x, y, z, w] = pose.rotation.quaternion_xyzw();
    let mut t = pose.translation;
    t.y = -t.y;
    let rotation = vidar_core::So3::from_quaternion(-x, y, -z, w).unwrap_or(pose.rotation);
    Se3::new(rotation, t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};
    use vidar_core::{LieGroup, So3};

    #[test]
    fn a_mirrored_pose_gives_the_same_pixels_with_a_positive_focal_length() {
        let rotation = So3::from_axis_angle(&Vector3::new(0.3, -0.5, 0.8).normalize(), 0.7);
        let pose = Se3::new(rotation, Vector3::new(0.4, -1.2, 2.0));
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
        for point in [Vector3::new(0.2, 0.1, 5.0), Vector3::new(-1.0, 0.7, 4.0)] {
            let in_camera = pose.inverse().act(&point);
            let [fx, fy, cx, cy] = ICL_CAMERA;
            let pixel = (cx + fx * in_camera.x / in_camera.z, cy + fy * in_camera.y / in_camera.z);
            let seen = mirrored(&pose).inverse().act(&(mirror * point));
            let again = (cx + fx * seen.x / seen.z, cy - fy * seen.y / seen.z);
            assert!((pixel.0 - again.0).abs() + (pixel.1 - again.1).abs() < 1e-9, "{pixel:?} {again:?}");
            assert!((seen.z - in_camera.z).abs() < 1e-12, "depth stays");
        }
    }
}
