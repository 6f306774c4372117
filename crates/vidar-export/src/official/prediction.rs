//! A prediction as `npz` and `mini_npz`, and back.
//!
//! | Array | Type and shape | `npz` | `mini_npz` |
//! |---|---|---|---|
//! | `image` | `uint8` N×H×W×3 | the network's input | – |
//! | `depth` | `float32` N×H×W | 6 decimals | 8 decimals |
//! | `conf` | `float32` N×H×W | 2 decimals | 2 decimals |
//! | `extrinsics` | `float32` N×3×4 | `camera_from_world` | same |
//! | `intrinsics` | `float32` N×3×3 | at the depth's size | same |
//!
//! Arrays that a network does not predict are omitted. Reading takes `exts`, `ixts` and 4×4 extrinsics too, which other
//! programs write.

use super::npy::{NpyArray, NpyData};
use super::npz::{NpzLimits, read_npz, write_npz_arrays};
use super::numbers::rounded;
use super::{PredictedView, Prediction};
use crate::error::ExportError;
use std::collections::BTreeMap;
use std::io::{Read, Seek, Write};
use vidar_core::Image;

const FORMAT: &str = "prediction npz";
/// The official program rounds before it writes; the digits beyond would only cost space.
const DEPTH_SCALE: f32 = 1e6;
const MINI_DEPTH_SCALE: f32 = 1e8;
const CONFIDENCE_SCALE: f32 = 1e2;

/// Writes `results.npz` of the official format `npz`.
pub fn write_npz<W: Write + Seek>(w: W, prediction: &Prediction) -> Result<(), ExportError> {
    write(w, prediction, DEPTH_SCALE, true)
}

/// Writes `results.npz` of the official format `mini_npz`: no images, more decimals.
pub fn write_mini_npz<W: Write + Seek>(w: W, prediction: &Prediction) -> Result<(), ExportError> {
    write(w, prediction, MINI_DEPTH_SCALE, false)
}

fn write<W: Write + Seek>(
    w: W,
    prediction: &Prediction,
    depth_scale: f32,
    with_images: bool,
) -> Result<(), ExportError> {
    prediction.check(FORMAT)?;
    let views = &prediction.views;
    let n = views.len();
    let (width, height) = prediction.size();
    let plane = vec![n, height, width];
    let mut arrays = Vec::new();
    if with_images {
        let images: Option<Vec<&Image<[u8; 3]>>> = views.iter().map(|v| v.image.as_ref()).collect();
        let Some(images) = images else {
            return Err(ExportError::unwritable(
                FORMAT,
                "npz",
                "the prediction has no images; write mini_npz",
            ));
        };
        let bytes = images.into_iter().flat_map(|i| i.data().as_flattened()).copied().collect();
        arrays.push(("image", NpyArray::new(vec![n, height, width, 3], NpyData::U8(bytes))?));
    }
    let all = |image: fn(&PredictedView) -> Option<&Image<f32>>, scale: f32| {
        let planes: Option<Vec<_>> = views.iter().map(image).collect();
        let values = planes?.into_iter().flat_map(|i| i.data()).map(|v| rounded(*v, scale)).collect();
        Some(NpyData::F32(values))
    };
    if let Some(depth) = all(|v| Some(&v.depth), depth_scale) {
        arrays.push(("depth", NpyArray::new(plane.clone(), depth)?));
    }
    if let Some(confidence) = all(|v| v.confidence.as_ref(), CONFIDENCE_SCALE) {
        arrays.push(("conf", NpyArray::new(plane, confidence)?));
    }
    if let Some(matrices) = views.iter().map(|v| v.extrinsics).collect::<Option<Vec<_>>>() {
        let values = matrices.as_flattened().as_flattened().to_vec();
        arrays.push(("extrinsics", NpyArray::new(vec![n, 3, 4], NpyData::F32(values))?));
    }
    if let Some(matrices) = views.iter().map(|v| v.intrinsics).collect::<Option<Vec<_>>>() {
        let values = matrices.as_flattened().as_flattened().to_vec();
        arrays.push(("intrinsics", NpyArray::new(vec![n, 3, 3], NpyData::F32(values))?));
    }
    let named: Vec<(&str, &NpyArray)> = arrays.iter().map(|(name, array)| (*name, array)).collect();
    write_npz_arrays(w, &named)
}

