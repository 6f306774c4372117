//! Predicted views in metres and in the world.

use crate::chunks::StoredChunk;
use crate::error::Error;
use vidar_align::aligner::ViewPlacement;
use vidar_align::{AlignError, Placement};
use vidar_core::{AlignedView, Image, RelativeDepth, Timestamp, ViewGeometry};

/// A placed view with the shape that a network gave it.
pub struct Shaped {
    /// The view.
    pub view: AlignedView,
    /// z-depth by a network, in any unit and at any size of the same view.
    pub shape: Option<Image<f32>>,
    /// What of the view is not to be used: `true` there.
    pub mask: Option<Image<bool>>,
}

/// The views that a chunk owns, in metres and in the world.
pub fn placed_views(placement: &Placement, stored: StoredChunk) -> Result<Vec<AlignedView>, Error> {
    Ok(placed_and_shaped(placement, stored)?.into_iter().map(|s| s.view).collect())
}

/// As [`placed_views`], with their shapes.
pub fn placed_and_shaped(placement: &Placement, stored: StoredChunk) -> Result<Vec<Shaped>, Error> {
    let id = stored.prediction.chunk_id;
    let mut colors = stored.colors.into_iter();
    let mut shapes = stored.shapes.into_iter();
    let mut masks = stored.masks.into_iter();
    let mut views = Vec::new();
    for (view, time) in stored.prediction.views.into_iter().zip(stored.times) {
        let (color, shape, mask) = (colors.next(), shapes.next().flatten(), masks.next().flatten());
        let Some(place) = placement.view(view.frame_id).filter(|p| p.owner == id) else { continue };
        views.push(Shaped { view: placed_view(view, time, place, color)?, shape, mask });
    }
    Ok(views)
}

/// The view where it is placed, its depth in metres and corrected where landmarks support it.
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
