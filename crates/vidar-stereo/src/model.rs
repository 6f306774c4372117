//! The model: views in, depth in the frame of the given poses out.

use crate::cache::{Cache, ViewDepth, fingerprint};
use crate::confidence::{confidence, features, pose_cap};
use crate::config::StereoConfig;
use crate::consistency::{Support, support};
use crate::error::StereoError;
use crate::estimate::{Probe, estimate, probe};
use crate::filter::remove_speckles;
use crate::prepare::{Prepared, prepare};
use crate::register::registered;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
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
    cache: Cache,
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
        Ok(Self { config, info, cache: Cache::default() })
    }

    /// The settings.
    pub fn config(&self) -> &StereoConfig {
        &self.config
    }

    /// Depth of the views at the indices `references` only, from all of `views`.
    ///
    /// Neighbours are chosen anywhere in `views`, so a streaming driver passes a window around the references; a view
    /// given before in just the same way keeps the pose and estimate that it got then. `cancel` is asked before each view's
    /// estimate. If no reference has parallax, that is an error.
    pub fn predict_with(
        &mut self,
        views: &ChunkViews,
        references: &[usize],
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<StereoOutput, StereoError> {
        let output = self.depths_of(views, references, cancel)?;
        if output.prediction.views.is_empty() && !output.omitted.is_empty() {
            let found_deg = output.omitted.iter().map(|o| o.found_parallax_deg).fold(0.0, f64::max);
            let needed_deg = self.config.min_parallax_deg;
            return Err(StereoError::NoParallax { chunk: views.id, found_deg, needed_deg });
        }
        Ok(output)
    }

    /// The whole of it; references without parallax are omitted, even if that leaves none.
    fn depths_of(
        &mut self,
        views: &ChunkViews,
        references: &[usize],
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<StereoOutput, StereoError> {
        let found = views.views.len();
        if found < MIN_VIEWS {
            return Err(StereoError::TooFewViews { chunk: views.id, found, needed: MIN_VIEWS });
        }
        if let Some(&index) = references.iter().find(|&&r| r >= found) {
            return Err(StereoError::NoSuchReference { index, views: found });
        }
        let references: BTreeSet<usize> = references.iter().copied().collect();
        let prepared: Vec<_> = views.views.par_iter().map(|v| prepare(v, &self.config)).collect();
        // Collected one by one, so that the first bad view is the one named.
        let mut prepared = prepared.into_iter().collect::<Result<Vec<_>, _>>()?;
        let fingerprints: Vec<u64> = prepared.par_iter().map(fingerprint).collect();
        self.cache.begin(&prepared, &fingerprints);
        let mut parallax_deg = vec![0.0f64; found];
        let probes = self.probe_all(&prepared, &mut parallax_deg, cancel)?;
        self.place_all(&mut prepared, &probes);
        self.estimate_all(&prepared, &references, &probes, &mut parallax_deg, cancel)?;
        let checks: BTreeSet<usize> = references
            .iter()
            .flat_map(|&r| self.checked(&prepared[r]))
            .filter_map(|frame| prepared.iter().position(|v| v.frame_id == frame))
            .collect();
        self.estimate_all(&prepared, &checks, &probes, &mut parallax_deg, cancel)?;
        let geometries: Vec<_> =
            references.par_iter().filter_map(|&r| self.checked_geometry(&prepared[r])).collect();
        let omitted = references
            .iter()
            .filter(|&&r| self.cache.depth(prepared[r].frame_id).is_none())
            .map(|&r| OmittedView {
                frame_id: prepared[r].frame_id,
                found_parallax_deg: parallax_deg[r],
                needed_parallax_deg: self.config.min_parallax_deg,
            })
            .collect();
        let prediction = GeometryPrediction {
            chunk_id: views.id,
            frame: ChunkFrame::PriorWorld,
            views: geometries.into_iter().collect::<Result<Vec<_>, _>>()?,
        };
        Ok(StereoOutput { prediction, omitted })
    }

    /// A rough look at every view that has none yet; nothing for those without parallax.
    fn probe_all(
        &mut self,
        views: &[Prepared],
        parallax_deg: &mut [f64],
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Option<Arc<Probe>>>, StereoError> {
        let found: Vec<Result<Arc<Probe>, f64>> = (0..views.len())
            .into_par_iter()
            .map(|i| {
                if cancel() {
                    return Err(StereoError::Cancelled);
                }
                let known = self.cache.probe(views[i].frame_id);
                Ok(known.map_or_else(|| probe(views, i, &self.config).map(Arc::new), Ok))
            })
            .collect::<Result<_, _>>()?;
        let mut probes = Vec::with_capacity(views.len());
        for (i, result) in found.into_iter().enumerate() {
            match &result {
                Ok(probe) => self.cache.put_probe(views[i].frame_id, Arc::clone(probe)),
                Err(found_deg) => parallax_deg[i] = *found_deg,
            }
            probes.push(result.ok());
        }
        Ok(probes)
    }

    /// Moves the views to their corrected poses. What was estimated before stays where it was then.
    fn place_all(&self, views: &mut [Prepared], probes: &[Option<Arc<Probe>>]) {
        let mut placed = vec![false; views.len()];
        for (view, placed) in views.iter_mut().zip(&mut placed) {
            if let Some(depth) = self.cache.depth(view.frame_id) {
                (view.world_from_camera, *placed) = (depth.world_from_camera, true);
            }
        }
        if self.config.pose_spread_deg > 0.0 && self.config.pose_spread_m > 0.0 {
            let poses = registered(views, &placed, probes, &self.config);
            for (view, corrected) in views.iter_mut().zip(poses) {
                (view.world_from_camera, view.shift_px) = (corrected.world_from_camera, corrected.shift_px);
            }
        }
    }

    /// Estimates those of `wanted` that have no depth yet, views in parallel.
    fn estimate_all(
        &mut self,
        views: &[Prepared],
        wanted: &BTreeSet<usize>,
        probes: &[Option<Arc<Probe>>],
        parallax_deg: &mut [f64],
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<(), StereoError> {
        let missing: Vec<(usize, &Probe)> = wanted
            .iter()
            .filter(|&&i| self.cache.depth(views[i].frame_id).is_none())
            .filter_map(|&i| Some((i, probes[i].as_deref()?)))
            .collect();
        let done = missing
            .par_iter()
            .map(|&(i, probe)| {
                if cancel() {
                    return Err(StereoError::Cancelled);
                }
                Ok((i, estimate(views, i, &probe.depth, &self.config)))
            })
            .collect::<Result<Vec<_>, _>>()?;
        for (i, outcome) in done {
            match outcome {
                Err(found_deg) => parallax_deg[i] = found_deg,
                Ok((estimate, neighbours)) => {
                    let depth = ViewDepth {
                        world_from_camera: views[i].world_from_camera,
                        shift_px: views[i].shift_px,
                        intrinsics: views[i].levels[0].intrinsics,
                        estimate,
                        neighbours: neighbours.iter().map(|&n| views[n].frame_id).collect(),
                    };
                    self.cache.put_depth(views[i].frame_id, Arc::new(depth));
                }
            }
        }
        Ok(())
    }

    /// The frames that a view with depth is checked against.
    fn checked(&self, view: &Prepared) -> Vec<FrameId> {
        let depth = self.cache.depth(view.frame_id);
        depth.map_or_else(Vec::new, |d| d.neighbours.iter().copied().take(CHECKED_NEIGHBOURS).collect())
    }

    /// A view's depth after the checks against its neighbours' own; nothing without parallax.
    fn checked_geometry(&self, view: &Prepared) -> Option<Result<ViewGeometry, StereoError>> {
        let own = self.cache.depth(view.frame_id)?;
        let others: Vec<_> =
            self.checked(view).into_iter().filter_map(|frame| self.cache.depth(frame)).collect();
        let supports = support(&own, &others, &self.config);
        Some(self.geometry(view, &own, &supports))
    }

    fn geometry(
        &self,
        view: &Prepared,
        own: &ViewDepth,
        supports: &[Support],
    ) -> Result<ViewGeometry, StereoError> {
        let level = &view.levels[0];
        let mut rho = vec![f32::NAN; supports.len()];
        let mut confident = vec![0.0f32; supports.len()];
        for (i, support) in supports.iter().enumerate() {
            let p = confidence(&features(&own.estimate, i, support, self.config.noise_gray as f32));
            if support.rho > 0.0 && f64::from(p) >= self.config.min_confidence && support.agreeing > 0 {
                let cap = pose_cap(own.shift_px, own.estimate.rho_per_px / support.rho);
                (rho[i], confident[i]) = (support.rho, p * cap);
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

    /// Views without parallax are left out, even if that leaves none; the context is estimated as far as the checks
    /// of the wanted views need it.
    fn predict_wanted(
        &mut self,
        views: &ChunkViews,
        wanted: Range<usize>,
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<GeometryPrediction, ModelError> {
        let references: Vec<usize> = wanted.filter(|&i| i < views.views.len()).collect();
        Ok(self.depths_of(views, &references, cancel)?.prediction)
    }
}
