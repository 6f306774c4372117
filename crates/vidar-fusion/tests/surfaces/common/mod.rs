//! Analytic scenes and checks of meshes, shared by the tests.

use nalgebra::Vector3;
use std::collections::HashMap;
use vidar_core::{
    AlignedView, Confidence, FrameId, Image, MetricDepth, Pinhole, Se3, So3, Timestamp, TriangleMesh,
};
use vidar_fusion::{FusionConfig, TsdfVolume};

pub type Vec3 = Vector3<f64>;

pub const WIDTH: usize = 200;
pub const HEIGHT: usize = 150;

/// A camera of about 64° × 50°.
pub fn camera() -> Pinhole {
    Pinhole::new(160.0, 160.0, 99.5, 74.5, WIDTH, HEIGHT).unwrap()
}

/// Keeps everything, so that the effect of one view is visible.
pub fn config() -> FusionConfig {
    FusionConfig {
        voxel_size_m: 0.02,
        min_observations: 1,
        min_component_triangles: 0,
        carve_range_m: 0.0,
        ..FusionConfig::default()
    }
}

/// A camera at `eye` that looks at `target`, its y axis pointing down (world z up).
pub fn look_at(eye: Vec3, target: Vec3) -> Se3 {
    let forward = (target - eye).normalize();
    let up = if forward.z.abs() > 0.9 { Vec3::y() } else { Vec3::z() };
    let right = forward.cross(&up).normalize();
    let down = forward.cross(&right);
    let matrix = nalgebra::Matrix3::from_columns(&[right, down, forward]);
    Se3::new(So3::from_matrix(&matrix).unwrap(), eye)
}

/// A view of what `cast` (origin, direction) hits: the factor of the direction, or `None`.
pub fn view(
    id: u32,
    world_from_camera: Se3,
    confidence: f32,
    cast: impl Fn(Vec3, Vec3) -> Option<f64>,
) -> AlignedView {
    let k = camera();
    let rotation = world_from_camera.rotation.matrix();
    // The ray has z = 1, so the factor is the z-depth.
    let depth = Image::from_fn(WIDTH, HEIGHT, |x, y| {
        let ray = rotation * k.ray(x as f64, y as f64);
        cast(world_from_camera.translation, ray).map_or(f32::NAN, |t| t as f32)
    });
    from_depth(id, world_from_camera, depth, Image::filled(WIDTH, HEIGHT, confidence))
}

pub fn from_depth(id: u32, world_from_camera: Se3, depth: Image<f32>, confidence: Image<f32>) -> AlignedView {
    let time = Timestamp::from_nanos(i64::from(id));
    let (depth, confidence) = (MetricDepth::new(depth), Confidence::new(confidence));
    AlignedView::new(FrameId(id), time, world_from_camera, camera(), depth, confidence).unwrap()
}

/// First hit of a ball around the origin.
pub fn ball(radius: f64) -> impl Fn(Vec3, Vec3) -> Option<f64> {
    move |o, d| {
        let (a, b, c) = (d.norm_squared(), o.dot(&d), o.norm_squared() - radius * radius);
        let root = (b * b - a * c).sqrt();
        let t = (-b - root) / a;
        (root >= 0.0 && t > 0.0).then_some(t)
    }
}

/// First hit of the box of half sizes `half` around the origin from outside.
pub fn solid_box(half: [f64; 3]) -> impl Fn(Vec3, Vec3) -> Option<f64> {
    move |o, d| {
        let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
        for a in 0..3 {
            let (t0, t1) = ((-half[a] - o[a]) / d[a], (half[a] - o[a]) / d[a]);
            near = near.max(t0.min(t1));
            far = far.min(t0.max(t1));
        }
        (near <= far && near > 0.0).then_some(near)
    }
}

/// Hit of the plane z = height.
pub fn floor(height: f64) -> impl Fn(Vec3, Vec3) -> Option<f64> {
    move |o, d| Some((height - o.z) / d.z).filter(|&t| t > 0.0)
}

/// Eyes spread evenly over a sphere (Fibonacci lattice).
pub fn eyes_around(count: usize, distance: f64) -> Vec<Vec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count)
        .map(|i| {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
            let (r, angle) = ((1.0 - z * z).sqrt(), golden * i as f64);
            Vec3::new(r * angle.cos(), r * angle.sin(), z) * distance
        })
        .collect()
}

pub fn views_around(
    count: usize,
    distance: f64,
    cast: impl Fn(Vec3, Vec3) -> Option<f64>,
) -> Vec<AlignedView> {
    let eyes = eyes_around(count, distance);
    let looks = eyes.iter().enumerate();
    looks.map(|(i, eye)| view(i as u32, look_at(*eye, Vec3::zeros()), 1.0, &cast)).collect()
}

pub fn fuse(config: &FusionConfig, views: &[AlignedView]) -> TsdfVolume {
    let mut volume = TsdfVolume::new(config).unwrap();
    for view in views {
        volume.integrate(view).unwrap();
    }
    volume
}

pub fn point(p: [f32; 3]) -> Vec3 {
    Vec3::from(p.map(f64::from))
}

pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0), |(sum, n), v| (sum + v * v, n + 1));
    assert!(n > 0, "no values");
    (sum / f64::from(n)).sqrt()
}

/// How often each directed edge of the mesh is used.
pub fn directed_edges(mesh: &TriangleMesh) -> HashMap<[u32; 2], u32> {
    let mut edges = HashMap::new();
    for t in &mesh.triangles {
        for i in 0..3 {
            *edges.entry([t[i], t[(i + 1) % 3]]).or_insert(0) += 1;
        }
    }
    edges
}

/// Asserts that no edge is used twice in one direction, and returns the edges with one triangle only.
pub fn border_edges(mesh: &TriangleMesh) -> Vec<[u32; 2]> {
    let edges = directed_edges(mesh);
    assert!(edges.values().all(|&n| n == 1), "an edge has two triangles on one side");
    edges.keys().copied().filter(|[a, b]| !edges.contains_key(&[*b, *a])).collect()
}

/// Asserts that no two vertices coincide and that every vertex is used.
pub fn assert_vertices_are_distinct_and_used(mesh: &TriangleMesh) {
    assert!(mesh.is_consistent());
    let mut positions: Vec<[u32; 3]> = mesh.positions.iter().map(|p| p.map(f32::to_bits)).collect();
    positions.sort_unstable();
    positions.dedup();
    assert_eq!(positions.len(), mesh.positions.len(), "two vertices coincide");
    let mut used: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    assert_eq!(used.len(), mesh.positions.len(), "a vertex without triangle");
}

/// Angle between two directions, degrees.
pub fn angle_deg(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b)).to_degrees()
}

/// Largest share of triangles whose winding disagrees with their vertex normals.
pub fn triangles_against_normals(mesh: &TriangleMesh) -> usize {
    let against = mesh.triangles.iter().filter(|t| {
        let [a, b, c] = t.map(|i| point(mesh.positions[i as usize]));
        let normals: Vec3 = t.iter().map(|&i| point(mesh.normals[i as usize])).sum();
        (b - a).cross(&(c - a)).dot(&normals) < 0.0
    });
    against.count()
}
