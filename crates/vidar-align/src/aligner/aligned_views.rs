//! Metric views of a chunk, by a placement.

use super::Placement;
use crate::AlignError;
use vidar_core::{AlignedView, ChunkView, FrameImage, GeometryError, GeometryPrediction, Image, MetricDepth};

impl Placement {
    /// The views of a prediction that its chunk owns, in metres and in the world, coloured from their images.
    ///
    /// Views that belong to a later chunk, and all views of a chunk that is left out, are not among them: over a run each
    /// frame comes once. Depth is multiplied by the view's scale and by its field, where it has one.
    ///
    /// # Errors
    /// [`AlignError::Geometry`] when depth, confidence and intrinsics differ in size.
    pub fn aligned_views(
        &self,
        prediction: GeometryPrediction,
        images: &[ChunkView],
    ) -> Result<Vec<AlignedView>, AlignError> {
        let chunk = prediction.chunk_id;
        let geometry = |source| AlignError::Geometry { chunk, source };
        let mut aligned = Vec::new();
        for view in prediction.views {
            let Some(place) = self.view(view.frame_id).filter(|p| p.owner == chunk) else { continue };
            let metric = view.depth.to_metric(place.metres_per_unit).map_err(geometry)?;
            let depth = match &place.field {
                Some(field) => MetricDepth::new(field.apply(metric.image())),
                None => metric,
            };
            let image = images.iter().find(|v| v.frame_id == view.frame_id);
            let time = image.map_or_else(Default::default, |v| v.time);
            let placed = AlignedView::new(
                view.frame_id,
                time,
                place.world_from_camera,
                view.intrinsics,
                depth,
                view.confidence,
            );
            aligned.push(colored(placed.map_err(geometry)?, image).map_err(geometry)?);
        }
        Ok(aligned)
    }
}

/// The same view with the colours of its image, if there is one.
fn colored(view: AlignedView, image: Option<&ChunkView>) -> Result<AlignedView, GeometryError> {
    let Some(image) = image else { return Ok(view) };
    let color = color_at_size(&image.image, view.intrinsics().width, view.intrinsics().height);
    view.with_color(color)
}

/// The image's colours at the depth's size: bilinear, pixel centres kept (`c' = (c + 0.5)·s − 0.5`).
pub fn color_at_size(image: &FrameImage, width: usize, height: usize) -> Image<[u8; 3]> {
    let color = image.to_rgb8();
    let (w, h) = (color.width(), color.height());
    if (w, h) == (width, height) || w == 0 || h == 0 {
        return color;
    }
    let (sx, sy) = (w as f32 / width as f32, h as f32 / height as f32);
    let source = |c: usize, s: f32, n: usize| ((c as f32 + 0.5) * s - 0.5).clamp(0.0, (n - 1) as f32);
    Image::from_fn(width, height, |x, y| {
        let (fx, fy) = (source(x, sx, w), source(y, sy, h));
        let (x0, y0) = (fx as usize, fy as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (ax, ay) = (fx - x0 as f32, fy - y0 as f32);
        std::array::from_fn(|c| {
            let at = |x: usize, y: usize| f32::from(color[(x, y)][c]);
            let top = at(x0, y0) + ax * (at(x1, y0) - at(x0, y0));
            let bottom = at(x0, y1) + ax * (at(x1, y1) - at(x0, y1));
            (top + ay * (bottom - top)).round() as u8
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_resampled_to_the_size_of_the_depth() {
        let ramp = Image::from_fn(8, 6, |x, _| (x * 20) as u8);
        let small = color_at_size(&FrameImage::Gray8(ramp), 4, 3);
        // Pixel 1 of 4 has its centre at (1.5 · 2) − 0.5 = 2.5 of 8.
        assert_eq!(small[(1, 1)], [50, 50, 50]);
        assert_eq!((small.width(), small.height()), (4, 3));
    }
}
