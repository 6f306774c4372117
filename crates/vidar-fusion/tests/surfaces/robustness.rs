//! Order, threads, memory and bad input.

use crate::common::*;
use proptest::prelude::*;
use vidar_core::{AlignedView, Image, Se3, TriangleMesh};
use vidar_fusion::{FusionConfig, FusionError, PointFusion, TsdfVolume};

/// Coloured views of a ball on a floor with various confidences, so that every sum takes part.
fn scene() -> Vec<AlignedView> {
    let eyes = eyes_around(16, 1.4);
    let above = eyes.iter().filter(|e| e.z > 0.2).enumerate();
    above
        .map(|(i, eye)| {
            let confidence = 0.4 + 0.07 * i as f32;
            let color = Image::from_fn(WIDTH, HEIGHT, |x, y| [x as u8, y as u8, 30 * i as u8]);
            let cast = |o: Vec3, d: Vec3| ball(0.4)(o, d).or_else(|| floor(-0.4)(o, d).filter(|&t| t < 5.0));
            view(i as u32, look_at(*eye, Vec3::zeros()), confidence, cast).with_color(color).unwrap()
        })
        .collect()
}

fn carving() -> FusionConfig {
    FusionConfig { carve_range_m: 3.0, min_component_triangles: 20, min_observations: 2, ..config() }
}

