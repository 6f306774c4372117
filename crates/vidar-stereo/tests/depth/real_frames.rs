//! Real frames with sensor depth, where they are at hand; skipped loudly otherwise.

use nalgebra::{Matrix4, Vector3};
use std::path::{Path, PathBuf};
use vidar_core::testing::shared_data;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, GeometryModel, Image, LieGroup, Pinhole, Se3,
    Timestamp,
};
use vidar_stereo::{StereoConfig, StereoModel};

/// Frames of each recording, and which of them are evaluated.
const FRAMES: usize = 9;
const EVALUATED: std::ops::Range<usize> = 3..6;

fn numbers(path: &Path) -> Vec<f64> {
    let text = std::fs::read_to_string(path).expect("readable");
    text.split_whitespace().filter_map(|t| t.parse().ok()).collect()
}

fn pose(n: &[f64]) -> Se3 {
    Se3::from_matrix(&Matrix4::from_row_slice(&n[..16])).expect("a motion")
}

fn depth(path: &Path) -> Image<f32> {
    let d = image::open(path).expect("a picture").into_luma16();
    let metres = |&v: &u16| if v == 0 || v == u16::MAX { f32::NAN } else { f32::from(v) * 1e-3 };
    Image::from_vec(d.width() as usize, d.height() as usize, d.as_raw().iter().map(metres).collect())
        .expect("its size")
}

fn view(i: usize, path: &Path, world_from_camera: Se3, k: impl Fn(usize, usize) -> Pinhole) -> ChunkView {
    let picture = image::open(path).expect("a picture").into_rgb8();
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let pixels = picture.pixels().map(|p| p.0).collect();
    ChunkView {
        frame_id: FrameId(i as u32),
        time: Timestamp::from_nanos(i as i64 * 100_000_000),
        image: FrameImage::Rgb8(Image::from_vec(w, h, pixels).expect("its size")),
        intrinsics: k(w, h),
        world_from_camera: Some(world_from_camera),
    }
}

/// Completeness, and the share of the depths that is within 10 % of the sensor.
fn evaluate(views: Vec<ChunkView>, sensor: &[(Image<f32>, Pinhole, Se3)]) -> (f64, f64) {
    let chunk = ChunkViews { id: ChunkId(0), views };
    let mut model = StereoModel::new(StereoConfig::default()).expect("defaults are valid");
    let found = model.predict_views(&chunk, EVALUATED, &|_| false).expect("has parallax").views;
    assert_eq!(found.len(), EVALUATED.len());
    let (mut with_truth, mut there, mut near) = (0usize, 0usize, 0usize);
    for view in found {
        let (truth, k, color_from_depth) = &sensor[view.frame_id.0 as usize];
        // Every third sensor pixel, projected into the colour camera.
        for (x, y) in (0..k.height).step_by(3).flat_map(|y| (0..k.width).step_by(3).map(move |x| (x, y))) {
            let z = truth[(x, y)];
            let p = *color_from_depth * (k.ray(x as f64, y as f64) * f64::from(z));
            let Some(pixel) = view.intrinsics.project(&p) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            let inside = u >= 0.0 && v >= 0.0;
            if !inside || u as usize >= view.intrinsics.width || v as usize >= view.intrinsics.height {
                continue;
            }
            with_truth += 1;
            let z = f64::from(view.depth.image()[(u as usize, v as usize)]);
            there += usize::from(z.is_finite());
            near += usize::from((z - p.z).abs() < 0.1 * p.z);
        }
    }
    (there as f64 / with_truth.max(1) as f64, near as f64 / there.max(1) as f64)
}

fn sorted(folder: &Path, end: &str) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("a folder").filter_map(|e| e.ok().map(|e| e.path())).collect();
    files.retain(|p| p.to_string_lossy().ends_with(end));
    files.sort();
    files
}

#[test]
fn depth_of_a_room_seen_by_a_headset_is_mostly_correct() {
    let Some(folder) = shared_data("data/hololens_commonroom") else { return };
    let k = numbers(&folder.join("K.txt"));
    let poses = numbers(&folder.join("poses.txt"));
    let camera = |w: usize, h: usize| Pinhole::new(k[0], k[4], k[2], k[5], w, h).expect("a camera");
    let (mut views, mut sensor) = (Vec::new(), Vec::new());
    let images = sorted(&folder.join("images"), ".png");
    for (i, (image, d)) in images.iter().zip(sorted(&folder.join("depth"), ".png")).take(FRAMES).enumerate() {
        let view = view(i, image, pose(&poses[16 * i..]), camera);
        let truth = depth(&d);
        let k = view.intrinsics.resized(truth.width(), truth.height()).expect("a size");
        views.push(view);
        sensor.push((truth, k, Se3::IDENTITY));
    }
    let (complete, near) = evaluate(views, &sensor);
    assert!(complete > 0.2 && near > 0.8, "completeness {complete:.3}, within 10 % {near:.3}");
}

#[test]
fn depth_of_a_kitchen_with_poses_of_another_clock_is_mostly_correct() {
    let Some(folder) = shared_data("data/7scenes_redkitchen/seq-01") else { return };
    let color_from_depth = Se3::from_translation(Vector3::new(-0.023, 0.012, 0.0));
    let (mut views, mut sensor) = (Vec::new(), Vec::new());
    for (i, image) in sorted(&folder, ".color.jpg").iter().step_by(3).take(FRAMES).enumerate() {
        let name = image.to_string_lossy().replace(".color.jpg", "");
        let world_from_depth = pose(&numbers(Path::new(&format!("{name}.pose.txt"))));
        // Focal length and centre as photometric consistency with the depth finds them.
        let camera = |w: usize, h: usize| Pinhole::new(525.1, 525.1, 322.3, 223.3, w, h).expect("a camera");
        views.push(view(i, image, world_from_depth * color_from_depth.inverse(), camera));
        let k = Pinhole::new(585.0, 585.0, 320.0, 240.0, 640, 480).expect("a camera");
        sensor.push((depth(Path::new(&format!("{name}.depth.png"))), k, color_from_depth));
    }
    let (complete, near) = evaluate(views, &sensor);
    assert!(complete > 0.25 && near > 0.7, "completeness {complete:.3}, within 10 % {near:.3}");
}
