//! COLMAP sparse models: `cameras`, `images`, `points3D`, as text or binary.
//!
//! - Camera model PINHOLE; equal intrinsics share one camera. Pixels count from the image's corner, so 0.5 is added to
//!   the principal point on export and subtracted on import.
//! - `images` hold `camera_from_world` (quaternion w x y z, translation), metres. `IMAGE_ID` is the frame number + 1,
//!   because COLMAP's own numbers start at 1. The format has no times.
//! - `points3D` hold position and colour; without a colour mid grey is written. The error is −1 ("not computed"). Tracks are
//!   empty unless [`Observation`]s are given. The format has no normals and no confidence.
//! - The world is not re-centred, rotated or rescaled: the model is metric, z up.
//! - NaN is refused in both directions.
//!
//! Read: PINHOLE and SIMPLE_PINHOLE; other models are refused by name, because views have no distortion.
//! Observations and tracks are checked for shape and skipped.

mod binary;
mod text;

use crate::atomic::write_atomically;
use crate::error::ExportError;
use crate::vertices::Vertices;
use crate::view::{
    ExportView, ImportedView, check_views, corner_origin, corner_origin_principal_point,
    pinhole_from_corner_origin,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use vidar_core::{FrameId, LieGroup, PointCloud, Se3, So3};

const FORMAT: &str = "COLMAP model";
const CAMERAS: &str = "COLMAP cameras";
const IMAGES: &str = "COLMAP images";
const POINTS: &str = "COLMAP points3D";

/// COLMAP packs two image ids into one number; larger ids break its databases.
const MAX_IMAGE_ID: u32 = 2_147_483_646;
/// Colour of points without one.
const NO_COLOR: [u8; 3] = [128; 3];

/// How a COLMAP model is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColmapFormat {
    /// `cameras.txt`, `images.txt`, `points3D.txt`.
    Text,
    /// `cameras.bin`, `images.bin`, `points3D.bin`.
    Binary,
}

impl ColmapFormat {
    fn extension(self) -> &'static str {
        match self {
            Self::Text => "txt",
            Self::Binary => "bin",
        }
    }
}

/// The supported part of a COLMAP model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColmapModel {
    /// The posed images, in the order of the file; `frame_id` is `IMAGE_ID` − 1.
    pub views: Vec<ImportedView>,
    /// The points with their colours.
    pub points: PointCloud,
}

/// One point seen in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// The point, an index into the cloud.
    pub point: u32,
    /// The image, an index into the views.
    pub view: u32,
    /// Where it is seen; the centre of the top-left pixel is (0, 0).
    pub pixel: [f64; 2],
}

/// A line of `cameras`; principal point in COLMAP's pixels.
#[derive(Clone, Debug, PartialEq)]
struct RawCamera {
    id: u32,
    width: u64,
    height: u64,
    focal: (f64, f64),
    principal_point: (f64, f64),
}

/// A line of `images`.
#[derive(Clone, Debug, PartialEq)]
struct RawImage {
    id: u32,
    /// `camera_from_world`, w x y z.
    rotation_wxyz: [f64; 4],
    /// `camera_from_world`, metres.
    translation: [f64; 3],
    camera_id: u32,
    name: String,
    /// Pixels in COLMAP's convention, each with the id of its point.
    observations: Vec<([f64; 2], u64)>,
}

/// Track of a point: images by id, with the place in the image's list of observations.
type TrackEntries = Vec<(u32, u32)>;

/// Writes a model into `dir` (made if missing), each file atomically. Without `observations` tracks are empty.
///
/// A text model cannot hold image names with blanks; a binary one can.
///
/// # Errors
/// Views or points that the format cannot hold, an observation of a point or view that is not there, and files that cannot be
/// written.
pub fn write_colmap(
    dir: &Path,
    format: ColmapFormat,
    views: &[ExportView],
    points: &PointCloud,
    observations: &[Observation],
) -> Result<(), ExportError> {
    let (cameras, mut images) = raw_model(format, views)?;
    Vertices::of_cloud(points).check(POINTS)?;
    let tracks = tracks(&mut images, points.len(), observations)?;
    fs::create_dir_all(dir).map_err(|source| file_error("create", dir, source))?;
    let path = |name: &str| dir.join(format!("{name}.{}", format.extension()));
    match format {
        ColmapFormat::Text => {
            write_atomically(&path("cameras"), |w| text::write_cameras(w, &cameras))?;
            write_atomically(&path("images"), |w| text::write_images(w, &images))?;
            write_atomically(&path("points3D"), |w| text::write_points(w, points, &tracks))
        }
        ColmapFormat::Binary => {
            write_atomically(&path("cameras"), |w| binary::write_cameras(w, &cameras))?;
            write_atomically(&path("images"), |w| binary::write_images(w, &images))?;
            write_atomically(&path("points3D"), |w| binary::write_points(w, points, &tracks))
        }
    }
}

/// Reads the model in `dir`; a binary one is preferred when both are there, as COLMAP does.
pub fn read_colmap(dir: &Path) -> Result<ColmapModel, ExportError> {
    let format = if dir.join("cameras.bin").exists() { ColmapFormat::Binary } else { ColmapFormat::Text };
    let read = |name: &str| {
        let path = dir.join(format!("{name}.{}", format.extension()));
        fs::read(&path).map_err(|source| file_error("read", &path, source))
    };
    read_colmap_bytes(format, &read("cameras")?, &read("images")?, &read("points3D")?)
}

