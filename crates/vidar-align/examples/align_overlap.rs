//! Aligns one overlap given as a safetensors file and prints time and answer as JSON: the Rust half of
//! `bench/align_vs_reference.py`.
//!
//! Usage: `align_overlap FILE ROUNDS`. The file holds `depth1`, `conf1` (probabilities), `chunk_from_camera1` and the same with 2, and
//! `K`: `[frames, height, width]`, `[frames, 4, 4]`, `[3, 3]`, all f32.

#![allow(clippy::print_stdout)] // its output is the purpose of an example

use safetensors::SafeTensors;
use std::error::Error;
use std::time::Instant;
use vidar_align::overlap::{OverlapConfig, OverlapFit, SampledView, fit_overlap, pair_views, shared_views};
use vidar_core::{Confidence, FrameId, Image, Pinhole, RelativeDepth, Se3, ViewGeometry};

fn numbers(file: &SafeTensors<'_>, name: &str) -> Result<(Vec<usize>, Vec<f32>), Box<dyn Error>> {
    let tensor = file.tensor(name)?;
    let values = tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    Ok((tensor.shape().to_vec(), values.collect()))
}

fn views(file: &SafeTensors<'_>, which: char) -> Result<Vec<ViewGeometry>, Box<dyn Error>> {
    let (shape, depth) = numbers(file, &format!("depth{which}"))?;
    let (_, confidence) = numbers(file, &format!("conf{which}"))?;
    let (_, poses) = numbers(file, &format!("chunk_from_camera{which}"))?;
    let (_, k) = numbers(file, "K")?;
    let (h, w) = (shape[1], shape[2]);
    let k: Vec<f64> = k.into_iter().map(f64::from).collect();
    let intrinsics = Pinhole::new(k[0], k[4], k[2], k[5], w, h)?;
    let mut all = Vec::new();
    for (i, ((depth, confidence), pose)) in
        depth.chunks_exact(w * h).zip(confidence.chunks_exact(w * h)).zip(poses.chunks_exact(16)).enumerate()
    {
        let matrix = nalgebra::Matrix4::from_row_iterator(pose.iter().map(|v| f64::from(*v)));
        all.push(ViewGeometry {
            frame_id: FrameId(i as u32),
            chunk_from_camera: Se3::from_matrix(&matrix).ok_or("not a pose")?,
            intrinsics,
            depth: RelativeDepth::new(Image::from_vec(w, h, depth.to_vec())?),
            confidence: Confidence::new(Image::from_vec(w, h, confidence.to_vec())?),
        });
    }
    Ok(all)
}

fn align(earlier: &[ViewGeometry], later: &[ViewGeometry]) -> Result<OverlapFit, Box<dyn Error>> {
    let config = OverlapConfig::default();
    let sampled = |v: &[ViewGeometry]| -> Vec<SampledView> {
        v.iter().map(|v| SampledView::new(v, config.samples_per_view)).collect()
    };
    let (a, b) = (sampled(earlier), sampled(later));
    Ok(fit_overlap(&pair_views(&shared_views(a.iter(), b.iter()), config.max_pairs), &config)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().ok_or("which file?")?;
    let rounds: usize = arguments.next().map_or(Ok(5), |r| r.parse())?;
    let bytes = std::fs::read(path)?;
    let file = SafeTensors::deserialize(&bytes)?;
    let (earlier, later) = (views(&file, '1')?, views(&file, '2')?);
    let mut times = Vec::new();
    let mut fit = align(&earlier, &later)?;
    for _ in 0..rounds {
        let start = Instant::now();
        fit = align(&earlier, &later)?;
        times.push(start.elapsed().as_secs_f64());
    }
    let s = fit.target_from_source;
    let report = serde_json::json!({
        "seconds": times,
        "scale": s.scale,
        "rotation": s.rotation.matrix().transpose().as_slice(),
        "translation": s.translation.as_slice(),
        "log_scale_std": fit.log_scale_std(),
        "pairs": fit.pairs,
        "inlier_ratio": fit.inlier_ratio,
        "iterations": fit.iterations,
    });
    println!("{report}");
    Ok(())
}
