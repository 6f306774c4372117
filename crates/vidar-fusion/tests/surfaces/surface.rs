//! The fused surface against shapes whose truth is known.

use crate::common::*;
use vidar_core::{Image, Se3};
use vidar_fusion::{PointFusion, surface_area_m2};

const RADIUS: f64 = 0.5;

#[test]
fn a_ball_seen_from_all_sides_becomes_a_closed_mesh_of_the_right_place_area_and_normals() {
    let volume = fuse(&config(), &views_around(40, 1.5, ball(RADIUS)));
    let mesh = volume.extract_mesh();
    assert_vertices_are_distinct_and_used(&mesh);
    assert_eq!(border_edges(&mesh), Vec::<[u32; 2]>::new(), "the mesh is open");
    // Euler: V − E + F = 2 for one closed surface without handles.
    let (v, f) = (mesh.positions.len() as i64, mesh.triangles.len() as i64);
    assert_eq!(v - f * 3 / 2 + f, 2);
    let error = rms(mesh.positions.iter().map(|&p| point(p).norm() - RADIUS));
    assert!(error < 0.3 * 0.02, "rms {error}");
    let truth = 4.0 * std::f64::consts::PI * RADIUS * RADIUS;
    let area = surface_area_m2(&mesh);
    assert!((area / truth - 1.0).abs() < 0.02, "area {area} of {truth}");
    let angle = rms(mesh.positions.iter().zip(&mesh.normals).map(|(&p, &n)| angle_deg(&point(p), &point(n))));
    assert!(angle < 3.0, "normals off by {angle}° rms");
    assert!(mesh.normals.iter().all(|&n| (point(n).norm() - 1.0).abs() < 1e-5));
    let inward = mesh.triangles.iter().filter(|t| {
        let [a, b, c] = t.map(|i| point(mesh.positions[i as usize]));
        (b - a).cross(&(c - a)).dot(&(a + b + c)) <= 0.0
    });
    assert_eq!(inward.count(), 0, "triangles wound clockwise seen from outside");
    eprintln!("ball: rms {:.3} mm, area ratio {:.4}, normals {angle:.2} deg", error * 1e3, area / truth);
}

#[test]
fn a_box_keeps_its_faces_flat_and_its_area() {
    let half = [0.4, 0.3, 0.25];
    let volume = fuse(&config(), &views_around(60, 1.5, solid_box(half)));
    let mesh = volume.extract_mesh();
    assert_vertices_are_distinct_and_used(&mesh);
    assert!(border_edges(&mesh).is_empty());
    // Signed distance to the box, negative inside.
    let distance = |p: Vec3| {
        let q: Vec<f64> = (0..3).map(|a| p[a].abs() - half[a]).collect();
        let outside = q.iter().map(|v| v.max(0.0).powi(2)).sum::<f64>().sqrt();
        outside + q.iter().fold(f64::NEG_INFINITY, |m, &v| m.max(v)).min(0.0)
    };
    let error = rms(mesh.positions.iter().map(|&p| distance(point(p))));
    assert!(error < 0.3 * 0.02, "rms {error}");
    let truth = 8.0 * (half[0] * half[1] + half[1] * half[2] + half[2] * half[0]);
    let area = surface_area_m2(&mesh);
    assert!((area / truth - 1.0).abs() < 0.02, "area {area} of {truth}");
    assert_eq!(triangles_against_normals(&mesh), 0);
    eprintln!("box: rms {:.3} mm, area ratio {:.4}", error * 1e3, area / truth);
}

