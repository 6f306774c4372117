//! Depth of one reference view from its neighbours, before views are compared with each other.
//!
//! Probe for the scene's depth → choose neighbours for that depth → sweep of the whole range and semi-global matching at a
//! quarter of the size → edges, sweep along the surface found and semi-global matching over the offsets at half the size
//! → edges and matching cost at the full size (`fine`). Each size continues the surface of the one before along its slopes.

use crate::config::StereoConfig;
use crate::edges::with_sharp_edges;
use crate::fine::settle;
use crate::ncc::{Reference, Source, Surface};
use crate::prepare::{Level, Prepared};
use crate::select::{Selection, select};
use crate::sgm::{Penalties, Winners, aggregate};
use crate::surface::{Grid, doubled};
use crate::sweep::{Labels, sweep};
use crate::warp::{Warp, neighbour_from_reference};
use crate::window::UNITS;
use tracing::trace_span;

/// Pyramid level of the sweep over the whole range, and of the probe for the scene's depth.
const COARSE: usize = 2;
/// Pyramid level of the sweep along the surface.
const MIDDLE: usize = 1;
/// Pyramid level of the probe.
pub(crate) const PROBE_LEVEL: usize = COARSE;
/// Planes of the probe.
const PROBE_PLANES: usize = 64;
/// Shift of the best neighbour's pixel from one plane of the coarse sweep to the next, pixels of that size. More planes find
/// no more (HoloLens keyframes 0 to 15: completeness .606, .621, .631 and .624 at 0.67, 1, 1.5 and 2 px, AbsRel .0266, .0237,
/// .0236, .0229); offsets from the surface resolve the rest.
const PLANE_PX: f64 = 1.5;
/// Offsets from the surface, and how many of them a plane of the coarse sweep is apart from the next: the surface is
/// searched 1.6 planes to both sides.
const OFFSETS: usize = 17;
const OFFSETS_PER_PLANE: f32 = 5.0;
/// Share of the penalties between planes that holds between offsets, which differ by less. At 0.7 and 0.5 AbsRel is .0219 and
/// .0216 on HoloLens keyframes 0 to 15, .0083 and .0082 on rendered room A, .0176 and .0171 on the corridor; completeness is
/// .678 and .667, .962 and .963, .837 and .838.
const OFFSET_PENALTY: f32 = 0.5;
/// How far away the surfaces are that are tried at edges before the offsets, pixels of the middle size. On the same sets
/// completeness is .676 and .678, .961 and .962, .834 and .837 without and with, AbsRel .0222 and .0219, .0084 and .0083,
/// .0178 and .0176.
const REACH_PX: isize = 3;
/// Neighbours that the full size is scored against: the best few decide, and each costs the same time.
const SCORED_NEIGHBOURS: usize = 3;

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

/// The surface from the coarse size to the full one, with its scores.
fn matched(
    views: &[Prepared],
    reference: usize,
    neighbours: &[usize],
    near_m: f64,
    config: &StereoConfig,
) -> Estimate {
    let [fine, middle, coarse] = &views[reference].levels;
    let sources = |level: usize| sources(views, reference, neighbours, level);
    let penalties = Penalties { step: config.step_penalty as i16, jump: config.jump_penalty as i16 };
    let noise_gray = config.noise_gray as f32;

    let coarse_sources = sources(COARSE);
    let planes = place_planes(coarse, &coarse_sources, near_m.max(config.min_depth_m), config);
    let winners = trace_span!("quarter size")
        .in_scope(|| best_planes(coarse, &coarse_sources, &planes, penalties, noise_gray));

    let surface = continued(&winners.rho, coarse, middle, planes.step);
    let step = planes.step / OFFSETS_PER_PLANE;
    let offsets = Labels { first: -step * (OFFSETS / 2) as f32, step, count: OFFSETS };
    let moved = trace_span!("half size").in_scope(|| {
        let (windows, sources) = (Reference::new(middle, noise_gray), sources(MIDDLE));
        let surface = trace_span!("edges")
            .in_scope(|| with_sharp_edges(&windows, &sources, surface, planes.step, REACH_PX));
        best_offsets(middle, &windows, &sources, &surface, &offsets, penalties.scaled(OFFSET_PENALTY))
    });

    let rho = continued(&moved, middle, fine, 0.5 * planes.step);
    let span = trace_span!("full size").entered();
    let windows = Reference::new(fine, noise_gray);
    let fine_sources = sources(0);
    let best_sources = &fine_sources[..fine_sources.len().min(SCORED_NEIGHBOURS)];
    let mut settled = settle(&windows, best_sources, rho, planes.step);
    for (rho, _) in settled.rho.iter_mut().zip(&views[reference].masked).filter(|(_, masked)| **masked) {
        *rho = f32::NAN;
    }
    drop(span);
    let rho_per_px = 1.0 / shift_per_rho(fine, &fine_sources).max(f32::MIN_POSITIVE);
    let coarse_pixel = |i: usize| {
        let (x, y) = (i % fine.width / 4, i / fine.width / 4);
        y.min(coarse.height - 1) * coarse.width + x.min(coarse.width - 1)
    };
    Estimate {
        margin: (0..settled.rho.len()).map(|i| winners.margin[coarse_pixel(i)]).collect(),
        texture: windows.inverse_deviation.iter().map(|d| 1.0 / (UNITS * d)).collect(),
        curvature: settled.bend.iter().map(|b| b * rho_per_px * rho_per_px).collect(),
        cost: settled.cost,
        rho: settled.rho,
        rho_per_px,
    }
}

