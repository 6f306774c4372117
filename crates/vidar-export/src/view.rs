//! Frames as exported to COLMAP and nerfstudio, and as read from them.

use crate::error::ExportError;
use std::collections::BTreeSet;
use vidar_core::{FrameId, Pinhole, Se3, Timestamp};

/// An image with its pose and its pinhole camera, as radiance-field tools require.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportView {
    /// Which frame.
    pub frame_id: FrameId,
    /// When it was taken.
    pub time: Timestamp,
    /// The image's path, relative to what the format calls the image folder; `/` between folders.
    pub image_name: String,
    /// Maps camera coordinates (x right, y down, z forward) to the world (z up), metres.
    pub world_from_camera: Se3,
    /// Intrinsics of the undistorted image, top-left pixel centre at (0, 0).
    pub intrinsics: Pinhole,
}

/// A view of another program's model; data that the format lacks is `None`.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedView {
    /// Which frame, if the file has it.
    pub frame_id: Option<FrameId>,
    /// When it was taken, if the file has it (COLMAP files never do).
    pub time: Option<Timestamp>,
    /// The image's path as written in the file.
    pub image_name: String,
    /// Maps camera coordinates (x right, y down, z forward) to the file's world.
    pub world_from_camera: Se3,
    /// Intrinsics, top-left pixel centre at (0, 0).
    pub intrinsics: Pinhole,
}

/// Half a pixel: COLMAP and nerfstudio put the centre of the top-left pixel at (0.5, 0.5), VIDAR at (0, 0).
const HALF_PIXEL: f64 = 0.5;

/// A principal point in COLMAP's and nerfstudio's pixel convention.
pub(crate) fn corner_origin_principal_point(intrinsics: &Pinhole) -> (f64, f64) {
    (corner_origin(intrinsics.cx), corner_origin(intrinsics.cy))
}

/// A pixel coordinate in that convention.
pub(crate) fn corner_origin(coordinate: f64) -> f64 {
    coordinate + HALF_PIXEL
}

/// Intrinsics from a file that counts pixels from the corner of the image.
pub(crate) fn pinhole_from_corner_origin(
    focal: (f64, f64),
    principal_point: (f64, f64),
    size: (usize, usize),
) -> Result<Pinhole, vidar_core::CameraError> {
    let (cx, cy) = (principal_point.0 - HALF_PIXEL, principal_point.1 - HALF_PIXEL);
    Pinhole::new(focal.0, focal.1, cx, cy, size.0, size.1)
}

/// Checks the requirements of every format: finite poses, valid intrinsics, unique non-empty names.
pub(crate) fn check_views(format: &'static str, views: &[ExportView]) -> Result<(), ExportError> {
    let mut names = BTreeSet::new();
    let mut frames = BTreeSet::new();
    for view in views {
        let what = || format!("frame {} ({})", view.frame_id, crate::error::quoted(&view.image_name));
        if !view.world_from_camera.is_finite() {
            return Err(ExportError::unwritable(format, what(), "its pose is not finite"));
        }
        let k = &view.intrinsics;
        if let Err(error) = Pinhole::new(k.fx, k.fy, k.cx, k.cy, k.width, k.height) {
            return Err(ExportError::unwritable(format, what(), error.to_string()));
        }
        if view.image_name.is_empty() || view.image_name.chars().any(char::is_control) {
            return Err(ExportError::unwritable(format, what(), "an image name must be printable text"));
        }
        if !names.insert(view.image_name.as_str()) || !frames.insert(view.frame_id) {
            return Err(ExportError::unwritable(
                format,
                what(),
                "its frame number or image name occurs twice",
            ));
        }
    }
    Ok(())
}
