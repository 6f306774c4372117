//! Writes what the official Depth Anything 3 programs would have left of a synthetic sequence, with a network's errors.
//!
//! `record_predictions SEQUENCE OUT [--stride N] [--chunk N] [--overlap N] [--width N] [--seed N] [--scale X]
//! [--conditioned]`
//!
//! SEQUENCE is a folder that `vidar synth` wrote. Every `stride`-th frame is predicted, in chunks:
//! - `OUT/api/chunk_0000.npz`, …: the official API's export `npz`, one file per chunk;
//! - `OUT/streaming/results_output/frame_N.npz`, `camera_poses.txt`, `intrinsic.txt`: DA3-Streaming's output, the chunks
//!   joined one to the next without loops.
//!
//! `--scale` multiplies all errors within a chunk (1 is a small network; 0 leaves only the gauges). `--conditioned` tells
//! the network the true poses, for which DA3-Streaming has no counterpart: only `api` is written then.

use std::collections::HashMap;
use std::error::Error;
use std::fmt::Write as _;
use std::fs::File;
use std::path::{Path, PathBuf};
use vidar_core::{
    CameraModel, ChunkId, FrameId, FrameImage, GeometryPrediction, Image, LieGroup, Pinhole, Se3,
    ViewGeometry,
};
use vidar_export::official::{NpyArray, NpyData, PredictedView, Prediction, write_npz, write_npz_arrays};
use vidar_synth::predict::{
    PredictionErrors, TruePlace, chain_chunks, chunk_ranges, predict_chunk, true_views,
};
use vidar_synth::{Simulation, SynthView, render_views};

type Failure = Box<dyn Error>;

/// Confidence that stands for certainty: the head's 1 + exp(l) has no end.
const SUREST: f32 = 100.0;

fn main() -> Result<(), Failure> {
    let (paths, options) = arguments();
    let [sequence, out] = &paths[..] else { return Err("usage: record_predictions SEQUENCE OUT".into()) };
    let number = |name: &str, usual: usize| options.get(name).map_or(Ok(usual), |v| v.parse());
    let scale: f64 = options.get("--scale").map_or(Ok(1.0), |v| v.parse())?;
    let (stride, seed) = (number("--stride", 1)?.max(1), number("--seed", 1)? as u64);
    let conditioned = options.contains_key("--conditioned");

    let simulation = Simulation::open(sequence)?;
    let intrinsics = camera(number("--width", 280)?)?;
    let frames =
        (simulation.path().duration_secs() * simulation.config().camera_rate_hz - 1e-6).ceil() as usize;
    let place = |k: usize| {
        let time = simulation.frame_time(k * stride);
        let world_from_camera = simulation.world_from_camera(time)?;
        Some(TruePlace { frame_id: FrameId(k as u32), time, world_from_camera })
    };
    let places: Vec<TruePlace> = (0..frames.div_ceil(stride)).filter_map(place).collect();
    let errors = scaled(scale);
    let ranges = chunk_ranges(places.len(), number("--chunk", 30)?, number("--overlap", 10)?)?;

    std::fs::create_dir_all(out.join("api"))?;
    let mut chunks = Vec::with_capacity(ranges.len());
    for (k, range) in ranges.into_iter().enumerate() {
        let places = &places[range];
        let truth = true_views(simulation.world(), places, &intrinsics);
        let prior: Vec<Se3> = places.iter().map(|p| p.world_from_camera).collect();
        let prior = conditioned.then_some(&prior[..]);
        let chunk = predict_chunk(ChunkId(k as u32), &truth, prior, &errors, seed)?;
        let pictures = pictures(&simulation, places, &intrinsics)?;
        write_npz(File::create(out.join(format!("api/chunk_{k:04}.npz")))?, &official(&chunk, &pictures))?;
        chunks.push(chunk);
    }
    if !conditioned {
        let pictures = pictures(&simulation, &places, &intrinsics)?;
        write_streaming(&out.join("streaming"), &chain_chunks(&chunks)?, &pictures)?;
    }
    Ok(())
}

/// EuRoC's angle of view, with the principal point in the middle as networks have it.
fn camera(width: usize) -> Result<Pinhole, Failure> {
    let height = (width as f64 * 480.0 / 752.0 / 14.0).round() as usize * 14;
    let focal = 458.0 * width as f64 / 752.0;
    let middle = |size: usize| 0.5 * (size as f64 - 1.0);
    Ok(Pinhole::new(focal, focal, middle(width), middle(height), width, height)?)
}

fn scaled(scale: f64) -> PredictionErrors {
    let usual = PredictionErrors::default();
    PredictionErrors {
        drift_rotation_deg: scale * usual.drift_rotation_deg,
        drift_translation_share: scale * usual.drift_translation_share,
        drift_scale_sigma: scale * usual.drift_scale_sigma,
        position_jitter_m: scale * usual.position_jitter_m,
        frame_scale_sigma: scale * usual.frame_scale_sigma,
        focal_sigma: scale * usual.focal_sigma,
        deformation_sigma: scale * usual.deformation_sigma,
        bleeding_px: scale * usual.bleeding_px,
        noise_sigma: scale * usual.noise_sigma,
        conditioned_scale_sigma: scale * usual.conditioned_scale_sigma,
        ..usual
    }
}