#[test]
fn a_plane_through_the_nodes_and_one_between_them_are_both_exact_and_face_the_camera() {
    // 0.1 is a multiple of the voxel: every node of the surface has distance zero.
    for height in [0.1, 0.1071] {
        let eye = Vec3::new(0.0, 0.0, 1.1);
        let seen = view(0, look_at(eye, Vec3::new(0.0, 0.0, 0.0)), 1.0, floor(height));
        let mesh = fuse(&config(), &[seen]).extract_mesh();
        assert_vertices_are_distinct_and_used(&mesh);
        let error = rms(mesh.positions.iter().map(|p| f64::from(p[2]) - height));
        assert!(error < 0.01 * 0.02, "height {height}: rms {error}");
        let tilt = rms(mesh.normals.iter().map(|&n| angle_deg(&point(n), &Vec3::z())));
        assert!(tilt < 1.0, "height {height}: tilt {tilt}°");
        assert_eq!(triangles_against_normals(&mesh), 0);
        // All of the border lies at the border of what the camera observed; inside there is no hole.
        let edge_of_view = |p: Vec3| {
            let depth = eye.z - height;
            let (x, y) = (99.5 / 160.0 * depth - p.x.abs(), 74.5 / 160.0 * depth - p.y.abs());
            x.min(y)
        };
        for v in border_edges(&mesh).into_iter().flatten() {
            let inside = edge_of_view(point(mesh.positions[v as usize]));
            assert!(inside < 2.5 * 0.02, "height {height}: a hole {inside} m inside the view");
        }
        let truth = 4.0 * (99.5 / 160.0) * (74.5 / 160.0) * (eye.z - height).powi(2);
        let area = surface_area_m2(&mesh);
        assert!(area < truth * 1.02 && area > truth * 0.9, "height {height}: area {area} of {truth}");
    }
}

#[test]
fn a_slanted_floor_across_many_blocks_has_no_seams() {
    let eyes = [(-0.5, -1.0), (0.0, -1.2), (0.5, -1.0), (0.0, -0.6)];
    let views: Vec<_> = (0..4u32)
        .map(|i| {
            let (x, y) = eyes[i as usize];
            view(i, look_at(Vec3::new(x, y, 1.3), Vec3::new(0.013, 0.3, 0.0)), 1.0, |o, d| {
                // z = 0.2 x + 0.1 y
                let n = Vec3::new(-0.2, -0.1, 1.0);
                Some(-n.dot(&o) / n.dot(&d)).filter(|&t| t > 0.0 && t < 3.0)
            })
        })
        .collect();
    let mesh = fuse(&config(), &views).extract_mesh();
    assert_vertices_are_distinct_and_used(&mesh);
    // Within 0.4 m of where all four cameras look, no edge is a border.
    let near = |i: u32| point(mesh.positions[i as usize]).norm() < 0.4;
    assert_eq!(border_edges(&mesh).iter().filter(|e| e.iter().any(|&v| near(v))).count(), 0);
    let error = rms(mesh.positions.iter().map(|&p| {
        let p = point(p);
        (p.z - 0.2 * p.x - 0.1 * p.y) / 1.05f64.sqrt()
    }));
    assert!(error < 0.1 * 0.02, "rms {error}");
}

/// By the confidence, 1 for .99 and above.
fn inverse_variance(confidence: f64) -> f64 {
    (1.0 - confidence.min(0.99).powi(2)).ln() / (1.0 - 0.99f64.powi(2)).ln()
}

#[test]
fn confidence_decides_where_disagreeing_views_put_the_surface() {
    let camera = || look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    let height_with = |other: f32| {
        let views = [view(0, camera(), 1.0, floor(0.0)), view(1, camera(), other, floor(0.03))];
        let config = vidar_fusion::FusionConfig { min_confidence: 0.0, ..config() };
        let mesh = fuse(&config, &views).extract_mesh();
        let middle: Vec<f64> =
            (mesh.positions.iter()).filter(|p| p[0].hypot(p[1]) < 0.2).map(|p| f64::from(p[2])).collect();
        middle.iter().sum::<f64>() / middle.len() as f64
    };
    // The weighted mean of 0 and 0.03: w / (1 + w) of the way.
    for confidence in [0.25, 0.5, 0.9, 1.0] {
        let weight = inverse_variance(confidence);
        let (expected, found) = (0.03 * weight / (1.0 + weight), height_with(confidence as f32));
        assert!((found - expected).abs() < 1e-3, "confidence {confidence}: {found} instead of {expected}");
    }
    assert!(height_with(0.0).abs() < 2e-4, "a view of no confidence moved the surface");
}

