//! Inference with given cameras against a reference: preprocessing, normalisation, alignment.

use super::compare::Comparison;
use super::golden::Golden;
use super::three_rows;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::infer::{InferOptions, Inputs, Prediction};
use crate::pose::{Cameras, normalise_world};
use crate::preprocess::{self, PreprocessConfig};
use crate::run::Hooks;
use crate::weights::synthetic::image_u8;
use nalgebra::{Matrix3, Matrix4};
use vidar_core::Image;

/// The cameras that the network takes; the intermediate values are compared with those of the reference.
pub(super) fn net_cameras(golden: &Golden, comparison: &mut Comparison<'_>) -> Result<Cameras, Da3Error> {
    let moved = normalise_world(&given(golden)?.camera_from_world);
    let rows: Vec<f64> =
        moved.iter().flat_map(|m| m.transpose().iter().copied().collect::<Vec<_>>()).collect();
    comparison.tensor("norm_extrinsics", &rows)?;
    let (_, k) = golden.tensor("proc_intrinsics")?;
    let intrinsics = k.chunks_exact(9).map(Matrix3::from_row_slice).collect();
    Ok(Cameras { camera_from_world: moved, intrinsics })
}

/// Runs the public interface with and without alignment, and compares.
pub(super) fn check_interface(
    golden: &Golden,
    model: &Da3,
    hooks: &Hooks<'_>,
    comparison: &mut Comparison<'_>,
) -> Result<(), Da3Error> {
    let Cameras { camera_from_world: poses, intrinsics } = given(golden)?;
    let bad = |reason: &str| Da3Error::BadGolden {
        place: golden.path().display().to_string(),
        reason: reason.into(),
    };
    let (Some([height, width]), Some(process_size_px)) = (golden.entry.source_hw, golden.entry.process_res)
    else {
        return Err(bad("source_hw and process_res are missing"));
    };
    let seeds = golden.seeds().ok_or_else(|| bad("the seeds of its pictures are missing"))?;
    if width.max(height) > 8192 {
        return Err(bad("its pictures are too large"));
    }
    let images: Vec<Image<[u8; 3]>> = seeds.iter().map(|s| image_u8(*s, width, height)).collect();
    let config = PreprocessConfig { process_size_px, ..PreprocessConfig::default() };
    let borrowed: Vec<&Image<[u8; 3]>> = images.iter().collect();
    let batch = preprocess::process(&borrowed, Some(&intrinsics), &config)?;
    comparison.tensor("proc_intrinsics", &matrices(batch.intrinsics.as_deref()))?;
    let infer = |align_to_given| -> Result<Prediction, Da3Error> {
        let options = InferOptions {
            preprocess: config,
            align_to_given,
            compat: true,
            reference: golden.strategy,
            ..InferOptions::default()
        };
        model.infer_with(&Inputs::posed(&images, &poses, &intrinsics), &options, hooks)
    };
    if golden.entry.api_true_error.is_some() {
        let is_refused = matches!(infer(true), Err(Da3Error::DegenerateCameras { .. }));
        comparison.number("api_true (raises as the official code)", 1.0, f64::from(u8::from(is_refused)));
        return Ok(());
    }
    let aligned = infer(true)?;
    let depth: Vec<f64> = aligned.depth.iter().flat_map(|d| d.data()).map(|d| f64::from(*d)).collect();
    comparison.tensor("api_true.depth", &depth)?;
    let poses = |p: &Prediction| p.camera_from_world.clone().unwrap_or_default();
    let rows: Vec<f64> = poses(&aligned).iter().flat_map(three_rows).collect();
    comparison.tensor("api_true.extrinsics", &rows)?;
    comparison.tensor("api_true.intrinsics", &matrices(aligned.intrinsics.as_deref()))?;
    let bytes: Vec<u8> = aligned.images.iter().flat_map(|i| i.data().iter().flatten().copied()).collect();
    comparison.bytes("api.processed_images", &bytes)?;
    let free = infer(false)?;
    let rows: Vec<f64> =
        poses(&free).iter().flat_map(|m| m.transpose().iter().copied().collect::<Vec<_>>()).collect();
    comparison.tensor("api_false.extrinsics", &rows)?;
    comparison.tensor("api_false.intrinsics", &matrices(free.intrinsics.as_deref()))?;
    if let (Some(alignment), Ok((_, expected))) = (&free.alignment, golden.tensor("api.umeyama_scale_f64")) {
        comparison.number("api.umeyama_scale_f64", expected[0], alignment.scale);
    }
    Ok(())
}

fn matrices(all: Option<&[Matrix3<f64>]>) -> Vec<f64> {
    all.unwrap_or_default().iter().flat_map(|k| k.transpose().iter().copied().collect::<Vec<_>>()).collect()
}

fn given(golden: &Golden) -> Result<Cameras, Da3Error> {
    let (_, poses) = golden.tensor("in_extrinsics")?;
    let (_, intrinsics) = golden.tensor("in_intrinsics")?;
    let poses: Vec<_> = poses.chunks_exact(16).map(Matrix4::from_row_slice).collect();
    let intrinsics: Vec<_> = intrinsics.chunks_exact(9).map(Matrix3::from_row_slice).collect();
    if poses.len() != golden.views || intrinsics.len() != golden.views {
        let reason =
            format!("{} poses and {} intrinsics for {} views", poses.len(), intrinsics.len(), golden.views);
        return Err(Da3Error::BadGolden { place: golden.path().display().to_string(), reason });
    }
    Ok(Cameras { camera_from_world: poses, intrinsics })
}
