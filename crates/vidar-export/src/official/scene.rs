//! `scene.glb` of the official program: confident pixels as coloured points, cameras as wire frames.
//!
//! - A pixel becomes a point when its confidence reaches `min(max(1.05, P40), P90)` (percentiles over all views) and its
//!   depth is finite and positive. Its index (u, v) is used as its position, without half a pixel.
//! - The scene is turned so that the first camera looks along −z with y up, and moved so that the median of the points is
//!   the origin: `A = T(−median) · diag(1, −1, −1, 1) · camera0_from_world`. `A` is kept in `asset.extras`.
//! - Colours are the image's bytes as they are, which is how the official program's viewer shows them.
//! - Each camera is eight segments: four edges from its centre, four around its image, at 0.03 of the scene's diagonal
//!   (between the 5th and 95th percentile), in a distinct hue.
//! - Excess points are thinned evenly with a fixed seed. The official program uses an unseeded sample.

use super::numbers::{Camera, percentile_of, transform};
use super::{Prediction, confidence_percentile, is_point};
use crate::error::{ExportError, write_error};
use nalgebra::{Matrix4, Vector3};
use serde_json::{Value, json};
use std::io::Write;
use vidar_core::random::SplitMix64;

const FORMAT: &str = "GLB scene";
/// `glTF`, version 2, and the names of its two chunks, little-endian.
const MAGIC: u32 = 0x4654_6C67;
const VERSION: u32 = 2;
const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;
const UNSIGNED_BYTE: u32 = 5121;
const FLOAT: u32 = 5126;
const MODE_POINTS: u32 = 0;
const MODE_LINES: u32 = 1;

/// Confidence is 1 + exp(…): values below this carry no information.
const LEAST_CONFIDENCE: f64 = 1.05;
/// The best tenth of the points is always shown.
const MOST_PERCENTILE: f64 = 90.0;
/// Length of a camera's edges in diagonals of the scene.
const CAMERA_SIZE: f64 = 0.03;

/// Options of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneOptions {
    /// Percentile of confidence below which pixels are skipped.
    pub confidence_percentile: f64,
    /// Most points.
    pub most_points: usize,
    /// Whether cameras are drawn.
    pub cameras: bool,
}

impl Default for SceneOptions {
    /// The official program's.
    fn default() -> Self {
        Self { confidence_percentile: 40.0, most_points: 1_000_000, cameras: true }
    }
}

/// Statistics of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSummary {
    /// The confidence that a point has at least.
    pub least_confidence: f64,
    /// Points that reach it.
    pub points: usize,
    /// Points written.
    pub written: usize,
    /// Maps the prediction's world to the scene.
    pub scene_from_world: Matrix4<f64>,
    /// Distance between the 5th and the 95th percentile of the points.
    pub diagonal: f64,
}

/// Points and cameras, in the scene.
struct Scene {
    summary: SceneSummary,
    positions: Vec<[f32; 3]>,
    colors: Vec<[u8; 3]>,
    /// End points of segments, two after the other, for each camera.
    cameras: Vec<[[f32; 3]; 16]>,
}

/// Writes `scene.glb`. Single-view networks predict no cameras, so they have no scene.
pub fn write_scene_glb(
    w: &mut dyn Write,
    prediction: &Prediction,
    options: &SceneOptions,
) -> Result<SceneSummary, ExportError> {
    prediction.check(FORMAT)?;
    let scene = compose(prediction, options)?;
    let (document, binary) = encode(&scene);
    let mut document = document.to_string().into_bytes();
    // Chunks are padded to four bytes, JSON with blanks.
    document.resize(document.len().next_multiple_of(4), b' ');
    let Ok(total) = u32::try_from(12 + 8 + document.len() + 8 + binary.len()) else {
        let what = format!("{} points", scene.positions.len());
        return Err(ExportError::unwritable(FORMAT, what, "its lengths end at 4 GiB"));
    };
    // Both lengths are smaller than `total`, which fits.
    let head = [MAGIC, VERSION, total, document.len() as u32, CHUNK_JSON];
    let words = |words: &[u32]| words.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
    [words(&head), document, words(&[binary.len() as u32, CHUNK_BIN]), binary]
        .iter()
        .try_for_each(|part| w.write_all(part))
        .map_err(write_error(FORMAT))?;
    Ok(scene.summary)
}

