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
    // The same rectangle of rays.
    let at_width =
        |view: &Pinhole| view.resized(camera.width, (view.height * camera.width).div_ceil(view.width));
    let first = views.first().map(|view| at_width(&view.intrinsics)).transpose()?;
    let shared = first.map(|view| RemapTable::new(&model, &view));
    views.par_iter_mut().try_for_each(|view| {
        let Some(Some(source)) = sources.get(&view.frame_id.0) else {
            return Err(refuse(format!("frame {} has no image file: {needs}", view.frame_id)));
        };
        let image = read_image(source, &ImageLimits::default())?;
        if (image.width(), image.height()) != (camera.width, camera.height) {
            let found = format!("{} is {}x{} pixels", source.display(), image.width(), image.height());
            return Err(refuse(format!("{found}, the run's camera has {}x{}", camera.width, camera.height)));
        }
        // All views have the first one's intrinsics, unless a prediction brought its own.
        view.intrinsics = at_width(&view.intrinsics)?;
        let undistorted = match &shared {
            Some(table) if *table.target() == view.intrinsics => table.apply(&image),
            _ => RemapTable::new(&model, &view.intrinsics).apply(&image),
        };
        let path = images.join(&view.image_name);
        let png = vidar_view::encode_png(&undistorted.to_rgb8())?;
        Ok(vidar_export::atomic::write_file_atomically(&path, &png)?)
    })
}