/// Reads a prediction that the official program or this one wrote as `npz` or `mini_npz`.
pub fn read_prediction_npz<R: Read + Seek>(r: R, limits: NpzLimits) -> Result<Prediction, ExportError> {
    let mut arrays = Arrays(read_npz(r, limits)?);
    let Some(depth) = arrays.take(&["depth"]) else {
        return Err(bad("depth", "an array of that name", "none"));
    };
    let [n, height, width] = depth.shape[..] else {
        return Err(bad("depth", "the shape [views, rows, columns]", format!("{:?}", depth.shape)));
    };
    if depth.data.is_empty() {
        return Err(bad("depth", "at least one pixel", format!("{:?}", depth.shape)));
    }
    let planes = |name: &str, array: NpyArray| -> Result<Vec<Image<f32>>, ExportError> {
        if array.shape != [n, height, width] {
            return Err(bad(
                name,
                format!("the shape of depth, {:?}", [n, height, width]),
                format!("{:?}", array.shape),
            ));
        }
        let values = array.into_f32().ok_or_else(|| bad(name, "floats", "integers"))?;
        split(&values, width, height).ok_or_else(|| bad(name, "whole images", "another number of values"))
    };
    let depths = planes("depth", depth)?;
    let confidences = match arrays.take(&["conf", "confidence"]) {
        Some(array) => planes("conf", array)?.into_iter().map(Some).collect(),
        None => vec![None; n],
    };
    let images = match arrays.take(&["image", "images"]) {
        Some(array) => images(array, n, width, height)?.into_iter().map(Some).collect(),
        None => vec![None; n],
    };
    let extrinsics = match arrays.take(&["extrinsics", "exts"]) {
        Some(array) => matrices::<4>("extrinsics", array, n)?,
        None => vec![None; n],
    };
    let intrinsics = match arrays.take(&["intrinsics", "ixts"]) {
        Some(array) => matrices::<3>("intrinsics", array, n)?,
        None => vec![None; n],
    };
    let parts = depths.into_iter().zip(confidences).zip(images).zip(extrinsics).zip(intrinsics);
    let views = parts
        .map(|((((depth, confidence), image), extrinsics), intrinsics)| PredictedView {
            image,
            depth,
            confidence,
            extrinsics,
            intrinsics,
        })
        .collect();
    Ok(Prediction { views })
}

struct Arrays(BTreeMap<String, NpyArray>);

impl Arrays {
    fn take(&mut self, names: &[&str]) -> Option<NpyArray> {
        names.iter().find_map(|name| self.0.remove(*name))
    }
}

fn bad(name: &str, expected: impl Into<String>, found: impl Into<String>) -> ExportError {
    ExportError::malformed(FORMAT, format!("array {name:?}"), expected, found)
}

/// The images of an array whose shape was checked; `None` if the values do not fill them.
fn split<P: Clone>(values: &[P], width: usize, height: usize) -> Option<Vec<Image<P>>> {
    let size = width.checked_mul(height).filter(|n| *n > 0)?;
    values.chunks(size).map(|chunk| Image::from_vec(width, height, chunk.to_vec()).ok()).collect()
}

fn images(
    array: NpyArray,
    n: usize,
    width: usize,
    height: usize,
) -> Result<Vec<Image<[u8; 3]>>, ExportError> {
    let expected = [n, height, width, 3];
    match array.data {
        NpyData::U8(bytes) if array.shape == expected => split(bytes.as_chunks::<3>().0, width, height)
            .ok_or_else(|| bad("image", "whole images", "another number of pixels")),
        _ => Err(bad(
            "image",
            format!("bytes of the shape {expected:?}"),
            format!("the shape {:?}", array.shape),
        )),
    }
}

/// Matrices of three rows (a fourth one is ignored) and `C` columns.
fn matrices<const C: usize>(
    name: &str,
    array: NpyArray,
    n: usize,
) -> Result<Vec<Option<[[f32; C]; 3]>>, ExportError> {
    let rows = match array.shape[..] {
        [views, rows, columns] if views == n && columns == C && (rows == 3 || (rows == 4 && C == 4)) => rows,
        _ => return Err(bad(name, format!("the shape [{n}, 3, {C}]"), format!("{:?}", array.shape))),
    };
    let values = array.into_f32().ok_or_else(|| bad(name, "floats", "integers"))?;
    let matrix = |chunk: &[f32]| Some(std::array::from_fn(|r| std::array::from_fn(|c| chunk[r * C + c])));
    Ok(values.chunks_exact(rows * C).map(matrix).collect())
}
