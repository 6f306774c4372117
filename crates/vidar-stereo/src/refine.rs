//! From the coarse winners to slanted planes at the working size.
//!
//! Every pixel holds a plane `ρ(x+dx, y+dy) = ρ + gx·dx + gy·dy` in inverse depth, which is exactly a plane in space.
//! In each round a pixel tests the planes of pixels around it and small changes of its own, and keeps the one whose
//! windows correlate best in the better half of the neighbours (the idea of PatchMatch stereo, Bleyer 2011). All
//! pixels read the previous round, so the order does not matter. A weak prior at the semi-global solution decides
//! where the texture does not.

use crate::config::StereoConfig;
use crate::estimate::{Estimate, Winners, shift_per_rho};
use crate::prepare::Level;
use crate::sweep::{Planes, Source};
use crate::warp::sample;
use rayon::prelude::*;

/// A plane in inverse depth around a pixel.
#[derive(Clone, Copy, Debug)]
struct Plane {
    rho: f32,
    gx: f32,
    gy: f32,
    score: f32,
    cost: f32,
    /// Second derivative of the cost by inverse depth, m².
    curvature: f32,
}

/// Penalty of a deviation from the coarse solution, per plane of difference, in units of a full mismatch.
const PRIOR_WEIGHT: f32 = 0.05;
/// Differences from the coarse solution beyond this many planes cost no more.
const PRIOR_LIMIT_PLANES: f32 = 2.0;
/// Brightness difference at which a pixel's weight in the window is halved, grey levels.
const BILATERAL_GRAY: f32 = 25.0;
/// Window of the refinement: every other pixel of 7 × 7.
const REACH: i32 = 3;
const SAMPLES: usize = 25;
/// Neighbours used by the refinement: the best few contribute most, and each costs the same time.
const MOST_SOURCES: usize = 3;
/// Offsets of the pixels whose planes are tested, by round: near ones, then further ones.
const FROM: [[(i32, i32); 4]; 2] = [[(-1, 0), (1, 0), (0, -1), (0, 1)], [(-4, 1), (4, -1), (1, 4), (-1, -4)]];

/// Refines `winners` (at `coarse`'s size) on `fine`.
pub(crate) fn refine(
    fine: &Level,
    coarse: &Level,
    winners: &Winners,
    sources: &[Source<'_>],
    planes: &Planes,
    config: &StereoConfig,
) -> Estimate {
    let (w, h) = (fine.width, fine.height);
    let prior = upsample(fine, coarse, winners, planes);
    let patches = Patches { fine, sources, noise_variance: (config.noise_gray * config.noise_gray) as f32 };
    let step = planes.step;
    let mut state: Vec<Plane> = prior.clone();
    for round in 0..config.refine_rounds.max(1) {
        // Without rounds the planes are only scored.
        let search = config.refine_rounds > 0;
        let delta = 0.4 * step * 0.5f32.powi(round as i32);
        let before = state;
        let mut next = before.clone();
        next.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
            for (x, own) in row.iter_mut().enumerate() {
                let center = prior[y * w + x].rho;
                if !center.is_finite() {
                    continue;
                }
                let patch = patches.reference(x, y);
                let mut best = *own;
                if round == 0 {
                    best = patches.scored(best, center, step, &patch);
                }
                if search {
                    for (dx, dy) in FROM[round % 2] {
                        let (qx, qy) = (x as i32 + dx, y as i32 + dy);
                        if qx < 0 || qy < 0 || qx >= w as i32 || qy >= h as i32 {
                            continue;
                        }
                        let q = before[qy as usize * w + qx as usize];
                        let rho = q.rho - q.gx * dx as f32 - q.gy * dy as f32;
                        // Nearly the same plane: skipped.
                        if rho > 0.0 && (rho - own.rho).abs() > 0.5 * delta {
                            let candidate = patches.scored(Plane { rho, ..q }, center, step, &patch);
                            if candidate.score < best.score {
                                best = candidate;
                            }
                        }
                    }
                    best = patches.settled(best, delta, center, step, &patch);
                }
                *own = best;
            }
        });
        state = next;
    }
    let texture = (0..w * h).map(|i| patches.reference(i % w, i / w).variance.sqrt()).collect();
    let margin = (0..w * h).map(|i| winners.margin[coarse_index(coarse, i % w, i / w)]).collect();
    let rho_per_px = 1.0 / shift_per_rho(fine, sources).max(f32::MIN_POSITIVE);
    Estimate {
        curvature: state.iter().map(|p| p.curvature * rho_per_px * rho_per_px).collect(),
        rho: state.iter().map(|p| p.rho).collect(),
        cost: state.iter().map(|p| p.cost).collect(),
        margin,
        texture,
        rho_per_px,
    }
}

