//! Colour and light of every vertex, before anything is drawn.

use super::raster::{Lens, Vertex};
use super::{MapSurface, Shading};
use crate::canvas::theme;
use crate::colormap::ColorMap;
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{PointCloud, TriangleMesh};

/// Colour of a surface without colours.
const PLASTER: [f32; 3] = [214.0, 209.0, 200.0];

/// Every vertex in the camera's frame with its final colour; vertices that are hidden or not finite have a NaN position.
pub(super) fn painted(surface: &MapSurface<'_>, lens: &Lens, shading: &Shading<'_>) -> Vec<Vertex> {
    let computed;
    let normals = match surface {
        MapSurface::Mesh(mesh) if mesh.normals.is_empty() => {
            computed = vertex_normals(mesh);
            &computed[..]
        }
        other => other.normals(),
    };
    let is_cloud = matches!(surface, MapSurface::Cloud(_));
    surface
        .positions()
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            let place = Vector3::from(p.map(f64::from));
            let normal = normals.get(i).map(|n| Vector3::from(n.map(f64::from)));
            let facing = normal.map(|n| n.normalize().dot(&lens.towards_eye(&place)));
            // Discs have no winding: their normal says which side they are seen from.
            let hidden = is_cloud && lens.culls() && facing.is_some_and(|f| f < 0.0);
            if hidden || !place.iter().all(|v| v.is_finite()) {
                return Vertex::hidden();
            }
            let color = match *shading {
                Shading::Color => surface.colors().get(i).map_or(PLASTER, |c| c.map(f32::from)),
                Shading::Normals => normal.map_or(PLASTER, |n| normal_color(&n)),
                Shading::Error { values, range, .. } => error_color(values[i], range).map(f32::from),
            };
            let light = light(facing, shading, surface.colors().is_empty());
            Vertex { place: lens.to_camera(&place), color: color.map(|c| c * light) }
        })
        .collect()
}

/// Brightness under a light at the camera. Colours that encode values are dimmed least.
fn light(facing: Option<f64>, shading: &Shading<'_>, is_plain: bool) -> f32 {
    let depth = match shading {
        Shading::Color if is_plain => 0.55,
        Shading::Color => 0.3,
        Shading::Error { .. } => 0.22,
        Shading::Normals => 0.0,
    };
    match facing {
        Some(f) if f.is_finite() => 1.0 - depth * (1.0 - f.abs() as f32),
        _ => 1.0,
    }
}

fn normal_color(normal: &Vector3<f64>) -> [f32; 3] {
    match normal.try_normalize(1e-12) {
        Some(n) => [n.x, n.y, n.z].map(|c| (127.5 * (c + 1.0)) as f32),
        None => theme::NO_DATA.map(f32::from),
    }
}

fn error_color(value: f32, (low, high): (f32, f32)) -> [u8; 3] {
    if !value.is_finite() {
        // Brighter than "no data" in a depth picture, so that the shape stays visible.
        return [150, 150, 152];
    }
    ColorMap::Ember.color(if high > low { (value - low) / (high - low) } else { 0.0 })
}

/// Area-weighted vertex normals.
fn vertex_normals(mesh: &TriangleMesh) -> Vec<[f32; 3]> {
    let at = |i: u32| Vector3::from(mesh.positions[i as usize].map(f64::from));
    let mut sums = vec![Vector3::<f64>::zeros(); mesh.positions.len()];
    for t in &mesh.triangles {
        let [a, b, c] = t.map(at);
        let normal = (b - a).cross(&(c - a));
        if normal.iter().all(|v| v.is_finite()) {
            for &i in t {
                sums[i as usize] += normal;
            }
        }
    }
    sums.iter().map(|s| [s.x as f32, s.y as f32, s.z as f32]).collect()
}

/// Radius of a point's disc: somewhat more than half the usual distance between neighbours.
///
/// The covered area is counted in cells of 1/128 of the map's extent, of which each holds about a cell's face of
/// surface; the points share that area.
pub(super) fn disc_radius_m(cloud: &PointCloud) -> f64 {
    let stride = (cloud.len() / 200_000).max(1);
    let finite = || cloud.positions.iter().step_by(stride).filter(|p| p.iter().all(|v| v.is_finite()));
    let mut values: [Vec<f32>; 3] = Default::default();
    for p in finite() {
        for (axis, v) in values.iter_mut().zip(p) {
            axis.push(*v);
        }
    }
    let extent = values.iter_mut().map(|axis| {
        axis.sort_unstable_by(f32::total_cmp);
        let last = axis.len().saturating_sub(1);
        let trim = axis.len() / 100;
        axis.get(last - trim).zip(axis.get(trim)).map_or(0.0, |(h, l)| f64::from(*h) - f64::from(*l))
    });
    let cell = extent.fold(0.0, f64::max) / 128.0;
    if !(cell > 0.0) {
        return 0.01;
    }
    let mut cells: Vec<[i64; 3]> =
        finite().map(|p| p.map(|v| (f64::from(v) / cell).floor() as i64)).collect();
    let sampled = cells.len();
    cells.sort_unstable();
    cells.dedup();
    let points_per_cell = (sampled * stride) as f64 / cells.len().max(1) as f64;
    0.7 * cell / points_per_cell.max(1.0).sqrt()
}
