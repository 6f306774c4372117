//! Time of one view, of the mesh and of point fusion, on a synthetic room of VGA depth.

#![allow(clippy::expect_used)] // a benchmark may stop at the first surprise, as a test may
use divan::Bencher;
use vidar_core::{AlignedView, Confidence, FrameId, Image, MetricDepth, Pinhole, Se3, So3, Timestamp};
use vidar_fusion::{FusionConfig, PointFusion, SurfaceRenderer, TsdfVolume};

fn main() {
    divan::main();
}

/// Views from the middle of a box of 5 m × 4 m × 3 m, turning about its upright axis.
fn views(count: usize) -> Vec<AlignedView> {
    let k = Pinhole::new(525.0, 525.0, 319.5, 239.5, 640, 480).expect("valid intrinsics");
    let half = [2.5, 1.5, 2.0];
    (0..count)
        .map(|i| {
            let turn = So3::from_axis_angle(&nalgebra::Vector3::y(), 0.05 * i as f64);
            let rotation = turn.matrix();
            let depth = Image::from_fn(640, 480, |x, y| {
                let ray = rotation * k.ray(x as f64, y as f64);
                (0..3).map(|a| half[a] / ray[a].abs()).fold(f64::INFINITY, f64::min) as f32
            });
            let color = Image::from_fn(640, 480, |x, y| [x as u8, y as u8, 128]);
            let world_from_camera = Se3::new(turn, nalgebra::Vector3::zeros());
            AlignedView::new(
                FrameId(i as u32),
                Timestamp::from_nanos(i as i64),
                world_from_camera,
                k,
                MetricDepth::new(depth),
                Confidence::full(640, 480),
            )
            .and_then(|v| v.with_color(color))
            .expect("consistent view")
        })
        .collect()
}

fn fused(views: &[AlignedView]) -> TsdfVolume {
    let mut volume = TsdfVolume::new(&FusionConfig::default()).expect("valid default");
    for view in views {
        volume.integrate(view).expect("view fits");
    }
    volume
}

#[divan::bench(args = [0.0, 4.0])]
fn integrate_one_view_by_carve_range(bencher: Bencher<'_, '_>, carve_range_m: f64) {
    let views = views(8);
    let config = FusionConfig { carve_range_m, ..FusionConfig::default() };
    let mut volume = TsdfVolume::new(&config).expect("valid config");
    for view in &views {
        volume.integrate(view).expect("view fits");
    }
    let mut next = views.iter().cycle();
    bencher.bench_local(|| volume.integrate(next.next().expect("endless")).expect("view fits"));
}

#[divan::bench]
fn extract_mesh_of_20_views(bencher: Bencher<'_, '_>) {
    let volume = fused(&views(20));
    bencher.bench(|| volume.extract_mesh());
}

#[divan::bench]
fn integrate_one_view_into_points(bencher: Bencher<'_, '_>) {
    let views = views(8);
    let mut points = PointFusion::new(&FusionConfig::default()).expect("valid default");
    let mut next = views.iter().cycle();
    bencher.bench_local(|| points.integrate(next.next().expect("endless")).expect("view fits"));
}

/// The surface of the room, some 400 000 triangles, seen at 480 × 360.
#[divan::bench]
fn render_one_view(bencher: Bencher<'_, '_>) {
    let views = views(40);
    let mesh = fused(&views).extract_mesh();
    let renderer = SurfaceRenderer::new(&mesh);
    let k = views[0].intrinsics().resized(480, 360).expect("valid intrinsics");
    let mut next = views.iter().cycle();
    bencher.bench_local(|| renderer.render(next.next().expect("endless").world_from_camera(), &k));
}
