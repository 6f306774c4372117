//! Chunks joined one to the next, as DA3-Streaming's output is without loops.

use crate::error::SynthError;
use nalgebra::Vector3;
use std::ops::Range;
use vidar_core::{GeometryPrediction, LieGroup, RelativeDepth, Sim3, ViewGeometry, umeyama_sim3_weighted};

/// Every so many pixels of an overlap give a point: its errors are smooth, more points say nothing new.
const STRIDE: usize = 7;

/// Frames of each chunk: `size` of them, `overlap` shared with the chunk before; a short rest joins the last.
///
/// The reference's rule: n ≤ size is one chunk, else ⌈(n − overlap)/(size − overlap)⌉ of them.
///
/// # Errors
/// `size` 0 or `overlap` not smaller than `size`.
pub fn chunk_ranges(frames: usize, size: usize, overlap: usize) -> Result<Vec<Range<usize>>, SynthError> {
    if overlap >= size {
        let found = format!("size {size}, overlap {overlap}");
        return Err(SynthError::BadConfig {
            key: "overlap",
            expected: "smaller than the chunk's size",
            found,
        });
    }
    if frames <= size {
        return Ok(std::iter::once(0..frames).filter(|all| !all.is_empty()).collect());
    }
    let step = size - overlap;
    let chunks = (frames - overlap).div_ceil(step);
    Ok((0..chunks).map(|k| k * step..(k * step + size).min(frames)).collect())
}

/// All views once, in the frame and units of the first chunk, each from the last chunk that has it.
///
/// Each chunk is moved onto the one before by the weighted similarity of the points that both have of shared views.
/// Errors add up along the chain, as they do in the program that this imitates.
///
/// # Errors
/// Neighbours that share too little for a similarity.
pub fn chain_chunks(chunks: &[GeometryPrediction]) -> Result<Vec<ViewGeometry>, SynthError> {
    let mut chained: Vec<ViewGeometry> = Vec::new();
    let mut first_from_chunk = Sim3::IDENTITY;
    for (k, chunk) in chunks.iter().enumerate() {
        if k > 0 {
            first_from_chunk = first_from_chunk * earlier_from_later(&chunks[k - 1], chunk)?;
        }
        for view in &chunk.views {
            let moved = ViewGeometry {
                chunk_from_camera: first_from_chunk.transform_pose(&view.chunk_from_camera),
                depth: scaled(&view.depth, first_from_chunk.scale),
                ..view.clone()
            };
            match chained.iter_mut().rev().find(|v| v.frame_id == view.frame_id) {
                Some(earlier) => *earlier = moved,
                None => chained.push(moved),
            }
        }
    }
    Ok(chained)
}

fn scaled(depth: &RelativeDepth, scale: f64) -> RelativeDepth {
    RelativeDepth::new(depth.image().map(|&z| (f64::from(z) * scale) as f32))
}

fn earlier_from_later(earlier: &GeometryPrediction, later: &GeometryPrediction) -> Result<Sim3, SynthError> {
    let (mut source, mut target, mut weights) = (Vec::new(), Vec::new(), Vec::new());
    for view in &later.views {
        let Some(other) = earlier.views.iter().find(|v| v.frame_id == view.frame_id) else { continue };
        for y in (STRIDE / 2..view.intrinsics.height).step_by(STRIDE) {
            for x in (STRIDE / 2..view.intrinsics.width).step_by(STRIDE) {
                if let (Some((a, wa)), Some((b, wb))) = (point(other, x, y), point(view, x, y)) {
                    target.push(a);
                    source.push(b);
                    weights.push((wa * wb).sqrt());
                }
            }
        }
    }
    umeyama_sim3_weighted(&source, &target, &weights).map_err(|e| SynthError::Unchained {
        earlier: earlier.chunk_id,
        later: later.chunk_id,
        reason: e.to_string(),
    })
}

/// The point of a pixel in the chunk's frame, and its confidence.
fn point(view: &ViewGeometry, x: usize, y: usize) -> Option<(Vector3<f64>, f64)> {
    let z = *view.depth.image().get(x, y)?;
    let confidence = f64::from(*view.confidence.image().get(x, y)?);
    let ray = view.intrinsics.ray(x as f64, y as f64);
    (z.is_finite() && confidence > 0.0)
        .then(|| (view.chunk_from_camera.act(&(ray * f64::from(z))), confidence))
}
