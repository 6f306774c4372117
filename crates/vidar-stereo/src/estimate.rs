//! Depth of one reference view from its neighbours, before views are compared with each other.
//!
//! Probe at a quarter of the size for the scene's depth → choose neighbours for that depth → sweep → semi-global
//! matching → winner with sub-plane fit → slanted-plane refinement.

use crate::config::StereoConfig;
use crate::prepare::{Level, Prepared};
use crate::refine::refine;
use crate::select::{Selection, select};
use crate::sgm::{Penalties, aggregate};
use crate::sweep::{INVISIBLE, Planes, Source, WORST, sweep};
use crate::warp::{Warp, neighbour_from_reference};

/// Pyramid level of the sweep; the refinement works on level 0.
const SWEEP_LEVEL: usize = 1;
/// Pyramid level of the probe for the scene's depth.
pub(crate) const PROBE_LEVEL: usize = 2;
/// Planes of the probe.
const PROBE_PLANES: usize = 64;

/// The estimate from one reference alone.
#[derive(Clone, Debug)]
pub(crate) struct Estimate {
    /// Inverse depth at the working size, 1/m; NaN where there is none.
    pub rho: Vec<f32>,
    /// Matching cost at the winner, 0 (perfect) to 1 (none).
    pub cost: Vec<f32>,
    /// How much worse the next best plane is after aggregation, in units of a full mismatch.
    pub margin: Vec<f32>,
    /// Standard deviation of the reference's window, grey levels.
    pub texture: Vec<f32>,
    /// Growth of the cost away from the winner, per squared pixel of shift of the best neighbour.
    pub curvature: Vec<f32>,
    /// Inverse-depth step that shifts the pixel in the best neighbour by one working pixel, 1/m.
    pub rho_per_px: f32,
}

/// Depth of `views[reference]` and the views it was matched with; `Err` holds the largest parallax in degrees, if
/// there is too little for matching.
pub(crate) fn estimate(
    views: &[Prepared],
    reference: usize,
    depth: &SceneDepth,
    config: &StereoConfig,
) -> Result<(Estimate, Vec<usize>), f64> {
    let selection = select(views, reference, &[depth.median], config);
    if selection.neighbours.is_empty() {
        return Err(selection.best_parallax_deg);
    }
    let estimate = matched(views, reference, &selection.neighbours, depth.near, config);
    Ok((estimate, selection.neighbours))
}

/// Sweep, semi-global matching and refinement against `neighbours`.
fn matched(
    views: &[Prepared],
    reference: usize,
    neighbours: &[usize],
    near_m: f64,
    config: &StereoConfig,
) -> Estimate {
    let coarse = &views[reference].levels[SWEEP_LEVEL];
    let coarse_sources = sources(views, reference, neighbours, SWEEP_LEVEL);
    let planes = place_planes(coarse, &coarse_sources, near_m.max(config.min_depth_m), config);
    let costs = sweep(coarse, &coarse_sources, &planes, config.noise_gray as f32);
    let penalties = Penalties { step: config.step_penalty as i16, jump: config.jump_penalty as i16 };
    let sums = aggregate(coarse, &costs, planes.count, penalties);
    let winners = Winners::pick(coarse, &costs, &sums, &planes);
    let fine_sources = sources(views, reference, neighbours, 0);
    refine(&views[reference].levels[0], coarse, &winners, &fine_sources, &planes, config)
}

/// The neighbours' images at one level, with the warps into them.
pub(crate) fn sources<'a>(
    views: &'a [Prepared],
    reference: usize,
    neighbours: &[usize],
    level: usize,
) -> Vec<Source<'a>> {
    let own = &views[reference];
    neighbours
        .iter()
        .map(|&i| {
            let motion = neighbour_from_reference(&views[i].world_from_camera, &own.world_from_camera);
            let other = &views[i].levels[level];
            let warp = Warp::new(&own.levels[level].intrinsics, &other.intrinsics, &motion);
            Source { level: other, warp }
        })
        .collect()
}

/// Shift of a neighbour's pixel per unit of inverse depth, px·m: the largest over `sources`, at the image centre.
pub(crate) fn shift_per_rho(level: &Level, sources: &[Source<'_>]) -> f32 {
    let (x, y) = (level.width as f32 * 0.5, level.height as f32 * 0.5);
    let shift = |source: &Source<'_>| {
        let at = |rho| source.warp.project(x, y, rho);
        // A small step from infinity: the derivative there, free of perspective.
        match (at(0.0), at(0.01)) {
            (Some(far), Some(near)) => ((near.0 - far.0).powi(2) + (near.1 - far.1).powi(2)).sqrt() * 100.0,
            _ => 0.0,
        }
    };
    sources.iter().map(shift).fold(0.0, f32::max)
}

