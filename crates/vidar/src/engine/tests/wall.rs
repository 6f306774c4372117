//! A geometry model that sees a wall.

use super::pinhole;
use crate::engine::*;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkViews, Confidence, GeometryPrediction, Image, ModelError, ModelInfo, RelativeDepth, ViewGeometry,
};

/// A wall 2 m in front of the camera, in the metres of the given poses; predictions of the chunks in `failing` fail, and views less than
/// `least_span_m` apart show nothing.
pub(super) struct Wall {
    pub(super) info: ModelInfo,
    pub(super) failing: Vec<u32>,
    pub(super) least_span_m: f64,
    /// Whether its depth is completed once all is fused.
    pub(super) completes: bool,
}

impl Wall {
    pub(super) fn new(failing: &[u32]) -> Self {
        let info = ModelInfo {
            name: "wall".into(),
            licence: "none".into(),
            weights_sha256: None,
            needs_poses: true,
            min_views: 2,
        };
        Self { info, failing: failing.to_vec(), least_span_m: 0.0, completes: false }
    }
}

impl GeometrySource for Wall {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn overlaps(&self) -> bool {
        false
    }

    fn predicts_any_views(&self) -> bool {
        false
    }

    fn completes(&self) -> bool {
        self.completes
    }

    fn predict(
        &mut self,
        views: &ChunkViews,
        _: &[Option<Image<bool>>],
        wanted: std::ops::Range<usize>,
        _: vidar_core::Watch<'_>,
    ) -> Result<Prediction, ModelError> {
        if self.failing.contains(&views.id.0) {
            return Err(ModelError::Other("out of order".into()));
        }
        let x = |v: &vidar_core::ChunkView| v.world_from_camera.unwrap().translation.x;
        let depth_m = match views.views.as_slice() {
            [first, .., last] => {
                let step_m = (x(last) - x(first)) / f64::from(last.frame_id.0 - first.frame_id.0);
                2.0 * step_m / super::STEP_M
            }
            _ => 2.0,
        };
        let view = |v: &vidar_core::ChunkView| ViewGeometry {
            frame_id: v.frame_id,
            chunk_from_camera: v.world_from_camera.unwrap(),
            intrinsics: pinhole(),
            depth: RelativeDepth::new(Image::filled(64, 48, depth_m as f32)),
            confidence: Confidence::full(64, 48),
        };
        let spans = |from: f64, to: f64| to - from >= self.least_span_m;
        let ends = views.views.iter().map(x).fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
        let wanted = if spans(ends.0, ends.1) { wanted } else { 0..0 };
        let views = GeometryPrediction {
            chunk_id: views.id,
            frame: ChunkFrame::PriorWorld,
            views: views.views[wanted].iter().map(view).collect(),
        };
        Ok(Prediction::of(views))
    }
}
