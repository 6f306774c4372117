//! Distances of the surfaces of runs to that of the first, and back.

use super::load::StoredRun;
use crate::error::Error;
use crate::interactive::Samples;
use serde_json::{Value, json};
use vidar_core::TriangleMesh;
use vidar_eval::{NearestIndex, SampleDensity, nearest_distances, sample_mesh};

/// Points on a surface at most: a point every centimetre on 200 m².
const MOST_SAMPLES: usize = 2_000_000;
/// Spacing of points where a run does not say its voxels, m.
const USUAL_SPACING_M: f64 = 0.01;
/// Distance within which surfaces count as the same: the tighter of the two thresholds of scores.
const SAME_M: f32 = 0.05;

/// Distances between the surfaces of one run and of the first.
#[derive(Debug)]
pub(super) struct SurfaceDistance {
    /// Number of the run.
    pub run: usize,
    /// Of points of the run to the first run's surface.
    pub to_first: Samples,
    /// Of points of the first run to the run's surface.
    pub from_first: Samples,
}

impl SurfaceDistance {
    pub(super) fn json(&self) -> Value {
        json!({ "to_first": summary(&self.to_first).json(), "from_first": summary(&self.from_first).json() })
    }

    pub(super) fn words(&self, runs: &[StoredRun]) -> String {
        let unit = crate::interactive::unit_name(runs[0].metrics.scale.is_metric);
        let (there, back) = (summary(&self.to_first), summary(&self.from_first));
        format!(
            "median {:.4} {unit}, 90 % below {:.4}; back: median {:.4}, 90 % below {:.4}",
            there.median, there.p90, back.median, back.p90
        )
    }
}

/// Quantiles of distances.
pub(super) struct Summary {
    pub median: f64,
    pub mean: f64,
    pub p90: f64,
    /// Share within [`SAME_M`].
    pub same: f64,
}

impl Summary {
    fn json(&self) -> Value {
        json!({ "median_m": self.median, "mean_m": self.mean, "p90_m": self.p90, "within_5cm": self.same })
    }
}

/// Quantiles of the finite distances.
pub(super) fn summary(samples: &Samples) -> Summary {
    let mut finite: Vec<f32> = samples.values.iter().copied().filter(|v| v.is_finite()).collect();
    finite.sort_unstable_by(f32::total_cmp);
    let n = finite.len();
    let at = |share: f64| finite.get(((n as f64 * share) as usize).min(n.saturating_sub(1))).copied().unwrap_or(f32::NAN);
    let of_all = |sum: f64| sum / n.max(1) as f64;
    Summary {
        median: f64::from(at(0.5)),
        mean: of_all(finite.iter().map(|&v| f64::from(v)).sum()),
        p90: f64::from(at(0.9)),
        same: of_all(finite.iter().filter(|v| **v <= SAME_M).count() as f64),
    }
}

/// Points on the surfaces and their distances to the surface of the other, in the world of the first run.
///
/// A surface is represented by points half a voxel apart, as in scores, so equal surfaces are some tenths of that apart.
pub(super) fn measure(runs: &[StoredRun]) -> Result<Vec<SurfaceDistance>, Error> {
    let Some(first) = runs.first().filter(|r| !r.mesh.triangles.is_empty()) else { return Ok(Vec::new()) };
    let of_first = sampled(first)?;
    let first_index = NearestIndex::build(&of_first)?;
    let mut distances = Vec::new();
    for (run, stored) in runs.iter().enumerate().skip(1).filter(|(_, r)| !r.mesh.triangles.is_empty()) {
        let of_run = sampled(stored)?;
        let index = NearestIndex::build(&of_run)?;
        let to_first = nearest_distances(&of_run, &first_index, None);
        let from_first = nearest_distances(&of_first, &index, None);
        distances.push(SurfaceDistance {
            run,
            to_first: Samples { positions: of_run, values: to_first },
            from_first: Samples { positions: of_first.clone(), values: from_first },
        });
    }
    Ok(distances)
}

fn sampled(run: &StoredRun) -> Result<Vec<[f32; 3]>, Error> {
    let spacing = run.voxel_size_m().map_or(USUAL_SPACING_M, |v| v / 2.0);
    let density = match area_m2(&run.mesh) / (spacing * spacing) {
        count if count > MOST_SAMPLES as f64 => SampleDensity::Count(MOST_SAMPLES),
        _ => SampleDensity::SpacingM(spacing),
    };
    Ok(sample_mesh(&run.mesh, density)?.positions)
}

fn area_m2(mesh: &TriangleMesh) -> f64 {
    let of = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| nalgebra::Vector3::from(mesh.positions[i as usize].map(f64::from)));
        let area = (b - a).cross(&(c - a)).norm() / 2.0;
        if area.is_finite() { area } else { 0.0 }
    };
    mesh.triangles.iter().map(of).sum()
}