/// Planes one pixel apart in the neighbour of the widest baseline, from infinity's side to `near_m`.
fn place_planes(level: &Level, sources: &[Source<'_>], near_m: f64, config: &StereoConfig) -> Planes {
    let (first, last) = (1.0 / config.max_depth_m, 1.0 / near_m.min(config.max_depth_m / 1.1));
    let pixels = f64::from(shift_per_rho(level, sources)) * (last - first);
    let count = (pixels.ceil() as usize + 1).clamp(16, config.max_planes);
    Planes { first: first as f32, step: ((last - first) / (count - 1) as f64) as f32, count }
}

/// Typical and nearest depth of a scene, metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SceneDepth {
    pub median: f64,
    pub near: f64,
}

/// A coarse estimate at a quarter of the size.
#[derive(Clone, Debug)]
pub(crate) struct Probe {
    pub depth: SceneDepth,
    /// Inverse depth at a quarter of the working size, 1/m; NaN where the estimate is ambiguous.
    pub rho: Vec<f32>,
}

/// Estimates depth coarsely at a quarter of the size. `Err` holds the largest parallax in degrees, if there is too little.
pub(crate) fn probe(views: &[Prepared], reference: usize, config: &StereoConfig) -> Result<Probe, f64> {
    // Depth is unknown here: average the score of a neighbour over the searched range, evenly in log depth.
    let ratio = config.max_depth_m / config.min_depth_m;
    let depths_m: Vec<f64> =
        (0..5).map(|i| config.min_depth_m * ratio.powf((i as f64 + 0.5) / 5.0)).collect();
    let Selection { neighbours, best_parallax_deg } = select(views, reference, &depths_m, config);
    if neighbours.is_empty() {
        return Err(best_parallax_deg);
    }
    let level = &views[reference].levels[PROBE_LEVEL];
    let sources = sources(views, reference, &neighbours, PROBE_LEVEL);
    let (first, last) = (1.0 / config.max_depth_m as f32, 1.0 / config.min_depth_m as f32);
    let planes = Planes { first, step: (last - first) / (PROBE_PLANES - 1) as f32, count: PROBE_PLANES };
    let costs = sweep(level, &sources, &planes, config.noise_gray as f32);
    let penalties = Penalties { step: config.step_penalty as i16, jump: config.jump_penalty as i16 };
    let sums = aggregate(level, &costs, planes.count, penalties);
    let winners = Winners::pick(level, &costs, &sums, &planes);
    let is_distinct = |i: usize| winners.cost[i] < 0.4 && winners.margin[i] > 0.05 && winners.rho[i] > 0.0;
    let rho: Vec<f32> =
        (0..winners.rho.len()).map(|i| if is_distinct(i) { winners.rho[i] } else { f32::NAN }).collect();
    let mut depths_m: Vec<f32> = rho.iter().filter(|rho| !rho.is_nan()).map(|rho| 1.0 / rho).collect();
    if depths_m.len() < rho.len() / 50 {
        let centre = (config.min_depth_m * config.max_depth_m).sqrt();
        return Ok(Probe { depth: SceneDepth { median: centre, near: config.min_depth_m }, rho });
    }
    depths_m.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| f64::from(depths_m[((depths_m.len() - 1) as f64 * share) as usize]);
    // Small near objects may have been missed at this size, so the near end keeps a margin.
    Ok(Probe { depth: SceneDepth { median: at(0.5), near: 0.6 * at(0.02) }, rho })
}

/// The best plane of every pixel.
pub(crate) struct Winners {
    pub rho: Vec<f32>,
    pub cost: Vec<f32>,
    pub margin: Vec<f32>,
}

impl Winners {
    /// Picks the least sum, fits a parabola through its neighbours, and finds the least sum more than two planes away.
    pub fn pick(level: &Level, costs: &[u8], sums: &[i16], planes: &Planes) -> Self {
        let n = level.width * level.height;
        let mut winners = Self { rho: vec![f32::NAN; n], cost: vec![1.0; n], margin: vec![0.0; n] };
        for pixel in 0..n {
            let sums = &sums[pixel * planes.count..][..planes.count];
            let costs = &costs[pixel * planes.count..][..planes.count];
            let Some((best, &least)) = sums.iter().enumerate().min_by_key(|(_, s)| **s) else { continue };
            if costs[best] == INVISIBLE {
                continue;
            }
            let outside = |k: usize| k.abs_diff(best) > 2;
            let next = (0..planes.count).filter(|&k| outside(k)).map(|k| sums[k]).min().unwrap_or(least);
            winners.rho[pixel] = planes.rho(best as f32 + parabola_offset(sums, best));
            winners.cost[pixel] = f32::from(costs[best]) / WORST;
            winners.margin[pixel] = f32::from(next - least) / (8.0 * WORST);
        }
        winners
    }
}

/// Offset in −0.5…0.5 of the least of the parabola through the sums around `best`.
fn parabola_offset(sums: &[i16], best: usize) -> f32 {
    if best == 0 || best + 1 >= sums.len() {
        return 0.0;
    }
    let (a, b, c) = (f32::from(sums[best - 1]), f32::from(sums[best]), f32::from(sums[best + 1]));
    let curvature = a - 2.0 * b + c;
    if curvature > 0.0 { (0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
}
