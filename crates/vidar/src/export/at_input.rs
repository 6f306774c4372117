//! Keyframes undistorted again from the recording's images, at their size. A run keeps them at the size that the geometry model
//! gets, which radiance fields and meshing programs find too small.

use super::{ExportView, StoredViews};
use crate::error::Error;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_core::remap::RemapTable;
use vidar_core::{CameraModel, Image, Pinhole};
use vidar_dataset::decode::read_image;
use vidar_dataset::{CameraFlag, with_size};

const NEEDS: &str = "--input-size needs a run of this version on a recording of image files";

/// Writes the images of `views` into `images` and gives the views their intrinsics.
pub(super) fn undistort(
    run: &Path,
    stored: &StoredViews,
    views: &mut [ExportView],
    images: &Path,
) -> Result<(), Error> {
    let at_input = AtInputSize::new(run, stored)?;
    views.par_iter_mut().try_for_each(|view| {
        view.intrinsics = at_input.intrinsics(&view.intrinsics)?;
        let undistorted = at_input.image(view.frame_id.0, &view.intrinsics)?;
        let path = images.join(&view.image_name);
        let png = vidar_view::encode_png(&undistorted)?;
        Ok(vidar_export::atomic::write_file_atomically(&path, &png)?)
    })
}

/// The recording's images of a run's keyframes.
pub(super) struct AtInputSize<'a> {
    run: &'a Path,
    /// At the size of the recording's images.
    model: CameraModel,
    sources: BTreeMap<u32, &'a Option<PathBuf>>,
    /// For the intrinsics that all views have, unless a prediction brought its own.
    shared: Option<RemapTable>,
}

impl<'a> AtInputSize<'a> {
    /// Of the run in the folder `run`; fails where its camera or files are not known.
    pub fn new(run: &'a Path, stored: &'a StoredViews) -> Result<Self, Error> {
        let Some(camera) = stored.camera.as_ref() else {
            return Err(refused(run, format!("views.json has no camera: {NEEDS}")));
        };
        let flag: CameraFlag = camera.model.parse()?;
        let model = with_size(&flag.0, camera.width, camera.height)?;
        let sources = stored.views.iter().map(|v| (v.frame, &v.source)).collect();
        let mut this = Self { run, model, sources, shared: None };
        if let Some(first) = stored.views.first() {
            this.shared = Some(RemapTable::new(&this.model, &this.intrinsics(&first.intrinsics)?));
        }
        Ok(this)
    }

    /// The same rectangle of rays at the width of the recording's images.
    pub fn intrinsics(&self, view: &Pinhole) -> Result<Pinhole, Error> {
        let width = self.model.width();
        Ok(view.resized(width, (view.height * width).div_ceil(view.width))?)
    }

    /// The undistorted image of a frame with the given [`Self::intrinsics`].
    pub fn image(&self, frame: u32, intrinsics: &Pinhole) -> Result<Image<[u8; 3]>, Error> {
        let Some(Some(source)) = self.sources.get(&frame) else {
            return Err(refused(self.run, format!("frame {frame} has no image file: {NEEDS}")));
        };
        let image = read_image(source)?;
        let size = (self.model.width(), self.model.height());
        if (image.width(), image.height()) != size {
            let found = format!("{} is {}x{} pixels", source.display(), image.width(), image.height());
            let expected = format!("the run's camera has {}x{}", size.0, size.1);
            return Err(refused(self.run, format!("{found}, {expected}")));
        }
        let undistorted = match &self.shared {
            Some(table) if table.target() == intrinsics => table.apply(&image),
            _ => RemapTable::new(&self.model, intrinsics).apply(&image),
        };
        Ok(undistorted.to_rgb8())
    }
}

fn refused(run: &Path, reason: String) -> Error {
    Error::NotARun { path: run.to_owned(), reason }
}
