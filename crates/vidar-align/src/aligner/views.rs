//! A chunk's depth as metric views, where a placement says they are.

use super::Placement;
use crate::AlignError;
use crate::place::colored;
use vidar_core::{AlignedView, ChunkView, GeometryPrediction, MetricDepth};

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
