//! The model: views in, depth in the frame of the given poses out.

use crate::confidence::{confidence, features};
use crate::config::StereoConfig;
use crate::consistency::{Support, support};
use crate::error::StereoError;
use crate::estimate::{Estimate, Outcome, estimate};
use crate::filter::remove_speckles;
use crate::prepare::{Prepared, prepare};
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkViews, Confidence, FrameId, GeometryModel, GeometryPrediction, Image, ModelError, ModelInfo,
    RelativeDepth, ViewGeometry,
};

/// Fewest views of a chunk.
const MIN_VIEWS: usize = 2;
/// Neighbours whose own depths are compared with a reference's.
const CHECKED_NEIGHBOURS: usize = 4;

/// Multi-view stereo as a [`GeometryModel`]: name `stereo`, needs poses, depth in metres of the prior's world.
#[derive(Debug)]
pub struct StereoModel {
    config: StereoConfig,
    info: ModelInfo,
}

/// A reference that got no depth because the camera did not move enough.
#[derive(Clone, Debug, PartialEq)]
pub struct OmittedView {
    /// Which frame.
    pub frame_id: FrameId,
    /// Largest parallax to another view, degrees at the scene's depth.
    pub found_parallax_deg: f64,
    /// Parallax needed, degrees.
    pub needed_parallax_deg: f64,
}

/// Depths of the references, and what became of the rest.
#[derive(Clone, Debug)]
pub struct StereoOutput {
    /// One entry per reference with parallax, in the order of the views. The depth has the working size
    /// (`max_width_px`), and the intrinsics are those of that size.
    pub prediction: GeometryPrediction,
    /// References without parallax.
    pub omitted: Vec<OmittedView>,
}

impl StereoModel {
    /// A model with these settings.
    pub fn new(config: StereoConfig) -> Result<Self, StereoError> {
        config.validate()?;
        let info = ModelInfo {
            name: "stereo".to_owned(),
            licence: "MIT OR Apache-2.0".to_owned(),
            weights_sha256: None,
            needs_poses: true,
            min_views: MIN_VIEWS,
        };
        Ok(Self { config, info })
    }

    /// The settings.
    pub fn config(&self) -> &StereoConfig {
        &self.config
    }

    /// Depth of the views at the indices `references` only, from all of `views`.
    ///
    /// Neighbours are chosen anywhere in `views`, so a streaming driver passes a window around the references.
    /// `cancel` is asked before each view's estimate. If no reference has parallax, that is an error.
    pub fn predict_with(
        &mut self,
        views: &ChunkViews,
        references: &[usize],
        cancel: &dyn Fn() -> bool,
    ) -> Result<StereoOutput, StereoError> {
        let found = views.views.len();
        if found < MIN_VIEWS {
            return Err(StereoError::TooFewViews { chunk: views.id, found, needed: MIN_VIEWS });
        }
        if let Some(&index) = references.iter().find(|&&r| r >= found) {
            return Err(StereoError::NoSuchReference { index, views: found });
        }
        let mut references = references.to_vec();
        references.sort_unstable();
        references.dedup();
        let prepared = views.views.iter().map(|v| prepare(v, &self.config)).collect::<Result<Vec<_>, _>>()?;
        let mut estimates: Vec<Option<Outcome>> = (0..found).map(|_| None).collect();
        let need = |i: usize, estimates: &mut Vec<Option<Outcome>>| -> Result<(), StereoError> {
            if estimates[i].is_none() {
                if cancel() {
                    return Err(StereoError::Cancelled);
                }
                estimates[i] = Some(estimate(&prepared, i, &self.config));
            }
            Ok(())
        };
        let (mut outputs, mut omitted) = (Vec::new(), Vec::new());
        for &reference in &references {
            need(reference, &mut estimates)?;
            let checked = match &estimates[reference] {
                Some(Outcome::Estimated(own)) => {
                    own.neighbours.iter().copied().take(CHECKED_NEIGHBOURS).collect::<Vec<_>>()
                }
                Some(Outcome::NoParallax(found_parallax_deg)) => {
                    omitted.push(OmittedView {
                        frame_id: prepared[reference].frame_id,
                        found_parallax_deg: *found_parallax_deg,
                        needed_parallax_deg: self.config.min_parallax_deg,
                    });
                    continue;
                }
                None => continue,
            };
            for &i in &checked {
                need(i, &mut estimates)?;
            }
            let Some(Outcome::Estimated(own)) = &estimates[reference] else { continue };
            let others: Vec<(usize, &Estimate)> = checked
                .iter()
                .filter_map(|&i| match &estimates[i] {
                    Some(Outcome::Estimated(e)) => Some((i, &**e)),
                    _ => None,
                })
                .collect();
            let supports = support(&prepared, reference, own, &others, &self.config);
            outputs.push(self.geometry(&prepared[reference], own, &supports)?);
        }
        if outputs.is_empty() && !omitted.is_empty() {
            let found_deg = omitted.iter().map(|o| o.found_parallax_deg).fold(0.0, f64::max);
            let needed_deg = self.config.min_parallax_deg;
            return Err(StereoError::NoParallax { chunk: views.id, found_deg, needed_deg });
        }
        let prediction =
            GeometryPrediction { chunk_id: views.id, frame: ChunkFrame::PriorWorld, views: outputs };
        Ok(StereoOutput { prediction, omitted })
    }

    fn geometry(
        &self,
        view: &Prepared,
        own: &Estimate,
        supports: &[Support],
    ) -> Result<ViewGeometry, StereoError> {
        let level = &view.levels[0];
        let mut rho = vec![f32::NAN; supports.len()];
        let mut confident = vec![0.0f32; supports.len()];
        for (i, support) in supports.iter().enumerate() {
            let p = confidence(&features(own, i, support, self.config.noise_gray));
            if support.rho > 0.0 && p >= self.config.min_confidence && support.agreeing > 0 {
                (rho[i], confident[i]) = (support.rho, p);
            }
        }
        remove_speckles(&mut rho, level.width);
        for (c, _) in confident.iter_mut().zip(&rho).filter(|(_, rho)| rho.is_nan()) {
            *c = 0.0;
        }
        let depth: Vec<f32> = rho.iter().map(|rho| 1.0 / rho).collect();
        let image = |data| {
            Image::from_vec(level.width, level.height, data)
                .map_err(|e| StereoError::Internal { what: e.to_string() })
        };
        Ok(ViewGeometry {
            frame_id: view.frame_id,
            chunk_from_camera: view.world_from_camera,
            intrinsics: level.intrinsics,
            depth: RelativeDepth::new(image(depth)?),
            confidence: Confidence::new(image(confident)?),
        })
    }
}

impl GeometryModel for StereoModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
        let references: Vec<usize> = (0..views.views.len()).collect();
        Ok(self.predict_with(views, &references, &|| false)?.prediction)
    }
}
