//! `predictions.json`: the result. `manifest.json`: how it was made.

use super::write::{Writer, depth_name, unit_words};
use super::{DepthFormat, DepthOutcome, DepthRequest, Resolution};
use crate::error::Error;
use crate::models::LocatedModel;
use crate::run_folder::{RunFolder, now_rfc3339, pretty};
use serde_json::{Value, json};
use vidar_da3::Da3;

/// Schema of `predictions.json`.
const PREDICTIONS_SCHEMA: &str = "vidar.depth/1";
/// Schema of `manifest.json` of a depth run.
const MANIFEST_SCHEMA: &str = "vidar.depth-run/1";

/// Writes `predictions.json`, in VIDAR's conventions.
pub(super) fn predictions(
    writer: &mut Writer<'_>,
    located: &LocatedModel,
    outcome: &DepthOutcome,
) -> Result<(), Error> {
    let prediction = writer.prediction;
    let (width, height) = outcome.size;
    let has_png = writer.request.formats.contains(&DepthFormat::DepthPng);
    let view = |i: usize| -> Value {
        let picture = &writer.pictures[i];
        let camera = writer.camera(i);
        json!({
            "image": picture.path.display().to_string(),
            "image_width": picture.image.width(),
            "image_height": picture.image.height(),
            "depth": has_png.then(|| depth_name(i)),
            "intrinsics": camera.map(|c| c.intrinsics),
            "world_from_camera": camera.map(|c| {
                let m = c.world_from_camera.matrix();
                (0..3).map(|r| (0..4).map(|c| m[(r, c)]).collect::<Vec<f64>>()).collect::<Vec<_>>()
            }),
        })
    };
    let alignment = prediction.alignment.as_ref().map(
        |a| json!({ "predicted_units_per_given": a.scale, "scale_source": a.scale_source, "inliers": a.inliers }),
    );
    let document = json!({
        "schema": PREDICTIONS_SCHEMA,
        "model": located.identity,
        "width": width,
        "height": height,
        "unit": outcome.unit,
        "unit_reason": outcome.unit_reason,
        "frame": writer.frame_words(),
        "conventions": "depth is z; world_from_camera maps camera (x right, y down, z forward) to the world; pixel (0, 0) is \
                        the centre of the top-left pixel; intrinsics are at width x height",
        "reference_view": prediction.reference_view,
        "alignment": alignment,
        "scale_factor": prediction.scale_factor,
        "depth_png": writer.depth_scale.map(|scale| json!({
            "steps_per_unit": scale,
            "unit": unit_words(outcome.unit),
            "invalid": 0,
            "size": match writer.request.resolution {
                Resolution::Processed => "processed",
                Resolution::Input => "input",
            },
        })),
        "views": (0..outcome.views).map(view).collect::<Vec<_>>(),
    });
    writer.bytes("predictions.json", &pretty(&document)?)
}

/// Writes `manifest.json`, last.
pub(super) fn manifest(
    folder: &RunFolder,
    request: &DepthRequest,
    located: &LocatedModel,
    network: &Da3,
    outcome: &DepthOutcome,
) -> Result<(), Error> {
    let infer = &request.infer;
    let document = json!({
        "schema": MANIFEST_SCHEMA,
        "version": crate::VERSION,
        "command": request.command,
        "finished": now_rfc3339(),
        "model": located.identity,
        "options": {
            "process_size_px": infer.preprocess.process_size_px,
            "method": infer.preprocess.method,
            "reference": format!("{:?}", infer.reference),
            "use_ray_pose": infer.use_ray_pose,
            "align_to_given": infer.align_to_given,
            "compat": infer.compat,
            "precision": request.da3.precision.name(),
            "arithmetic": network.describe_compute(),
            "device": network.device_name().unwrap_or_else(|| "cpu".to_owned()),
            "poses": request.poses,
            "focal_px": request.focal_px,
        },
        "hardware": crate::system::hardware(),
        "seconds": { "network": outcome.network_secs, "all": outcome.seconds },
        "peak_memory_bytes": crate::system::peak_memory_bytes(),
        "result": { "views": outcome.views, "size": outcome.size, "unit": outcome.unit },
        "warnings": outcome.warnings,
        "artifacts": outcome.artifacts,
    });
    folder.write("manifest.json", &pretty(&document)?).map(|_| ())
}
