//! Fuses a 7-Scenes sequence and prints what it took, as one JSON line: the counterpart of `bench/fusion_vs_open3d.py`.
//!
//! `fuse_folder SEQUENCE_DIR [--voxel M] [--trunc VOXELS] [--max-depth M] [--carve M] [--min-views N] [--frames N]
//! [--color] [--points FRAMES] [--cloud OUT.bin] [--triangles OUT.bin]`; the mesh's vertices are written as
//! little-endian f32 x, y, z, its triangles as three u32 each.

use std::collections::HashMap;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;
use vidar_core::{AlignedView, Confidence, FrameId, Image, MetricDepth, Pinhole, Se3, Timestamp};
use vidar_fusion::{FusionConfig, PointFusion, TsdfVolume};

/// The value of missing depth in 7-Scenes.
const INVALID_MM: [u16; 2] = [0, 65535];

#[allow(clippy::print_stdout)] // printing is this program's whole purpose
fn main() -> Result<(), Box<dyn Error>> {
    let (folder, options) = arguments();
    let number = |name: &str, default: f64| options.get(name).map_or(Ok(default), |v| v.parse());
    let config = FusionConfig {
        voxel_size_m: number("--voxel", 0.02)?,
        truncation_voxels: number("--trunc", 4.0)?,
        max_depth_m: number("--max-depth", 6.0)?,
        carve_range_m: number("--carve", 0.0)?,
        min_observations: number("--min-views", 1.0)? as u32,
        max_incidence_deg: number("--max-incidence", 80.0)?,
        min_component_triangles: 0,
        ..FusionConfig::default()
    };
    let views = read_views(&folder, number("--frames", 1e9)? as usize, options.contains_key("--color"))?;

    let mut volume = TsdfVolume::new(&config)?;
    let mut frame_ms = Vec::new();
    let (mut touched, mut blocks) = (0, 0);
    let cpu_before = cpu_ms();
    for view in &views {
        let start = Instant::now();
        let stats = volume.integrate(view)?;
        frame_ms.push(start.elapsed().as_secs_f64() * 1e3);
        touched += stats.blocks_touched;
        blocks = stats.blocks_total;
    }
    let cpu_ms = cpu_ms() - cpu_before;
    let start = Instant::now();
    let mesh = volume.extract_mesh();
    let extract_ms = start.elapsed().as_secs_f64() * 1e3;
    let mut points = PointFusion::new(&config)?;
    let mut point_ms = Vec::new();
    let point_cpu_before = self::cpu_ms();
    for view in views.iter().take(number("--points", 0.0)? as usize) {
        let start = Instant::now();
        points.integrate(view)?;
        point_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let point_cpu_ms = self::cpu_ms() - point_cpu_before;
    let coverage = volume.coverage(&mesh);
    println!(
        "{{\"frames\": {}, \"ms_per_frame\": {:.4}, \"cpu_ms_per_frame\": {:.3}, \"total_ms\": {:.3}, \"extract_ms\": {:.3}, \
         \"blocks_per_frame\": {:.0}, \"blocks\": {}, \"vertices\": {}, \"triangles\": {}, \"area_m2\": {:.3}, \
         \"volume_mib\": {:.1}, \"peak_mib\": {:.1}, \"points_ms_per_frame\": {:.3}, \"points_cpu_ms_per_frame\": {:.3}, \"share_seen_by_3\": {:.3}}}",
        views.len(),
        median(&mut frame_ms.clone()),
        cpu_ms / views.len().max(1) as f64,
        frame_ms.iter().sum::<f64>(),
        extract_ms,
        touched as f64 / views.len().max(1) as f64,
        blocks,
        mesh.positions.len(),
        mesh.triangles.len(),
        coverage.surface_area_m2,
        volume.memory_bytes() as f64 / 1048576.0,
        volume.peak_memory_bytes() as f64 / 1048576.0,
        median(&mut point_ms),
        point_cpu_ms / point_ms.len().max(1) as f64,
        coverage.share_seen_by_3_or_more,
    );
    if let Some(path) = options.get("--cloud") {
        let bytes: Vec<u8> = mesh.positions.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::write(path, bytes)?;
    }
    if let Some(path) = options.get("--triangles") {
        let bytes: Vec<u8> = mesh.triangles.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::write(path, bytes)?;
    }
    Ok(())
}

/// Processor time of all threads so far; 0 without `/proc`.
fn cpu_ms() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let stats = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("schedstat")).ok());
    // The first number is the time on a processor, in nanoseconds.
    stats.filter_map(|stat| stat.split_whitespace().next()?.parse::<f64>().ok()).sum::<f64>() * 1e-6
}

