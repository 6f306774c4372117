//! 7-Scenes: `frame-000000.color.png` (or `.jpg`), `.depth.png` in millimetres, `.pose.txt` with world_from_camera.
//!
//! The files hold no times (30 Hz is assumed) and only the depth camera's intrinsics. Poses are those of
//! the depth camera, metric, from KinectFusion.

use crate::draft::{Draft, DraftDepth};
use crate::error::DatasetError;
use crate::folder::{first_file, frame_number, names_in, synthetic_time, synthetic_warning};
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::{self, Source};
use crate::source::read_file_up_to;
use std::path::{Path, PathBuf};
use vidar_core::{
    BodyFrame, CameraId, CameraModel, LieGroup, Pinhole, Se3, StampedPose, Timestamp, Trajectory, Warning,
};

/// A pose file holds 16 numbers.
const MAX_POSE_BYTES: u64 = 16 << 10;
/// The Kinect's factory values, which the dataset's page gives.
const PUBLISHED: [f64; 4] = [585.0, 585.0, 320.0, 240.0];

/// Looks for frames in `path` and in its `seq-XX`; returns the folder of frames and the reason.
pub(crate) fn detect(path: &Path) -> Option<(PathBuf, String)> {
    let is_frame = |n: &String| n.starts_with("frame-") && n.contains(".color.");
    let names = names_in(path).ok()?;
    if names.iter().any(is_frame) {
        return Some((path.to_path_buf(), "files named frame-….color.*".into()));
    }
    let sequences: Vec<&String> = names
        .iter()
        .filter(|n| n.starts_with("seq"))
        .filter(|n| names_in(&path.join(n)).is_ok_and(|inner| inner.iter().any(is_frame)))
        .collect();
    let first = sequences.first()?;
    let others = match sequences.len() {
        1 => String::new(),
        n => format!(", the first of {n} sequences"),
    };
    Some((path.join(first), format!("files named {first}/frame-….color.*{others}")))
}

/// Reads the layout.
pub(crate) fn open(folder: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::SevenScenes, folder, reason);
    let mut poses = Vec::new();
    for name in names_in(folder)? {
        let Some(base) = name.find(".color.").map(|at| &name[..at]) else { continue };
        let Some(number) = frame_number(base) else { continue };
        let time = synthetic_time(number);
        draft.images.push((time, folder.join(&name).into()));
        let depth = folder.join(format!("{base}.depth.png"));
        if depth.is_file() {
            draft.depths.push((time, depth.into()));
        }
        let pose = folder.join(format!("{base}.pose.txt"));
        if pose.is_file() {
            poses.push((time, read_pose(&mut draft, &pose)?, pose));
        }
    }
    // The layout has no file of times, so there is no hint to give.
    draft.warnings.push(Warning { hint: None, ..synthetic_warning(folder) });
    complete_poses(&mut draft, poses)?;
    complete_cameras(&mut draft, options)?;
    Ok(draft)
}

fn read_pose(draft: &mut Draft, path: &Path) -> Result<Option<Se3>, DatasetError> {
    let bytes = read_file_up_to(path, MAX_POSE_BYTES)?;
    draft.text_files.push(path.to_path_buf());
    parse::single_pose(&Source { path, bytes: &bytes })
}

/// An identity pose whose neighbours are within this distance of the origin may be real; otherwise it is a placeholder.
const NEAR_ORIGIN_M: f64 = 0.25;
const NEAR_ORIGIN_RAD: f64 = 0.35;

fn is_near_identity(pose: &Se3) -> bool {
    pose.translation.norm() < NEAR_ORIGIN_M && pose.rotation.log().norm() < NEAR_ORIGIN_RAD
}

