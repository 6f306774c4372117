//! A predicted view in metres and in the world.

use crate::error::Error;
use vidar_align::AlignError;
use vidar_align::aligner::ViewPlacement;
use vidar_core::{AlignedView, Image, RelativeDepth, Timestamp, ViewGeometry};

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
