//! A simulated network behind the trait of all geometry models.

use super::{PredictionErrors, TruePlace, predict_chunk, true_views};
use crate::bounds::ensure;
use crate::error::SynthError;
use crate::simulation::Simulation;
use std::sync::Arc;
use vidar_core::{ChunkView, ChunkViews, GeometryModel, GeometryPrediction, ModelError, ModelInfo, Se3};

/// Sides of a prediction are multiples of this, as a network with such patches makes them.
const PATCH: usize = 14;

/// Whether a simulated network heeds prior poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Conditioning {
    /// Prior poses are ignored.
    PoseFree,
    /// Prior poses are injected; each view must have one.
    PosesInjected,
}

/// A network that sees a [`Simulation`]: it takes the truth at the views' stamps and adds
/// [`PredictionErrors`]. It ignores the images.
pub struct SyntheticModel {
    info: ModelInfo,
    simulation: Arc<Simulation>,
    errors: PredictionErrors,
    conditioning: Conditioning,
    seed: u64,
    long_side_px: usize,
}

impl SyntheticModel {
    /// A network whose predictions have `long_side_px` (28…4096) along the views' longer side, 280 for a small one.
    ///
    /// # Errors
    /// A key of `errors` or the size outside its domain.
    pub fn new(
        simulation: Arc<Simulation>,
        errors: PredictionErrors,
        conditioning: Conditioning,
        long_side_px: usize,
        seed: u64,
    ) -> Result<Self, SynthError> {
        errors.validate()?;
        ensure((28..=4096).contains(&long_side_px), "long_side_px", "28 to 4096 pixels", long_side_px)?;
        let info = ModelInfo {
            name: "synthetic".to_owned(),
            licence: "MIT OR Apache-2.0".to_owned(),
            weights_sha256: None,
            needs_poses: conditioning == Conditioning::PosesInjected,
            min_views: 1,
        };
        Ok(Self { info, simulation, errors, conditioning, seed, long_side_px })
    }

    /// Columns and rows of the prediction of a view: longest side as asked for, both to the nearest multiple of 14.
    fn size(&self, view: &ChunkView) -> [usize; 2] {
        let sides = [view.intrinsics.width, view.intrinsics.height];
        let factor = self.long_side_px as f64 / sides[0].max(sides[1]).max(1) as f64;
        sides.map(|s| ((s as f64 * factor / PATCH as f64).round().max(1.0) as usize) * PATCH)
    }
}

impl GeometryModel for SyntheticModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
        let Some(first) = views.views.first() else {
            return Err(ModelError::TooFewViews { chunk: views.id, found: 0, needed: 1 });
        };
        let [width, height] = self.size(first);
        let intrinsics =
            first.intrinsics.resized(width, height).map_err(|e| bad_view(first, e.to_string()))?;
        if let Some(other) = views.views.iter().find(|v| v.intrinsics != first.intrinsics) {
            return Err(bad_view(other, "its intrinsics are not those of the chunk's first view".to_owned()));
        }
        let place = |view: &ChunkView| {
            let world_from_camera = self.simulation.world_from_camera(view.time).ok_or_else(|| {
                bad_view(view, format!("its time, {} s, is not in the simulation", view.time))
            })?;
            Ok(TruePlace { frame_id: view.frame_id, time: view.time, world_from_camera })
        };
        let places = views.views.iter().map(place).collect::<Result<Vec<_>, ModelError>>()?;
        let prior = match self.conditioning {
            Conditioning::PoseFree => None,
            Conditioning::PosesInjected => Some(priors(views)?),
        };
        let truth = true_views(self.simulation.world(), &places, &intrinsics);
        predict_chunk(views.id, &truth, prior.as_deref(), &self.errors, self.seed)
            .map_err(|e| ModelError::Other(e.to_string()))
    }
}

fn priors(views: &ChunkViews) -> Result<Vec<Se3>, ModelError> {
    let prior = |v: &ChunkView| v.world_from_camera.ok_or(ModelError::MissingPose { frame: v.frame_id });
    views.views.iter().map(prior).collect()
}

fn bad_view(view: &ChunkView, reason: String) -> ModelError {
    ModelError::BadView { frame: view.frame_id, reason }
}
