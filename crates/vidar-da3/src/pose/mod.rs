//! Camera positions and views as the network writes and reads them (DA3, camera encoder and decoder).
//!
//! A pose encoding has nine numbers: position of the camera in the world, its orientation `world_from_camera` as a
//! quaternion xyzw, and the fields of view down and across in radians. Intrinsics have their origin at the *edge* of
//! the top-left pixel; [`to_edge`] and [`from_edge`] cross to `VIDAR`'s convention, whose origin is that pixel's centre.

mod quaternion;

pub use quaternion::{matrix_from_quaternion, quaternion_from_matrix};

use nalgebra::{Matrix3, Matrix4, Vector3};
use vidar_core::Pinhole;

/// Tangents of half a field of view are not taken smaller than this.
const MIN_TAN: f64 = 1e-6;
/// Median distance of the cameras below which positions are not scaled up any further.
const MIN_MEDIAN_DISTANCE: f64 = 0.1;

/// Poses and intrinsics of some views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cameras {
    /// Poses.
    pub camera_from_world: Vec<Matrix4<f64>>,
    /// Intrinsics, origin at the edge of the top-left pixel.
    pub intrinsics: Vec<Matrix3<f64>>,
}

/// Cameras as the network takes them: the first camera is the world frame, distances are normalised, intrinsics are those
/// of the network's pixels.
#[derive(Clone, Copy, Debug)]
pub struct NetCameras<'a> {
    /// Poses, see [`normalise_world`].
    pub camera_from_world: &'a [Matrix4<f64>],
    /// Intrinsics of the network's pixels.
    pub intrinsics: &'a [Matrix3<f64>],
}

/// The inverse of a rigid transform, `[Rᵀ | −Rᵀt]`, without assuming that R is exactly a rotation.
pub fn rigid_inverse(a_from_b: &Matrix4<f64>) -> Matrix4<f64> {
    let (rotation, translation) = parts(a_from_b);
    compose(&rotation.transpose(), &-(rotation.transpose() * translation))
}

/// Rotation and translation of a rigid transform.
pub fn parts(a_from_b: &Matrix4<f64>) -> (Matrix3<f64>, Vector3<f64>) {
    (a_from_b.fixed_view::<3, 3>(0, 0).into_owned(), a_from_b.fixed_view::<3, 1>(0, 3).into_owned())
}

/// The rigid transform of a rotation and a translation.
pub fn compose(rotation: &Matrix3<f64>, translation: &Vector3<f64>) -> Matrix4<f64> {
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(translation);
    matrix
}

/// The camera centre in the world.
pub fn centre(camera_from_world: &Matrix4<f64>) -> Vector3<f64> {
    parts(&rigid_inverse(camera_from_world)).1
}

/// Input poses as the camera encoder wants them: the first camera is the world, the median camera distance is one.
///
/// The median is the *lower* one over all views, the first view's zero included, and at least 0.1: with two views it
/// is zero, so that their baseline comes out ten times as long, not one. That is what the official code does.
pub fn normalise_world(camera_from_world: &[Matrix4<f64>]) -> Vec<Matrix4<f64>> {
    let Some(first) = camera_from_world.first() else {
        return Vec::new();
    };
    let world_from_first = rigid_inverse(first);
    let mut moved: Vec<Matrix4<f64>> = camera_from_world.iter().map(|c| c * world_from_first).collect();
    let mut distances: Vec<f64> = moved.iter().map(|c| centre(c).norm()).collect();
    distances.sort_by(f64::total_cmp);
    let median = distances[(distances.len() - 1) / 2].max(MIN_MEDIAN_DISTANCE);
    for camera in &mut moved {
        camera.fixed_view_mut::<3, 1>(0, 3).unscale_mut(median);
    }
    moved
}

/// The pose encoding of a camera for an image of `width` × `height`; principal point and skew do not take part.
pub fn encode(
    camera_from_world: &Matrix4<f64>,
    intrinsics: &Matrix3<f64>,
    width: usize,
    height: usize,
) -> [f64; 9] {
    let (rotation, position) = parts(&rigid_inverse(camera_from_world));
    let [qx, qy, qz, qw] = quaternion_from_matrix(&rotation);
    let fov = |length: usize, focal: f64| 2.0 * (length as f64 / 2.0 / focal).atan();
    let (down, across) = (fov(height, intrinsics[(1, 1)]), fov(width, intrinsics[(0, 0)]));
    [position.x, position.y, position.z, qx, qy, qz, qw, down, across]
}

