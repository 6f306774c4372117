//! Which surfaces count as double walls.

use vidar_core::{PointCloud, TriangleMesh};
use vidar_fusion::{DoubleWallDetector, FusionError};

/// Positions and normals.
type Patch = (Vec<[f32; 3]>, Vec<[f32; 3]>);

/// Points 1 cm apart on the square of 1 m at height `z` from `from_x` on, facing `up`.
fn square(z: f32, from_x: f32, up: f32) -> Patch {
    let points: Vec<[f32; 3]> =
        (0..10_000).map(|i| [from_x + (i % 100) as f32 * 0.01, (i / 100) as f32 * 0.01, z]).collect();
    let normals = vec![[0.0, 0.0, up]; points.len()];
    (points, normals)
}

fn cloud(patches: &[Patch]) -> PointCloud {
    PointCloud {
        positions: patches.iter().flat_map(|p| p.0.clone()).collect(),
        normals: patches.iter().flat_map(|p| p.1.clone()).collect(),
        ..PointCloud::default()
    }
}

fn rate(patches: &[Patch]) -> f64 {
    DoubleWallDetector::default().of_cloud(&cloud(patches)).unwrap().rate
}

#[test]
fn only_a_near_surface_that_faces_the_same_way_is_a_double_wall() {
    assert_eq!(rate(&[square(0.0, 0.0, 1.0)]), 0.0);
    assert_eq!(rate(&[square(0.0, 0.0, 1.0), square(0.1, 0.0, 1.0)]), 1.0);
    assert_eq!(rate(&[square(0.0, 0.0, 1.0), square(0.1, 0.0, -1.0)]), 0.0, "two sides of a board");
    assert_eq!(rate(&[square(0.0, 0.0, 1.0), square(0.3, 0.0, 1.0)]), 0.0, "a shelf above");
    assert_eq!(rate(&[square(0.0, 0.0, 1.0), square(0.02, 0.0, 1.0)]), 0.0, "roughness");
    let half = rate(&[square(0.0, 0.0, 1.0), square(0.1, 0.5, 1.0)]);
    assert!((half - 0.51).abs() < 0.03, "{half}");
}

#[test]
fn a_tilt_beyond_the_angle_is_not_a_double_wall() {
    let tilted = |angle: f32| {
        let (points, normals) = square(0.0, 0.0, 1.0);
        let turn = |p: &[f32; 3]| [p[0], p[1], p[2] + 0.1 + (p[1] - 0.5) * angle.tan()];
        let normals = normals.iter().map(|_| [0.0, -angle.sin(), angle.cos()]).collect();
        (points.iter().map(turn).collect(), normals)
    };
    let at = |degrees: f32| rate(&[square(0.0, 0.0, 1.0), tilted(degrees.to_radians())]);
    assert!(at(5.0) > 0.95 && at(35.0) == 0.0, "{} {}", at(5.0), at(35.0));
}

#[test]
fn a_mesh_counts_by_area() {
    // Two triangles of 1 m² that face up, 10 cm apart at one corner only, and a small double wall over that corner.
    let mesh = TriangleMesh {
        positions: vec![
            [0.0, 0.0, 0.0],
            [2.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, 0.0, 0.1],
            [0.01, 0.0, 0.1],
            [0.0, 0.01, 0.1],
        ],
        normals: vec![[0.0, 0.0, 1.0]; 6],
        triangles: vec![[0, 1, 2], [3, 4, 5]],
        ..TriangleMesh::default()
    };
    let report = DoubleWallDetector::default().of_mesh(&mesh).unwrap();
    // A third of the large triangle hangs on its corner.
    assert!((report.rate - 1.0 / 3.0).abs() < 1e-3, "{report:?}");
    assert_eq!((report.points, report.doubled), (6, 4));
}

#[test]
fn surfaces_without_normals_have_no_rate() {
    let detector = DoubleWallDetector::default();
    let (positions, normals) = square(0.0, 0.0, 1.0);
    assert_eq!(detector.of_cloud(&PointCloud::from_positions(positions.clone())).unwrap().rate, 0.0);
    assert_eq!(detector.of_mesh(&TriangleMesh::default()).unwrap().points, 0);
    let mut broken = cloud(&[(positions, normals), square(0.1, 0.0, 1.0)]);
    for i in 0..100 {
        broken.positions[i * 7] = [f32::NAN, f32::INFINITY, 0.0];
        broken.normals[i * 11] = [f32::NAN; 3];
    }
    assert!(detector.of_cloud(&broken).unwrap().rate > 0.9);
    let bad = DoubleWallDetector { max_distance_m: 0.01, ..detector };
    assert!(matches!(bad.of_cloud(&broken), Err(FusionError::BadConfig { field: "max_distance_m", .. })));
}

#[test]
fn the_rate_is_the_same_for_any_number_of_threads() {
    let both = cloud(&[square(0.0, 0.0, 1.0), square(0.1, 0.5, 1.0)]);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| DoubleWallDetector::default().of_cloud(&both).unwrap())
    };
    assert_eq!(on(1), on(4));
}
