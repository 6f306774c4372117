//! Even sampling of a mesh by area.
//!
//! Sample k of n lies at area (k + ½)/n of the mesh's total, counted triangle by triangle, so that the number of
//! samples of a patch is proportional to its area to within one; within the triangle it takes the k-th point of the R₂ low-discrepancy sequence
//! (Roberts 2018), folded from the unit square. No random numbers: the same mesh gives the same points.

use crate::error::EvalError;
use nalgebra::Vector3;
use vidar_core::{PointCloud, TriangleMesh};

/// How densely to sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SampleDensity {
    /// One point per square of this side on average, metres.
    SpacingM(f64),
    /// This many points in all.
    Count(usize),
}

/// Largest number of samples, which bounds memory at 1.5 GB with normals and colours.
const MAX_SAMPLES: usize = 50_000_000;

/// 1/g and 1/g² for the plastic number g, the root of g³ = g + 1.
const R2: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_2];

/// Points on `mesh` with normals (of vertices, else of faces), and with colours and confidences where the mesh has
/// them. Triangles without area or with a coordinate that is not finite get no point.
///
/// Fails when the mesh is not consistent, has no area, or would need more than fifty million points.
pub fn sample_mesh(mesh: &TriangleMesh, density: SampleDensity) -> Result<PointCloud, EvalError> {
    let bad = |reason| EvalError::BadMesh {
        vertices: mesh.positions.len(),
        triangles: mesh.triangles.len(),
        reason,
    };
    if !mesh.is_consistent() {
        return Err(bad("a vertex index is out of range, or an attribute list does not fit the vertices"));
    }
    let mut total = 0.0;
    let cumulative: Vec<f64> = (0..mesh.triangles.len())
        .map(|t| {
            total += area(mesh, t);
            total
        })
        .collect();
    if !(total > 0.0) {
        return Err(bad("it has no area"));
    }
    let count = match density {
        SampleDensity::Count(count) => count,
        SampleDensity::SpacingM(spacing) if spacing > 0.0 => (total / (spacing * spacing)).ceil() as usize,
        SampleDensity::SpacingM(_) => return Err(bad("the spacing is not a positive number of metres")),
    };
    if count > MAX_SAMPLES {
        return Err(bad("it would need more than fifty million points; use a larger spacing"));
    }
    let mut cloud = PointCloud::default();
    let mut triangle = 0;
    for k in 0..count {
        let target = (k as f64 + 0.5) / count as f64 * total;
        while triangle + 1 < cumulative.len() && cumulative[triangle] <= target {
            triangle += 1;
        }
        push_sample(&mut cloud, mesh, triangle, barycentric(k));
    }
    Ok(cloud)
}

fn barycentric(k: usize) -> [f64; 3] {
    let at = |step: f64| (0.5 + step * (k as f64 + 1.0)).fract();
    let (mut u, mut v) = (at(R2[0]), at(R2[1]));
    if u + v > 1.0 {
        (u, v) = (1.0 - u, 1.0 - v);
    }
    [1.0 - u - v, u, v]
}

fn corners(mesh: &TriangleMesh, triangle: usize) -> [Vector3<f64>; 3] {
    mesh.triangles[triangle].map(|i| Vector3::from(mesh.positions[i as usize]).cast())
}

fn scaled_normal(mesh: &TriangleMesh, triangle: usize) -> Vector3<f64> {
    let [a, b, c] = corners(mesh, triangle);
    (b - a).cross(&(c - a))
}

fn area(mesh: &TriangleMesh, triangle: usize) -> f64 {
    let area = 0.5 * scaled_normal(mesh, triangle).norm();
    if area.is_finite() { area } else { 0.0 }
}

