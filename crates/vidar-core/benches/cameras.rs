//! Projection, unprojection, undistortion and the Lie-group kernels. Run: `cargo bench -p vidar-core`.

// A benchmark may stop at the first surprise.
#![allow(clippy::unwrap_used)]

use divan::{Bencher, black_box, counter::ItemsCount};
use nalgebra::{SVector, Vector2, Vector3};
use vidar_core::camera::{DoubleSphere, Equidistant, Fov, ParametricCamera, RadTan};
use vidar_core::remap::{RemapTable, undistorted_view};
use vidar_core::{CameraModel, FrameImage, Image, LieGroup, Pinhole, Se3, Sim3, umeyama_sim3};

fn main() {
    divan::main();
}

const MODELS: [&str; 5] = ["pinhole", "pinhole-radtan", "pinhole-equidistant", "double-sphere", "fov"];

fn camera(name: &str) -> CameraModel {
    match name {
        "pinhole" => CameraModel::Pinhole(Pinhole::examples()[0]),
        "pinhole-radtan" => CameraModel::RadTan(RadTan::examples()[0]),
        "pinhole-equidistant" => CameraModel::Equidistant(Equidistant::examples()[0]),
        "double-sphere" => CameraModel::DoubleSphere(DoubleSphere::examples()[0]),
        _ => CameraModel::Fov(Fov::examples()[0]),
    }
}

/// A thousand pixels over the image that have a ray, and points along these rays.
fn samples(camera: &CameraModel) -> (Vec<Vector2<f64>>, Vec<Vector3<f64>>) {
    let (w, h) = (camera.width() as f64, camera.height() as f64);
    let at = |i: u32| Vector2::new(w * (f64::from(i) * 0.618) % w, h * f64::from(i) / 1000.0);
    (0..1000).map(at).filter_map(|p| Some((p, camera.unproject(&p)? * (1.0 + p.x / w)))).unzip()
}

#[divan::bench(args = MODELS)]
fn project_1000(bencher: Bencher<'_, '_>, name: &str) {
    let camera = camera(name);
    let (_, points) = samples(&camera);
    bencher
        .counter(ItemsCount::new(points.len()))
        .bench_local(|| points.iter().filter_map(|p| camera.project(black_box(p))).map(|p| p.x).sum::<f64>());
}

#[divan::bench(args = MODELS)]
fn project_with_jacobian_1000(bencher: Bencher<'_, '_>, name: &str) {
    let camera = camera(name);
    let (_, points) = samples(&camera);
    let one = |p| camera.project_with_jacobian(black_box(p)).map(|(_, j)| j[(0, 2)]);
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| points.iter().filter_map(one).sum::<f64>());
}

#[divan::bench(args = MODELS)]
fn unproject_1000(bencher: Bencher<'_, '_>, name: &str) {
    let camera = camera(name);
    let (pixels, _) = samples(&camera);
    bencher.counter(ItemsCount::new(pixels.len())).bench_local(|| {
        pixels.iter().filter_map(|p| camera.unproject(black_box(p))).map(|p| p.x).sum::<f64>()
    });
}

/// Building the map and undistorting one EuRoC image, at full size and at half.
#[divan::bench(args = [(752, 480), (376, 240)])]
fn remap_table(bencher: Bencher<'_, '_>, (w, h): (usize, usize)) {
    let camera = camera("pinhole-radtan");
    let view = undistorted_view(&camera, w, h).unwrap();
    bencher.bench_local(|| RemapTable::new(black_box(&camera), &view));
}

#[divan::bench(args = [(752, 480), (376, 240)])]
fn remap_apply_gray8(bencher: Bencher<'_, '_>, (w, h): (usize, usize)) {
    let camera = camera("pinhole-radtan");
    let table = RemapTable::new(&camera, &undistorted_view(&camera, w, h).unwrap());
    let image = FrameImage::Gray8(Image::from_fn(752, 480, |x, y| (x * 7 + y * 13) as u8));
    bencher.counter(ItemsCount::new(w * h)).bench_local(|| table.apply(black_box(&image)));
}

#[divan::bench]
fn se3_left_jacobian(bencher: Bencher<'_, '_>) {
    let tangent = SVector::<f64, 6>::from([0.3, -0.8, 1.1, 2.0, -1.0, 0.4]);
    bencher.bench_local(|| Se3::left_jacobian(black_box(&tangent)));
}

#[divan::bench]
fn sim3_exp_log(bencher: Bencher<'_, '_>) {
    let tangent = SVector::<f64, 7>::from([0.3, -0.8, 1.1, 2.0, -1.0, 0.4, 0.2]);
    bencher.bench_local(|| Sim3::exp(black_box(&tangent)).log());
}

#[divan::bench]
fn sim3_left_jacobian(bencher: Bencher<'_, '_>) {
    let tangent = SVector::<f64, 7>::from([0.3, -0.8, 1.1, 2.0, -1.0, 0.4, 0.2]);
    bencher.bench_local(|| Sim3::left_jacobian(black_box(&tangent)));
}

#[divan::bench]
fn umeyama_1000_points(bencher: Bencher<'_, '_>) {
    let camera = camera("pinhole");
    let (_, source) = samples(&camera);
    let target: Vec<_> = source.iter().map(|p| p * 2.0 + Vector3::x()).collect();
    bencher.bench_local(|| umeyama_sim3(black_box(&source), black_box(&target)));
}