/// Skips NaN poses and placeholder identities; the rest is the ground truth.
fn complete_poses(
    draft: &mut Draft,
    poses: Vec<(Timestamp, Option<Se3>, PathBuf)>,
) -> Result<(), DatasetError> {
    let is_identity = |p: &Se3| *p == Se3::IDENTITY;
    let real: Vec<Option<Se3>> = poses.iter().map(|p| p.1.filter(|p| !is_identity(p))).collect();
    // The nearest real pose before and after each frame, in one sweep each way.
    let nearest = |last: &mut Option<Se3>, p: &Option<Se3>| {
        *last = p.or(*last);
        Some(*last)
    };
    let before: Vec<Option<Se3>> = real.iter().scan(None, nearest).collect();
    let mut after: Vec<Option<Se3>> = real.iter().rev().scan(None, nearest).collect();
    after.reverse();
    let mut kept = Vec::with_capacity(poses.len());
    let mut skipped: Vec<&Path> = Vec::new();
    for (i, (time, pose, path)) in poses.iter().enumerate() {
        let neighbour_near = [before[i], after[i]].iter().flatten().any(is_near_identity);
        match pose {
            Some(pose) if !is_identity(pose) || neighbour_near => {
                kept.push(StampedPose { time: *time, world_from_body: *pose });
            }
            _ => skipped.push(path),
        }
    }
    if let Some(first) = skipped.first() {
        let message =
            format!("{} poses are NaN or an identity far from their neighbours; skipped", skipped.len());
        draft.warnings.push(Warning::new("pose-not-finite", message).at(first.display()));
    }
    if kept.is_empty() {
        if !poses.is_empty() {
            let message = format!("none of {} poses is valid; there is no ground truth", poses.len());
            draft.warnings.push(Warning::new("no-poses", message).at(draft.root.display()));
        }
        return Ok(());
    }
    let trajectory = Trajectory::new(BodyFrame::Camera(CameraId(0)), kept)
        .map_err(|e| DatasetError::NoPoses { path: draft.root.clone(), found: e.to_string() })?;
    draft.ground_truth = Some((trajectory, draft.root.clone()));
    Ok(())
}

/// Uses the depth camera's model for the colour camera unless the user gives another.
fn complete_cameras(draft: &mut Draft, options: &OpenOptions) -> Result<(), DatasetError> {
    let names = ["camera-intrinsics.txt", "intrinsics.txt", "K.txt"];
    let parent = draft.root.parent().map(Path::to_path_buf);
    let file = first_file(&draft.root, &names).or_else(|| first_file(&parent?, &names));
    let intrinsics = match &file {
        Some(path) => {
            let bytes = draft.read(path)?;
            parse::intrinsics_matrix(&Source { path, bytes: &bytes })?
        }
        None => {
            let message = "no camera-intrinsics.txt; the published depth camera is used (f 585, c 320, 240)";
            draft.warnings.push(Warning::new("intrinsics-published", message).at(draft.root.display()));
            PUBLISHED
        }
    };
    let place = file.clone().unwrap_or_else(|| draft.root.clone());
    let pinhole = checked_pinhole(intrinsics, &place)?;
    let camera = &mut draft.cameras[0];
    camera.model = Some(CameraModel::Pinhole(pinhole));
    camera.source = match file {
        Some(path) => crate::CalibrationSource::File(path),
        None => crate::CalibrationSource::DatasetDefault,
    };
    let from_user = options.camera_model.is_some() || !options.calibration.is_empty();
    if !from_user {
        let message = "no calibration of the colour camera; that of the depth camera is used, although on a Kinect they differ by 2.5 cm and 10 % of focal length";
        draft.warnings.push(
            Warning::new("color-is-depth-camera", message)
                .at(place.display())
                .hint("--camera-model pinhole:fx,fy,cx,cy for colour, and --color-from-depth"),
        );
    }
    if !draft.depths.is_empty() {
        draft.depth = Some(DraftDepth {
            distorted: None,
            intrinsics: Some(intrinsics),
            units_per_metre: Some(1000.0),
            default_units: 1000.0,
            body_from_depth: None,
            invalid: vec![0, u16::MAX],
            is_registered: !from_user,
        });
    }
    Ok(())
}

/// Checks intrinsics whose image size is not known yet.
pub(crate) fn checked_pinhole([fx, fy, cx, cy]: [f64; 4], place: &Path) -> Result<Pinhole, DatasetError> {
    let pinhole = Pinhole::new(fx, fy, cx, cy, 1, 1).map_err(|source| DatasetError::BadCamera {
        path: place.to_path_buf(),
        key: "intrinsics".into(),
        source,
    })?;
    Ok(Pinhole { width: 0, height: 0, ..pinhole })
}
