//! Runs stereo on a folder of posed frames with sensor depth and prints how good it is.
//!
//! `cargo run --release -p vidar-stereo --example stereo_on_frames -- <hololens|7scenes> FOLDER OUT [key=value…]`
//! writes depth pictures to OUT, and `features.csv` with a sample of confidences against the sensor.

#![allow(clippy::print_stdout, reason = "its output is what the example is for")]

use nalgebra::{Matrix4, Vector3};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, Image, LieGroup, Pinhole, Se3, So3, Timestamp,
};
use vidar_stereo::{StereoConfig, StereoModel};

struct Truth {
    depth_m: Image<f32>,
    intrinsics: Pinhole,
    /// Coordinates of the depth camera from those of the colour camera.
    depth_from_color: Se3,
}

fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace().filter_map(|t| t.parse().ok()).collect()
}

fn motion(n: &[f64]) -> Result<Se3, Box<dyn Error>> {
    let m = Matrix4::from_row_slice(&n[..16]);
    // Printed digits leave the rotation slightly off; the nearest rotation is taken.
    let r = m.fixed_view::<3, 3>(0, 0).into_owned();
    let svd = r.svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return Err("bad rotation".into()) };
    let rotation = So3::from_matrix(&(u * vt)).ok_or("bad rotation")?;
    Ok(Se3::new(rotation, Vector3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)])))
}

fn depth(path: &Path) -> Result<Image<f32>, Box<dyn Error>> {
    let d = image::open(path)?.into_luma16();
    let metres = |&v: &u16| if v == 0 || v == 65535 { f32::NAN } else { f32::from(v) * 1e-3 };
    Ok(Image::from_vec(d.width() as usize, d.height() as usize, d.as_raw().iter().map(metres).collect())?)
}

fn rgb(path: &Path) -> Result<FrameImage, Box<dyn Error>> {
    let i = image::open(path)?.into_rgb8();
    let pixels = i.pixels().map(|p| p.0).collect();
    Ok(FrameImage::Rgb8(Image::from_vec(i.width() as usize, i.height() as usize, pixels)?))
}

fn sorted(folder: &Path, end: &str) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder)?.filter_map(|e| e.ok().map(|e| e.path())).collect();
    files.retain(|p| p.to_string_lossy().ends_with(end));
    files.sort();
    Ok(files)
}

