//! Files of the run folder: trajectories, map, depth sidecar, scores, README.

use super::{MetricMap, RunOutcome, RunRequest};
use crate::config::Config;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::quality::TrackQuality;
use crate::run_folder::{MANIFEST_SCHEMA, RunFolder, StoredCamera, StoredView, VIEWS_SCHEMA, pretty};
use serde_json::{Value, json};
use vidar_align::Placement;
use vidar_align::aligner::{ChunkPlacement, LoopReport};
use vidar_core::{FrameId, Se3, Timestamp, Trajectory, printable};
use vidar_dataset::{CameraFlag, Location, Recording};
use vidar_export::{DepthFrame, DepthSidecar, ExportError};

/// Writes everything but pictures and manifest.
pub fn write(
    outcome: &RunOutcome,
    dataset: &Recording,
    config: &Config,
    request: &RunRequest,
    folder: &RunFolder,
    events: &Events,
) -> Result<(), Error> {
    let writer = Writer { folder, events };
    let (plan, map) = (&outcome.plan, &outcome.map);
    if let Some(trajectory) = &map.trajectory {
        writer.trajectory("trajectory/metric_camera", &trajectory.camera_trajectory, map)?;
    }
    if let Some(keyframes) = map.keyframe_trajectory() {
        writer.trajectory("trajectory/keyframes_camera", &keyframes, map)?;
    }
    writer.bytes("views.json", &pretty(&views_json(outcome, dataset))?)?;
    if config.output.depth_png && !outcome.map.views.is_empty() {
        writer.export("depth/depth.json", |w| sidecar(outcome, config).write(w))?;
    }
    let comments = [
        "VIDAR metric map".to_owned(),
        map.world_words(plan.mode),
        format!("unit: {}", if outcome.is_metric() { "metre" } else { "arbitrary" }),
        format!("metric poses: {}", map.poses()),
        format!("coupling: {}", plan.mode),
        format!("geometry: {}", plan.model.name),
    ]
    .map(|line| printable(&line).into_owned())
    .to_vec();
    writer.export("map/mesh.ply", |w| vidar_export::write_ply_mesh(w, &map.surface.mesh, &comments))?;
    writer.export("map/points.ply", |w| vidar_export::write_ply_cloud(w, &map.surface.cloud, &comments))?;
    if config.output.mesh_glb && !map.surface.mesh.triangles.is_empty() {
        writer.export("map/mesh.glb", |w| vidar_export::write_glb_mesh(w, &map.surface.mesh, &comments))?;
    }
    writer.bytes("map/coverage.json", &pretty(&map.surface.coverage)?)?;
    writer.bytes("eval/metrics.json", &pretty(&metrics(outcome))?)?;
    writer.bytes("README.txt", readme(outcome, request).as_bytes())
}

struct Writer<'a> {
    folder: &'a RunFolder,
    events: &'a Events,
}

impl Writer<'_> {
    fn bytes(&self, path: &str, bytes: &[u8]) -> Result<(), Error> {
        let bytes = self.folder.write(path, bytes)?;
        self.events.emit(&Event::ArtifactWritten { path: path.to_owned(), bytes });
        Ok(())
    }

    /// Streams through a buffer beside the target, so that large maps need no second copy in memory.
    fn export(
        &self,
        path: &str,
        write: impl FnOnce(&mut dyn std::io::Write) -> Result<(), ExportError>,
    ) -> Result<(), Error> {
        let target = self.folder.file(path)?;
        vidar_export::atomic::write_atomically(&target, write)?;
        let bytes = std::fs::metadata(&target).map(|m| m.len()).unwrap_or(0);
        self.events.emit(&Event::ArtifactWritten { path: path.to_owned(), bytes });
        Ok(())
    }

    fn trajectory(&self, stem: &str, trajectory: &Trajectory, map: &MetricMap) -> Result<(), Error> {
        let note = printable(&format!("metric poses: {}", map.poses())).into_owned();
        self.export(&format!("{stem}.tum"), |w| vidar_export::write_tum(w, trajectory, &note))?;
        self.export(&format!("{stem}.euroc.csv"), |w| vidar_export::write_euroc_csv(w, trajectory, &note))
    }
}

