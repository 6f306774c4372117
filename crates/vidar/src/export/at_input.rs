//! Keyframes undistorted again from the recording's images, at their size. A run keeps them at the size that the geometry model
//! gets, which radiance fields and meshing programs find too small.

use super::{ExportView, StoredViews};
use crate::error::Error;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use vidar_core::Pinhole;
use vidar_core::remap::RemapTable;
use vidar_dataset::decode::{ImageLimits, read_image};
use vidar_dataset::{CameraFlag, with_size};

/// Writes the images of `views` into `images` and gives the views their intrinsics.
pub(super) fn undistort(
    run: &Path,
    stored: &StoredViews,
    views: &mut [ExportView],
    images: &Path,
) -> Result<(), Error> {
    let refuse = |reason: String| Error::NotARun { path: run.to_owned(), reason };
    let needs = "--input-size needs a run of this version on a recording of image files";
    let camera =
        stored.camera.as_ref().ok_or_else(|| refuse(format!("views.json has no camera: {needs}")))?;
    let model: CameraFlag = camera.model.parse()?;
    let model = with_size(&model.0, camera.width, camera.height)?;
    let sources: BTreeMap<u32, _> = stored.views.iter().map(|v| (v.frame, &v.source)).collect();
    views.par_iter_mut().try_for_each(|view| {
        let Some(Some(source)) = sources.get(&view.frame_id.0) else {
            return Err(refuse(format!("frame {} has no image file: {needs}", view.frame_id)));
        };
        let image = read_image(source, &ImageLimits::default())?;
        if (image.width(), image.height()) != (camera.width, camera.height) {
            let found = format!("{} is {}x{} pixels", source.display(), image.width(), image.height());
            return Err(refuse(format!("{found}, the run's camera has {}x{}", camera.width, camera.height)));
        }
        view.intrinsics = scaled(&view.intrinsics, camera.width)?;
        let undistorted = RemapTable::new(&model, &view.intrinsics).apply(&image);
        let path = images.join(&view.image_name);
        let png = vidar_view::encode_png(&undistorted.to_rgb8())?;
        Ok(vidar_export::atomic::write_file_atomically(&path, &png)?)
    })
}

/// The same rectangle of rays in `width` columns.
fn scaled(view: &Pinhole, width: usize) -> Result<Pinhole, Error> {
    let height = (view.height * width).div_ceil(view.width);
    let (x, y) = (width as f64 / view.width as f64, height as f64 / view.height as f64);
    // Edges stay where they are: they lie at -0.5.
    let moved = |c: f64, factor: f64| (c + 0.5) * factor - 0.5;
    Ok(Pinhole::new(view.fx * x, view.fy * y, moved(view.cx, x), moved(view.cy, y), width, height)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_field_of_view_stays() {
        let view = Pinhole::new(250.0, 251.0, 160.0, 110.0, 322, 224).unwrap();
        let large = scaled(&view, 752).unwrap();
        assert_eq!((large.width, large.height), (752, 524));
        for (from, to) in [((-0.5, -0.5), (-0.5, -0.5)), ((321.5, 223.5), (751.5, 523.5))] {
            let (a, b) = (view.ray(from.0, from.1), large.ray(to.0, to.1));
            assert!((a - b).norm() < 1e-12, "{a} {b}");
        }
    }
}