#[test]
fn colours_and_confidences_are_the_weighted_means_of_the_views() {
    let pose = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    let painted = |id, confidence, rgb: [u8; 3]| {
        view(id, pose, confidence, floor(0.0)).with_color(Image::filled(WIDTH, HEIGHT, rgb)).unwrap()
    };
    let views = [painted(0, 1.0, [200, 0, 40]), painted(1, 0.5, [50, 90, 40])];
    let check = |colors: &[[u8; 3]], confidences: &[f32], positions: &[[f32; 3]], weight: f64| {
        assert!(!positions.is_empty() && colors.len() == positions.len());
        let expected = [200.0 + weight * 50.0, weight * 90.0].map(|sum| (sum / (1.0 + weight)).round() as u8);
        for c in colors {
            assert!(
                c[0].abs_diff(expected[0]) <= 1 && c[1].abs_diff(expected[1]) <= 1 && c[2] == 40,
                "{c:?}"
            );
        }
        assert!(confidences.iter().all(|c| (c - 0.75).abs() < 0.005));
    };
    let mesh = fuse(&config(), &views).extract_mesh();
    // Colours of nodes are weighed by confidence, those of points as their positions are.
    check(&mesh.colors, &mesh.confidences, &mesh.positions, 0.5);
    let mut points = PointFusion::new(&config()).unwrap();
    for view in &views {
        points.integrate(view).unwrap();
    }
    let cloud = points.finish();
    assert!(cloud.is_consistent());
    check(&cloud.colors, &cloud.confidences, &cloud.positions, inverse_variance(0.5));
    // Views without colour give no colours, not black.
    assert!(fuse(&config(), &[view(0, pose, 1.0, floor(0.0))]).extract_mesh().colors.is_empty());
}

#[test]
fn carving_removes_a_floater_that_other_views_look_through_and_nothing_else() {
    let eye = |x: f64| look_at(Vec3::new(x, 0.0, 2.0), Vec3::new(0.0, 0.0, 0.0));
    // One view has a false surface 1 m above the floor.
    let mut views = vec![view(0, eye(0.0), 1.0, |o, d| {
        let t = (1.0 - o.z) / d.z;
        let p = o + d * t;
        if p.x.abs() < 0.15 && p.y.abs() < 0.15 { Some(t) } else { floor(0.0)(o, d) }
    })];
    views.extend((1..9).map(|i| view(i, eye(0.02 * f64::from(i)), 1.0, floor(0.0))));
    let floating = |carve_range_m: f64| {
        let config = vidar_fusion::FusionConfig { carve_range_m, ..config() };
        let mesh = fuse(&config, &views).extract_mesh();
        let above = mesh.positions.iter().filter(|p| p[2] > 0.5).count();
        (above, mesh.positions.len() - above)
    };
    let (kept, floor_without) = floating(0.0);
    let (left, floor_with) = floating(4.0);
    assert!(kept > 100, "the floater must be there to be carved, found {kept}");
    assert_eq!(left, 0, "floater survives");
    assert_eq!(floor_with, floor_without, "carving touched the floor");
    // Out of the carving range it stays.
    assert_eq!(floating(0.5).0, kept);
}

#[test]
fn carving_reaches_what_floats_close_before_a_slanted_surface() {
    // The camera looks at the floor at a slant; one view has a false surface 35 cm above it. Blocks there are neither entirely in
    // front of the floor nor touched by it.
    let eye = |y: f64| look_at(Vec3::new(-1.6, y, 1.1), Vec3::new(0.2, 0.0, 0.1));
    let floats = |o: Vec3, d: Vec3| {
        let t = (0.35 - o.z) / d.z;
        let p = o + d * t;
        if t > 0.0 && p.x.abs() < 0.3 && p.y.abs() < 0.3 { Some(t) } else { floor(0.0)(o, d) }
    };
    let mut views = vec![view(0, eye(0.0), 1.0, floats)];
    views.extend((1..9).map(|i| view(i, eye(0.03 * f64::from(i)), 1.0, floor(0.0))));
    let above = |carve_range_m: f64| {
        let mesh = fuse(&vidar_fusion::FusionConfig { carve_range_m, ..config() }, &views).extract_mesh();
        mesh.positions.iter().filter(|p| p[2] > 0.1).count()
    };
    assert!(above(0.0) > 300, "{} vertices of the false surface", above(0.0));
    assert_eq!(above(4.0), 0, "of {}", above(0.0));
}

