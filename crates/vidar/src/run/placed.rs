//! A predicted view in metres and in the world.

use crate::error::Error;
use vidar_align::AlignError;
use vidar_align::aligner::ViewPlacement;
use vidar_core::{AlignedView, FrameImage, Image, RelativeDepth, Timestamp, ViewGeometry};

/// The view where the alignment puts it, its depth in metres and corrected where landmarks support it.
pub(super) fn placed_view(
    view: ViewGeometry,
    time: Timestamp,
    place: &ViewPlacement,
    color: Option<Image<[u8; 3]>>,
) -> Result<AlignedView, Error> {
    let depth = match &place.field {
        Some(field) => RelativeDepth::new(field.apply(view.depth.image())),
        None => view.depth,
    };
    let geometry = |source| AlignError::Geometry { chunk: place.owner, source };
    let metres = depth.to_metric(place.metres_per_unit).map_err(geometry)?;
    let pose = place.world_from_camera;
    let placed = AlignedView::new(view.frame_id, time, pose, view.intrinsics, metres, view.confidence)
        .map_err(geometry)?;
    Ok(match color {
        Some(color) => placed.with_color(color).map_err(geometry)?,
        None => placed,
    })
}

/// The image's colours at the depth's size: bilinear, pixel centres kept (`c' = (c + 0.5)·s − 0.5`).
pub(super) fn color_at_size(image: &FrameImage, width: usize, height: usize) -> Image<[u8; 3]> {
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
