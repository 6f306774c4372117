//! Depth to points.

use nalgebra::{Matrix3, Vector3};
use vidar_core::{Pinhole, Se3};

/// Points of a depth image in the frame of `chunk_from_camera`, row-major; pixel centres are integers.
///
/// A depth that is not finite gives a point that is not finite, so that indices stay those of the pixels.
/// The reference reads intrinsics whose principal point is W/2 (pixel edges) as if pixel centres were integers; feed
/// such intrinsics here unchanged to follow it, or converted ones to be right.
pub fn unproject(depth: &[f32], intrinsics: &Pinhole, chunk_from_camera: &Se3) -> Vec<Vector3<f64>> {
    let rotation: Matrix3<f64> = chunk_from_camera.rotation.matrix();
    let width = intrinsics.width.max(1);
    depth
        .iter()
        .enumerate()
        .map(|(i, &z)| {
            let (u, v) = ((i % width) as f64, (i / width) as f64);
            let ray =
                Vector3::new((u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, 1.0);
            rotation * (ray * f64::from(z)) + chunk_from_camera.translation
        })
        .collect()
}
