//! A folder of `images/`, `poses.txt` (one row-major world_from_camera a line and image), `K.txt`, perhaps `depth/`.

use crate::draft::{Draft, DraftDepth};
use crate::error::DatasetError;
use crate::folder::{images_in, numbers_of, stem, synthetic_time, synthetic_warning};
use crate::image_folder;
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::{self, Source};
use crate::recording::CalibrationSource;
use crate::seven_scenes::checked_pinhole;
use std::path::Path;
use vidar_core::{BodyFrame, CameraId, CameraModel, StampedPose, Trajectory, Warning};

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let has = path.join("images").is_dir() && path.join("poses.txt").is_file();
    has.then(|| "a folder images next to poses.txt".into())
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::PosedFolder, path, reason);
    let folder = path.join("images");
    let names = images_in(&folder)?;
    draft.image_list = folder.clone();
    let images = match image_folder::find_times(path, options) {
        Some(list) => image_folder::images_by_list(&mut draft, &folder, &names, &list, options)?,
        None => {
            draft.warnings.push(synthetic_warning(&folder));
            draft.times_are_invented = true;
            let times = numbers_of(&names).into_iter().map(synthetic_time);
            times.zip(&names).map(|(time, name)| (time, folder.join(name))).collect()
        }
    };
    draft.images = files(images);
    read_intrinsics(&mut draft)?;
    read_poses(&mut draft)?;
    read_depth(&mut draft)?;
    Ok(draft)
}

fn read_intrinsics(draft: &mut Draft) -> Result<(), DatasetError> {
    let path = draft.root.join("K.txt");
    if !path.is_file() {
        return Ok(());
    }
    let bytes = draft.read(&path)?;
    let intrinsics = parse::intrinsics_matrix(&Source { path: &path, bytes: &bytes })?;
    let camera = &mut draft.cameras[0];
    camera.model = Some(CameraModel::Pinhole(checked_pinhole(intrinsics, &path)?));
    camera.source = CalibrationSource::File(path);
    Ok(())
}

fn read_poses(draft: &mut Draft) -> Result<(), DatasetError> {
    let path = draft.root.join("poses.txt");
    let bytes = draft.read(&path)?;
    let (poses, notes) = parse::matrix_poses(&Source { path: &path, bytes: &bytes })?;
    draft.warnings.extend(notes);
    if poses.len() != draft.images.len() {
        let (poses, times) = (poses.len(), draft.images.len());
        return Err(DatasetError::TimesMismatch { path, poses, times });
    }
    let lost = poses.iter().filter(|p| p.is_none()).count();
    if lost > 0 {
        let message = format!("{lost} poses contain NaN or infinity (tracking lost); skipped");
        draft.warnings.push(Warning::new("pose-not-finite", message).at(path.display()));
    }
    let mut stamped: Vec<StampedPose> = draft
        .images
        .iter()
        .zip(&poses)
        .filter_map(|((time, _), pose)| Some(StampedPose { time: *time, world_from_body: (*pose)? }))
        .collect();
    crate::checks::put_in_order(&mut stamped, |p| p.time, "poses", &path, &mut draft.warnings);
    if stamped.is_empty() {
        return Err(DatasetError::NoPoses { path, found: format!("{} rows, none finite", poses.len()) });
    }
    let trajectory = Trajectory::new(BodyFrame::Camera(CameraId(0)), stamped)
        .map_err(|e| DatasetError::NoPoses { path: path.clone(), found: e.to_string() })?;
    draft.ground_truth = Some((trajectory, path));
    Ok(())
}

/// A depth image belongs to the image with the same file stem.
fn read_depth(draft: &mut Draft) -> Result<(), DatasetError> {
    let folder = draft.root.join("depth");
    if !folder.is_dir() {
        return Ok(());
    }
    let by_stem: std::collections::HashMap<String, String> =
        images_in(&folder)?.into_iter().map(|n| (stem(&n).to_string(), n)).collect();
    for (time, image) in &draft.images {
        let image = image.path();
        let name = image.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        if let Some(depth) = by_stem.get(stem(&name)) {
            draft.depths.push((*time, folder.join(depth).into()));
        }
    }
    draft.depth = Some(DraftDepth {
        distorted: None,
        intrinsics: None,
        units_per_metre: None,
        default_units: 1000.0,
        body_from_depth: None,
        invalid: vec![0, u16::MAX],
        is_registered: true,
    });
    Ok(())
}
