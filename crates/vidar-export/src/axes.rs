//! Conversion between VIDAR's and OpenGL's axes; the only place where it is done.
//!
//! VIDAR: world z up; camera x right, y down, z forward (OpenCV). glTF: world y up. nerfstudio: world z up as here,
//! camera x right, y up, z back.

use nalgebra::{Matrix3, Matrix4};

/// `y_up_from_z_up`: (x, y, z) ↦ (x, z, −y), a rotation by −90° about x; entries 0 and ±1, so nothing rounds.
pub(crate) fn y_up_from_z_up() -> Matrix3<f64> {
    Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)
}

/// Turns `world_from_camera` of one camera convention (OpenCV, OpenGL) into the other's: y and z of the camera
/// change sign. It is its own inverse and exact.
pub(crate) fn opencv_to_opengl_camera(mut world_from_camera: Matrix4<f64>) -> Matrix4<f64> {
    for column in [1, 2] {
        for row in 0..3 {
            world_from_camera[(row, column)] = -world_from_camera[(row, column)];
        }
    }
    world_from_camera
}
