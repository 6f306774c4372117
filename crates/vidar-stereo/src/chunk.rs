//! The processing of one call, from views to depth. Nothing is cached between calls: corrected poses depend on all
//! views of a chunk, so an estimate of another chunk could hardly ever be reused.

use crate::config::StereoConfig;
use crate::error::StereoError;
use crate::estimate::{Estimate, Probe, estimate, probe};
use crate::prepare::Prepared;
use crate::register::register;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use vidar_core::{Pinhole, Se3, Watch};

/// Neighbours whose own depths are compared with a reference's. At 4 and 5 completeness is .651 and .673 on HoloLens keyframes
/// 0 to 15, AbsRel .0203 and .0219.
const CHECKED_NEIGHBOURS: usize = 5;
/// Fewest of them, also where their depth is not requested: what no checked view sees is lost. At 2 and 3 completeness is .919
/// and .959 on eight keyframes of rendered room A, .822 and .832 in the corridor.
const MIN_CHECKED: usize = 3;

/// Depth of one view before the checks, with the inputs of the consistency checks.
#[derive(Debug)]
pub(crate) struct ViewDepth {
    /// The corrected pose.
    pub world_from_camera: Se3,
    /// Intrinsics at the working size.
    pub intrinsics: Pinhole,
    /// The estimate of the view alone.
    pub estimate: Estimate,
    /// The views that it was matched with, best first: indices into the chunk.
    pub neighbours: Vec<usize>,
}

/// A call in progress.
pub(crate) struct Chunk<'a> {
    /// The views; at their corrected poses once [`Chunk::work`] is done.
    pub views: Vec<Prepared>,
    /// Largest parallax of each view without depth, degrees.
    pub parallax_deg: Vec<f64>,
    /// Depths of the references and of the views that these are checked against.
    pub depths: BTreeMap<usize, ViewDepth>,
    /// The views whose depth is requested.
    references: &'a BTreeSet<usize>,
    config: &'a StereoConfig,
    watch: Watch<'a>,
    /// Units of work so far.
    done: AtomicUsize,
}

impl<'a> Chunk<'a> {
    pub fn new(
        views: Vec<Prepared>,
        references: &'a BTreeSet<usize>,
        config: &'a StereoConfig,
        watch: Watch<'a>,
    ) -> Self {
        let parallax_deg = vec![0.0; views.len()];
        Self {
            views,
            parallax_deg,
            depths: BTreeMap::new(),
            references,
            config,
            watch,
            done: AtomicUsize::new(0),
        }
    }

    /// Depth of the references and of the views that they are checked against.
    pub fn work(&mut self) -> Result<(), StereoError> {
        let probes = self.probe()?;
        if let Some(prior) = self.config.pose_std() {
            let corrected = register(&self.views, &probes, &prior, self.config);
            for (view, corrected) in self.views.iter_mut().zip(corrected) {
                view.world_from_camera = corrected.world_from_camera;
                view.correction = corrected.correction;
                view.pose_std = Some(corrected.std);
            }
        }
        self.estimate(self.references, &probes)?;
        let checks = self.references.iter().flat_map(|&r| self.checked(r)).collect();
        self.estimate(&checks, &probes)
    }

    /// The views that a view with depth is checked against: those whose depth is requested anyway come first.
    pub fn checked(&self, view: usize) -> Vec<usize> {
        let Some(depth) = self.depths.get(&view) else { return Vec::new() };
        let (requested, context): (Vec<usize>, Vec<usize>) =
            depth.neighbours.iter().partition(|n| self.references.contains(n));
        let extra = MIN_CHECKED.saturating_sub(requested.len());
        requested.into_iter().take(CHECKED_NEIGHBOURS).chain(context.into_iter().take(extra)).collect()
    }

    /// A coarse estimate of every view; `None` for those without parallax.
    fn probe(&mut self) -> Result<Vec<Option<Probe>>, StereoError> {
        let of_view = |i| self.unless_cancelled(|| probe(&self.views, i, self.config));
        let found = (0..self.views.len()).into_par_iter().map(of_view).collect::<Result<Vec<_>, _>>()?;
        for (parallax_deg, probe) in self.parallax_deg.iter_mut().zip(&found) {
            *parallax_deg = probe.as_ref().err().copied().unwrap_or(0.0);
        }
        Ok(found.into_iter().map(Result::ok).collect())
    }

    /// Estimates those of `needed` that have no depth yet, views in parallel.
    fn estimate(&mut self, needed: &BTreeSet<usize>, probes: &[Option<Probe>]) -> Result<(), StereoError> {
        let missing: Vec<(usize, &Probe)> = needed
            .iter()
            .filter(|i| !self.depths.contains_key(i))
            .filter_map(|&i| Some((i, probes[i].as_ref()?)))
            .collect();
        let done = missing
            .into_par_iter()
            .map(|(i, probe)| {
                self.unless_cancelled(|| (i, estimate(&self.views, i, &probe.depth, self.config)))
            })
            .collect::<Result<Vec<_>, _>>()?;
        for (i, outcome) in done {
            match outcome {
                Err(found_deg) => self.parallax_deg[i] = found_deg,
                Ok((estimate, neighbours)) => {
                    let (world_from_camera, intrinsics) =
                        (self.views[i].world_from_camera, self.views[i].levels[0].intrinsics);
                    self.depths.insert(i, ViewDepth { world_from_camera, intrinsics, estimate, neighbours });
                }
            }
        }
        Ok(())
    }

    fn unless_cancelled<T>(&self, work: impl FnOnce() -> T) -> Result<T, StereoError> {
        // Every view is probed, every reference estimated; the few estimates for checks come on top.
        let units = self.views.len() + self.references.len();
        let done = self.done.fetch_add(1, Ordering::Relaxed).min(units);
        if (self.watch)(done as f64 / units as f64) { Err(StereoError::Cancelled) } else { Ok(work()) }
    }
}