#[test]
fn views_are_averaged_by_their_inverse_variances() {
    // With a tolerance of 3 %, erf(t / (σ √2)) is the confidence of σ = 1.5 % and of σ = 6 %.
    let (sure, unsure, offset) = (0.954_5, 0.382_9, 0.03);
    let pose = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    let views = [view(0, pose, sure, floor(0.0)), view(1, pose, unsure, floor(offset))];
    let mesh = fuse(&config(), &views).extract_mesh();
    let heights: Vec<f64> = mesh.positions.iter().filter(|p| p[2] < 0.02).map(|p| f64::from(p[2])).collect();
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    // Of inverse variances 16 : 1, which also the lesser depth of the upper one changes little.
    assert!((mean - offset / 17.0).abs() < 0.15 * offset / 17.0, "{mean:.5} m");
}

#[test]
fn point_fusion_puts_points_and_normals_on_the_surface() {
    let mut points = PointFusion::new(&config()).unwrap();
    for view in views_around(24, 1.5, ball(RADIUS)) {
        points.integrate(&view).unwrap();
    }
    let bytes = points.memory_bytes();
    let cloud = points.finish();
    assert!(cloud.is_consistent() && cloud.len() > 5000, "{}", cloud.len());
    assert!(bytes > cloud.len() as u64 * 60);
    let error = rms(cloud.positions.iter().map(|&p| point(p).norm() - RADIUS));
    // The mean of a patch of a ball lies below it by about voxel²/(12 R): 0.07 mm.
    assert!(error < 0.05 * 0.02, "rms {error}");
    let angle =
        rms(cloud.positions.iter().zip(&cloud.normals).map(|(&p, &n)| angle_deg(&point(p), &point(n))));
    assert!(angle < 3.0, "normals off by {angle}° rms");
    eprintln!("points: rms {:.3} mm, normals {angle:.2} deg", error * 1e3);
}

#[test]
fn coverage_counts_views_and_measures_the_observed_space() {
    let pose: Se3 = look_at(Vec3::new(0.0, 0.0, 1.0), Vec3::zeros());
    let views: Vec<_> = (0..4).map(|i| view(i, pose, 0.8, floor(0.0))).collect();
    for (count, share) in [(1, 0.0), (2, 0.0), (3, 1.0), (4, 1.0)] {
        let volume = fuse(&config(), &views[..count]);
        let mesh = volume.extract_mesh();
        let report = volume.coverage(&mesh);
        assert_eq!(report.views as usize, count);
        assert_eq!(report.mean_observations, count as f64);
        assert_eq!(report.share_seen_by_3_or_more, share);
        assert!((report.mean_confidence - 0.8).abs() < 0.003);
        assert_eq!(report.surface_area_m2, surface_area_m2(&mesh));
        // Three layers of voxels lie within one voxel of the floor, give or take the border.
        let layers = report.surface_voxels as f64 * config().voxel_size_m.powi(2) / report.surface_area_m2;
        assert!((layers - 3.0).abs() < 0.3, "{layers}");
        let [low, high] = report.bounds_m.unwrap();
        assert!(low[2].abs() < 1e-3 && high[2].abs() < 1e-3 && low[0] < -0.5 && high[0] > 0.5);
        // One view observes at least the truncation on both sides of the floor, at most the blocks it passes.
        let area = report.surface_area_m2;
        assert!(report.observed_volume_m3 > area * 0.1 && report.observed_volume_m3 < area * 0.4);
    }
    let empty = fuse(&config(), &[]);
    let report = empty.coverage(&empty.extract_mesh());
    assert_eq!((report.bounds_m, report.surface_voxels, report.mean_observations), (None, 0, 0.0));
}
