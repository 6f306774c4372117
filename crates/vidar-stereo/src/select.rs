//! Selection of the neighbours that a reference is matched with.
//!
//! A good neighbour observes the same surface (overlap), with a baseline wide enough to resolve depth and narrow enough
//! for similar appearance (parallax), and in another direction than the neighbours chosen before it. The weight of the
//! parallax angle is the piecewise Gaussian used by multi-view stereo since Goesele 2007 and MVSNet.

use crate::config::StereoConfig;
use crate::prepare::Prepared;
use nalgebra::Vector3;
use vidar_core::LieGroup;

/// Least share of the reference that is visible in a neighbour.
const MIN_OVERLAP: f64 = 0.25;
/// Fall-off of the weight above the best parallax, as a multiple of the best parallax.
const WIDE_SIGMA: f64 = 1.5;

/// Score of a candidate at one scene depth.
struct Candidate {
    index: usize,
    score: f64,
    /// From the reference to the candidate, metres, in the world.
    offset: Vector3<f64>,
}

/// The chosen neighbours, best first, and the largest parallax found at the given depths.
pub(crate) struct Selection {
    pub neighbours: Vec<usize>,
    pub best_parallax_deg: f64,
}

/// Chooses up to `config.neighbours` views for `reference`, for a scene at `depths_m` (averaged over them).
pub(crate) fn select(
    views: &[Prepared],
    reference: usize,
    depths_m: &[f64],
    config: &StereoConfig,
) -> Selection {
    let mut best_parallax_deg = 0.0f64;
    let mut candidates = Vec::new();
    for index in (0..views.len()).filter(|&i| i != reference) {
        let (mut score, mut parallax) = (0.0, 0.0f64);
        for &z in depths_m {
            let (overlap, angle_deg) = overlap_and_parallax(&views[reference], &views[index], z);
            if overlap >= MIN_OVERLAP {
                parallax = parallax.max(angle_deg);
                if angle_deg >= config.min_parallax_deg {
                    score += overlap * angle_weight(angle_deg, config) / depths_m.len() as f64;
                }
            }
        }
        best_parallax_deg = best_parallax_deg.max(parallax);
        if score > 0.0 {
            let offset =
                views[index].world_from_camera.translation - views[reference].world_from_camera.translation;
            candidates.push(Candidate { index, score, offset });
        }
    }
    Selection { neighbours: choose(candidates, config.neighbours), best_parallax_deg }
}

/// Greedy choice; a candidate near one already chosen scores less.
fn choose(mut candidates: Vec<Candidate>, count: usize) -> Vec<usize> {
    let mut chosen = Vec::with_capacity(count);
    while chosen.len() < count {
        // Ties go to the earlier view, so that the choice depends on the input only.
        let Some(best) = (0..candidates.len())
            .reduce(|a, b| if candidates[b].score > candidates[a].score { b } else { a })
        else {
            break;
        };
        let taken = candidates.remove(best);
        for other in &mut candidates {
            let apart = (other.offset - taken.offset).norm() / taken.offset.norm().max(f64::MIN_POSITIVE);
            // Half a baseline apart scores nearly in full, the same position a fifth.
            other.score *= 1.0 - 0.8 * (-(apart / 0.3).powi(2)).exp();
        }
        chosen.push(taken.index);
    }
    chosen
}

fn angle_weight(angle_deg: f64, config: &StereoConfig) -> f64 {
    let best = config.best_parallax_deg;
    let sigma = if angle_deg < best { 0.6 * best } else { WIDE_SIGMA * best };
    (-0.5 * ((angle_deg - best) / sigma).powi(2)).exp()
}

/// Share of a grid of reference pixels at depth `z_m` that is visible in `other`, and their mean parallax, degrees.
pub(crate) fn overlap_and_parallax(reference: &Prepared, other: &Prepared, z_m: f64) -> (f64, f64) {
    const GRID: usize = 6;
    let (k, k_other) = (&reference.levels[0].intrinsics, &other.levels[0].intrinsics);
    let other_from_reference = other.world_from_camera.inverse() * reference.world_from_camera;
    let center = other_from_reference.translation;
    let (mut visible, mut angle) = (0usize, 0.0);
    for i in 0..GRID {
        for j in 0..GRID {
            let x = (i as f64 + 0.5) / GRID as f64 * k.width as f64 - 0.5;
            let y = (j as f64 + 0.5) / GRID as f64 * k.height as f64 - 0.5;
            let point = other_from_reference * (k.ray(x, y) * z_m);
            let Some(pixel) = k_other.project(&point) else { continue };
            let inside = pixel.x >= 0.0
                && pixel.y >= 0.0
                && pixel.x <= (k_other.width - 1) as f64
                && pixel.y <= (k_other.height - 1) as f64;
            if inside {
                visible += 1;
                // Between the rays from the two centres to the point.
                angle += point.angle(&(point - center)).to_degrees();
            }
        }
    }
    (visible as f64 / (GRID * GRID) as f64, if visible > 0 { angle / visible as f64 } else { 0.0 })
}
