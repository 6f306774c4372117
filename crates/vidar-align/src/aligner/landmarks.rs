//! Scale and depth corrections of one chunk from its landmarks, before overlaps and loops are measured.
//!
//! A chunk in a frame of its own has a free unit: landmarks measure it ([`DepthCorrection::scale`]), and each view is
//! corrected relative to it. A chunk in the world of its pose priors has metres for a unit as far as its poses go; a network
//! that was given the poses may still predict all depth too near or too far. Where landmarks contradict the depth beyond
//! three standard deviations, the depth is scaled to them and the poses stay.

use super::observation::FrameObservation;
use super::report::RejectionReason;
use super::view_consistency::{ViewCorrection, enforce_consistency};
use crate::depth_field::{DepthField, FieldConstraint, fit_depth_field};
use crate::landmark_scale::{
    DepthRatio, LandmarkConfig, LogScale, RatioSource, depth_ratios, landmark_scale, point_ratios,
};
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, GeometryPrediction, RelativeDepth, ViewGeometry};
use vidar_solve::statistics::median_upper;

/// σ of ln(metres per unit) of a correct chunk in the world of its pose priors.
const METRIC_DEPTH_STD: f64 = 0.02;
/// Landmarks contradict a depth from this many standard deviations on.
const CONTRADICTS: f64 = 3.0;

/// Scale and fields of one chunk.
#[derive(Debug, Default)]
pub(super) struct DepthCorrection {
    /// ln(metres per unit) of the chunk after correction.
    pub scale: Option<LogScale>,
    /// Corrections of views' depths.
    pub fields: BTreeMap<FrameId, DepthField>,
    pub rejections: Vec<RejectionReason>,
}

impl DepthCorrection {
    pub fn from_landmarks(
        prediction: &GeometryPrediction,
        frames: &[FrameObservation],
        config: &LandmarkConfig,
    ) -> Self {
        let ratios_of = |view: &ViewGeometry| {
            let Some(frame) = frames.iter().find(|f| f.frame_id == view.frame_id) else { return Vec::new() };
            let mut ratios = depth_ratios(view, &frame.landmarks, config);
            ratios.extend(point_ratios(view, &frame.points, config));
            ratios
        };
        let per_view: Vec<(&ViewGeometry, Vec<DepthRatio>)> =
            prediction.views.iter().map(|v| (v, ratios_of(v))).collect();
        let all: Vec<DepthRatio> = per_view.iter().flat_map(|(_, r)| r.iter().copied()).collect();
        let Some(scale) = landmark_scale(&all, config) else { return Self::default() };
        let shared_std = shared_std(&all, frames);
        let limit = CONTRADICTS * METRIC_DEPTH_STD.hypot(scale.std);
        let is_off = prediction.frame == ChunkFrame::PriorWorld && scale.log_scale.abs() > limit;
        let shift = if is_off { scale.log_scale } else { 0.0 };
        let mut found = Self {
            scale: Some(LogScale { log_scale: scale.log_scale - shift, shared_std, ..scale }),
            ..Self::default()
        };
        if is_off {
            found.rejections.push(RejectionReason::DepthRescaled);
        }
        let mut refined = Vec::new();
        let mut prior_scales = Vec::new();
        for (view, ratios) in &per_view {
            let size = (view.intrinsics.width, view.intrinsics.height);
            let fit = fit_depth_field(ratios, scale.log_scale, size, config.min_for_field);
            if fit.as_ref().is_some_and(|f| !f.keeps_grid) {
                found.rejections.push(RejectionReason::DepthFieldRejected);
            }
            prior_scales.extend(fit.as_ref().map(|f| f.prior_scale));
            refined.push(ViewCorrection {
                view,
                // In metres where the chunk's poses are, else in its own unit: corrections are relative to it.
                shift,
                landmarks: ratios.iter().map(|r| FieldConstraint::of_landmark(r, scale.log_scale)).collect(),
                field: fit.map(|f| f.field),
            });
        }
        // Neighbours correct each other where most views need more than a good network does.
        if let Some(prior_scale) = median_upper(&mut prior_scales).filter(|s| *s > 1.0) {
            enforce_consistency(&mut refined, prior_scale);
        }
        for view in refined {
            if let Some(mut field) = view.field.or(is_off.then(DepthField::default)) {
                field.offset += shift;
                found.fields.insert(view.view.frame_id, field);
            }
        }
        found
    }

    /// The prediction with its depths corrected: overlaps and loops are measured on it.
    pub fn corrected(&self, mut prediction: GeometryPrediction) -> GeometryPrediction {
        for view in &mut prediction.views {
            if let Some(field) = self.fields.get(&view.frame_id) {
                view.depth = RelativeDepth::new(field.apply(view.depth.image()));
            }
        }
        prediction
    }
}

/// σ of the error that the landmarks used share, on average over them: those that the odometry tracks share none.
fn shared_std(ratios: &[DepthRatio], frames: &[FrameObservation]) -> f64 {
    let of = |r: &DepthRatio| match r.source {
        RatioSource::Landmark(_) => 0.0,
        RatioSource::Point(_) => {
            frames.iter().find(|f| f.frame_id == r.frame_id).map_or(0.0, |f| f.shared_point_std)
        }
    };
    ratios.iter().map(of).sum::<f64>() / ratios.len().max(1) as f64
}