/// `camera_from_world` and intrinsics of a pose encoding; the principal point is the middle of the image.
pub fn decode(code: &[f64; 9], width: usize, height: usize) -> (Matrix4<f64>, Matrix3<f64>) {
    let [x, y, z, qx, qy, qz, qw, down, across] = *code;
    let world_from_camera = compose(&matrix_from_quaternion([qx, qy, qz, qw]), &Vector3::new(x, y, z));
    let focal = |length: usize, fov: f64| length as f64 / 2.0 / (fov / 2.0).tan().max(MIN_TAN);
    let (half_width, half_height) = (width as f64 / 2.0, height as f64 / 2.0);
    let intrinsics = Matrix3::new(
        focal(width, across),
        0.0,
        half_width,
        0.0,
        focal(height, down),
        half_height,
        0.0,
        0.0,
        1.0,
    );
    (rigid_inverse(&world_from_camera), intrinsics)
}

/// Intrinsics with the origin at the edge of the top-left pixel, from `VIDAR`'s (its centre): half a pixel more.
pub fn to_edge(intrinsics: &Pinhole) -> Matrix3<f64> {
    let mut matrix = intrinsics.matrix();
    matrix[(0, 2)] += 0.5;
    matrix[(1, 2)] += 0.5;
    matrix
}

/// `VIDAR`'s intrinsics (origin at the centre of the top-left pixel) from those with the origin at its edge; `None`
/// when focal lengths are not positive and finite. Skew is dropped.
pub fn from_edge(matrix: &Matrix3<f64>, width: usize, height: usize) -> Option<Pinhole> {
    let (cx, cy) = (matrix[(0, 2)] - 0.5, matrix[(1, 2)] - 0.5);
    Pinhole::new(matrix[(0, 0)], matrix[(1, 1)], cx, cy, width, height).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_edge_convention_and_back_is_half_a_pixel() {
        let pinhole = Pinhole::new(500.0, 510.0, 319.5, 239.5, 640, 480).unwrap();
        let edge = to_edge(&pinhole);
        assert_eq!((edge[(0, 2)], edge[(1, 2)]), (320.0, 240.0));
        assert_eq!(from_edge(&edge, 640, 480).unwrap(), pinhole);
        // Halved with the origin at the edge and halved as VIDAR does it: the same camera.
        let mut half = edge;
        half.row_mut(0).scale_mut(0.5);
        half.row_mut(1).scale_mut(0.5);
        assert_eq!(from_edge(&half, 320, 240).unwrap(), pinhole.resized(320, 240).unwrap());
    }

    #[test]
    fn a_pose_code_is_read_back() {
        let rotation = nalgebra::Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
        let camera_from_world = compose(&rotation, &Vector3::new(1.0, -2.0, 0.5));
        let intrinsics = Matrix3::new(400.0, 0.0, 252.0, 0.0, 410.0, 189.0, 0.0, 0.0, 1.0);
        let code = encode(&camera_from_world, &intrinsics, 504, 378);
        let (back, k) = decode(&code, 504, 378);
        assert!((back - camera_from_world).norm() < 1e-12);
        assert!((k - intrinsics).norm() < 1e-9);
    }

    #[test]
    fn an_angle_of_view_of_nothing_gives_the_longest_focal_length_allowed() {
        let (_, k) = decode(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 56, 42);
        assert_eq!(k[(1, 1)], 21.0 / MIN_TAN);
    }

    #[test]
    fn two_views_are_divided_by_the_least_median() {
        let at = |x: f64| compose(&Matrix3::identity(), &Vector3::new(-x, 0.0, 0.0));
        let moved = normalise_world(&[at(1.0), at(3.0)]);
        assert!((centre(&moved[1]).x - 20.0).abs() < 1e-12);
        let moved = normalise_world(&[at(0.0), at(2.0), at(4.0)]);
        assert!((centre(&moved[2]).x - 2.0).abs() < 1e-12, "the middle camera is at distance one");
    }
}
