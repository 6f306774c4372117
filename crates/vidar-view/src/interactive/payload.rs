//! A view as JSON with packed numbers, as `js/decode.js` reads it.
//!
//! Positions are sixteen-bit steps in the box of a surface: 0.12 mm in a room of 8 m. Normals are two bytes (octahedral, Meyer et
//! al. 2010), values one byte with 255 for "none". A triangle index is the distance to the highest one so far, as a
//! variable number of bytes: neighbours in the mesh are close in the list, so most take one.

use super::grid::{SampleMeans, normals_towards, thinned};
use super::page::Controls;
use super::simplify::simplified;
use super::{
    EncodedView, Field, FieldKind, FieldValues, InteractiveView, MAX_PATH_POSES, MAX_POINTS, MAX_TRIANGLES,
    Pane, PanePath, PaneScale, PanesShown, PathRole, PosedThumbnail,
};
use crate::ViewError;
use crate::colormap::ColorMap;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use nalgebra::Vector3;
use serde_json::{Value, json};
use vidar_core::{PointCloud, TriangleMesh, printable};

/// A byte that stands for no value.
const NO_VALUE: u8 = 255;
/// Poses that decide which side of a surface without normals was seen.
const EYES: usize = 100;

pub(super) fn encode(view: &InteractiveView<'_>) -> Result<EncodedView, ViewError> {
    view.panes.iter().try_for_each(check)?;
    let share =
        |most: usize, has: fn(&Pane<'_>) -> bool| most / view.panes.iter().filter(|p| has(p)).count().max(1);
    let limits = (share(MAX_TRIANGLES, |p| p.mesh.is_some()), share(MAX_POINTS, |p| p.cloud.is_some()));
    let eyes = eyes(view);
    let mut encoded = EncodedView::default();
    let panes: Vec<Value> =
        view.panes.iter().map(|pane| self::pane(pane, limits, &eyes, &mut encoded)).collect();
    let table = |map: ColorMap| bytes((0..=254).flat_map(|i| map.color(i as f32 / 254.0)));
    let value = json!({
        "schema": "vidar.interactive/1",
        "up": [view.up.x, view.up.y, view.up.z],
        "shown": if view.shown == PanesShown::All { "all" } else { "first" },
        "coloring": view.coloring.map_or("color", FieldKind::id),
        "maps": { "sea": table(ColorMap::Sea), "ember": table(ColorMap::Ember) },
        "panes": panes,
    });
    encoded.json = safe_in_script(&value.to_string());
    encoded.controls = Controls::of(view);
    Ok(encoded)
}

fn check(pane: &Pane<'_>) -> Result<(), ViewError> {
    let inconsistent =
        |surface, vertices, triangles| ViewError::InconsistentSurface { surface, vertices, triangles };
    if let Some(mesh) = pane.mesh.filter(|m| !m.is_consistent()) {
        return Err(inconsistent("mesh", mesh.positions.len(), mesh.triangles.len()));
    }
    if let Some(cloud) = pane.cloud.filter(|c| !c.is_consistent()) {
        return Err(inconsistent("cloud", cloud.len(), 0));
    }
    for field in &pane.fields {
        if let FieldValues::Samples { positions, values, .. } = &field.values
            && positions.len() != values.len()
        {
            return Err(ViewError::WrongValueCount { expected: positions.len(), found: values.len() });
        }
    }
    Ok(())
}

/// Where the surfaces were seen from: poses of the first path that there is.
fn eyes(view: &InteractiveView<'_>) -> Vec<Vector3<f64>> {
    let poses = view.panes.iter().flat_map(|p| &p.paths).next().map_or(&[][..], |p| p.trajectory.poses());
    let every = poses.len().div_ceil(EYES).max(1);
    poses.iter().step_by(every).map(|p| p.world_from_body.translation).collect()
}

fn pane(
    pane: &Pane<'_>,
    (triangles, points): (usize, usize),
    eyes: &[Vector3<f64>],
    encoded: &mut EncodedView,
) -> Value {
    let mesh = pane.mesh.filter(|m| !m.triangles.is_empty()).map(|m| simplified(m, triangles));
    let cloud = pane.cloud.filter(|c| !c.is_empty()).map(|full| {
        let (mut kept, spacing) = thinned(full, points);
        if kept.normals.is_empty() && !eyes.is_empty() {
            kept.normals = normals_towards(&kept.positions, &full.positions, 1.5 * spacing, eyes);
        }
        (kept, spacing)
    });
    encoded.triangles += mesh.as_ref().map_or(0, |(m, _)| m.triangles.len());
    encoded.points += cloud.as_ref().map_or(0, |(c, _)| c.len());
    let mesh = mesh.map(|(mesh, side)| (in_order_of_use(&mesh), side));
    let (is_metric, log_std) = match pane.scale {
        PaneScale::Metric { log_std } => (true, log_std),
        PaneScale::Reference => (true, Some(0.0)),
        PaneScale::Arbitrary => (false, None),
    };
    json!({
        "name": printable(&pane.name),
        "isMetric": is_metric,
        "isReference": pane.scale == PaneScale::Reference,
        "scaleLogStd": log_std.filter(|s| s.is_finite()),
        "mesh": mesh.as_ref().map(|(mesh, side)| mesh_json(mesh, *side, pane)),
        "cloud": cloud.as_ref().map(|(cloud, spacing)| cloud_json(cloud, *spacing, pane)),
        "fields": pane.fields.iter().map(field_json).collect::<Vec<_>>(),
        "paths": pane.paths.iter().map(path_json).collect::<Vec<_>>(),
        "keyframes": pane.keyframes.iter().map(keyframe_json).collect::<Vec<_>>(),
    })
}

fn mesh_json(mesh: &TriangleMesh, side_m: f64, pane: &Pane<'_>) -> Value {
    let values = |field: &Field<'_>| values_at(field, &mesh.positions, &mesh.confidences, side_m);
    json!({
        "vertices": mesh.positions.len(),
        "triangles": mesh.triangles.len(),
        "positions": positions_json(&mesh.positions),
        "normals": normals(&mesh.normals),
        "colors": colors(&mesh.colors),
        "indices": bytes(index_bytes(&mesh.triangles)),
        "values": pane.fields.iter().map(values).collect::<Vec<_>>(),
    })
}

fn cloud_json(cloud: &PointCloud, spacing_m: f64, pane: &Pane<'_>) -> Value {
    let values = |field: &Field<'_>| values_at(field, &cloud.positions, &cloud.confidences, spacing_m);
    json!({
        "vertices": cloud.len(),
        "spacing": spacing_m,
        "positions": positions_json(&cloud.positions),
        "normals": normals(&cloud.normals),
        "colors": colors(&cloud.colors),
        "values": pane.fields.iter().map(values).collect::<Vec<_>>(),
    })
}

/// One byte per vertex, or null where the field has no values there.
fn values_at(field: &Field<'_>, places: &[[f32; 3]], own: &[f32], side_m: f64) -> Option<String> {
    let quantised = |value: f32, (low, high): (f32, f32)| {
        let share = (value - low) / (high - low).max(f32::MIN_POSITIVE);
        if share.is_nan() { NO_VALUE } else { (share.clamp(0.0, 1.0) * 254.0).round() as u8 }
    };
    match &field.values {
        FieldValues::Own if own.is_empty() => None,
        FieldValues::Own => Some(bytes(own.iter().map(|&v| quantised(v, (0.0, 1.0))))),
        FieldValues::Samples { positions, values, range } => {
            let means = SampleMeans::new(positions, values, side_m);
            Some(bytes(places.iter().map(|p| quantised(means.at(p), *range))))
        }
        FieldValues::Missing(_) => None,
    }
}

fn field_json(field: &Field<'_>) -> Value {
    let (range, reason) = match &field.values {
        FieldValues::Own => (Some((0.0, 1.0)), None),
        FieldValues::Samples { range, .. } => (Some(*range), None),
        FieldValues::Missing(reason) => (None, Some(printable(reason))),
    };
    json!({
        "id": field.kind.id(),
        "label": printable(&field.label),
        "map": if field.kind.color_map() == ColorMap::Sea { "sea" } else { "ember" },
        "range": range.map(|(low, high)| [low, high]),
        "reason": reason,
    })
}

fn path_json(path: &PanePath<'_>) -> Value {
    let poses = path.trajectory.poses();
    let every = poses.len().div_ceil(MAX_PATH_POSES).max(1);
    let start = poses.first().map(|p| p.time);
    let kept: Vec<_> = poses.iter().step_by(every).collect();
    let numbers = kept.iter().flat_map(|p| {
        let t = p.world_from_body.translation;
        let [x, y, z, w] = p.world_from_body.rotation.quaternion_xyzw();
        let seconds = start.map_or(0.0, |s| p.time.since(s).as_secs_f64());
        [seconds, t.x, t.y, t.z, x, y, z, w]
    });
    json!({
        "name": printable(&path.name),
        "role": if path.role == PathRole::Truth { "truth" } else { "estimate" },
        "startNs": start.map(|s| s.nanos().to_string()),
        "poses": bytes(numbers.flat_map(|v| (v as f32).to_le_bytes())),
    })
}

fn keyframe_json(keyframe: &PosedThumbnail) -> Value {
    let k = &keyframe.intrinsics;
    // The edges of the image, half a pixel outside of the centres of the outermost pixels, at z = 1 in the camera.
    let x = |u: f64| (u - k.cx) / k.fx;
    let y = |v: f64| (v - k.cy) / k.fy;
    let (right, bottom) = (k.width as f64 - 0.5, k.height as f64 - 0.5);
    let pose = &keyframe.world_from_camera;
    json!({
        "frame": keyframe.frame,
        "timeNs": keyframe.time_ns.to_string(),
        "position": [pose.translation.x, pose.translation.y, pose.translation.z],
        "rotation": pose.rotation.quaternion_xyzw(),
        "edges": [x(-0.5), y(-0.5), x(right), y(bottom)],
        "image": keyframe.image_jpeg.as_ref().map(|jpeg| bytes(jpeg.iter().copied())),
        "depth": keyframe.depth.as_ref().map(|d| bytes(d.png.iter().copied())),
        "depthRange": keyframe.depth.as_ref().map(|d| [d.near_m, d.far_m]),
    })
}

/// The mesh with its vertices numbered in the order in which triangles use them; unused ones are left out.
fn in_order_of_use(mesh: &TriangleMesh) -> TriangleMesh {
    let mut number = vec![u32::MAX; mesh.positions.len()];
    let mut order = Vec::with_capacity(mesh.positions.len());
    let triangles = mesh
        .triangles
        .iter()
        .map(|t| {
            t.map(|i| {
                let slot = &mut number[i as usize];
                if *slot == u32::MAX {
                    *slot = order.len() as u32;
                    order.push(i as usize);
                }
                *slot
            })
        })
        .collect();
    fn taken<T: Copy>(list: &[T], order: &[usize]) -> Vec<T> {
        if list.is_empty() { Vec::new() } else { order.iter().map(|&i| list[i]).collect() }
    }
    TriangleMesh {
        positions: taken(&mesh.positions, &order),
        normals: taken(&mesh.normals, &order),
        colors: taken(&mesh.colors, &order),
        confidences: taken(&mesh.confidences, &order),
        triangles,
    }
}

/// Each index as the distance to the next new one, seven bits a byte, low bits first.
pub(super) fn index_bytes(triangles: &[[u32; 3]]) -> Vec<u8> {
    let mut out = Vec::with_capacity(triangles.len() * 4);
    let mut next = 0_u32;
    for &index in triangles.iter().flatten() {
        let mut code = next.saturating_sub(index);
        next = next.max(index.saturating_add(1));
        while code >= 128 {
            out.push(128 | (code & 127) as u8);
            code >>= 7;
        }
        out.push(code as u8);
    }
    out
}

/// Lower corner and step of each axis, metres, and the steps.
fn positions_json(positions: &[[f32; 3]]) -> Value {
    let bound =
        |axis: usize, start: f32, f: fn(f32, f32) -> f32| positions.iter().map(|p| p[axis]).fold(start, f);
    let mut lower = [0.0; 3];
    let mut step = [1.0; 3];
    for axis in 0..3 {
        let (low, high) = (bound(axis, f32::INFINITY, f32::min), bound(axis, f32::NEG_INFINITY, f32::max));
        if high > low {
            step[axis] = (f64::from(high) - f64::from(low)) / 65_535.0;
        }
        lower[axis] = if low.is_finite() { f64::from(low) } else { 0.0 };
    }
    let steps = positions.iter().flat_map(|p| {
        (0..3)
            .flat_map(|axis| (((f64::from(p[axis]) - lower[axis]) / step[axis]).round() as u16).to_le_bytes())
    });
    json!({ "lower": lower, "step": step, "steps": bytes(steps.collect::<Vec<_>>()) })
}

/// Two bytes each; (0, 0) on the fold's far corner, which no rounding gives, stands for none.
fn normals(normals: &[[f32; 3]]) -> Option<String> {
    let octahedral = |n: &[f32; 3]| {
        let sum = n.iter().map(|v| v.abs()).sum::<f32>();
        if !(sum > 0.0) {
            return [0, 0];
        }
        let (mut u, mut v) = (n[0] / sum, n[1] / sum);
        if n[2] < 0.0 {
            (u, v) = ((1.0 - v.abs()).copysign(u), (1.0 - u.abs()).copysign(v));
        }
        [u, v].map(|c| (128.0 + 127.0 * c).round() as u8)
    };
    (!normals.is_empty()).then(|| bytes(normals.iter().flat_map(octahedral)))
}

fn colors(colors: &[[u8; 3]]) -> Option<String> {
    (!colors.is_empty()).then(|| bytes(colors.iter().flatten().copied()))
}

fn bytes(bytes: impl IntoIterator<Item = u8>) -> String {
    STANDARD.encode(bytes.into_iter().collect::<Vec<u8>>())
}

/// JSON that can neither end its `<script>` element nor be read as a line end by a script.
pub(super) fn safe_in_script(json: &str) -> String {
    let mut safe = String::with_capacity(json.len() + 64);
    for c in json.chars() {
        match c {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => safe.push_str(&format!("\\u{:04x}", c as u32)),
            c => safe.push(c),
        }
    }
    safe
}