/// Keyframes, the files that they were read from, and the camera as it was used.
fn views_json(outcome: &RunOutcome, dataset: &Recording) -> Value {
    let source = |view: &StoredView| {
        let entry = dataset.images.iter().find(|i| i.frame_id.0 == view.frame)?;
        match &entry.location {
            Location::File(path) => std::path::absolute(path).ok(),
            Location::Message { .. } | Location::Frame { .. } => None,
        }
    };
    let views: Vec<StoredView> =
        outcome.map.views.iter().map(|v| StoredView { source: source(v), ..v.clone() }).collect();
    let camera = dataset.rig.camera(dataset.camera).map_or(&outcome.plan.camera, |c| &c.model);
    json!({
        "schema": VIEWS_SCHEMA,
        "camera": StoredCamera {
            model: CameraFlag(camera.clone()).to_string(), width: camera.width(), height: camera.height(),
        },
        "views": views,
    })
}

fn sidecar(outcome: &RunOutcome, config: &Config) -> DepthSidecar {
    let views = &outcome.map.views;
    let frames = views
        .iter()
        .filter_map(|v| {
            let file = v.depth.as_ref()?.rsplit('/').next()?.to_owned();
            let pose = pose_of(v)?;
            Some(DepthFrame::new(file, FrameId(v.frame), Timestamp::from_nanos(v.time_ns), &pose))
        })
        .collect();
    let intrinsics = views.first().map_or(outcome.plan.view, |v| v.intrinsics);
    DepthSidecar::new(config.output.depth_units_per_metre, &intrinsics, frames)
}

/// The stored 3×4 matrix as a motion.
pub fn pose_of(view: &StoredView) -> Option<Se3> {
    let mut matrix = nalgebra::Matrix4::identity();
    for (r, row) in view.world_from_camera.iter().enumerate() {
        for (c, value) in row.iter().enumerate() {
            matrix[(r, c)] = *value;
        }
    }
    Se3::from_matrix(&matrix)
}

fn metrics(outcome: &RunOutcome) -> Value {
    json!({
        "schema": "vidar.metrics/1",
        "metric_poses": outcome.map.poses_json(),
        "coupling": outcome.plan.mode,
        "poses_are_ground_truth": outcome.map.uses_ground_truth(),
        "reference": outcome.plan.reference.to_string(),
        "verdict": outcome.verdict,
        "scale": outcome.scale,
        "scores": crate::evaluate::scores(&outcome.evaluation),
        "evaluation": outcome.evaluation,
    })
}

/// Counts and scores for the manifest and `--json`.
pub fn result_json(outcome: &RunOutcome) -> Value {
    let map = &outcome.map;
    let mut result = json!({
        "keyframes": map.keyframes.len(),
        "keyframes_with_depth": map.views.len(),
        "mesh_triangles": map.surface.mesh.triangles.len(),
        "points": map.surface.cloud.len(),
        "coverage": map.surface.coverage,
        "volume_bytes": map.surface.volume_bytes,
        "double_walls": map.surface.double_walls,
        "metric_poses": map.poses_json(),
        "coupling": outcome.plan.mode,
        "place_recognition": outcome.plan.place_recognition,
        "is_metric": outcome.is_metric(),
        "verdict": outcome.verdict,
        "scale": outcome.scale,
        "odometry": map.quality.as_ref().map(TrackQuality::json),
        "placement": map.placement.as_deref().map(placement_json),
        "pose_correction": map.pose_correction().map(|(correction, std)| json!({
            "center_rms_m": correction.center_rms_m, "center_share": correction.center_share,
            "log_scale_std": correction.log_scale_std,
            "rotation_rms_deg": correction.rotation_rms_rad.to_degrees(),
            "std_m": std.translation_m, "std_deg": std.rotation_rad.to_degrees(),
        })),
        "evaluation": outcome.evaluation,
        "seconds": outcome.seconds,
        "budget": outcome.plan.budget,
    });
    if let (Some(live), Some(object)) = (&outcome.live, result.as_object_mut()) {
        object.insert("live".into(), json!(live));
    }
    if let (Some(remote), Some(object)) = (&outcome.remote, result.as_object_mut()) {
        object.insert("remote".into(), json!(remote));
    }
    result
}