fn compose(prediction: &Prediction, options: &SceneOptions) -> Result<Scene, ExportError> {
    let cameras = prediction.cameras(FORMAT)?;
    let percentiles = confidence_percentile(prediction, &[options.confidence_percentile, MOST_PERCENTILE]);
    let least_confidence = LEAST_CONFIDENCE.max(percentiles[0]).min(percentiles[1]);
    let (world, mut colors) = points(prediction, &cameras, least_confidence);
    let scene_from_world = alignment(&cameras[0], &world);
    let mut scene: Vec<Vector3<f64>> =
        world.iter().map(|p| transform(&scene_from_world, &p.cast::<f64>())).collect();
    let diagonal = diagonal(&scene);
    let points = scene.len();
    if points > options.most_points {
        let chosen = thinned(points, options.most_points);
        scene = chosen.iter().map(|&i| scene[i]).collect();
        colors = chosen.iter().map(|&i| colors[i]).collect();
    }
    let (width, height) = prediction.size();
    let frusta = match options.cameras {
        true => cameras.iter().map(|c| frustum(c, width, height, diagonal, &scene_from_world)).collect(),
        false => Vec::new(),
    };
    let written = scene.len();
    Ok(Scene {
        summary: SceneSummary { least_confidence, points, written, scene_from_world, diagonal },
        positions: scene.iter().map(in_f32).collect(),
        colors,
        cameras: frusta,
    })
}

fn in_f32(p: &Vector3<f64>) -> [f32; 3] {
    [p.x as f32, p.y as f32, p.z as f32]
}

/// Confident pixels of all views, in the prediction's world, in 32 bits as the official program has them.
fn points(
    prediction: &Prediction,
    cameras: &[Camera],
    least_confidence: f64,
) -> (Vec<Vector3<f32>>, Vec<[u8; 3]>) {
    let (width, height) = prediction.size();
    let (mut points, mut colors) = (Vec::new(), Vec::new());
    for (view, camera) in prediction.views.iter().zip(cameras) {
        for y in 0..height {
            for x in 0..width {
                if !is_point(view, x, y, least_confidence) {
                    continue;
                }
                let point = camera.point(x as f64, y as f64, f64::from(view.depth[(x, y)])).cast::<f32>();
                if point.iter().all(|v| v.is_finite()) {
                    points.push(point);
                    colors.push(view.image.as_ref().map_or([128; 3], |image| image[(x, y)]));
                }
            }
        }
    }
    (points, colors)
}

/// First camera upright at the origin's side, median of the points in the origin.
fn alignment(first: &Camera, world: &[Vector3<f32>]) -> Matrix4<f64> {
    let y_up = Matrix4::from_diagonal(&[1.0, -1.0, -1.0, 1.0].into());
    let mut scene_from_world = y_up * first.camera_from_world;
    let turned: Vec<Vector3<f64>> =
        world.iter().map(|p| transform(&scene_from_world, &p.cast::<f64>())).collect();
    for axis in 0..3 {
        let median = percentile_of(turned.iter().map(|p| p[axis]).collect(), 50.0).unwrap_or(0.0);
        scene_from_world[(axis, 3)] -= median;
    }
    scene_from_world
}

fn diagonal(points: &[Vector3<f64>]) -> f64 {
    let extent = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let at = |percent| super::numbers::percentile(&values, percent).unwrap_or(0.0);
        at(95.0) - at(5.0)
    };
    let diagonal = Vector3::new(extent(0), extent(1), extent(2)).norm();
    // Cameras are drawn even without points.
    if diagonal.is_finite() && diagonal > 0.0 { diagonal } else { 1.0 }
}

/// `keep` indices below `n`, ascending, each subset as likely (Knuth's selection sampling) and always the same.
pub fn thinned(n: usize, keep: usize) -> Vec<usize> {
    let mut random = SplitMix64::new(0x9E37_79B9_7F4A_7C15);
    let mut chosen = Vec::with_capacity(keep);
    for index in 0..n {
        let (left, wanted) = ((n - index) as u128, (keep - chosen.len()) as u128);
        if u128::from(random.next_u64() >> 11) * left < wanted << 53 {
            chosen.push(index);
        }
    }
    chosen
}

/// Segments of a camera: its centre to each corner of its image, then around the image.
fn frustum(
    camera: &Camera,
    width: usize,
    height: usize,
    diagonal: f64,
    scene_from_world: &Matrix4<f64>,
) -> [[f32; 3]; 16] {
    let (w, h) = (width.saturating_sub(1) as f64, height.saturating_sub(1) as f64);
    let plane = CAMERA_SIZE * diagonal;
    let centre = Vector3::from(camera.world_from_camera.fixed_view::<3, 1>(0, 3));
    let corner = |(u, v): (f64, f64)| {
        // On the plane z = `plane`, whatever the third row of the camera matrix does to the ray's length.
        let ray = camera.k_inverse * Vector3::new(u, v, 1.0);
        transform(&camera.world_from_camera, &(ray * (plane / ray.z)))
    };
    let corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)].map(corner);
    let placed = |p: &Vector3<f64>| in_f32(&transform(scene_from_world, p));
    let mut ends = [[0.0; 3]; 16];
    for i in 0..4 {
        ends[2 * i] = placed(&centre);
        ends[2 * i + 1] = placed(&corners[i]);
        ends[8 + 2 * i] = placed(&corners[i]);
        ends[8 + 2 * i + 1] = placed(&corners[(i + 1) % 4]);
    }
    ends
}