fn push_sample(cloud: &mut PointCloud, mesh: &TriangleMesh, triangle: usize, weights: [f64; 3]) {
    let ids = mesh.triangles[triangle].map(|i| i as usize);
    let blend =
        |values: [Vector3<f64>; 3]| -> Vector3<f64> { values.iter().zip(weights).map(|(v, w)| v * w).sum() };
    let to_f32 = |v: Vector3<f64>| -> [f32; 3] { v.cast::<f32>().into() };
    cloud.positions.push(to_f32(blend(corners(mesh, triangle))));
    let face = scaled_normal(mesh, triangle);
    let normal = if mesh.normals.is_empty() {
        face
    } else {
        blend(ids.map(|i| Vector3::from(mesh.normals[i]).cast()))
    };
    let unit = normal.try_normalize(1e-12).or_else(|| face.try_normalize(0.0)).unwrap_or_default();
    cloud.normals.push(to_f32(unit));
    if !mesh.colors.is_empty() {
        let color = blend(ids.map(|i| Vector3::from(mesh.colors[i].map(f64::from))));
        cloud.colors.push([color.x.round() as u8, color.y.round() as u8, color.z.round() as u8]);
    }
    if !mesh.confidences.is_empty() {
        let confidence =
            ids.iter().zip(weights).map(|(&i, w)| f64::from(mesh.confidences[i]) * w).sum::<f64>();
        cloud.confidences.push(confidence as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A unit square of two triangles, and beside it one with three times its area.
    fn two_sheets() -> TriangleMesh {
        let positions =
            [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [2.0, 0.0], [5.0, 0.0], [5.0, 1.0], [2.0, 1.0]];
        TriangleMesh {
            positions: positions.iter().map(|p| [p[0], p[1], 0.5]).collect(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn samples_lie_on_the_mesh_in_proportion_to_area() {
        let cloud = sample_mesh(&two_sheets(), SampleDensity::SpacingM(0.02)).unwrap();
        assert_eq!(cloud.len(), 10_000);
        assert!(cloud.is_consistent());
        assert!(cloud.positions.iter().all(|p| p[2] == 0.5));
        assert!(cloud.normals.iter().all(|n| *n == [0.0, 0.0, 1.0]));
        assert_eq!(cloud.positions.iter().filter(|p| p[0] <= 1.0).count(), 2_500);
        // Even inside: every tenth of the unit square in x holds a tenth of its points, to within 2 %.
        for tenth in 0..10 {
            let (low, high) = (tenth as f32 * 0.1, (tenth + 1) as f32 * 0.1);
            let n = cloud.positions.iter().filter(|p| p[0] >= low && p[0] < high).count();
            assert!((200..=300).contains(&n), "tenth {tenth} holds {n}");
        }
    }

    #[test]
    fn sampling_is_repeatable_and_carries_attributes() {
        let mut mesh = two_sheets();
        mesh.colors = vec![[10, 20, 30]; 8];
        mesh.confidences = vec![0.25; 8];
        let a = sample_mesh(&mesh, SampleDensity::Count(777)).unwrap();
        assert_eq!(a, sample_mesh(&mesh, SampleDensity::Count(777)).unwrap());
        assert_eq!(a.colors, vec![[10, 20, 30]; 777]);
        assert!(a.confidences.iter().all(|c| (c - 0.25).abs() < 1e-6));
    }

    #[test]
    fn unusable_meshes_are_errors_and_unusable_triangles_get_no_point() {
        let mut mesh = two_sheets();
        mesh.positions[0] = [f32::NAN; 3];
        let cloud = sample_mesh(&mesh, SampleDensity::Count(500)).unwrap();
        assert!(cloud.positions.iter().flatten().all(|v| v.is_finite()));
        mesh.triangles = vec![[0, 1, 99]];
        assert!(matches!(sample_mesh(&mesh, SampleDensity::Count(5)), Err(EvalError::BadMesh { .. })));
        for spacing in [0.0, f64::NAN, 1e-9] {
            let result = sample_mesh(&two_sheets(), SampleDensity::SpacingM(spacing));
            assert!(matches!(result, Err(EvalError::BadMesh { .. })), "{spacing}");
        }
        let empty = TriangleMesh::default();
        assert!(matches!(sample_mesh(&empty, SampleDensity::Count(5)), Err(EvalError::BadMesh { .. })));
    }
}