fn arguments() -> (PathBuf, HashMap<String, String>) {
    let mut folder = PathBuf::from(".");
    let mut options = HashMap::new();
    let mut arguments = std::env::args().skip(1).peekable();
    while let Some(argument) = arguments.next() {
        if argument.starts_with("--") {
            let value = arguments.next_if(|v| !v.starts_with("--")).unwrap_or_default();
            options.insert(argument, value);
        } else {
            folder = argument.into();
        }
    }
    (folder, options)
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn read_views(folder: &Path, limit: usize, colored: bool) -> Result<Vec<AlignedView>, Box<dyn Error>> {
    let mut depth_files: Vec<PathBuf> = std::fs::read_dir(folder)?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|p| p.to_string_lossy().ends_with(".depth.png"))
        .collect();
    depth_files.sort();
    depth_files.truncate(limit);
    let k = Pinhole::new(585.0, 585.0, 320.0, 240.0, 640, 480)?;
    let mut views = Vec::new();
    for (index, path) in depth_files.iter().enumerate() {
        let stem = path.to_string_lossy().replace(".depth.png", "");
        let text = std::fs::read_to_string(format!("{stem}.pose.txt"))?;
        let numbers = text.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>()?;
        let matrix = nalgebra::Matrix4::from_row_slice(numbers.get(..16).ok_or("a matrix of 16 numbers")?);
        let world_from_camera = Se3::from_matrix(&matrix).ok_or("not a rigid motion")?;
        let view = AlignedView::new(
            FrameId(index as u32),
            Timestamp::from_nanos(index as i64),
            world_from_camera,
            k,
            MetricDepth::new(read_depth(path)?),
            Confidence::full(k.width, k.height),
        )?;
        let view = if colored { view.with_color(read_color(&stem)?)? } else { view };
        views.push(view);
    }
    Ok(views)
}

fn read_depth(path: &Path) -> Result<Image<f32>, Box<dyn Error>> {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path)?));
    let mut reader = decoder.read_info()?;
    let mut bytes = vec![0; reader.output_buffer_size().ok_or("image too large")?];
    let info = reader.next_frame(&mut bytes)?;
    if info.bit_depth != png::BitDepth::Sixteen || info.color_type != png::ColorType::Grayscale {
        return Err("expected 16-bit grey".into());
    }
    let metres = |b: &[u8]| {
        let mm = u16::from_be_bytes([b[0], b[1]]);
        if INVALID_MM.contains(&mm) { f32::NAN } else { f32::from(mm) * 1e-3 }
    };
    let depth = bytes[..info.buffer_size()].chunks_exact(2).map(metres).collect();
    Ok(Image::from_vec(info.width as usize, info.height as usize, depth)?)
}

/// The colour image laid over the depth image as it is, good enough to time colour.
fn read_color(stem: &str) -> Result<Image<[u8; 3]>, Box<dyn Error>> {
    let rgb = image::open(format!("{stem}.color.jpg"))?.to_rgb8();
    let (width, height) = (rgb.width() as usize, rgb.height() as usize);
    Ok(Image::from_vec(width, height, rgb.pixels().map(|p| p.0).collect())?)
}
