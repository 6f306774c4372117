//! Coverage: what was observed, by how many views and with which confidence.

use crate::field::Field;
use crate::grid::{CELL, NODES, cell_of};
use crate::volume::TsdfVolume;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use vidar_core::TriangleMesh;

/// A voxel within one voxel of the surface.
struct SurfaceVoxel {
    /// Views that observed the voxel within the truncation of their depth.
    observations: u32,
    /// Mean confidence of those views, 0…1.
    mean_confidence: f32,
}

/// Coverage of a volume.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CoverageReport {
    /// Area of the extracted mesh, m².
    pub surface_area_m2: f64,
    /// Observed space, free or near the surface, m³: voxels with an observation and free blocks (the latter only within
    /// the carving range).
    pub observed_volume_m3: f64,
    /// Smallest and largest corner of the mesh in the world, metres; `None` when it is empty.
    pub bounds_m: Option<[[f32; 3]; 2]>,
    /// Voxels within one voxel of the surface.
    pub surface_voxels: u64,
    /// Mean number of views of a surface voxel.
    pub mean_observations: f64,
    /// Mean confidence of surface voxels, 0…1.
    pub mean_confidence: f64,
    /// Share of surface voxels observed by at least three views, 0…1.
    pub share_seen_by_3_or_more: f64,
    /// Views that were fused.
    pub views: u32,
}

impl TsdfVolume {
    /// The voxels within one voxel of the surface, sorted by block and node.
    fn surface_voxels(&self) -> Vec<SurfaceVoxel> {
        let field = Field::new(self);
        let one_voxel = 1.0 / self.config().truncation_voxels as f32;
        (0..field.len())
            .into_par_iter()
            .flat_map_iter(|at| {
                let (field, block) = (&field, field.blocks[at]);
                (0..NODES).filter(move |&node| field.value(at, node).abs() <= one_voxel).map(move |node| {
                    let mean_confidence = block.mean_confidence(node);
                    SurfaceVoxel { observations: block.observations(node), mean_confidence }
                })
            })
            .collect()
    }

    /// The coverage of this volume, whose extracted mesh is `mesh`.
    pub fn coverage(&self, mesh: &TriangleMesh) -> CoverageReport {
        let voxels = self.surface_voxels();
        // Integer and sequential sums: nothing here depends on the number of threads.
        let observations: u64 = voxels.iter().map(|c| u64::from(c.observations)).sum();
        let confidence: f64 = voxels.iter().map(|c| f64::from(c.mean_confidence)).sum();
        let often = voxels.iter().filter(|c| c.observations >= 3).count();
        let n = voxels.len().max(1) as f64;
        CoverageReport {
            surface_area_m2: surface_area_m2(mesh),
            observed_volume_m3: self.observed_nodes() as f64 * self.config().voxel_size_m.powi(3),
            bounds_m: bounds(mesh),
            surface_voxels: voxels.len() as u64,
            mean_observations: observations as f64 / n,
            mean_confidence: confidence / n,
            share_seen_by_3_or_more: often as f64 / n,
            views: self.views(),
        }
    }

    /// Nodes with an observation, with all nodes of free cells.
    fn observed_nodes(&self) -> u64 {
        let within_blocks: usize = (self.keys.par_iter().zip(&self.blocks))
            .map(|(key, block)| {
                let free = self.free.get(key).copied().unwrap_or_default();
                let weights = block.rows.iter().flat_map(|row| row.weight).enumerate();
                weights.filter(|&(node, w)| w > 0 && free[cell_of(node)] == 0).count()
            })
            .sum();
        let free_cells: usize =
            self.free.values().map(|cells| cells.iter().filter(|w| **w > 0).count()).sum();
        (within_blocks + free_cells * CELL.pow(3)) as u64
    }
}

/// Sum of the areas of all triangles, m².
pub fn surface_area_m2(mesh: &TriangleMesh) -> f64 {
    let point = |i: u32| nalgebra::Vector3::from(mesh.positions[i as usize].map(f64::from));
    let area = |&[a, b, c]: &[u32; 3]| 0.5 * (point(b) - point(a)).cross(&(point(c) - point(a))).norm();
    // A sum of nothing is −0.
    mesh.triangles.iter().map(area).sum::<f64>() + 0.0
}

fn bounds(mesh: &TriangleMesh) -> Option<[[f32; 3]; 2]> {
    let first = *mesh.positions.first()?;
    Some(mesh.positions.iter().fold([first, first], |[low, high], p| {
        [[0, 1, 2].map(|a| low[a].min(p[a])), [0, 1, 2].map(|a| high[a].max(p[a]))]
    }))
}