/// The sweep of `planes` with semi-global matching.
fn best_planes(
    level: &Level,
    sources: &[Source<'_>],
    planes: &Labels,
    penalties: Penalties,
    noise_gray: f32,
) -> Winners {
    let infinity = vec![0.0; level.width];
    let surface = Surface { rho: &infinity, stride: 0 };
    best_labels(level, &Reference::new(level, noise_gray), sources, surface, planes, penalties)
}

/// `surface` moved by the best of `offsets` at each pixel.
fn best_offsets(
    level: &Level,
    windows: &Reference,
    sources: &[Source<'_>],
    surface: &[f32],
    offsets: &Labels,
    penalties: Penalties,
) -> Vec<f32> {
    let over = Surface { rho: surface, stride: level.width };
    let winners = best_labels(level, windows, sources, over, offsets, penalties);
    // Where no neighbour sees any offset the surface stays as it is; the scores say that nothing matches.
    surface.iter().zip(&winners.rho).map(|(s, o)| if o.is_nan() { *s } else { s + o }).collect()
}

fn best_labels(
    level: &Level,
    windows: &Reference,
    sources: &[Source<'_>],
    surface: Surface<'_>,
    labels: &Labels,
    penalties: Penalties,
) -> Winners {
    let volume = trace_span!("sweep").in_scope(|| sweep(windows, sources, surface, labels));
    let sums = trace_span!("semi-global matching").in_scope(|| aggregate(level, &volume, penalties));
    trace_span!("winners").in_scope(|| Winners::pick(&volume, &sums, labels))
}

/// The surface of `from` at the size of `to`.
fn continued(rho: &[f32], from: &Level, to: &Level, step: f32) -> Vec<f32> {
    let _span = trace_span!("continuation").entered();
    let coarse = Grid { width: from.width, height: from.height, values: rho };
    doubled(coarse, to.width, to.height, step)
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

/// Planes [`PLANE_PX`] apart in the neighbour of the widest baseline, from infinity's side to `near_m`.
fn place_planes(level: &Level, sources: &[Source<'_>], near_m: f64, config: &StereoConfig) -> Labels {
    let (first, last) = (1.0 / config.max_depth_m, 1.0 / near_m.min(config.max_depth_m / 1.1));
    let pixels = f64::from(shift_per_rho(level, sources)) * (last - first) / PLANE_PX;
    let count = (pixels.ceil() as usize + 1).clamp(16, config.max_planes);
    Labels { first: first as f32, step: ((last - first) / (count - 1) as f64) as f32, count }
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
    let _span = trace_span!("probe").entered();
    let level = &views[reference].levels[PROBE_LEVEL];
    let sources = sources(views, reference, &neighbours, PROBE_LEVEL);
    let (first, last) = (1.0 / config.max_depth_m as f32, 1.0 / config.min_depth_m as f32);
    let planes = Labels { first, step: (last - first) / (PROBE_PLANES - 1) as f32, count: PROBE_PLANES };
    let penalties = Penalties { step: config.step_penalty as i16, jump: config.jump_penalty as i16 };
    let winners = best_planes(level, &sources, &planes, penalties, config.noise_gray as f32);
    let is_usable = |i: usize| level.hidden.is_empty() || !level.hidden[i];
    let is_distinct =
        |i: usize| is_usable(i) && winners.cost[i] < 0.4 && winners.margin[i] > 0.05 && winners.rho[i] > 0.0;
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