fn load(kind: &str, folder: &Path) -> Result<Vec<(ChunkView, Truth)>, Box<dyn Error>> {
    let mut out = Vec::new();
    let mut push = |image: FrameImage, k: Pinhole, pose: Se3, truth: Truth| {
        let id = out.len() as u32;
        let time = Timestamp::from_nanos(i64::from(id) * 50_000_000);
        let view =
            ChunkView { frame_id: FrameId(id), time, image, intrinsics: k, world_from_camera: Some(pose) };
        out.push((view, truth));
    };
    if kind == "hololens" {
        let k = numbers(&std::fs::read_to_string(folder.join("K.txt"))?);
        let poses = std::fs::read_to_string(folder.join("poses.txt"))?;
        let images = sorted(&folder.join("images"), ".png")?;
        let depths = sorted(&folder.join("depth"), ".png")?;
        for ((image, d), line) in images.iter().zip(&depths).zip(poses.lines()) {
            let (image, depth_m) = (rgb(image)?, depth(d)?);
            let intrinsics = Pinhole::new(k[0], k[4], k[2], k[5], image.width(), image.height())?;
            let truth_k = intrinsics.resized(depth_m.width(), depth_m.height())?;
            let truth = Truth { depth_m, intrinsics: truth_k, depth_from_color: Se3::IDENTITY };
            push(image, intrinsics, motion(&numbers(line))?, truth);
        }
    } else {
        let colors = sorted(folder, ".color.jpg")?;
        for color in colors {
            let name = color.to_string_lossy().replace(".color.jpg", "");
            let image = rgb(&color)?;
            let k = Pinhole::new(525.1, 525.1, 322.3, 223.3, image.width(), image.height())?;
            let world_from_depth = motion(&numbers(&std::fs::read_to_string(format!("{name}.pose.txt"))?))?;
            let depth_from_color = Se3::from_translation(Vector3::new(0.023, -0.012, 0.0));
            let depth_m = depth(Path::new(&format!("{name}.depth.png")))?;
            let intrinsics = Pinhole::new(585.0, 585.0, 320.0, 240.0, 640, 480)?;
            push(
                image,
                k,
                world_from_depth * depth_from_color,
                Truth { depth_m, intrinsics, depth_from_color },
            );
        }
    }
    Ok(out)
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [kind, folder, out, settings @ ..] = args.as_slice() else {
        return Err("usage: stereo_on_frames <hololens|7scenes> FOLDER OUT [key=value...]".into());
    };
    let stride: usize = if kind == "hololens" { 1 } else { 2 };
    let config: StereoConfig = toml::from_str(&settings.join("\n"))?;
    // Fewer frames for a quick look.
    let most: usize = std::env::var("STEREO_FRAMES").ok().and_then(|n| n.parse().ok()).unwrap_or(usize::MAX);
    let frames: Vec<_> = load(kind, Path::new(folder))?.into_iter().step_by(stride).take(most).collect();
    std::fs::create_dir_all(out)?;
    let views = ChunkViews { id: ChunkId(0), views: frames.iter().map(|f| f.0.clone()).collect() };
    let references: Vec<usize> = (0..frames.len()).collect();
    let mut model = StereoModel::new(config)?;
    let start = Instant::now();
    let output = model.predict_with(&views, &references, &|| false)?;
    let seconds = start.elapsed().as_secs_f64();
    let mut csv = String::new();
    let (mut truth_count, mut errors, mut bins) = (0usize, Vec::new(), [(0usize, 0usize, 0.0f64); 10]);
    let (mut absolute, mut signed) = (Vec::new(), Vec::new());
    for (i, view) in output.prediction.views.iter().enumerate() {
        let Some((given, truth)) = frames.iter().find(|f| f.0.frame_id == view.frame_id) else { continue };
        let (k, kd) = (&view.intrinsics, &truth.intrinsics);
        let mut picture = image::GrayImage::new((3 * k.width) as u32, k.height as u32);
        // The sensor's depth, carried into the colour camera's pixels; the nearest wins.
        let mut sensor = Image::filled(k.width, k.height, f32::NAN);
        let color_from_depth = truth.depth_from_color.inverse();
        for y in 0..kd.height {
            for x in 0..kd.width {
                let z = truth.depth_m[(x, y)];
                if z.is_nan() {
                    continue;
                }
                let p = color_from_depth * (kd.ray(x as f64, y as f64) * f64::from(z));
                let Some(u) = k.project(&p) else { continue };
                let (ux, uy) = (u.x.round(), u.y.round());
                if ux >= 0.0 && uy >= 0.0 && ux < k.width as f64 && uy < k.height as f64 {
                    let cell = &mut sensor[(ux as usize, uy as usize)];
                    if cell.is_nan() || p.z < f64::from(*cell) {
                        *cell = p.z as f32;
                    }
                }
            }
        }
        let gray = given.image.to_gray8();
        for y in 0..k.height {
            for x in 0..k.width {
                let (z, t) = (view.depth.image()[(x, y)], sensor[(x, y)]);
                let shade = |z: f32| if z.is_nan() { 0 } else { (40.0 + 215.0 / (1.0 + 0.5 * z)) as u8 };
                let g = gray[(x * gray.width() / k.width, y * gray.height() / k.height)];
                for (panel, value) in [g, shade(z), shade(t)].into_iter().enumerate() {
                    picture.put_pixel((panel * k.width + x) as u32, y as u32, image::Luma([value]));
                }
                if t.is_nan() {
                    continue;
                }
                truth_count += 1;
                if z.is_nan() {
                    continue;
                }
                let (e, c) = ((z - t).abs() / t, view.confidence.image()[(x, y)]);
                errors.push(e);
                absolute.push((z - t).abs());
                signed.push((z - t) / t);
                let bin = &mut bins[((c * 10.0) as usize).min(9)];
                bin.0 += 1;
                bin.1 += usize::from(e < vidar_stereo::TOLERANCE_RATIO);
                bin.2 += f64::from(c);
                if (x * 31 + y * 17) % 97 == 0 {
                    csv.push_str(&format!("{i},{x},{y},{e},{c}\n"));
                }
            }
        }
        if i % 8 == 0 {
            picture.save(Path::new(out).join(format!("{kind}-{i:03}.png")))?;
        }
    }
    std::fs::write(Path::new(out).join("features.csv"), csv)?;
    let share =
        |v: &[f32], limit: f32| v.iter().filter(|e| **e < limit).count() as f64 / v.len().max(1) as f64;
    let absrel = errors.iter().map(|e| f64::from(*e)).sum::<f64>() / errors.len().max(1) as f64;
    errors.sort_unstable_by(f32::total_cmp);
    signed.sort_unstable_by(f32::total_cmp);
    println!("median signed error {:.4}", signed.get(signed.len() / 2).unwrap_or(&f32::NAN));
    println!(
        "{kind}: {} views, {} omitted, {:.0} ms a view, completeness {:.3}, AbsRel {absrel:.4}, median {:.4}, \
         <3% {:.3} <5% {:.3} <10% {:.3}, <0.05 m {:.3} <0.10 m {:.3}; right within 0.05 m over all truth {:.3}",
        output.prediction.views.len(),
        output.omitted.len(),
        1e3 * seconds / references.len() as f64,
        errors.len() as f64 / truth_count.max(1) as f64,
        errors.get(errors.len() / 2).unwrap_or(&f32::NAN),
        share(&errors, 0.03),
        share(&errors, 0.05),
        share(&errors, 0.10),
        share(&absolute, 0.05),
        share(&absolute, 0.10),
        absolute.iter().filter(|e| **e < 0.05).count() as f64 / truth_count.max(1) as f64,
    );
    for (n, right, sum) in bins.iter().filter(|b| b.0 > 0) {
        let n_f = *n as f64;
        print!("  {:.2}->{:.2} ({n})", sum / n_f, *right as f64 / n_f);
    }
    println!();
    Ok(())
}