fn with_threads<R: Send>(threads: usize, work: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

fn assert_same_bits(a: &TriangleMesh, b: &TriangleMesh) {
    let bits = |list: &[[f32; 3]]| list.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>();
    assert!(bits(&a.positions) == bits(&b.positions), "positions differ");
    assert!(bits(&a.normals) == bits(&b.normals), "normals differ");
    assert!(a.colors == b.colors && a.triangles == b.triangles, "colours or triangles differ");
    assert!(a.confidences == b.confidences, "confidences differ");
}

#[test]
fn any_order_of_views_and_any_number_of_threads_gives_the_same_bits() {
    let views = scene();
    let n = views.len();
    let config = carving();
    let reference = with_threads(1, || fuse(&config, &views));
    let mesh = reference.extract_mesh();
    assert!(mesh.triangles.len() > 5000 && !mesh.colors.is_empty());
    let orders: [Vec<usize>; 3] =
        [(0..n).collect(), (0..n).rev().collect(), (0..n).map(|i| (i * 5 + 3) % n).collect()];
    assert_eq!(orders[2].iter().collect::<std::collections::HashSet<_>>().len(), n);
    let cloud = |order: &[usize]| {
        let mut points = PointFusion::new(&config).unwrap();
        for &i in order {
            points.integrate(&views[i]).unwrap();
        }
        points.finish()
    };
    let point_reference = with_threads(1, || cloud(&orders[0]));
    for order in &orders {
        with_threads(4, || {
            let shuffled: Vec<AlignedView> = order.iter().map(|&i| views[i].clone()).collect();
            let volume = fuse(&config, &shuffled);
            assert_same_bits(&mesh, &volume.extract_mesh());
            assert_eq!(volume.coverage(&mesh), reference.coverage(&mesh));
            assert_eq!(volume.memory_bytes(), reference.memory_bytes());
            assert!(point_reference == cloud(order), "point clouds differ");
        });
    }
    assert!(reference.warnings().is_empty());
}

#[test]
fn the_memory_budget_is_kept_and_what_it_cost_is_said() {
    let views = scene();
    let full = fuse(&carving(), &views);
    let budget = FusionConfig::MIN_MEMORY_BUDGET_BYTES * 2;
    assert!(full.memory_bytes() > 2 * budget, "the scene must not fit: {}", full.memory_bytes());
    let config = FusionConfig { memory_budget_bytes: budget, ..carving() };
    let mut volume = TsdfVolume::new(&config).unwrap();
    let mut points = PointFusion::new(&config).unwrap();
    let (mut dropped, mut dropped_points) = (0, 0);
    for view in &views {
        dropped += volume.integrate(view).unwrap().dropped_by_budget;
        dropped_points += points.integrate(view).unwrap().dropped_by_budget;
        assert!(volume.memory_bytes() <= budget && points.memory_bytes() <= budget);
    }
    assert!(dropped > 0 && dropped_points > 0);
    for warnings in [volume.warnings(), points.warnings()] {
        assert_eq!(warnings.len(), 1);
        assert_eq!(warnings[0].kind, "fusion-memory-budget");
        assert!(warnings[0].hint.is_some());
    }
    assert!(volume.warnings()[0].message.contains(&dropped.to_string()));
    // What fitted is whole and usable.
    let mesh = volume.extract_mesh();
    assert!(mesh.is_consistent() && !mesh.triangles.is_empty());
    assert!(volume.peak_memory_bytes() >= volume.memory_bytes());
}

#[test]
fn views_that_hold_nothing_change_nothing() {
    let pose = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    let flat = |z: f32| Image::filled(WIDTH, HEIGHT, z);
    let cases = [
        ("NaN depth", from_depth(0, pose, flat(f32::NAN), flat(1.0))),
        ("zero depth", from_depth(0, pose, flat(0.0), flat(1.0))),
        ("infinite depth", from_depth(0, pose, flat(f32::INFINITY), flat(1.0))),
        ("far depth", from_depth(0, pose, flat(1e6), flat(1.0))),
        ("huge depth", from_depth(0, pose, flat(f32::MAX), flat(1.0))),
        ("zero confidence", from_depth(0, pose, flat(1.0), flat(0.0))),
        ("NaN confidence", from_depth(0, pose, flat(1.0), flat(f32::NAN))),
    ];
    let config = FusionConfig { min_confidence: 0.0, ..carving() };
    for (name, view) in cases {
        let mut volume = TsdfVolume::new(&config).unwrap();
        let stats = volume.integrate(&view).unwrap();
        assert_eq!((stats.pixels_used, stats.blocks_touched, stats.blocks_total), (0, 0, 0), "{name}");
        assert_eq!(stats.blocks_carved, 0, "{name}");
        assert_eq!(volume.extract_mesh(), TriangleMesh::default(), "{name}");
        assert_eq!(volume.coverage(&TriangleMesh::default()).surface_voxels, 0, "{name}");
        let mut points = PointFusion::new(&config).unwrap();
        points.integrate(&view).unwrap();
        assert!(points.finish().is_empty(), "{name}");
    }
}

#[test]
fn holes_and_lone_pixels_do_not_disturb_their_neighbours() {
    let pose = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    // Holes on the right, lone pixels on the left.
    let depth = Image::from_fn(WIDTH, HEIGHT, |x, y| {
        let ninth = x % 3 == 0 && y % 3 == 0;
        if ninth == (x < WIDTH / 2) { 1.0 } else { f32::NAN }
    });
    let mesh =
        fuse(&config(), &[from_depth(0, pose, depth, Image::filled(WIDTH, HEIGHT, 1.0))]).extract_mesh();
    assert!(!mesh.triangles.is_empty());
    assert!(mesh.positions.iter().flatten().chain(mesh.normals.iter().flatten()).all(|v| v.is_finite()));
    assert!(mesh.positions.iter().all(|p| p[2].abs() < 1e-3));
}

#[test]
fn a_camera_out_of_reach_is_refused_by_name_and_leaves_the_volume_alone() {
    let mut volume = TsdfVolume::new(&config()).unwrap();
    volume.integrate(&view(0, look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros()), 1.0, floor(0.0))).unwrap();
    let before = volume.extract_mesh();
    let flat = || Image::filled(WIDTH, HEIGHT, 1.0f32);
    for distance in [1e6, 1e30, 1e150] {
        let far = from_depth(7, Se3::from_translation(Vec3::new(distance, 0.0, 0.0)), flat(), flat());
        match volume.integrate(&far) {
            Err(FusionError::TooFar { frame, distance_m, .. }) => {
                assert_eq!((frame.0, distance_m), (7, distance));
            }
            other => panic!("{distance}: {other:?}"),
        }
        assert!(matches!(
            PointFusion::new(&config()).unwrap().integrate(&far),
            Err(FusionError::TooFar { .. })
        ));
    }
    assert_same_bits(&before, &volume.extract_mesh());
    assert_eq!(volume.views(), 1);
    // Within reach it works, even some kilometres out.
    let pose = Se3::from_translation(Vec3::new(5000.0, -3000.0, 100.0));
    let mesh = fuse(&config(), &[from_depth(8, pose, flat(), flat())]).extract_mesh();
    assert!(!mesh.triangles.is_empty());
    assert!(mesh.positions.iter().all(|p| (p[2] - 101.0).abs() < 0.01));
}