fn coarse_index(coarse: &Level, x: usize, y: usize) -> usize {
    (y / 2).min(coarse.height - 1) * coarse.width + (x / 2).min(coarse.width - 1)
}

/// The coarse planes at the fine size, with gradients from the coarse pixels around that lie on the same surface.
fn upsample(fine: &Level, coarse: &Level, winners: &Winners, planes: &Planes) -> Vec<Plane> {
    let (cw, ch) = (coarse.width, coarse.height);
    let gradient = |cx: usize, cy: usize| -> (f32, f32, f32) {
        let center = winners.rho[cy * cw + cx];
        let (mut sums, mut count) = ([0.0f32; 6], 0.0f32);
        for qy in cy.saturating_sub(2)..(cy + 3).min(ch) {
            for qx in cx.saturating_sub(2)..(cx + 3).min(cw) {
                let rho = winners.rho[qy * cw + qx];
                if (rho - center).abs() < 1.5 * planes.step {
                    let (dx, dy, dr) = (qx as f32 - cx as f32, qy as f32 - cy as f32, rho - center);
                    for (s, v) in sums.iter_mut().zip([dx * dx, dy * dy, dx * dr, dy * dr, dr, 1.0]) {
                        *s += v;
                    }
                    count += 1.0;
                }
            }
        }
        if count < 8.0 {
            return (center, 0.0, 0.0);
        }
        // The window is symmetric but for its holes, so the mixed terms are neglected.
        (center + sums[4] / count, sums[2] / sums[0].max(1.0), sums[3] / sums[1].max(1.0))
    };
    let coarse_planes: Vec<(f32, f32, f32)> =
        (0..cw * ch).into_par_iter().map(|i| gradient(i % cw, i / cw)).collect();
    (0..fine.width * fine.height)
        .map(|i| {
            let (x, y) = (i % fine.width, i / fine.width);
            let (rho, gx, gy) = coarse_planes[coarse_index(coarse, x, y)];
            // Fine pixel 2c + 0 lies a quarter of a coarse pixel before the centre of c, 2c + 1 a quarter after.
            let offset = |p: usize, c: usize| (p as f32 + 0.5) * 0.5 - 0.5 - c as f32;
            let rho = rho + gx * offset(x, (x / 2).min(cw - 1)) + gy * offset(y, (y / 2).min(ch - 1));
            Plane { rho, gx: 0.5 * gx, gy: 0.5 * gy, score: f32::INFINITY, cost: 1.0, curvature: 0.0 }
        })
        .collect()
}

struct Patches<'a> {
    fine: &'a Level,
    sources: &'a [Source<'a>],
    noise_variance: f32,
}

/// The reference's window: offsets, centred grey levels and weights summing to one.
struct Patch {
    x: f32,
    y: f32,
    dx: [f32; SAMPLES],
    dy: [f32; SAMPLES],
    gray: [f32; SAMPLES],
    weight: [f32; SAMPLES],
    variance: f32,
}

