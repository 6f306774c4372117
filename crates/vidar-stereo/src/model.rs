//! The model: views in, depth in the frame of the given poses out.

use crate::chunk::{Chunk, ViewDepth};
use crate::confidence::{PixelFeatures, confident, pixel_features};
use crate::config::{PoseStd, StereoConfig};
use crate::consistency::{Support, support};
use crate::error::StereoError;
use crate::filter::remove_speckles;
use crate::prepare::{Prepared, prepare};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;
use tracing::trace_span;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkViews, Confidence, FrameId, GeometryModel, GeometryPrediction, Image, ModelError, ModelInfo,
    RelativeDepth, ViewGeometry, Watch,
};

/// Fewest views of a chunk.
const MIN_VIEWS: usize = 2;

/// Multi-view stereo as a [`GeometryModel`]: name `stereo`, needs poses, depth in metres, in the world frame of the prior poses.
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

/// Depths of the references, and the omitted references.
#[derive(Clone, Debug)]
pub struct StereoOutput {
    /// One entry per reference with parallax, in the order of the views. The depth has the working size
    /// (`max_width_px`), and the intrinsics are those of that size.
    pub prediction: GeometryPrediction,
    /// What the pose of each view of the prediction is known to, by the images and the given poses together; empty where poses are taken
    /// as given.
    pub pose_std: Vec<PoseStd>,
    /// References without parallax.
    pub omitted: Vec<OmittedView>,
}

/// The features from which the confidence of a view's pixels was computed.
#[derive(Clone, Debug)]
pub struct ViewFeatures {
    /// Which frame.
    pub frame_id: FrameId,
    /// One entry per pixel, row by row, also where the view got no depth.
    pub pixels: Vec<PixelFeatures>,
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
    /// `watch` is called before each unit of work; `true` ends it. Fails if no reference has parallax.
    pub fn predict_with(
        &self,
        views: &ChunkViews,
        references: &[usize],
        watch: Watch<'_>,
    ) -> Result<StereoOutput, StereoError> {
        Ok(self.with_parallax(views, references, watch, false)?.0)
    }

    /// As [`Self::predict_with`], with the features of the confidence: one entry per view of the prediction.
    pub fn predict_with_features(
        &self,
        views: &ChunkViews,
        references: &[usize],
        watch: Watch<'_>,
    ) -> Result<(StereoOutput, Vec<ViewFeatures>), StereoError> {
        self.with_parallax(views, references, watch, true)
    }

