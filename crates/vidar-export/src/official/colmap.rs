//! A COLMAP model as the official program exports it.
//!
//! One PINHOLE camera, one rig, one frame and one image per view, at the size of the original image: rows of the camera
//! matrix are scaled by the sizes' ratio. Points are pixels whose confidence reaches a percentile; each is observed in one image,
//! at its pixel scaled and truncated to an integer. The matrix is not changed: the network's principal point counts from
//! the image's corner, as COLMAP's does. `rigs.bin` and `frames.bin` are those of COLMAP 3.12 and later; older versions
//! ignore them.

use super::{Prediction, confidence_percentile, is_point};
use crate::atomic::write_atomically;
use crate::error::{ExportError, write_error};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use std::fs;
use std::io::{self, Write};
use std::path::Path;

const FORMAT: &str = "COLMAP model";
const PINHOLE: i32 = 1;
/// COLMAP's number of the sensor type "camera".
const CAMERA: i32 = 0;

/// Name and size of the image of a view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OriginalImage {
    /// Path relative to COLMAP's image folder.
    pub name: String,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

struct Observation {
    view: usize,
    /// Index among the observations of its view.
    index: u32,
    at: [f64; 2],
    point: [f64; 3],
    color: [u8; 3],
}

/// Writes the model into `dir`; pixels below the `percentile` of confidence are not used as points.
pub fn write_official_colmap(
    dir: &Path,
    prediction: &Prediction,
    originals: &[OriginalImage],
    percentile: f64,
) -> Result<usize, ExportError> {
    prediction.check(FORMAT)?;
    check_originals(prediction, originals)?;
    let views = views(prediction, originals)?;
    let observations = observations(prediction, originals, percentile)?;
    fs::create_dir_all(dir).map_err(|source| ExportError::File {
        action: "create",
        path: dir.to_path_buf(),
        source,
    })?;
    let write = |name: &str, f: &dyn Fn(&mut dyn Write) -> io::Result<()>| {
        write_atomically(&dir.join(name), |w| f(w).map_err(write_error(FORMAT)))
    };
    write("cameras.bin", &|w| write_cameras(w, &views))?;
    write("rigs.bin", &|w| write_rigs(w, views.len()))?;
    write("frames.bin", &|w| write_frames(w, &views))?;
    write("images.bin", &|w| write_images(w, &views, &observations))?;
    write("points3D.bin", &|w| write_points(w, &observations))?;
    Ok(observations.len())
}

fn check_originals(prediction: &Prediction, originals: &[OriginalImage]) -> Result<(), ExportError> {
    if originals.len() != prediction.views.len() {
        let reason = format!("{} original images", originals.len());
        return Err(ExportError::unwritable(FORMAT, format!("{} views", prediction.views.len()), reason));
    }
    for (i, original) in originals.iter().enumerate() {
        let bad_name = original.name.is_empty() || original.name.chars().any(char::is_control);
        if bad_name || original.width == 0 || original.height == 0 {
            let reason = format!("{:?} is {}x{}", original.name, original.width, original.height);
            return Err(ExportError::unwritable(FORMAT, format!("view {i}"), reason));
        }
    }
    Ok(())
}

struct ColmapView<'a> {
    original: &'a OriginalImage,
    /// fx, fy, cx, cy.
    parameters: [f64; 4],
    /// w, x, y, z, then the translation.
    camera_from_world: [f64; 7],
}

fn views<'a>(
    prediction: &Prediction,
    originals: &'a [OriginalImage],
) -> Result<Vec<ColmapView<'a>>, ExportError> {
    let (width, height) = prediction.size();
    let cameras = prediction.cameras(FORMAT)?;
    let view = |(camera, original): (&super::numbers::Camera, &'a OriginalImage)| {
        let (sx, sy) = (original.width as f64 / width as f64, original.height as f64 / height as f64);
        let rotation: Matrix3<f64> = camera.camera_from_world.fixed_view::<3, 3>(0, 0).into_owned();
        // The network's rotation is orthonormal to 32 bits only; the nearest rotation is stored as quaternion.
        let rotation = Rotation3::from_matrix_eps(&rotation, 1e-12, 100, Rotation3::identity());
        let q = UnitQuaternion::from_rotation_matrix(&rotation);
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        let m = &camera.camera_from_world;
        ColmapView {
            original,
            parameters: [
                camera.k[(0, 0)] * sx,
                camera.k[(1, 1)] * sy,
                camera.k[(0, 2)] * sx,
                camera.k[(1, 2)] * sy,
            ],
            camera_from_world: [
                q.w * sign,
                q.i * sign,
                q.j * sign,
                q.k * sign,
                m[(0, 3)],
                m[(1, 3)],
                m[(2, 3)],
            ],
        }
    };
    Ok(cameras.iter().zip(originals).map(view).collect())
}