/// The alignment: chunk status and scale, loops, rejections, graph, drift.
fn placement_json(placement: &Placement) -> Value {
    let finite = |v: f64| v.is_finite().then_some(v);
    let chunk = |c: &ChunkPlacement| {
        json!({
            "chunk": c.chunk_id, "status": c.status, "metres_per_unit": c.world_from_chunk.scale,
            "log_scale_std": finite(c.log_scale_std),
        })
    };
    let revisit = |l: &LoopReport| {
        json!({
            "later": l.later, "earlier": l.earlier, "similarity": l.similarity, "inlier_ratio": finite(l.inlier_ratio),
            "chi2": l.chi2.and_then(finite), "rejection": l.rejection,
        })
    };
    json!({
        "chunks": placement.chunks.iter().map(chunk).collect::<Vec<_>>(),
        "loops": placement.loops.iter().map(revisit).collect::<Vec<_>>(),
        "rejections": placement.rejections,
        "graph": placement.graph.as_ref().map(|g| json!({
            "flow": g.flow, "iterations": g.iterations, "cost": g.cost, "odometry_chi2": finite(g.odometry_chi2),
        })),
        "graph_failures": placement.graph_failures.iter().map(|f| json!({
            "first_chunk": f.first_chunk, "reason": f.reason,
        })).collect::<Vec<_>>(),
        "drift": {
            "center_rms_m": finite(placement.drift.center_rms_m), "center_max_m": finite(placement.drift.center_max_m),
            "scale_step_std": finite(placement.drift.scale_step_std), "matched": placement.drift.matched,
        },
        "fields": placement.views.iter().filter(|v| v.field.is_some()).count(),
    })
}

/// What the README says of a completed depth's further files.
const ORIGIN: &str = "\x20 depth_source/*.png             where each depth comes from: 1 stereo, 2 map, 3 plane; guesses: 4 network, 5 interpolation\n\
     \x20 depth_std/*.png                its relative standard deviation in steps of 0.2 %\n";

fn is_completed(outcome: &RunOutcome) -> bool {
    outcome.map.views.iter().any(|v| v.depth_source.is_some())
}

fn readme(outcome: &RunOutcome, request: &RunRequest) -> String {
    let plan: String =
        outcome.plan.lines().iter().map(|(k, v)| format!("  {k:<18} {}\n", printable(v))).collect();
    format!(
        "A run of VIDAR {version} ({MANIFEST_SCHEMA})\n\n  {verdict}\n  scale: {scale}\n\n{plan}\n\
         Frames and units\n\
         \x20 world: right-handed; {unit}. With an inertial or ground-truth trajectory z points up.\n\
         \x20 camera: x right, y down, z forward; pixel (0, 0) is the centre of the top-left pixel.\n\
         \x20 a_from_b maps coordinates in b to coordinates in a.\n\n\
         Files\n\
         \x20 report.html                    everything below in three dimensions, figures and numbers\n\
         \x20 map/mesh.ply, mesh.glb         surface (GLB is y-up by a root node; PLY is in the world frame)\n\
         \x20 map/points.ply                 points with normals, colour, confidence\n\
         \x20 trajectory/*.tum, *.csv        world_from_camera of all images and of the keyframes\n\
         \x20 depth/*.png, depth.json        z-depth, 16 bit, 0 = none; scale and cameras in depth.json\n\
         {origin}\x20 images/*.png, views.json       undistorted keyframes with intrinsics and world_from_camera\n\
         \x20 eval/metrics.json              scores and what the result was compared with\n\
         \x20 config.resolved.toml           every setting with its origin\n\
         \x20 manifest.json, log.jsonl       versions, hashes, timings, events\n\n\
         To do it again\n  {command}\n",
        version = crate::VERSION,
        origin = if is_completed(outcome) { ORIGIN } else { "" },
        verdict = outcome.verdict.line(),
        scale = outcome.scale.words,
        unit = if outcome.is_metric() { "metres" } else { "lengths are not metres" },
        command = printable(&request.command.join(" ")),
    )
}
