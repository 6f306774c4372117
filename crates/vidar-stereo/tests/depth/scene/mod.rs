//! A tiny renderer: textured planes and boxes seen by a pinhole, with exact depth.

use nalgebra::Vector3;
use vidar_core::random::{finalize, unit};
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, FrameId, FrameImage, Image, LieGroup, Pinhole, Se3, So3, Timestamp,
};

pub struct Scene {
    /// The back wall: `normal · p = distance`.
    pub normal: Vector3<f64>,
    pub distance: f64,
    /// A board in front, parallel to the image: half size and depth.
    pub board: Option<(f64, f64)>,
    pub textured: bool,
}

pub const WALL: Scene =
    Scene { normal: Vector3::new(0.0, 0.0, 1.0), distance: 3.0, board: None, textured: true };

fn hash(x: i64, y: i64, seed: i64) -> f64 {
    let key = x.wrapping_mul(73_856_093) ^ y.wrapping_mul(19_349_663) ^ seed.wrapping_mul(83_492_791);
    unit(finalize(key as u64))
}

fn value_noise(x: f64, y: f64, seed: i64) -> f64 {
    let (fx, fy) = (x.floor(), y.floor());
    let (ix, iy, ax, ay) = (fx as i64, fy as i64, x - fx, y - fy);
    let smooth = |a: f64| a * a * (3.0 - 2.0 * a);
    let (ax, ay) = (smooth(ax), smooth(ay));
    let top = hash(ix, iy, seed) * (1.0 - ax) + hash(ix + 1, iy, seed) * ax;
    let bottom = hash(ix, iy + 1, seed) * (1.0 - ax) + hash(ix + 1, iy + 1, seed) * ax;
    top * (1.0 - ay) + bottom * ay
}

impl Scene {
    /// Depth and brightness along a ray from the world.
    fn cast(&self, origin: &Vector3<f64>, ray: &Vector3<f64>) -> (f64, f64) {
        let mut t = (self.distance - self.normal.dot(origin)) / self.normal.dot(ray);
        let mut seed = 1;
        if let Some((half, depth)) = self.board {
            let s = (depth - origin.z) / ray.z;
            let p = origin + ray * s;
            if p.x.abs() < half && p.y.abs() < half {
                (t, seed) = (s, 2);
            }
        }
        let p = origin + ray * t;
        let texture = if self.textured {
            60.0 * value_noise(p.x * 6.0, p.y * 6.0, seed)
                + 70.0 * value_noise(p.x * 17.0, p.y * 17.0, seed + 7)
                + 60.0 * value_noise(p.x * 41.0, p.y * 41.0, seed + 9)
        } else {
            90.0
        };
        (t, 30.0 + texture)
    }
}

pub fn camera() -> Pinhole {
    Pinhole::new(170.0, 170.0, 95.5, 71.5, 192, 144).expect("valid")
}

/// Poses to the side and a little up and down, at uneven distances, all looking ahead with small turns.
pub fn poses() -> Vec<Se3> {
    [(-0.33, 0.02), (-0.16, -0.05), (0.0, 0.0), (0.19, 0.06), (0.36, -0.03)]
        .into_iter()
        .enumerate()
        .map(|(i, (x, y))| {
            let turn = Vector3::new(0.01 * y, -0.05 * x, 0.004 * i as f64);
            Se3::new(So3::exp(&turn), Vector3::new(x, y, 0.02 * x))
        })
        .collect()
}

/// Depth of the scene in one view.
pub fn depth(scene: &Scene, world_from_camera: &Se3) -> Image<f32> {
    let k = camera();
    Image::from_fn(k.width, k.height, |x, y| {
        let ray = world_from_camera.rotation * k.ray(x as f64, y as f64);
        // The camera's ray has z = 1, so its length along the ray is the z-depth.
        scene.cast(&world_from_camera.translation, &ray).0 as f32
    })
}

/// Views of the scene; `exposure` gives gain and offset by view, `noise` is Gaussian-like, grey levels.
pub fn views(scene: &Scene, poses: &[Se3], exposure: impl Fn(usize) -> (f64, f64), noise: f64) -> ChunkViews {
    let k = camera();
    let render = |i: usize, world_from_camera: &Se3| {
        let (gain, offset) = exposure(i);
        let image = Image::from_fn(k.width, k.height, |x, y| {
            let mut sum = 0.0;
            for (sx, sy) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let ray = world_from_camera.rotation * k.ray(x as f64 + sx, y as f64 + sy);
                sum += 0.25 * scene.cast(&world_from_camera.translation, &ray).1;
            }
            // Sum of twelve uniforms: variance one.
            let n: f64 =
                (0..12).map(|j| hash(x as i64, y as i64, 1000 + 12 * i as i64 + j)).sum::<f64>() - 6.0;
            (gain * sum + offset + noise * n).round().clamp(0.0, 255.0) as u8
        });
        ChunkView {
            frame_id: FrameId(i as u32),
            time: Timestamp::from_nanos(i as i64 * 100_000_000),
            image: FrameImage::Gray8(image),
            intrinsics: k,
            world_from_camera: Some(*world_from_camera),
        }
    };
    ChunkViews { id: ChunkId(0), views: poses.iter().enumerate().map(|(i, p)| render(i, p)).collect() }
}
