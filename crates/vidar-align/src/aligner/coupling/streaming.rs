//! DA3-Streaming as a coupling: the pose-free chain without VIDAR's revisits. With [`Compat::Reference`] it follows the
//! official program on all pixels, number for number ([`crate::streaming`]), and checks nothing.
//!
//! [`Compat::Reference`]: crate::streaming::Compat

use super::super::chunk::{Chunk, OverlapConstraint};
use super::super::config::AlignerConfig;
use super::super::estimate::Estimate;
use super::super::history::{History, LoopMeasurement};
use super::super::landmarks::DepthCorrection;
use super::super::observation::FrameObservation;
use super::super::overlaps::{self, odds};
use super::super::pose_fit::CameraPair;
use super::super::report::LoopRejection;
use super::pose_free::{PoseFree, first_chain};
use super::{Coupling, SharedFrames, checks};
use crate::overlap::{OverlapFit, PATCH_PIXELS, PointPairs, evaluate_fit};
use crate::streaming::{
    AlignMethod, Compat, IrlsConfig, PointMap, ScaleMethod, align_overlap, depth_scale, unproject,
};
use vidar_core::{GeometryPrediction, ViewGeometry};

/// What the reference meant.
#[derive(Debug)]
pub(in crate::aligner) struct Streaming;

/// What the reference does, number for number.
#[derive(Debug)]
pub(in crate::aligner) struct StreamingReference;

impl Coupling for Streaming {
    fn correct_depth(
        &self,
        _: &GeometryPrediction,
        _: &[FrameObservation],
        _: &AlignerConfig,
    ) -> DepthCorrection {
        DepthCorrection::default()
    }

    fn fit_overlap(&self, shared: &SharedFrames<'_>, config: &AlignerConfig) -> Option<OverlapFit> {
        overlaps::fit_reference(shared.sampled, config)
            .filter(|fit| fit.inlier_ratio >= config.overlap.min_inlier_ratio)
    }

    fn revisits(&self, _: &History, _: &Chunk) -> Vec<OverlapConstraint> {
        Vec::new()
    }

    fn initialise(&self, history: &History, chunk: &mut Chunk, pairs: &[CameraPair]) {
        PoseFree.initialise(history, chunk, pairs);
    }

    fn loop_chi2(&self, _: &History, _: &checks::CheckedLoop<'_>) -> Option<f64> {
        None
    }

    fn estimate(&self, history: &History) -> Estimate {
        first_chain(history, self.loops(history))
    }
}

impl Coupling for StreamingReference {
    fn correct_depth(
        &self,
        _: &GeometryPrediction,
        _: &[FrameObservation],
        _: &AlignerConfig,
    ) -> DepthCorrection {
        DepthCorrection::default()
    }

    fn keeps_full_views(&self) -> bool {
        true
    }

    fn fit_overlap(&self, shared: &SharedFrames<'_>, config: &AlignerConfig) -> Option<OverlapFit> {
        let of = |l: &&ViewGeometry| shared.earlier.iter().find(|e| e.frame_id == l.frame_id);
        let both: Vec<(&ViewGeometry, &ViewGeometry)> =
            shared.later.iter().filter_map(|l| of(&l).map(|e| (e, l))).collect();
        fit_all_pixels(&both, config)
    }

    fn revisits(&self, _: &History, _: &Chunk) -> Vec<OverlapConstraint> {
        Vec::new()
    }

    fn initialise(&self, history: &History, chunk: &mut Chunk, pairs: &[CameraPair]) {
        PoseFree.initialise(history, chunk, pairs);
    }

    fn check_loop(&self, _: &History, _: &LoopMeasurement) -> Option<LoopRejection> {
        None
    }

    fn loop_chi2(&self, _: &History, _: &checks::CheckedLoop<'_>) -> Option<f64> {
        None
    }

    fn loops(&self, history: &History) -> Vec<LoopMeasurement> {
        history.loops.clone()
    }

    fn estimate(&self, history: &History) -> Estimate {
        first_chain(history, self.loops(history))
    }
}

/// The reference's overlap fit as it is: every pixel, quirks included.
fn fit_all_pixels(views: &[(&ViewGeometry, &ViewGeometry)], config: &AlignerConfig) -> Option<OverlapFit> {
    let map = |side: Vec<&ViewGeometry>| {
        let mut map = PointMap::default();
        let mut depths: Vec<f32> = Vec::new();
        for v in side {
            let depth = v.depth.image().data();
            map.frame_len = depth.len();
            map.points.extend(unproject(depth, &v.intrinsics, &v.chunk_from_camera));
            map.confidence.extend(v.confidence.image().data().iter().map(|c| odds(*c)));
            depths.extend_from_slice(depth);
        }
        (map, depths)
    };
    let (target, target_depth) = map(views.iter().map(|v| v.0).collect());
    let (source, source_depth) = map(views.iter().map(|v| v.1).collect());
    let source_scale = match config.chain {
        AlignMethod::ScaleSe3 => {
            let found = depth_scale(
                (&target_depth, &target.confidence),
                (&source_depth, &source.confidence),
                ScaleMethod::Auto,
                Compat::Reference,
            );
            found.ok()?.scale
        }
        AlignMethod::Sim3 | AlignMethod::Se3 => 1.0,
    };
    let irls = IrlsConfig { compat: Compat::Reference, ..IrlsConfig::default() };
    let fit = align_overlap(&target, &source, config.chain, source_scale, &irls).ok()?;
    let mut pairs = PointPairs::default();
    let stride = target.points.len().div_ceil(config.overlap.max_pairs.max(1)).max(1);
    for i in (0..target.points.len().min(source.points.len())).step_by(stride) {
        let (zt, zs) = (f64::from(target_depth[i]), f64::from(source_depth[i]));
        if zt.is_finite() && zs.is_finite() {
            pairs.push(source.points[i], target.points[i], zs, zt, 1.0);
        }
    }
    pairs.independent = (target.frame_len / PATCH_PIXELS).max(7);
    Some(evaluate_fit(&pairs, fit.target_from_source))
}