impl Patches<'_> {
    fn reference(&self, x: usize, y: usize) -> Patch {
        let (w, h) = (self.fine.width as i32, self.fine.height as i32);
        let at = |x: i32, y: i32| self.fine.gray[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize];
        let (x, y) = (x as i32, y as i32);
        let center = at(x, y);
        let mut patch = Patch {
            x: x as f32,
            y: y as f32,
            dx: [0.0; SAMPLES],
            dy: [0.0; SAMPLES],
            gray: [0.0; SAMPLES],
            weight: [0.0; SAMPLES],
            variance: 0.0,
        };
        let mut i = 0;
        let (mut total, mut mean) = (0.0, 0.0);
        for dy in -REACH..=REACH {
            for dx in -REACH..=REACH {
                if (dx + dy) % 2 != 0 {
                    continue;
                }
                // The border repeats, and so does the offset: reference and neighbour repeat alike.
                let (px, py) = ((x + dx).clamp(0, w - 1), (y + dy).clamp(0, h - 1));
                let gray = at(px, py);
                let difference = (gray - center).abs() / BILATERAL_GRAY;
                // A rational fall-off: as good as an exponential one, and faster.
                let weight = 1.0 / (1.0 + difference * difference);
                (patch.dx[i], patch.dy[i]) = ((px - x) as f32, (py - y) as f32);
                (patch.gray[i], patch.weight[i]) = (gray, weight);
                total += weight;
                mean += weight * gray;
                i += 1;
            }
        }
        mean /= total;
        for i in 0..SAMPLES {
            patch.gray[i] -= mean;
            patch.weight[i] /= total;
            patch.variance += patch.weight[i] * patch.gray[i] * patch.gray[i];
        }
        patch
    }

    fn scored(&self, plane: Plane, center: f32, step: f32, patch: &Patch) -> Plane {
        let cost = self.cost(&plane, patch);
        let deviation = ((plane.rho - center).abs() / step).min(PRIOR_LIMIT_PLANES);
        Plane { score: cost + PRIOR_WEIGHT * deviation, cost, ..plane }
    }

    /// The best of a plane and the two `delta` nearer and further, with the vertex of the parabola through them.
    fn settled(&self, plane: Plane, delta: f32, center: f32, step: f32, patch: &Patch) -> Plane {
        let at = |by: f32| self.scored(Plane { rho: plane.rho + by, ..plane }, center, step, patch);
        let (further, nearer) = (at(-delta), at(delta));
        let bend = (further.cost - 2.0 * plane.cost + nearer.cost) / (delta * delta);
        if further.score < plane.score && further.score <= nearer.score && further.rho > 0.0 {
            return Plane { curvature: bend, ..further };
        }
        if nearer.score < plane.score {
            return Plane { curvature: bend, ..nearer };
        }
        let curvature = further.score - 2.0 * plane.score + nearer.score;
        if !(curvature > 1e-4) {
            return Plane { curvature: bend, ..plane };
        }
        let offset = (0.5 * (further.score - nearer.score) / curvature).clamp(-0.5, 0.5);
        Plane { rho: plane.rho + offset * delta, curvature: bend, ..plane }
    }

    /// Mean of `1 − ncc` over the better half of the neighbours; 1 where the window is visible in none.
    fn cost(&self, plane: &Plane, patch: &Patch) -> f32 {
        let mut costs = [f32::INFINITY; MOST_SOURCES];
        let n = self.sources.len().min(MOST_SOURCES);
        for (cost, source) in costs.iter_mut().zip(self.sources) {
            *cost = self.mismatch(plane, patch, source);
        }
        costs[..n].sort_unstable_by(f32::total_cmp);
        let half = n.div_ceil(2);
        let best = costs[0];
        if !best.is_finite() {
            return 1.0;
        }
        costs[..half].iter().map(|&c| if c.is_finite() { c } else { best }).sum::<f32>() / half as f32
    }

    fn mismatch(&self, plane: &Plane, patch: &Patch, source: &Source<'_>) -> f32 {
        let (a, b) = (&source.warp.a, &source.warp.b);
        let base = source.warp.apply(patch.x, patch.y, plane.rho);
        let ddx = [0, 1, 2].map(|r| a[r][0] + plane.gx * b[r]);
        let ddy = [0, 1, 2].map(|r| a[r][1] + plane.gy * b[r]);
        let mut values = [0.0f32; SAMPLES];
        for i in 0..SAMPLES {
            let (dx, dy) = (patch.dx[i], patch.dy[i]);
            let inverse = 1.0 / (base[2] + ddx[2] * dx + ddy[2] * dy);
            let u = (base[0] + ddx[0] * dx + ddy[0] * dy) * inverse;
            let v = (base[1] + ddx[1] * dx + ddy[1] * dy) * inverse;
            values[i] = sample(&source.level.gray, source.level.width, source.level.height, u, v);
        }
        let (mut mean, mut square, mut cross) = (0.0, 0.0, 0.0);
        for i in 0..SAMPLES {
            let value = values[i] - 128.0;
            mean += patch.weight[i] * value;
            square += patch.weight[i] * value * value;
            // The reference is centred, so the neighbour's mean drops out.
            cross += patch.weight[i] * value * patch.gray[i];
        }
        if mean.is_nan() || base[2] < crate::warp::MIN_DEPTH_RATIO {
            return f32::INFINITY;
        }
        let variance = (square - mean * mean).max(0.0);
        let scale = ((variance + self.noise_variance) * (patch.variance + self.noise_variance)).sqrt();
        (1.0 - cross / scale).clamp(0.0, 1.0)
    }
}
