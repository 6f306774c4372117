//! Double walls (ghosting): a surface that was reconstructed twice, at a small offset along its normal.
//!
//! When the poses of two visits of a wall disagree by a few centimetres, fusion reconstructs it twice. Both copies face
//! the cameras, so their normals are parallel and of the same direction; the two sides of a thin object have opposite
//! normals and are not counted. Flat objects on a wall (a picture, a door) are counted: compare a map's rate with that
//! of the reference surface, or the rates of one map before and after a correction.

use crate::FusionError;
use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};
use vidar_core::{PointCloud, TriangleMesh};

/// Settings of the detection of double walls.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DoubleWallDetector {
    /// Smallest distance along the normal at which a point belongs to a second surface, m, 0.001 to 10. About two
    /// voxels: smaller distances are the roughness of one surface.
    pub min_distance_m: f64,
    /// Largest distance along the normal, m, at most 100 times `min_distance_m`.
    pub max_distance_m: f64,
    /// Largest distance of a point from the line along the normal, m, 0.001 to 10. About the spacing of the points.
    pub radius_m: f64,
    /// Largest angle between the two normals, degrees, 1 to 89.
    pub max_angle_deg: f64,
}

impl Default for DoubleWallDetector {
    fn default() -> Self {
        Self { min_distance_m: 0.04, max_distance_m: 0.25, radius_m: 0.02, max_angle_deg: 30.0 }
    }
}

/// Share of a surface that was reconstructed twice.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DoubleWallReport {
    /// Share of the surface (of a mesh by area, of a cloud by points) that is doubled, 0…1; 0 without surface.
    pub rate: f64,
    /// Points (of a mesh, vertices) that were examined.
    pub points: u64,
    /// Points that have a second surface.
    pub doubled: u64,
}

impl DoubleWallDetector {
    /// Checks every field against the range in its description.
    pub fn validate(&self) -> Result<(), FusionError> {
        let ranges = [
            ("min_distance_m", self.min_distance_m, 0.001, 10.0),
            ("max_distance_m", self.max_distance_m, self.min_distance_m, 100.0 * self.min_distance_m),
            ("radius_m", self.radius_m, 0.001, 10.0),
            ("max_angle_deg", self.max_angle_deg, 1.0, 89.0),
        ];
        for (field, found, min, max) in ranges {
            if !(min..=max).contains(&found) {
                return Err(FusionError::BadConfig { field, min, max, found });
            }
        }
        Ok(())
    }

    /// The rate of a mesh with normals: each vertex stands for a third of the triangles around it.
    ///
    /// # Errors
    /// Settings outside their range. A mesh without normals has no rate: all zeros.
    pub fn of_mesh(&self, mesh: &TriangleMesh) -> Result<DoubleWallReport, FusionError> {
        let position = |i: u32| mesh.positions.get(i as usize).map(|p| Vector3::from(p.map(f64::from)));
        let mut areas = vec![0.0; mesh.positions.len()];
        for triangle in &mesh.triangles {
            let [Some(a), Some(b), Some(c)] = triangle.map(position) else { continue };
            let third = (b - a).cross(&(c - a)).norm() / 6.0;
            for i in triangle {
                areas[*i as usize] += third;
            }
        }
        self.evaluate(&mesh.positions, &mesh.normals, |i| areas[i])
    }

    /// The rate of a cloud with normals: each point counts once.
    ///
    /// # Errors
    /// Settings outside their range. A cloud without normals has no rate: all zeros.
    pub fn of_cloud(&self, cloud: &PointCloud) -> Result<DoubleWallReport, FusionError> {
        self.evaluate(&cloud.positions, &cloud.normals, |_| 1.0)
    }

    fn evaluate(
        &self,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        size: impl Fn(usize) -> f64,
    ) -> Result<DoubleWallReport, FusionError> {
        self.validate()?;
        if normals.len() != positions.len() {
            return Ok(DoubleWallReport::default());
        }
        let search = Search::new(self, positions, normals);
        let doubled: Vec<bool> =
            (0..positions.len()).into_par_iter().with_min_len(256).map(|i| search.is_doubled(i)).collect();
        // Summed in the order of the points, so that the rate is the same for any number of threads.
        let (mut all, mut twice) = (0.0, 0.0);
        for (i, doubled) in doubled.iter().enumerate() {
            all += size(i);
            twice += if *doubled { size(i) } else { 0.0 };
        }
        Ok(DoubleWallReport {
            rate: if all > 0.0 { twice / all } else { 0.0 },
            points: positions.len() as u64,
            doubled: doubled.iter().filter(|d| **d).count() as u64,
        })
    }
}

