//! Against depth that is known in closed form.

use super::*;
use crate::{FusionConfig, TsdfVolume};
use vidar_core::{AlignedView, Confidence, FrameId, MetricDepth, So3, Timestamp};

fn camera() -> Pinhole {
    Pinhole::new(120.0, 120.0, 79.5, 59.5, 160, 120).unwrap()
}

/// z-depth of the sphere of radius 0.8 m, 2 m in front of the origin, from a camera moved by `x` m; NaN beside it.
fn ball(k: &Pinhole, x: f64) -> Image<f32> {
    Image::from_fn(k.width, k.height, |u, v| {
        let ray = Vector3::new((u as f64 - k.cx) / k.fx, (v as f64 - k.cy) / k.fy, 1.0);
        let center = Vector3::new(-x, 0.0, 2.0);
        let (a, b, c) = (ray.norm_squared(), ray.dot(&center), center.norm_squared() - 0.64);
        let root = b * b - a * c;
        if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { f32::NAN }
    })
}

fn fused_ball() -> TriangleMesh {
    let k = camera();
    let mut volume =
        TsdfVolume::new(&FusionConfig { voxel_size_m: 0.01, ..FusionConfig::default() }).unwrap();
    for i in 0..5_u32 {
        let x = 0.1 * (f64::from(i) - 2.0);
        let pose = Se3::from_translation(Vector3::new(x, 0.0, 0.0));
        let depth = MetricDepth::new(ball(&k, x));
        let view =
            AlignedView::new(FrameId(i), Timestamp::default(), pose, k, depth, Confidence::full(160, 120));
        volume.integrate(&view.unwrap()).unwrap();
    }
    volume.extract_mesh()
}

#[test]
fn a_fused_ball_is_seen_where_it_is() {
    let mesh = fused_ball();
    let renderer = SurfaceRenderer::new(&mesh);
    // A camera that took no part.
    let x = 0.05;
    let seen = renderer.render(&Se3::from_translation(Vector3::new(x, 0.0, 0.0)), &camera());
    let truth = ball(&camera(), x);
    let (mut expected, mut found, mut worst) = (0, 0, 0.0_f32);
    for (z, truth) in seen.depth.data().iter().zip(truth.data()) {
        expected += usize::from(truth.is_finite());
        if z.is_finite() {
            assert!(truth.is_finite(), "depth beside the ball");
            found += 1;
            worst = worst.max((z / truth - 1.0).abs());
        }
    }
    // The rim is seen under more than 80°, where fusion takes nothing, and beside the silhouette.
    assert!(found as f64 > 0.9 * expected as f64, "{found} of {expected}");
    assert!(worst < 0.02, "{worst}");
}

#[test]
fn a_wall_is_closed_and_seen_from_its_front_alone() {
    // A square of 2 x 2 m at 3 m, counter-clockwise to an observer at the origin, whose rows point down.
    let corner = |x: f32, y: f32| [x, y, 3.0];
    let mesh = TriangleMesh {
        positions: vec![corner(-1.0, -1.0), corner(-1.0, 1.0), corner(1.0, 1.0), corner(1.0, -1.0)],
        confidences: vec![0.5; 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..TriangleMesh::default()
    };
    let renderer = SurfaceRenderer::new(&mesh);
    let front = renderer.render(&Se3::IDENTITY, &camera());
    let inside = |u: usize, v: usize| (u as f64 - 79.5).abs() < 39.9 && (v as f64 - 59.5).abs() < 39.9;
    for v in 0..120 {
        for u in 0..160 {
            let z = front.depth[(u, v)];
            assert_eq!(z.is_finite(), inside(u, v), "({u}, {v})");
            if z.is_finite() {
                assert!((z - 3.0).abs() < 1e-5 && (front.confidence[(u, v)] - 0.5).abs() < 1e-6);
            }
        }
    }
    // Behind the wall, looking back at it.
    let turn = So3::exp(&Vector3::new(0.0, std::f64::consts::PI, 0.0));
    let back = renderer.render(&Se3::new(turn, Vector3::new(0.0, 0.0, 6.0)), &camera());
    assert!(back.depth.data().iter().all(|z| z.is_nan()));
    assert!(back.confidence.data().iter().all(|c| *c == 0.0));
}

#[test]
fn what_is_no_mesh_gives_no_depth() {
    let mesh = TriangleMesh {
        positions: vec![[f32::NAN, 0.0, 1.0], [1e30, 1e30, 1.0], [0.0, 1.0, 1.0]],
        triangles: vec![[0, 1, 2], [1, 2, 7], [1, 1, 2]],
        ..TriangleMesh::default()
    };
    let seen = SurfaceRenderer::new(&mesh).render(&Se3::IDENTITY, &camera());
    assert!(seen.depth.data().iter().all(|z| z.is_nan()));
}
