//! Distances of the surfaces of runs to that of the first, and back.

use super::load::StoredRun;
use crate::error::Error;
use crate::interactive::Samples;
use rayon::prelude::*;
use serde_json::{Value, json};
use vidar_core::{PointCloud, TriangleMesh};
use vidar_eval::{NearestIndex, Neighbour, SampleDensity, sample_mesh};

/// Points on a surface at most: one every centimetre on 200 m².
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
    let at = |share: f64| {
        finite.get(((n as f64 * share) as usize).min(n.saturating_sub(1))).copied().unwrap_or(f32::NAN)
    };
    let of_all = |sum: f64| sum / n.max(1) as f64;
    Summary {
        median: f64::from(at(0.5)),
        mean: of_all(finite.iter().map(|&v| f64::from(v)).sum()),
        p90: f64::from(at(0.9)),
        same: of_all(finite.iter().filter(|v| **v <= SAME_M).count() as f64),
    }
}

/// Points on the surfaces and their distances to the surface of the other, in the world of the first run.
pub(super) fn measure(runs: &[StoredRun]) -> Result<Vec<SurfaceDistance>, Error> {
    let Some(first) = runs.first().filter(|r| !r.mesh.triangles.is_empty()) else { return Ok(Vec::new()) };
    let of_first = SampledSurface::of(first)?;
    let mut distances = Vec::new();
    for (run, stored) in runs.iter().enumerate().skip(1).filter(|(_, r)| !r.mesh.triangles.is_empty()) {
        let of_run = SampledSurface::of(stored)?;
        distances.push(SurfaceDistance {
            run,
            to_first: of_first.distances_of(&of_run.points.positions),
            from_first: of_run.distances_of(&of_first.points.positions),
        });
    }
    Ok(distances)
}

/// A surface as points with normals.
struct SampledSurface {
    points: PointCloud,
    index: NearestIndex,
    spacing_m: f64,
}

impl SampledSurface {
    /// Points half a voxel apart, as scores have them.
    fn of(run: &StoredRun) -> Result<Self, Error> {
        let spacing = run.voxel_size_m().map_or(USUAL_SPACING_M, |v| v / 2.0);
        let area = area_m2(&run.mesh);
        // Fewer points are further apart.
        let spacing_m = spacing.max((area / MOST_SAMPLES as f64).sqrt());
        let points = sample_mesh(&run.mesh, SampleDensity::SpacingM(spacing_m))?;
        let index = NearestIndex::build(&points.positions)?;
        Ok(Self { points, index, spacing_m })
    }

    /// Distances of places to the surface.
    ///
    /// The nearest point is usually aside by a part of the spacing. Where that is all that is between, the distance is the one to
    /// the tangent plane of the point; beyond the border of the surface it is the one to the point.
    fn distances_of(&self, places: &[[f32; 3]]) -> Samples {
        let nearest = self.index.nearest_all(places, None);
        let distance = |(place, found): (&[f32; 3], &Option<Neighbour>)| {
            let Some(found) = found else { return f32::NAN };
            let normal = self.points.normals.get(found.index as usize).copied().unwrap_or_default();
            let offset = |k: usize| f64::from(place[k]) - f64::from(found.position[k]);
            let along = (0..3).map(|k| offset(k) * f64::from(normal[k])).sum::<f64>().abs();
            let aside = (found.distance_m.powi(2) - along.powi(2)).max(0.0).sqrt();
            // Points that are evenly spread are at most about a spacing from any place between them.
            (if aside <= self.spacing_m { along } else { found.distance_m }) as f32
        };
        let values = places.par_iter().zip(&nearest).map(distance).collect();
        Samples { positions: places.to_vec(), values }
    }
}

fn area_m2(mesh: &TriangleMesh) -> f64 {
    let of = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| nalgebra::Vector3::from(mesh.positions[i as usize].map(f64::from)));
        let area = (b - a).cross(&(c - a)).norm() / 2.0;
        if area.is_finite() { area } else { 0.0 }
    };
    mesh.triangles.iter().map(of).sum()
}