/// Points by the cell that they lie in.
struct Search<'a> {
    detector: &'a DoubleWallDetector,
    positions: &'a [[f32; 3]],
    normals: &'a [[f32; 3]],
    cell_m: f64,
    least_cosine: f64,
    /// Range in `order` of each cell's points.
    cells: FxHashMap<[i32; 3], (u32, u32)>,
    order: Vec<u32>,
}

impl<'a> Search<'a> {
    fn new(detector: &'a DoubleWallDetector, positions: &'a [[f32; 3]], normals: &'a [[f32; 3]]) -> Self {
        // As wide as the search's tube, so that a step along the normal touches few cells.
        let cell_m = 2.0 * detector.radius_m;
        let cell = |i: u32| cell_of(&vector(positions[i as usize]), cell_m);
        let mut order: Vec<u32> = (0..positions.len() as u32)
            .filter(|&i| vector(positions[i as usize]).iter().all(|v| v.is_finite()))
            .collect();
        order.par_sort_unstable_by_key(|&i| (cell(i), i));
        let mut cells: FxHashMap<[i32; 3], (u32, u32)> = FxHashMap::default();
        for (at, &i) in order.iter().enumerate() {
            let at = at as u32;
            cells.entry(cell(i)).and_modify(|range| range.1 = at + 1).or_insert((at, at + 1));
        }
        let least_cosine = detector.max_angle_deg.to_radians().cos();
        Self { detector, positions, normals, cell_m, least_cosine, cells, order }
    }

    /// Whether point `i` has a second surface in front of or behind it.
    fn is_doubled(&self, i: usize) -> bool {
        let (position, normal) = (vector(self.positions[i]), vector(self.normals[i]));
        if !position.iter().chain(normal.iter()).all(|v| v.is_finite()) {
            return false;
        }
        let steps =
            ((self.detector.max_distance_m - self.detector.min_distance_m) / self.cell_m).ceil() as i32;
        for side in [1.0, -1.0] {
            let mut last: Option<[i32; 3]> = None;
            for step in 0..=steps {
                let along = (self.detector.min_distance_m + f64::from(step) * self.cell_m)
                    .min(self.detector.max_distance_m);
                let centre = cell_of(&(position + normal * (side * along)), self.cell_m);
                for offset in 0..27 {
                    // Indices saturate far outside; wrapping then reaches cells without points.
                    let [dx, dy, dz] = [offset % 3 - 1, offset / 3 % 3 - 1, offset / 9 - 1];
                    let key =
                        [centre[0].wrapping_add(dx), centre[1].wrapping_add(dy), centre[2].wrapping_add(dz)];
                    // Neighbouring steps share most cells; the previous step has searched those around it.
                    let searched = last.is_some_and(|l| {
                        (0..3).all(|a| key[a].wrapping_sub(l[a]).wrapping_add(1) as u32 <= 2)
                    });
                    if !searched && self.cell_has_second(key, &position, &normal) {
                        return true;
                    }
                }
                last = Some(centre);
            }
        }
        false
    }

    fn cell_has_second(&self, key: [i32; 3], position: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
        let Some(&(from, until)) = self.cells.get(&key) else { return false };
        self.order[from as usize..until as usize].iter().any(|&j| {
            let to = vector(self.positions[j as usize]) - position;
            let along = to.dot(normal);
            let gap = along.abs();
            gap >= self.detector.min_distance_m
                && gap <= self.detector.max_distance_m
                && (to - normal * along).norm() <= self.detector.radius_m
                && vector(self.normals[j as usize]).dot(normal) >= self.least_cosine
        })
    }
}

fn vector(p: [f32; 3]) -> Vector3<f64> {
    Vector3::from(p.map(f64::from))
}

fn cell_of(p: &Vector3<f64>, cell_m: f64) -> [i32; 3] {
    p.map(|v| (v / cell_m).floor() as i32).into()
}