/// The colour of camera `i` of `n`: hue (i + 0.5)/n, saturation 0.85, value 0.95.
pub(super) fn camera_color(i: usize, n: usize) -> [u8; 3] {
    let (hue, saturation, value) = ((i as f64 + 0.5) / n.max(1) as f64, 0.85, 0.95);
    let sector = hue * 6.0;
    let (whole, part) = (sector.floor(), sector - sector.floor());
    let p = value * (1.0 - saturation);
    let q = value * (1.0 - part * saturation);
    let t = value * (1.0 - (1.0 - part) * saturation);
    let rgb = match whole as i64 % 6 {
        0 => [value, t, p],
        1 => [q, value, p],
        2 => [p, value, t],
        3 => [p, q, value],
        4 => [t, p, value],
        _ => [value, p, q],
    };
    rgb.map(|c| (c * 255.0) as u8)
}

/// The document and its buffer.
fn encode(scene: &Scene) -> (Value, Vec<u8>) {
    let mut parts = Parts::default();
    let mut nodes = Vec::new();
    let mut meshes = Vec::new();
    let mut add = |name: String, mode: u32, positions: &[[f32; 3]], colors: &[[u8; 3]]| {
        if positions.is_empty() {
            return;
        }
        let (position, color) = (parts.positions(positions), parts.colors(colors));
        nodes.push(json!({ "name": name, "mesh": meshes.len() }));
        let attributes = json!({ "POSITION": position, "COLOR_0": color });
        meshes.push(json!({ "primitives": [{ "attributes": attributes, "mode": mode, "material": 0 }] }));
    };
    add("points".to_owned(), MODE_POINTS, &scene.positions, &scene.colors);
    for (i, ends) in scene.cameras.iter().enumerate() {
        let color = camera_color(i, scene.cameras.len());
        add(format!("camera_{i}"), MODE_LINES, ends, &[color; 16]);
    }
    let a = &scene.summary.scene_from_world;
    let rows: Vec<Vec<f64>> = a.row_iter().map(|r| r.iter().copied().collect()).collect();
    let mut document = json!({
        "asset": { "version": "2.0", "generator": "vidar", "extras": {
            "frame": "y up; first camera looks along -z; median of the points is the origin",
            "scene_from_world": rows,
            "least_confidence": scene.summary.least_confidence,
        }},
        "scene": 0,
        "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<_>>() }],
        "nodes": nodes,
    });
    if !meshes.is_empty() {
        document["meshes"] = Value::Array(meshes);
        let surface = json!({ "metallicFactor": 0.0, "roughnessFactor": 1.0 });
        let unlit = json!({ "KHR_materials_unlit": {} });
        document["materials"] = json!([{ "pbrMetallicRoughness": surface, "extensions": unlit }]);
        document["extensionsUsed"] = json!(["KHR_materials_unlit"]);
        document["accessors"] = Value::Array(parts.accessors);
        document["bufferViews"] = Value::Array(parts.views);
        document["buffers"] = json!([{ "byteLength": parts.buffer.len() }]);
    }
    (document, parts.buffer)
}

#[derive(Default)]
struct Parts {
    accessors: Vec<Value>,
    views: Vec<Value>,
    buffer: Vec<u8>,
}

impl Parts {
    fn positions(&mut self, positions: &[[f32; 3]]) -> usize {
        let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for position in positions {
            for axis in 0..3 {
                min[axis] = min[axis].min(f64::from(position[axis]));
                max[axis] = max[axis].max(f64::from(position[axis]));
            }
        }
        let bytes: Vec<u8> = positions.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let accessor = json!({ "componentType": FLOAT, "type": "VEC3", "min": min, "max": max });
        self.push(accessor, positions.len(), &bytes)
    }

    fn colors(&mut self, colors: &[[u8; 3]]) -> usize {
        let bytes: Vec<u8> = colors.iter().flat_map(|&[r, g, b]| [r, g, b, 255]).collect();
        let accessor = json!({ "componentType": UNSIGNED_BYTE, "type": "VEC4", "normalized": true });
        self.push(accessor, colors.len(), &bytes)
    }

    fn push(&mut self, mut accessor: Value, count: usize, bytes: &[u8]) -> usize {
        let (offset, length) = (self.buffer.len(), bytes.len());
        self.views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": length }));
        accessor["bufferView"] = json!(self.views.len() - 1);
        accessor["count"] = json!(count);
        self.buffer.extend_from_slice(bytes);
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_is_uniform_deterministic_and_keeps_the_requested_number() {
        let chosen = thinned(10_000, 1_000);
        assert_eq!(chosen.len(), 1_000);
        assert!(chosen.is_sorted_by(|a, b| a < b));
        assert_eq!(chosen, thinned(10_000, 1_000));
        // 500 ± 5 standard deviations of a hypergeometric draw.
        let low = chosen.iter().filter(|i| **i < 5_000).count();
        assert!((425..575).contains(&low), "{low}");
        assert_eq!(thinned(5, 5), [0, 1, 2, 3, 4]);
        assert!(thinned(5, 0).is_empty());
    }
}
