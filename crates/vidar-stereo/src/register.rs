//! Small corrections of the given poses, so that the images agree with them to a fraction of a pixel.
//!
//! Errors of odometry, of a depth camera's tracker or of a clock displace projections by several pixels, and stereo then
//! finds a wrong depth or none. Corners of every view, at the depth of the probe, are therefore matched around their
//! projections in other views, and a small bundle adjustment (Triggs 2000) corrects the poses: unknown are a correction
//! per view and an inverse depth per corner, the given poses are priors with the standard deviations of the settings,
//! and outliers are down-weighted (Cauchy). Inverse depths are eliminated (a scalar each), which leaves a dense system of
//! six unknowns per view.

mod solve;

use crate::config::StereoConfig;
use crate::estimate::{PROBE_LEVEL, Probe};
use crate::prepare::{Level, PoseCorrection, Prepared};
use crate::select::select;
use crate::warp::{Warp, neighbour_from_reference};
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use vidar_core::Se3;

/// One corner per square of this size, working pixels.
const CELL_PX: usize = 20;
/// Radius of a corner's template.
const TEMPLATE: isize = 4;
/// Radius of the search around the predicted position, working pixels.
const SEARCH: isize = 6;
/// Views that a corner is searched in.
const SEARCHED_VIEWS: usize = 5;
/// Least normalised correlation of a match.
const MIN_CORRELATION: f32 = 0.85;
/// Least standard deviation of a template in multiples of the noise: weaker ones match anything.
const MIN_TEXTURE: f32 = 4.0;

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
}

/// The views' poses, corrected; the given ones where there are too few matches.
pub(crate) fn register(
    views: &[Prepared],
    probes: &[Option<Probe>],
    config: &StereoConfig,
) -> Vec<CorrectedPose> {
    let mut tracks: Vec<Track> = (0..views.len())
        .into_par_iter()
        .flat_map_iter(|i| tracks_of(views, i, probes[i].as_ref(), config))
        .collect();
    let cameras: Vec<_> = views.iter().map(|v| v.levels[0].intrinsics).collect();
    let given: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    let prior =
        solve::PosePrior { rotation_rad: config.pose_std_deg.to_radians(), translation_m: config.pose_std_m };
    let poses = solve::adjusted(&given, &cameras, &mut tracks, &prior);
    let corrections = solve::corrections(&given, &poses, &cameras, &tracks);
    poses
        .into_iter()
        .zip(corrections)
        .map(|(world_from_camera, correction)| CorrectedPose { world_from_camera, correction })
        .collect()
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
    for (x, y) in corners(own) {
        let scale = 1 << PROBE_LEVEL;
        let (cx, cy) = ((x / scale).min(coarse.width - 1), (y / scale).min(coarse.height - 1));
        let rho = probe.rho[cy * coarse.width + cx];
        let Some(template) = Template::cut(own, x as isize, y as isize) else { continue };
        if !(rho > 0.0) || template.deviation < MIN_TEXTURE * config.noise_gray as f32 {
            continue;
        }
        let mut observations = Vec::new();
        for (warp, &n) in warps.iter().zip(&searched) {
            let Some((u, v, _)) = warp.project(x as f32, y as f32, rho) else { continue };
            if let Some(pixel) = template.search(&views[n].levels[0], u, v) {
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

/// The best corner of each square by the smaller eigenvalue of the structure tensor (Shi and Tomasi 1994).
fn corners(level: &Level) -> Vec<(usize, usize)> {
    let (w, h) = (level.width, level.height);
    let margin = TEMPLATE as usize + 1;
    let at = |x: usize, y: usize| level.gray[y * w + x];
    let strength = |x: usize, y: usize| -> f32 {
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for qy in y - 2..=y + 2 {
            for qx in x - 2..=x + 2 {
                let (gx, gy) = (at(qx + 1, qy) - at(qx - 1, qy), at(qx, qy + 1) - at(qx, qy - 1));
                xx += gx * gx;
                xy += gx * gy;
                yy += gy * gy;
            }
        }
        0.5 * (xx + yy - ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt())
    };
    let mut out = Vec::new();
    for top in (margin..h.saturating_sub(margin)).step_by(CELL_PX) {
        for left in (margin..w.saturating_sub(margin)).step_by(CELL_PX) {
            let mut best = (0.0f32, None);
            // Every other pixel: a corner is wider than that, and the match is found to a fraction of a pixel anyway.
            for y in (top..(top + CELL_PX).min(h - margin)).step_by(2) {
                for x in (left..(left + CELL_PX).min(w - margin)).step_by(2) {
                    let s = strength(x, y);
                    if s > best.0 {
                        best = (s, Some((x, y)));
                    }
                }
            }
            out.extend(best.1);
        }
    }
    out
}

const SIDE: usize = 2 * TEMPLATE as usize + 1;
const AREA: usize = SIDE * SIDE;

/// A window of grey levels, with zero mean.
struct Template {
    gray: [f32; AREA],
    deviation: f32,
}

impl Template {
    fn cut(level: &Level, x: isize, y: isize) -> Option<Self> {
        let (w, h) = (level.width as isize, level.height as isize);
        if x < TEMPLATE || y < TEMPLATE || x >= w - TEMPLATE || y >= h - TEMPLATE {
            return None;
        }
        let mut gray = [0.0; AREA];
        for (row, target) in gray.chunks_exact_mut(SIDE).enumerate() {
            let start = (y - TEMPLATE) as usize * level.width + row * level.width + (x - TEMPLATE) as usize;
            target.copy_from_slice(&level.gray[start..start + SIDE]);
        }
        let mean = gray.iter().sum::<f32>() / AREA as f32;
        gray.iter_mut().for_each(|g| *g -= mean);
        let deviation = (gray.iter().map(|g| g * g).sum::<f32>() / AREA as f32).sqrt();
        Some(Self { gray, deviation })
    }

    fn correlation(&self, other: &Self) -> f32 {
        let sum: f32 = self.gray.iter().zip(&other.gray).map(|(a, b)| a * b).sum();
        sum / (AREA as f32 * self.deviation * other.deviation).max(1e-6)
    }

    /// Position of the best correlation within the search radius, to a fraction of a pixel; `None` if the correlation is
    /// too low, or highest at the border of the search.
    fn search(&self, level: &Level, u: f32, v: f32) -> Option<Vector2<f64>> {
        let (u, v) = (u.round() as isize, v.round() as isize);
        let at = |dx: isize, dy: isize| -> f32 {
            Self::cut(level, u + dx, v + dy).map_or(-1.0, |t| self.correlation(&t))
        };
        let mut best = (MIN_CORRELATION, None);
        for dy in -SEARCH..=SEARCH {
            for dx in -SEARCH..=SEARCH {
                let c = at(dx, dy);
                if c > best.0 {
                    best = (c, Some((dx, dy)));
                }
            }
        }
        let (dx, dy) = best.1?;
        if dx.abs() == SEARCH || dy.abs() == SEARCH {
            return None;
        }
        let vertex = |a: f32, b: f32| {
            let curvature = a - 2.0 * best.0 + b;
            if curvature < -1e-6 { (0.5 * (a - b) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let x = (u + dx) as f32 + vertex(at(dx - 1, dy), at(dx + 1, dy));
        let y = (v + dy) as f32 + vertex(at(dx, dy - 1), at(dx, dy + 1));
        Some(Vector2::new(f64::from(x), f64::from(y)))
    }
}
