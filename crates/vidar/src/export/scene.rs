//! A finished run as Foxglove and Rerun show it, from the files of its folder. What the odometry said live and its landmarks are not
//! kept there: `vidar run --mcap` writes them while it runs.

use super::{StoredViews, pose_of};
use crate::error::Error;
use crate::system::{MAX_CLOUD_BYTES, MAX_JSON_BYTES, read_up_to};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use vidar_core::{CameraModel, Se3, Timestamp};
use vidar_dataset::{CameraFlag, with_size};
use vidar_export::scene::{LogLevel, Scene, SceneImage};

/// Name of the file.
const NAME: &str = "run.mcap";
/// While it is being written.
const PART: &str = "run.mcap.part";
/// Images of a run, and PNG files of its depth, are smaller.
const MAX_IMAGE_BYTES: u64 = 64 << 20;

/// Writes `run.mcap` into `out`, replacing an older one.
pub(super) fn mcap(run: &Path, stored: &StoredViews, out: &Path) -> Result<PathBuf, Error> {
    let (part, path) = (out.join(PART), out.join(NAME));
    let _absent = std::fs::remove_file(&part);
    let begin = stored.views.first().map_or(0, |view| view.time_ns);
    let mut scene = Scene::create(&part, Timestamp::from_nanos(begin))?;
    write(run, stored, &mut scene)?;
    scene.finish()?;
    std::fs::rename(&part, &path).map_err(|e| Error::io("rename", &part, e))?;
    Ok(path)
}

fn write(run: &Path, stored: &StoredViews, scene: &mut Scene) -> Result<(), Error> {
    let file = |name: &str, limit| {
        let path = run.join(name);
        path.is_file().then(|| read_up_to(&path, limit).map_err(|e| Error::io("read", &path, e))).transpose()
    };
    if let Some(csv) = file("trajectory/metric_camera.euroc.csv", MAX_CLOUD_BYTES)? {
        let trajectory = vidar_export::read_euroc_csv(&csv)?;
        trajectory.poses().iter().for_each(|pose| scene.camera_pose(pose.time, &pose.world_from_body));
    }
    let (camera, units_per_metre) = (camera(stored)?, super::depth_units(run)?);
    let mut placed: Vec<(u32, Se3)> = Vec::new();
    for view in &stored.views {
        let Some(pose) = pose_of(view) else { continue };
        let time = Timestamp::from_nanos(view.time_ns);
        if let (Some(camera), Some(source)) = (&camera, &view.source)
            && let Some((bytes, format)) = crate::run::encoded_image(source)
        {
            scene.image(time, camera, &SceneImage::Encoded(&bytes, format))?;
        }
        let image = view.image.as_deref().map(|name| file(name, MAX_IMAGE_BYTES)).transpose()?.flatten();
        let depth = match (&view.depth, units_per_metre) {
            (Some(name), Some(units)) => file(name, MAX_IMAGE_BYTES)?
                .map(|png| vidar_export::read_depth_png(&png, units))
                .transpose()?,
            _ => None,
        };
        let image = image.as_deref().map(|bytes| SceneImage::Encoded(bytes, "png"));
        scene.posed_view(time, &pose, &view.intrinsics, image, depth.as_ref().map(|d| d.image()))?;
        placed.push((view.frame, pose));
    }
    if let Some(first) = stored.views.first() {
        scene.keyframes(&first.intrinsics, placed.iter().map(|(frame, pose)| (*frame, pose)));
        scene.trajectory(placed.iter().map(|(_, pose)| pose));
    }
    if let Some(mesh) = file("map/mesh.ply", MAX_CLOUD_BYTES)? {
        scene.mesh(&vidar_export::read_ply(&mesh)?.into_mesh(), true);
    }
    if let Some(points) = file("map/points.ply", MAX_CLOUD_BYTES)? {
        scene.points(&vidar_export::read_ply(&points)?.cloud);
    }
    if let Some(log) = file("log.jsonl", MAX_JSON_BYTES)? {
        log.split(|byte| *byte == b'\n').filter_map(|l| serde_json::from_slice(l).ok()).for_each(|event| {
            match event {
                LogLine::Warning { kind, message, severity } => {
                    let is_info = severity.as_deref() == Some("info");
                    scene.log(if is_info { LogLevel::Info } else { LogLevel::Warning }, &kind, &message);
                }
                LogLine::StageFinished { stage, seconds } => scene.stage(&stage, seconds),
            }
        });
    }
    Ok(())
}

/// What is shown of a line of `log.jsonl`.
#[derive(Deserialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
enum LogLine {
    Warning { kind: String, message: String, severity: Option<String> },
    StageFinished { stage: String, seconds: f64 },
}

/// The camera of the images as they were taken, where the run says it.
fn camera(stored: &StoredViews) -> Result<Option<CameraModel>, Error> {
    let Some(camera) = &stored.camera else { return Ok(None) };
    let flag: CameraFlag = camera.model.parse()?;
    Ok(Some(with_size(&flag.0, camera.width, camera.height)?))
}
