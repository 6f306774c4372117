//! The mesh with the pixels of the keyframes' images as its texture.

use super::at_input::AtInputSize;
use super::{ExportOptions, StoredViews, pose_of};
use crate::error::Error;
use crate::run_folder::StoredView;
use crate::system::{MAX_CLOUD_BYTES, read_up_to};
use std::path::{Path, PathBuf};
use vidar_core::Image;
use vidar_dataset::decode::read_image;
use vidar_fusion::{TextureCamera, TextureConfig, TextureImage, texture_mesh};

/// Name of the file.
const NAME: &str = "textured.glb";

/// Writes `textured.glb` into `out`.
pub(super) fn glb(
    run: &Path,
    stored: &StoredViews,
    options: ExportOptions,
    out: &Path,
) -> Result<PathBuf, Error> {
    let refuse = |reason: &str| Error::NotARun { path: run.to_owned(), reason: reason.to_owned() };
    let path = run.join("map/mesh.ply");
    let bytes = read_up_to(&path, MAX_CLOUD_BYTES).map_err(|e| Error::io("read", &path, e))?;
    let mut ply = vidar_export::read_ply(&bytes)?;
    // Frame and unit among them.
    let mut comments = std::mem::take(&mut ply.comments);
    let mesh = ply.into_mesh();
    drop(bytes);
    let mut views: Vec<View<'_>> = stored.views.iter().filter_map(View::new).collect();
    if views.is_empty() {
        return Err(refuse("it holds no images; run again with output.images = true"));
    }
    let at_input = options.input_size.then(|| AtInputSize::new(run, stored)).transpose()?;
    if let Some(at_input) = &at_input {
        for view in &mut views {
            view.camera.intrinsics = at_input.intrinsics(&view.camera.intrinsics)?;
        }
    }
    let units_per_metre = super::depth_units(run)?;
    let cameras: Vec<TextureCamera> = views.iter().map(|v| v.camera.clone()).collect();
    let image = |at: usize| {
        let view = &views[at];
        let color = match &at_input {
            Some(at_input) => at_input.image(view.stored.frame, &view.camera.intrinsics)?,
            None => read_image(&run.join(view.image))?.to_rgb8(),
        };
        Ok::<_, Error>(TextureImage { color, depth: view.depth(run, units_per_metre)? })
    };
    let config = TextureConfig { max_px: options.texture_px.unwrap_or(TextureConfig::default().max_px) };
    let (textured, report) = texture_mesh(&mesh, &cameras, image, &config)?;
    drop(mesh);
    let target = out.join(NAME);
    comments.push(format!(
        "{} of {} triangles textured from {} images, {} charts, {:.2} texels per pixel",
        report.textured_triangles,
        report.triangles,
        cameras.len(),
        report.charts,
        report.scale
    ));
    vidar_export::atomic::write_atomically(&target, |w| {
        vidar_export::write_glb_textured(w, &textured, &comments)
    })?;
    Ok(target)
}

/// A keyframe that has an image and a pose.
struct View<'a> {
    stored: &'a StoredView,
    image: &'a str,
    camera: TextureCamera,
}

impl<'a> View<'a> {
    fn new(stored: &'a StoredView) -> Option<Self> {
        let camera = TextureCamera { world_from_camera: pose_of(stored)?, intrinsics: stored.intrinsics };
        Some(Self { stored, image: stored.image.as_deref()?, camera })
    }

    /// Its depth, metres, where the run kept it.
    fn depth(&self, run: &Path, units_per_metre: Option<f64>) -> Result<Option<Image<f32>>, Error> {
        let (Some(file), Some(units)) = (&self.stored.depth, units_per_metre) else { return Ok(None) };
        let path = run.join(file);
        let png = read_up_to(&path, MAX_CLOUD_BYTES).map_err(|e| Error::io("read", &path, e))?;
        Ok(Some(vidar_export::read_depth_png(&png, units)?.image().clone()))
    }
}