    /// As [`GeometryModel::predict_views`], without the pixels that are `true` in `masks` (one entry per view at the image's size; none, or
    /// fewer entries, where every pixel may be used): they get no depth, and nothing is matched with them.
    pub fn predict_unmasked(
        &self,
        views: &ChunkViews,
        masks: &[Option<Image<bool>>],
        requested: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<StereoOutput, StereoError> {
        let references: Vec<usize> = requested.filter(|&i| i < views.views.len()).collect();
        Ok(self.depths_of(views, masks, &references, (watch, false))?.0)
    }

    /// As [`Self::depths_of`]; an error if no reference has parallax.
    fn with_parallax(
        &self,
        views: &ChunkViews,
        references: &[usize],
        watch: Watch<'_>,
        keep_features: bool,
    ) -> Result<(StereoOutput, Vec<ViewFeatures>), StereoError> {
        let (output, features) = self.depths_of(views, &[], references, (watch, keep_features))?;
        if output.prediction.views.is_empty() && !output.omitted.is_empty() {
            let found_deg = output.omitted.iter().map(|o| o.found_parallax_deg).fold(0.0, f64::max);
            let needed_deg = self.config.min_parallax_deg;
            return Err(StereoError::NoParallax { chunk: views.id, found_deg, needed_deg });
        }
        Ok((output, features))
    }

    /// Predicts the references; those without parallax are omitted, even if that leaves none.
    fn depths_of(
        &self,
        views: &ChunkViews,
        masks: &[Option<Image<bool>>],
        references: &[usize],
        (watch, keep_features): (Watch<'_>, bool),
    ) -> Result<(StereoOutput, Vec<ViewFeatures>), StereoError> {
        let found = views.views.len();
        if found < MIN_VIEWS {
            return Err(StereoError::TooFewViews { chunk: views.id, found, needed: MIN_VIEWS });
        }
        if let Some(&index) = references.iter().find(|&&r| r >= found) {
            return Err(StereoError::NoSuchReference { index, views: found });
        }
        let references: BTreeSet<usize> = references.iter().copied().collect();
        let one = |(i, view)| {
            let mask = masks.get(i).and_then(Option::as_ref);
            trace_span!("preparation").in_scope(|| prepare(view, mask, &self.config))
        };
        let prepared: Vec<_> = views.views.par_iter().enumerate().map(one).collect();
        // Collected one by one, so that the error is that of the first bad view.
        let prepared = prepared.into_iter().collect::<Result<Vec<_>, _>>()?;
        let mut chunk = Chunk::new(prepared, &references, &self.config, watch);
        chunk.work()?;
        let results: Vec<_> = references
            .par_iter()
            .filter_map(|&r| checked_geometry(&chunk, r, &self.config, keep_features))
            .collect();
        let (geometries, features) = results.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().unzip();
        let pose_std = references.iter().filter(|r| chunk.depths.contains_key(r));
        let pose_std = pose_std.filter_map(|&r| chunk.views[r].pose_std).collect();
        let omitted = references
            .iter()
            .filter(|r| !chunk.depths.contains_key(r))
            .map(|&r| OmittedView {
                frame_id: chunk.views[r].frame_id,
                found_parallax_deg: chunk.parallax_deg[r],
                needed_parallax_deg: self.config.min_parallax_deg,
            })
            .collect();
        let prediction =
            GeometryPrediction { chunk_id: views.id, frame: ChunkFrame::PriorWorld, views: geometries };
        Ok((StereoOutput { prediction, pose_std, omitted }, features))
    }
}

/// A view's depth after the checks against its neighbours' own; `None` without parallax.
fn checked_geometry(
    chunk: &Chunk<'_>,
    reference: usize,
    config: &StereoConfig,
    keep_features: bool,
) -> Option<Result<(ViewGeometry, ViewFeatures), StereoError>> {
    let own = chunk.depths.get(&reference)?;
    let others: Vec<_> = chunk.checked(reference).iter().filter_map(|i| chunk.depths.get(i)).collect();
    let support = trace_span!("consistency").in_scope(|| support(own, &others, config));
    Some(geometry(&chunk.views[reference], own, &support, config, keep_features))
}

fn geometry(
    view: &Prepared,
    own: &ViewDepth,
    support: &Support,
    config: &StereoConfig,
    keep_features: bool,
) -> Result<(ViewGeometry, ViewFeatures), StereoError> {
    let level = &view.levels[0];
    let (mut rho, mut confidence) = trace_span!("confidence")
        .in_scope(|| confident(&own.estimate, support, &view.correction, config.min_confidence as f32));
    trace_span!("speckles").in_scope(|| remove_speckles(&mut rho, level.width));
    for (c, _) in confidence.iter_mut().zip(&rho).filter(|(_, rho)| rho.is_nan()) {
        *c = 0.0;
    }
    let depth: Vec<f32> = rho.iter().map(|rho| 1.0 / rho).collect();
    let image = |data| {
        Image::from_vec(level.width, level.height, data)
            .map_err(|e| StereoError::Internal { what: e.to_string() })
    };
    let geometry = ViewGeometry {
        frame_id: view.frame_id,
        chunk_from_camera: view.world_from_camera,
        intrinsics: level.intrinsics,
        depth: RelativeDepth::new(image(depth)?),
        confidence: Confidence::new(image(confidence)?),
    };
    let of = |i: usize| pixel_features(&own.estimate, i, support, &view.correction, config);
    let pixels = if keep_features { (0..support.rho.len()).map(of).collect() } else { Vec::new() };
    Ok((geometry, ViewFeatures { frame_id: view.frame_id, pixels }))
}

impl GeometryModel for StereoModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
        let references: Vec<usize> = (0..views.views.len()).collect();
        Ok(self.predict_with(views, &references, &|_| false)?.prediction)
    }

    /// Views without parallax are omitted, even if that leaves none; context views are estimated only as far as the
    /// consistency checks of the requested views need them.
    fn predict_views(
        &mut self,
        views: &ChunkViews,
        requested: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<GeometryPrediction, ModelError> {
        Ok(self.predict_unmasked(views, &[], requested, watch)?.prediction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{ChunkId, ChunkView, FrameImage, Pinhole, Se3, Timestamp};

    /// A wall at 2 m with random texture, by cameras that move to the side by whole pixels.
    fn wall() -> ChunkViews {
        let k = Pinhole::new(100.0, 100.0, 63.5, 47.5, 128, 96).expect("valid");
        let texture = |x: usize, y: usize| ((x / 3 * 7919 + y / 3 * 104_729 + x * y / 7) % 239) as u8;
        let view = |i: usize| ChunkView {
            frame_id: FrameId(i as u32),
            time: Timestamp::from_nanos(i as i64),
            image: FrameImage::Gray8(Image::from_fn(128, 96, |x, y| texture(x + 5 * i, y))),
            intrinsics: k,
            world_from_camera: Some(Se3::from_translation([0.1 * i as f64, 0.0, 0.0].into())),
        };
        ChunkViews { id: ChunkId(0), views: (0..4).map(view).collect() }
    }

    #[test]
    fn the_bits_do_not_depend_on_the_instructions() {
        let chunk = wall();
        let run = || -> Vec<u32> {
            let model = StereoModel::new(StereoConfig::default()).expect("valid");
            let output = model.predict_with(&chunk, &[1, 2], &|_| false).expect("has parallax");
            let values = output.prediction.views.into_iter().flat_map(|view| {
                let depth = view.depth.image().data().to_vec();
                depth.into_iter().chain(view.confidence.image().data().to_vec())
            });
            values.map(f32::to_bits).collect()
        };
        let found = vidar_core::testing::same_with_each_instruction_set(run);
        let near = |bits: &&u32| (f32::from_bits(**bits) - 2.0).abs() < 0.06;
        let right = found.iter().filter(near).count();
        assert!(right > 128 * 96, "{right} of two views' pixels");
    }
}
