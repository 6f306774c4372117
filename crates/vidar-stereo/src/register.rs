//! Small corrections of the given poses, so that the images agree with them to a fraction of a pixel.
//!
//! Errors of odometry, of a depth camera's tracker or of a clock displace projections by several pixels, and stereo then
//! finds a wrong depth or none. Corners of every view, at the depth of the probe, are therefore matched around their
//! projections in other views, as these see the window around them and only where no other place looks like it. A small
//! bundle adjustment (Triggs 2000) corrects the poses: unknown are a correction per view and an inverse depth per corner,
//! the given poses are priors with the standard deviations of the settings, and outliers are down-weighted (Cauchy).
//! Inverse depths are eliminated (a scalar each), which leaves a dense system of six unknowns per view.

mod search;
mod solve;

use crate::config::{PoseStd, StereoConfig};
use crate::estimate::{PROBE_LEVEL, Probe};
use crate::prepare::{Level, PoseCorrection, Prepared};
use crate::select::select;
use crate::warp::{Warp, neighbour_from_reference};
use nalgebra::{Matrix2, Vector2, Vector3};
use rayon::prelude::*;
use tracing::trace_span;
use vidar_core::Se3;

/// Views that a corner is searched in.
const SEARCHED_VIEWS: usize = 5;
/// Least standard deviation of a template in multiples of the noise: weaker ones match anything.
const MIN_TEXTURE: f32 = 4.0;
/// A window that is seen at less than this share of its area, or more than its inverse, is not matched.
const MIN_AREA_RATIO: f32 = 0.1;

/// A corner of one view and its observations in others.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    /// Its host view.
    pub host: usize,
    /// Its ray there, z = 1.
    pub ray: Vector3<f64>,
    /// Inverse depth there, 1/m.
    pub rho: f64,
    /// Views and pixels of its observations.
    pub observations: Vec<(usize, Vector2<f64>)>,
}

/// A corrected pose.
pub(crate) struct CorrectedPose {
    pub world_from_camera: Se3,
    /// Size and residual of the correction.
    pub correction: PoseCorrection,
    /// By matches and prior together; the prior's where there are too few matches.
    pub std: PoseStd,
}

/// The views' poses, corrected; the given ones, which `prior` is the standard deviation of, where there are too few matches.
pub(crate) fn register(
    views: &[Prepared],
    probes: &[Option<Probe>],
    prior: &PoseStd,
    config: &StereoConfig,
) -> Vec<CorrectedPose> {
    let mut tracks: Vec<Track> = (0..views.len())
        .into_par_iter()
        .flat_map_iter(|i| trace_span!("tracks").in_scope(|| tracks_of(views, i, probes[i].as_ref(), config)))
        .collect();
    let _span = trace_span!("adjustment").entered();
    let cameras: Vec<_> = views.iter().map(|v| v.levels[0].intrinsics).collect();
    let given: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    let adjusted = solve::adjusted(&given, &cameras, &mut tracks, prior);
    let poses: Vec<Se3> = adjusted.iter().map(|a| a.0).collect();
    let corrections = solve::corrections(&given, &poses, &cameras, &tracks);
    let corrected =
        |((world_from_camera, std), correction)| CorrectedPose { world_from_camera, correction, std };
    adjusted.into_iter().zip(corrections).map(corrected).collect()
}

/// Corners of a view with known depth, each matched in its best neighbours.
fn tracks_of(views: &[Prepared], host: usize, probe: Option<&Probe>, config: &StereoConfig) -> Vec<Track> {
    let Some(probe) = probe else { return Vec::new() };
    let searched = select(
        views,
        host,
        &[probe.depth.median],
        &StereoConfig { neighbours: SEARCHED_VIEWS, ..config.clone() },
    )
    .neighbours;
    let own = &views[host].levels[0];
    let coarse = &views[host].levels[PROBE_LEVEL];
    let warps: Vec<Warp> = searched
        .iter()
        .map(|&n| {
            let motion =
                neighbour_from_reference(&views[n].world_from_camera, &views[host].world_from_camera);
            Warp::new(&own.intrinsics, &views[n].levels[0].intrinsics, &motion)
        })
        .collect();
    let mut tracks = Vec::new();
    for (x, y) in search::corners(own) {
        if touches_mask(own, x, y) {
            continue;
        }
        let scale = 1 << PROBE_LEVEL;
        let (cx, cy) = ((x / scale).min(coarse.width - 1), (y / scale).min(coarse.height - 1));
        let rho = probe.rho[cy * coarse.width + cx];
        let Some(template) = search::Template::cut(own, x, y) else { continue };
        if !(rho > 0.0) || template.deviation() < MIN_TEXTURE * config.noise_gray as f32 {
            continue;
        }
        let mut observations = Vec::new();
        for (warp, &n) in warps.iter().zip(&searched) {
            let Some((seen, at)) = seen_by(own, warp, (x, y), rho) else { continue };
            let other = &views[n].levels[0];
            if let Some(pixel) = seen.search(other, at.x, at.y)
                && !touches_mask(other, pixel.x as usize, pixel.y as usize)
            {
                observations.push((n, pixel));
            }
        }
        if observations.len() >= 2 {
            let ray = own.intrinsics.ray(x as f64, y as f64);
            tracks.push(Track { host, ray, rho: f64::from(rho), observations });
        }
    }
    tracks
}

/// The window around a corner as a neighbour sees it, on a plane across the corner's ray at inverse depth `rho`, and the neighbour's
/// pixel of the corner: turned and scaled windows match where upright ones are off by a fraction of a pixel, all to the same side. `None`
/// where the neighbour sees it at less than a third of the size or more than three times of it.
fn seen_by(
    own: &Level,
    warp: &Warp,
    (x, y): (usize, usize),
    rho: f32,
) -> Option<(search::Template, Vector2<f32>)> {
    let at = |x, y| warp.project(x as f32, y as f32, rho).map(|(u, v, _)| Vector2::new(u, v));
    let corner = at(x, y)?;
    let other_from_own = Matrix2::from_columns(&[at(x + 1, y)? - corner, at(x, y + 1)? - corner]);
    let area = other_from_own.determinant();
    if !(MIN_AREA_RATIO..=1.0 / MIN_AREA_RATIO).contains(&area) {
        return None;
    }
    let template = search::Template::warped(own, x, y, &other_from_own.try_inverse()?)?;
    Some((template, corner))
}

/// Whether a template around the pixel may hold a part of what must not be used: at its corners or its middle, which a person covers
/// where they cover any of it.
fn touches_mask(level: &Level, x: usize, y: usize) -> bool {
    let near = search::TEMPLATE;
    let at =
        |x: usize, y: usize| level.hidden[y.min(level.height - 1) * level.width + x.min(level.width - 1)];
    let columns = [x.saturating_sub(near), x, x + near];
    let rows = [y.saturating_sub(near), y, y + near];
    !level.hidden.is_empty() && rows.iter().any(|&y| columns.iter().any(|&x| at(x, y)))
}