fn pictures(
    simulation: &Simulation,
    places: &[TruePlace],
    k: &Pinhole,
) -> Result<Vec<Image<[u8; 3]>>, Failure> {
    let camera = CameraModel::Pinhole(*k);
    let view = |p: &TruePlace| SynthView { world_from_camera: p.world_from_camera, camera: camera.clone() };
    let views: Vec<SynthView> = places.iter().map(view).collect();
    let rendered = render_views(simulation.world(), &views, 2)?;
    let rgb = |image: FrameImage| Image::from_fn(k.width, k.height, |x, y| [gray(&image, x, y); 3]);
    Ok(rendered.into_iter().map(|v| rgb(v.image)).collect())
}

fn gray(image: &FrameImage, x: usize, y: usize) -> u8 {
    match image {
        FrameImage::Gray8(image) => image[(x, y)],
        _ => 0,
    }
}

/// The head's confidence c of a probability p = 1 − 1/c.
fn head_confidence(p: f32) -> f32 {
    (1.0 / (1.0 - p)).min(SUREST)
}

/// Rows of the camera matrix as the official program counts: from the image's corner.
fn from_corner(k: &Pinhole) -> [[f32; 3]; 3] {
    [[k.fx, 0.0, k.cx + 0.5], [0.0, k.fy, k.cy + 0.5], [0.0, 0.0, 1.0]].map(|row| row.map(|v| v as f32))
}

/// What has no depth is infinitely unsure, and far away rather than not a number, as sky is.
fn known(depth: &Image<f32>) -> Image<f32> {
    let farthest = depth.data().iter().copied().filter(|z| z.is_finite()).fold(1.0, f32::max);
    depth.map(|z| if z.is_finite() { *z } else { farthest })
}

fn official(chunk: &GeometryPrediction, pictures: &[Image<[u8; 3]>]) -> Prediction {
    let view = |(v, picture): (&ViewGeometry, &Image<[u8; 3]>)| {
        let camera_from_chunk = v.chunk_from_camera.inverse().matrix();
        let rows = std::array::from_fn(|r| std::array::from_fn(|c| camera_from_chunk[(r, c)] as f32));
        PredictedView {
            image: Some(picture.clone()),
            depth: known(v.depth.image()),
            confidence: Some(v.confidence.image().map(|p| head_confidence(*p))),
            extrinsics: Some(rows),
            intrinsics: Some(from_corner(&v.intrinsics)),
        }
    };
    Prediction { views: chunk.views.iter().zip(pictures).map(view).collect() }
}

/// DA3-Streaming's folder: one file per frame, poses line by line. Its `conf` is the head's less one.
fn write_streaming(
    folder: &Path,
    views: &[ViewGeometry],
    pictures: &[Image<[u8; 3]>],
) -> Result<(), Failure> {
    std::fs::create_dir_all(folder.join("results_output"))?;
    let (mut poses, mut focal) = (String::new(), String::new());
    for (v, picture) in views.iter().zip(pictures) {
        let (width, height) = (v.intrinsics.width, v.intrinsics.height);
        let plane = |image: Image<f32>| NpyArray::new(vec![height, width], NpyData::F32(image.into_vec()));
        let less_one = v.confidence.image().map(|p| head_confidence(*p) - 1.0);
        let k = from_corner(&v.intrinsics);
        let bytes = NpyData::U8(picture.data().as_flattened().to_vec());
        let arrays = [
            ("image", NpyArray::new(vec![height, width, 3], bytes)?),
            ("depth", plane(known(v.depth.image()))?),
            ("conf", plane(less_one)?),
            ("intrinsics", NpyArray::new(vec![3, 3], NpyData::F32(k.as_flattened().to_vec()))?),
        ];
        let arrays: Vec<(&str, &NpyArray)> = arrays.iter().map(|(name, array)| (*name, array)).collect();
        let path = folder.join(format!("results_output/frame_{}.npz", v.frame_id));
        write_npz_arrays(File::create(path)?, &arrays)?;
        let pose = v.chunk_from_camera.matrix().transpose();
        let numbers: Vec<String> = pose.iter().map(f64::to_string).collect();
        writeln!(poses, "{}", numbers.join(" "))?;
        writeln!(focal, "{} {} {} {}", k[0][0], k[1][1], k[0][2], k[1][2])?;
    }
    std::fs::write(folder.join("camera_poses.txt"), poses)?;
    std::fs::write(folder.join("intrinsic.txt"), focal)?;
    Ok(())
}

fn arguments() -> (Vec<PathBuf>, HashMap<String, String>) {
    let (mut paths, mut options) = (Vec::new(), HashMap::new());
    let mut rest = std::env::args().skip(1);
    while let Some(argument) = rest.next() {
        if argument == "--conditioned" {
            options.insert(argument, String::new());
        } else if argument.starts_with("--") {
            options.insert(argument, rest.next().unwrap_or_default());
        } else {
            paths.push(argument.into());
        }
    }
    (paths, options)
}