/// Reads a model from the bytes of its three files.
pub fn read_colmap_bytes(
    format: ColmapFormat,
    cameras: &[u8],
    images: &[u8],
    points: &[u8],
) -> Result<ColmapModel, ExportError> {
    let (cameras, images, points) = match format {
        ColmapFormat::Text => {
            (text::read_cameras(cameras)?, text::read_images(images)?, text::read_points(points)?)
        }
        ColmapFormat::Binary => {
            (binary::read_cameras(cameras)?, binary::read_images(images)?, binary::read_points(points)?)
        }
    };
    Ok(ColmapModel { views: views(cameras, images)?, points })
}

fn file_error(action: &'static str, path: &Path, source: std::io::Error) -> ExportError {
    ExportError::File { action, path: path.to_path_buf(), source }
}

fn raw_model(
    format: ColmapFormat,
    views: &[ExportView],
) -> Result<(Vec<RawCamera>, Vec<RawImage>), ExportError> {
    check_views(FORMAT, views)?;
    let mut cameras: Vec<RawCamera> = Vec::new();
    let mut known = BTreeMap::new();
    let mut images = Vec::with_capacity(views.len());
    for view in views {
        let k = &view.intrinsics;
        let what = || format!("frame {}", view.frame_id);
        if format == ColmapFormat::Text && view.image_name.chars().any(char::is_whitespace) {
            let reason = format!("the image name {:?} has a blank; use the binary format", view.image_name);
            return Err(ExportError::unwritable("COLMAP text model", what(), reason));
        }
        if view.frame_id.0 >= MAX_IMAGE_ID {
            return Err(ExportError::unwritable(FORMAT, what(), format!("image ids end at {MAX_IMAGE_ID}")));
        }
        let key = ([k.fx, k.fy, k.cx, k.cy].map(f64::to_bits), k.width, k.height);
        let camera_id = *known.entry(key).or_insert_with(|| {
            // Fewer cameras than views, and those fit 31 bits.
            let id = cameras.len() as u32 + 1;
            let principal_point = corner_origin_principal_point(k);
            let (width, height) = (k.width as u64, k.height as u64);
            cameras.push(RawCamera { id, width, height, focal: (k.fx, k.fy), principal_point });
            id
        });
        let camera_from_world = view.world_from_camera.inverse();
        let [x, y, z, w] = camera_from_world.rotation.quaternion_xyzw();
        images.push(RawImage {
            id: view.frame_id.0 + 1,
            rotation_wxyz: [w, x, y, z],
            translation: camera_from_world.translation.into(),
            camera_id,
            name: view.image_name.clone(),
            observations: Vec::new(),
        });
    }
    Ok((cameras, images))
}

/// Gives every image its observations; the track of every point.
fn tracks(
    images: &mut [RawImage],
    points: usize,
    observations: &[Observation],
) -> Result<Vec<TrackEntries>, ExportError> {
    let mut tracks = vec![TrackEntries::new(); points];
    for observation in observations {
        let Observation { point, view, pixel } = *observation;
        let (Some(track), Some(image)) = (tracks.get_mut(point as usize), images.get_mut(view as usize))
        else {
            let what = format!("point {point} in view {view}");
            return Err(ExportError::unwritable(FORMAT, what, "there is no such point or view"));
        };
        if !pixel.iter().all(|c| c.is_finite()) {
            let what = format!("point {point} in view {view}");
            return Err(ExportError::unwritable(FORMAT, what, "its pixel is not finite"));
        }
        // Fewer observations in an image than points in the cloud, which are numbered by 32 bits.
        track.push((image.id, image.observations.len() as u32));
        image.observations.push((pixel.map(corner_origin), u64::from(point) + 1));
    }
    Ok(tracks)
}

fn views(cameras: Vec<RawCamera>, images: Vec<RawImage>) -> Result<Vec<ImportedView>, ExportError> {
    let mut intrinsics = BTreeMap::new();
    for camera in cameras {
        let place = format!("camera {}", camera.id);
        let bad =
            |expected: &str, found: String| ExportError::malformed(CAMERAS, place.clone(), expected, found);
        let (Ok(width), Ok(height)) = (usize::try_from(camera.width), usize::try_from(camera.height)) else {
            return Err(bad("an image size", format!("{}x{}", camera.width, camera.height)));
        };
        let pinhole = pinhole_from_corner_origin(camera.focal, camera.principal_point, (width, height))
            .map_err(|error| bad("a pinhole camera", error.to_string()))?;
        if intrinsics.insert(camera.id, pinhole).is_some() {
            return Err(bad("camera ids that differ", "the same twice".to_owned()));
        }
    }
    images
        .into_iter()
        .map(|image| {
            let bad = |expected: &str, found: String| {
                ExportError::malformed(IMAGES, format!("image {}", image.id), expected, found)
            };
            let [w, x, y, z] = image.rotation_wxyz;
            // COLMAP normalises what it reads, so any length is good but none at all.
            let rotation = So3::from_quaternion(x, y, z, w)
                .ok_or_else(|| bad("a quaternion with a direction", format!("{:?}", image.rotation_wxyz)))?;
            let Some(pinhole) = intrinsics.get(&image.camera_id) else {
                return Err(bad("a camera of the model", format!("camera {}", image.camera_id)));
            };
            Ok(ImportedView {
                frame_id: image.id.checked_sub(1).map(FrameId),
                time: None,
                world_from_camera: Se3::new(rotation, Vector3::from(image.translation)).inverse(),
                intrinsics: *pinhole,
                image_name: image.name,
            })
        })
        .collect()
}

fn color_of(points: &PointCloud, index: usize) -> [u8; 3] {
    points.colors.get(index).copied().unwrap_or(NO_COLOR)
}

/// The error of a camera model with distortion.
fn unsupported_model(place: String, model: &str) -> ExportError {
    ExportError::Unsupported {
        format: CAMERAS,
        place,
        feature: format!("camera model {model}"),
        hint: "undistort the model first (colmap image_undistorter), so that it is PINHOLE",
    }
}
