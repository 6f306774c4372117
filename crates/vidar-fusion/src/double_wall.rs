//! Ghosts: surface that has a second surface right behind or before it, facing the same way.
//!
//! When two visits of one wall disagree by a few centimetres, fusion draws it twice. Both copies face the observer, so
//! they have parallel normals of the same direction at a small distance along them; the two sides of a real thin thing
//! face opposite ways and do not count. Real things that lie flat on a wall (a picture, a door) do: compare a map's
//! rate with that of the reference surface, or the rates of one map before and after a correction.

use crate::FusionError;
use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};
use vidar_core::{PointCloud, TriangleMesh};

/// What counts as a second surface.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DoubleWalls {
    /// Nearest distance along the normal at which a point belongs to another surface, m, 0.001 to 10. About two
    /// voxels: nearer ones are the roughness of one surface.
    pub nearest_m: f64,
    /// Farthest distance along the normal, m, at most 100 times `nearest_m`.
    pub farthest_m: f64,
    /// How far beside the normal a point may lie, m, 0.001 to 10. About the spacing of the points.
    pub beside_m: f64,
    /// Largest angle between the two normals, degrees, 1 to 89.
    pub max_angle_deg: f64,
}

impl Default for DoubleWalls {
    fn default() -> Self {
        Self { nearest_m: 0.04, farthest_m: 0.25, beside_m: 0.02, max_angle_deg: 30.0 }
    }
}

/// How much of a surface is there twice.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DoubleWallReport {
    /// Share of the surface (of a mesh by area, of a cloud by points) that has a second one, 0…1; 0 without surface.
    pub rate: f64,
    /// Points (of a mesh, vertices) that were judged.
    pub points: u64,
    /// Points that have a second surface.
    pub doubled: u64,
}

impl DoubleWalls {
    /// Checks every field against the range in its description.
    pub fn validate(&self) -> Result<(), FusionError> {
        let ranges = [
            ("nearest_m", self.nearest_m, 0.001, 10.0),
            ("farthest_m", self.farthest_m, self.nearest_m, 100.0 * self.nearest_m),
            ("beside_m", self.beside_m, 0.001, 10.0),
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
        let place = |i: u32| mesh.positions.get(i as usize).map(|p| Vector3::from(p.map(f64::from)));
        let mut areas = vec![0.0; mesh.positions.len()];
        for triangle in &mesh.triangles {
            let [Some(a), Some(b), Some(c)] = triangle.map(place) else { continue };
            let third = (b - a).cross(&(c - a)).norm() / 6.0;
            for i in triangle {
                areas[*i as usize] += third;
            }
        }
        self.judge(&mesh.positions, &mesh.normals, |i| areas[i])
    }

    /// The rate of a cloud with normals: each point counts once.
    ///
    /// # Errors
    /// Settings outside their range. A cloud without normals has no rate: all zeros.
    pub fn of_cloud(&self, cloud: &PointCloud) -> Result<DoubleWallReport, FusionError> {
        self.judge(&cloud.positions, &cloud.normals, |_| 1.0)
    }

    fn judge(
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
    walls: &'a DoubleWalls,
    positions: &'a [[f32; 3]],
    normals: &'a [[f32; 3]],
    cell_m: f64,
    least_cosine: f64,
    /// First and behind-last place in `order` of each cell's points.
    cells: FxHashMap<[i32; 3], (u32, u32)>,
    order: Vec<u32>,
}

impl<'a> Search<'a> {
    fn new(walls: &'a DoubleWalls, positions: &'a [[f32; 3]], normals: &'a [[f32; 3]]) -> Self {
        // As wide as the search's tube, so that a step along the normal touches few cells.
        let cell_m = 2.0 * walls.beside_m;
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
        let least_cosine = walls.max_angle_deg.to_radians().cos();
        Self { walls, positions, normals, cell_m, least_cosine, cells, order }
    }

    /// Whether another surface lies before or behind point `i`.
    fn is_doubled(&self, i: usize) -> bool {
        let (place, normal) = (vector(self.positions[i]), vector(self.normals[i]));
        if !place.iter().chain(normal.iter()).all(|v| v.is_finite()) {
            return false;
        }
        let steps = ((self.walls.farthest_m - self.walls.nearest_m) / self.cell_m).ceil() as i32;
        for side in [1.0, -1.0] {
            let mut last: Option<[i32; 3]> = None;
            for step in 0..=steps {
                let along = (self.walls.nearest_m + f64::from(step) * self.cell_m).min(self.walls.farthest_m);
                let centre = cell_of(&(place + normal * (side * along)), self.cell_m);
                for offset in 0..27 {
                    // A place beyond all bounds has cells at the end of the numbers; there is nothing behind.
                    let [dx, dy, dz] = [offset % 3 - 1, offset / 3 % 3 - 1, offset / 9 - 1];
                    let key =
                        [centre[0].wrapping_add(dx), centre[1].wrapping_add(dy), centre[2].wrapping_add(dz)];
                    // Neighbouring steps share most cells; the last step has looked into those around it.
                    let known = last.is_some_and(|l| {
                        (0..3).all(|a| key[a].wrapping_sub(l[a]).wrapping_add(1) as u32 <= 2)
                    });
                    if !known && self.cell_has_second(key, &place, &normal) {
                        return true;
                    }
                }
                last = Some(centre);
            }
        }
        false
    }

    fn cell_has_second(&self, key: [i32; 3], place: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
        let Some(&(from, until)) = self.cells.get(&key) else { return false };
        self.order[from as usize..until as usize].iter().any(|&j| {
            let to = vector(self.positions[j as usize]) - place;
            let along = to.dot(normal);
            let gap = along.abs();
            gap >= self.walls.nearest_m
                && gap <= self.walls.farthest_m
                && (to - normal * along).norm() <= self.walls.beside_m
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