#[test]
fn voxels_far_finer_than_the_pixels_are_refused_with_the_size_that_works() {
    let tiny = FusionConfig { voxel_size_m: 0.0005, carve_range_m: 50.0, max_depth_m: 100.0, ..config() };
    let pose = look_at(Vec3::new(0.0, 0.0, 8.0), Vec3::zeros());
    let seen = view(3, pose, 1.0, floor(0.0));
    let smallest = match TsdfVolume::new(&tiny).unwrap().integrate(&seen) {
        Err(FusionError::VoxelTooSmall { frame, smallest_m, .. }) => {
            assert_eq!(frame.0, 3);
            smallest_m
        }
        other => panic!("{other:?}"),
    };
    // The size it names is accepted, and the work and memory stay bounded.
    let config = FusionConfig { voxel_size_m: smallest * 1.001, memory_budget_bytes: 64 << 20, ..tiny };
    let mut volume = TsdfVolume::new(&config).unwrap();
    let stats = volume.integrate(&seen).unwrap();
    assert!(stats.blocks_touched > 0 && volume.memory_bytes() <= 64 << 20);
    let kinds: Vec<String> = volume.warnings().into_iter().map(|w| w.kind).collect();
    assert!(kinds.contains(&"fusion-carve-range".to_string()), "{kinds:?}");
}

#[test]
fn small_pieces_are_dropped_and_large_ones_kept() {
    let pose = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    // A speck of 8 × 8 pixels 0.3 m above the floor.
    let depth =
        Image::from_fn(
            WIDTH,
            HEIGHT,
            |x, y| {
                if x.abs_diff(100) < 8 && y.abs_diff(75) < 8 { 0.7f32 } else { 1.0 }
            },
        );
    let seen = [from_depth(0, pose, depth, Image::filled(WIDTH, HEIGHT, 1.0))];
    let above = |min_component_triangles| {
        let mesh = fuse(&FusionConfig { min_component_triangles, ..config() }, &seen).extract_mesh();
        assert!(mesh.is_consistent());
        (mesh.positions.iter().filter(|p| p[2] > 0.2).count(), mesh.positions.len())
    };
    let (speck, all) = above(0);
    assert!(speck > 5);
    assert_eq!(above(500), (0, all - speck));
}

#[test]
fn configuration_from_text_keeps_defaults_and_refuses_unknown_keys() {
    let config: FusionConfig = toml::from_str("voxel_size_m = 0.05").unwrap();
    assert_eq!(config, FusionConfig { voxel_size_m: 0.05, ..FusionConfig::default() });
    assert!(toml::from_str::<FusionConfig>("voxel_size = 0.05").is_err());
    let bad = FusionConfig { voxel_size_m: f64::NAN, ..FusionConfig::default() };
    assert!(matches!(TsdfVolume::new(&bad), Err(FusionError::BadConfig { field: "voxel_size_m", .. })));
    assert!(PointFusion::new(&bad).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn arbitrary_depth_and_confidence_never_break_a_mesh(seed in proptest::collection::vec(any::<u32>(), 64)) {
        // Blocks of noise between 0.2 and 4 m with holes: every case of marching cubes comes up.
        let noise = |x: usize, y: usize| seed[(x / 7 * 13 + y / 5 * 29) % 64].wrapping_mul(1 + (x * 31 + y) as u32 % 3);
        let depth = Image::from_fn(WIDTH, HEIGHT, |x, y| match noise(x, y) {
            n if n % 11 == 0 => f32::NAN,
            n => 0.2 + (n % 1000) as f32 * 0.0038,
        });
        let confidence = Image::from_fn(WIDTH, HEIGHT, |x, y| (noise(y, x) % 100) as f32 / 99.0);
        let views: Vec<AlignedView> = [0.0, 0.3]
            .iter()
            .enumerate()
            .map(|(i, &x)| from_depth(i as u32, look_at(Vec3::new(x, 0.0, 1.0), Vec3::zeros()), depth.clone(), confidence.clone()))
            .collect();
        let mesh = fuse(&FusionConfig { voxel_size_m: 0.05, carve_range_m: 3.0, max_incidence_deg: 90.0, ..config() }, &views).extract_mesh();
        prop_assert!(!mesh.triangles.is_empty());
        assert_vertices_are_distinct_and_used(&mesh);
        // Manifold but for its border: asserted inside.
        border_edges(&mesh);
        prop_assert!(mesh.normals.iter().all(|&n| (point(n).norm() - 1.0).abs() < 1e-4));
        prop_assert!(mesh.confidences.iter().all(|c| (0.0..=1.0).contains(c)));
    }
}