fn observations(
    prediction: &Prediction,
    originals: &[OriginalImage],
    percentile: f64,
) -> Result<Vec<Observation>, ExportError> {
    let least = confidence_percentile(prediction, &[percentile])[0];
    let (width, height) = prediction.size();
    let mut observations = Vec::new();
    let cameras = prediction.cameras(FORMAT)?;
    for (v, ((view, camera), original)) in prediction.views.iter().zip(&cameras).zip(originals).enumerate() {
        let (sx, sy) = (original.width as f64 / width as f64, original.height as f64 / height as f64);
        let mut index = 0;
        for y in 0..height {
            for x in 0..width {
                if !is_point(view, x, y, least) {
                    continue;
                }
                let point = camera.point(x as f64, y as f64, f64::from(view.depth[(x, y)]));
                if !point.iter().all(|v| v.is_finite()) {
                    continue;
                }
                let at = [(x as f64 * sx).trunc(), (y as f64 * sy).trunc()];
                let color = view.image.as_ref().map_or([128; 3], |image| image[(x, y)]);
                // 32 bits, as the official program keeps its points.
                let point = point.map(|v| f64::from(v as f32)).into();
                observations.push(Observation { view: v, index, at, point, color });
                index += 1;
            }
        }
    }
    Ok(observations)
}

fn reals(w: &mut dyn Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))
}

fn id(index: usize) -> [u8; 4] {
    // More than four billion views do not fit a machine.
    (index as u32 + 1).to_le_bytes()
}

fn write_cameras(w: &mut dyn Write, views: &[ColmapView<'_>]) -> io::Result<()> {
    w.write_all(&(views.len() as u64).to_le_bytes())?;
    for (i, view) in views.iter().enumerate() {
        w.write_all(&id(i))?;
        w.write_all(&PINHOLE.to_le_bytes())?;
        w.write_all(&(view.original.width as u64).to_le_bytes())?;
        w.write_all(&(view.original.height as u64).to_le_bytes())?;
        reals(w, &view.parameters)?;
    }
    Ok(())
}

fn write_rigs(w: &mut dyn Write, count: usize) -> io::Result<()> {
    w.write_all(&(count as u64).to_le_bytes())?;
    for i in 0..count {
        w.write_all(&id(i))?;
        // One sensor, the reference.
        w.write_all(&1_u32.to_le_bytes())?;
        w.write_all(&CAMERA.to_le_bytes())?;
        w.write_all(&id(i))?;
    }
    Ok(())
}

fn write_frames(w: &mut dyn Write, views: &[ColmapView<'_>]) -> io::Result<()> {
    w.write_all(&(views.len() as u64).to_le_bytes())?;
    for (i, view) in views.iter().enumerate() {
        w.write_all(&id(i))?;
        w.write_all(&id(i))?;
        reals(w, &view.camera_from_world)?;
        // One image.
        w.write_all(&1_u32.to_le_bytes())?;
        w.write_all(&CAMERA.to_le_bytes())?;
        w.write_all(&id(i))?;
        w.write_all(&(i as u64 + 1).to_le_bytes())?;
    }
    Ok(())
}

fn write_images(w: &mut dyn Write, views: &[ColmapView<'_>], observations: &[Observation]) -> io::Result<()> {
    w.write_all(&(views.len() as u64).to_le_bytes())?;
    let mut rest = observations.iter().enumerate().peekable();
    for (i, view) in views.iter().enumerate() {
        w.write_all(&id(i))?;
        reals(w, &view.camera_from_world)?;
        w.write_all(&id(i))?;
        w.write_all(view.original.name.as_bytes())?;
        w.write_all(&[0])?;
        let count = observations.iter().filter(|o| o.view == i).count();
        w.write_all(&(count as u64).to_le_bytes())?;
        while let Some((number, observation)) = rest.next_if(|(_, o)| o.view == i) {
            reals(w, &observation.at)?;
            w.write_all(&(number as u64 + 1).to_le_bytes())?;
        }
    }
    Ok(())
}

fn write_points(w: &mut dyn Write, observations: &[Observation]) -> io::Result<()> {
    w.write_all(&(observations.len() as u64).to_le_bytes())?;
    for (number, observation) in observations.iter().enumerate() {
        w.write_all(&(number as u64 + 1).to_le_bytes())?;
        reals(w, &observation.point)?;
        w.write_all(&observation.color)?;
        // The error is not computed; the track has one entry.
        reals(w, &[-1.0])?;
        w.write_all(&1_u64.to_le_bytes())?;
        w.write_all(&id(observation.view))?;
        w.write_all(&observation.index.to_le_bytes())?;
    }
    Ok(())
}
