//! KITTI odometry: `image_0/`, `image_1/`, …, `times.txt`, `calib.txt`, and `poses.txt` or `../../poses/NN.txt`.
//!
//! Images are rectified. A line `PN: …` of `calib.txt` is the projection of camera N's image, K·[I | t], with t the position of camera 0
//! in camera N; poses are `world_from_camera` of camera 0 (Geiger et al., "Vision meets Robotics", 2013, and the development kit).

use crate::draft::{Draft, DraftCamera};
use crate::error::DatasetError;
use crate::folder::{images_in, names_in};
use crate::image_folder::images_by_list;
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind, TrajectoryFormat, TrajectoryReadOptions};
use crate::parse::{self, ProjectionMatrix, Source};
use crate::recording::CalibrationSource;
use crate::trajectory_file::{ReadPoses, read_poses};
use std::path::{Path, PathBuf};
use vidar_core::{BodyFrame, CameraId, CameraModel, LieGroup, Pinhole, Se3};

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let lists = path.join("times.txt").is_file() && path.join("calib.txt").is_file();
    let cameras = cameras_of(path);
    (lists && !cameras.is_empty()).then(|| format!("image_{} beside times.txt and calib.txt", cameras[0]))
}

/// Numbers of the folders `image_N`.
fn cameras_of(path: &Path) -> Vec<u32> {
    let names = names_in(path).unwrap_or_default();
    let number = |n: &String| n.strip_prefix("image_").filter(|d| d.len() < 3)?.parse().ok();
    names.iter().filter(|n| path.join(n).is_dir()).filter_map(number).collect()
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::KittiOdometry, path, reason);
    let wanted = options.camera.0;
    let cameras = cameras_of(path);
    if !cameras.contains(&wanted) {
        return Err(missing_camera(path, options.camera, &cameras));
    }
    let file = path.join("calib.txt");
    let bytes = draft.read(&file)?;
    let projections = parse::projection_matrices(&Source { path: &file, bytes: &bytes })?;
    draft.cameras = projections
        .iter()
        .filter_map(|(name, p)| Some((name.strip_prefix('P')?.parse().ok()?, p)))
        .map(|(number, p)| camera_of(number, p, &file))
        .collect::<Result<_, _>>()?;
    draft.chosen = chosen(&draft, wanted, &file)?;
    let folder = path.join(format!("image_{wanted}"));
    let names = images_in(&folder)?;
    draft.image_list = path.join("times.txt");
    let list = options.timestamps.clone().unwrap_or_else(|| draft.image_list.clone());
    draft.images = files(images_by_list(&mut draft, &folder, &names, &list, options)?);
    read_truth(&mut draft)?;
    Ok(draft)
}

pub(crate) fn missing_camera(path: &Path, camera: CameraId, found: &[u32]) -> DatasetError {
    let found = found.iter().map(|n| format!("camera {n}")).collect::<Vec<_>>().join(", ");
    DatasetError::MissingCamera { path: path.to_path_buf(), camera, found }
}

/// The index of camera `wanted` among those of the calibration.
pub(crate) fn chosen(draft: &Draft, wanted: u32, file: &Path) -> Result<usize, DatasetError> {
    draft.cameras.iter().position(|c| c.number == wanted).ok_or_else(|| DatasetError::Malformed {
        path: file.to_path_buf(),
        line: 0,
        found: format!("no projection of camera {wanted}"),
        expected: "a line with its projection matrix, 12 numbers".into(),
    })
}

/// A rectified camera from its projection; its body is camera 0's rectified frame.
pub(crate) fn camera_of(number: u32, p: &ProjectionMatrix, file: &Path) -> Result<DraftCamera, DatasetError> {
    let bad = |source| DatasetError::BadCamera {
        path: file.to_path_buf(),
        key: format!("camera {number}"),
        source,
    };
    let pinhole = Pinhole::new(p.fx(), p.fy(), p.cx(), p.cy(), 1, 1).map_err(bad)?;
    let camera_from_first = Se3::from_translation(p.translation());
    Ok(DraftCamera {
        model: Some(CameraModel::Pinhole(Pinhole { width: 0, height: 0, ..pinhole })),
        source: CalibrationSource::File(file.to_path_buf()),
        body_from_camera: camera_from_first.inverse(),
        ..DraftCamera::unknown(number)
    })
}

/// Poses of a training sequence.
fn read_truth(draft: &mut Draft) -> Result<(), DatasetError> {
    let absolute = draft.root.canonicalize().unwrap_or_else(|_| draft.root.clone());
    let named = absolute.file_name().map(|n| format!("{}.txt", n.to_string_lossy()));
    let beside = || Some(absolute.parent()?.parent()?.join("poses").join(named?));
    let places: [Option<PathBuf>; 2] = [Some(draft.root.join("poses.txt")), beside()];
    let Some(file) = places.into_iter().flatten().find(|p| p.is_file()) else { return Ok(()) };
    let bytes = draft.read(&file)?;
    // The rows are those of camera 0's images, which are as many as any camera's.
    let first = draft.cameras.iter().position(|c| c.number == 0).unwrap_or(draft.chosen);
    let read = TrajectoryReadOptions {
        format: Some(TrajectoryFormat::Kitti),
        body: Some(BodyFrame::Camera(CameraId(first as u32))),
        time_unit: None,
        times: Some(draft.images.iter().map(|i| i.0).collect()),
    };
    let ReadPoses { trajectory, notes, .. } = read_poses(&Source { path: &file, bytes: &bytes }, &read)?;
    draft.warnings.extend(notes);
    draft.ground_truth = Some((trajectory, file));
    Ok(())
}
