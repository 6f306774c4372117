//! What a chunk's landmarks say of its depth, before anything else is made of it.
//!
//! The unit of a chunk that the model placed itself is free: landmarks measure it ([`Landmarks::scale`]), and each view is
//! corrected about it. A chunk in the anchors' own world has metres for a unit, as far as its poses go; a network that was
//! given the poses may still see everything too near or too far. Where landmarks say so beyond doubt, its depth alone is
//! brought to them, and its poses stay.

use super::agreement::{Refined, agree};
use super::observation::FrameObservation;
use super::report::RejectionReason;
use crate::depth_field::{DepthField, Evidence, fit_depth_field};
use crate::landmark_scale::{DepthRatio, LandmarkConfig, LogScale, depth_ratios, landmark_scale};
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, GeometryPrediction, RelativeDepth, ViewGeometry};

/// How far the depth of a chunk in the anchors' world is off a metre when nothing is wrong, standard deviation of ln.
const METRIC_DEPTH_STD: f64 = 0.02;
/// From so many standard deviations on it is not believed against its landmarks.
const CONTRADICTS: f64 = 3.0;

/// Scale and fields of one chunk.
#[derive(Debug, Default)]
pub(super) struct Landmarks {
    /// ln(metres per unit) of the chunk after correction.
    pub scale: Option<LogScale>,
    /// Corrections of views' depths.
    pub fields: BTreeMap<FrameId, DepthField>,
    pub rejections: Vec<RejectionReason>,
}

impl Landmarks {
    pub fn learn(
        prediction: &GeometryPrediction,
        frames: &[FrameObservation],
        config: &LandmarkConfig,
    ) -> Self {
        let seen = |view: &ViewGeometry| {
            let frame = frames.iter().find(|f| f.frame_id == view.frame_id);
            frame.map_or(Vec::new(), |f| depth_ratios(view, &f.landmarks, config))
        };
        let per_view: Vec<(&ViewGeometry, Vec<DepthRatio>)> =
            prediction.views.iter().map(|v| (v, seen(v))).collect();
        let all: Vec<DepthRatio> = per_view.iter().flat_map(|(_, r)| r.iter().copied()).collect();
        let Some(scale) = landmark_scale(&all, config) else { return Self::default() };
        let shared_std = shared_std(&all, frames);
        let doubt = CONTRADICTS * METRIC_DEPTH_STD.hypot(scale.std);
        let is_off = prediction.frame == ChunkFrame::PriorWorld && scale.log_scale.abs() > doubt;
        let shift = if is_off { scale.log_scale } else { 0.0 };
        let mut found = Self {
            scale: Some(LogScale { log_scale: scale.log_scale - shift, shared_std, ..scale }),
            ..Self::default()
        };
        if is_off {
            found.rejections.push(RejectionReason::DepthRescaled);
        }
        let mut refined = Vec::new();
        let mut prior_scale = Vec::new();
        for (view, ratios) in &per_view {
            let size = (view.intrinsics.width, view.intrinsics.height);
            let fit = fit_depth_field(ratios, scale.log_scale, size, config.min_for_field);
            if fit.as_ref().is_some_and(|f| !f.keeps_grid) {
                found.rejections.push(RejectionReason::DepthFieldRejected);
            }
            prior_scale.extend(fit.as_ref().map(|f| f.prior_scale));
            refined.push(Refined {
                view,
                // In metres where the chunk's poses are, else in its own unit: what landmarks ask for is counted from there.
                shift,
                landmarks: ratios.iter().map(|r| Evidence::of_landmark(r, scale.log_scale)).collect(),
                field: fit.map(|f| f.field),
            });
        }
        // Neighbours correct each other where most views need more than a good network does.
        prior_scale.sort_by(f64::total_cmp);
        if let Some(prior_scale) = prior_scale.get(prior_scale.len() / 2).filter(|l| **l > 1.0) {
            agree(&mut refined, *prior_scale);
        }
        for view in refined {
            if let Some(mut field) = view.field.or(is_off.then(DepthField::default)) {
                field.offset += shift;
                found.fields.insert(view.view.frame_id, field);
            }
        }
        found
    }

    /// The prediction with its depths corrected: what overlaps and loops are measured on.
    pub fn corrected(&self, mut prediction: GeometryPrediction) -> GeometryPrediction {
        for view in &mut prediction.views {
            if let Some(field) = self.fields.get(&view.frame_id) {
                view.depth = RelativeDepth::new(field.apply(view.depth.image()));
            }
        }
        prediction
    }
}

/// What the landmarks used have in common, on average over them.
fn shared_std(ratios: &[DepthRatio], frames: &[FrameObservation]) -> f64 {
    let of = |r: &DepthRatio| {
        frames.iter().find(|f| f.frame_id == r.frame_id).map_or(0.0, |f| f.shared_landmark_std)
    };
    ratios.iter().map(of).sum::<f64>() / ratios.len().max(1) as f64
}
