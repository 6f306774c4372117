use super::shape::MIN_T;
use super::*;
use crate::random::{Gaussian, Purpose, stream};
use std::f64::consts::PI;

fn shapes() -> Vec<Shape> {
    let v = Vector3::new;
    let axis = v(0.3, -0.5, 0.8).normalize();
    vec![
        Shape::block(v(0.5, -0.2, 0.1), [0.8, 0.5, 1.2], 0.7),
        Shape::cylinder(v(-0.5, 0.4, 0.2), axis, 0.3, 1.1),
        Shape::cylinder(v(1.5, 0.4, 0.0), Vector3::z(), 0.2, 2.0),
        Shape::Ball { center: v(-1.2, -0.8, 0.6), radius: 0.45 },
        Shape::Sheet {
            corner: v(-0.3, -1.5, 0.0),
            u_axis: Vector3::x(),
            v_axis: Vector3::z(),
            size: [0.9, 1.4],
        },
    ]
}

fn rays(n: usize) -> Vec<(Vector3<f64>, Vector3<f64>)> {
    let mut random = Gaussian::new(stream(7, Purpose::Imu));
    // From about 2 m away toward somewhere near the middle, with directions of any length.
    let mut ray = || {
        let origin = random.vector() * 2.0;
        (origin, random.vector() * 0.8 - origin)
    };
    (0..n).map(|_| ray()).collect()
}

#[test]
fn rays_end_on_surfaces_and_faces_unroll_and_back() {
    let mut hits = 0;
    for (origin, direction) in rays(4000) {
        for shape in shapes() {
            let Some(t) = shape.intersect(&origin, &direction, f64::INFINITY) else { continue };
            hits += 1;
            let point = origin + direction * t;
            assert!(shape.distance(&point) < 1e-9, "{shape:?} misses by {}", shape.distance(&point));
            let place = shape.resolve(&point, &direction);
            assert!(place.normal.dot(&direction) <= 1e-9, "{shape:?}: the normal faces the ray");
            let [u, v] = shape.face_size(place.face);
            assert!(
                place.uv[0] > -1e-9
                    && place.uv[0] < u + 1e-9
                    && place.uv[1] > -1e-9
                    && place.uv[1] < v + 1e-9
            );
            // The unrolled place is the same place; a cap's very rim may fall off it.
            if let Some((back, _)) = shape.at(place.face, place.uv) {
                assert!((back - point).norm() < 1e-7, "{shape:?} {:?}", place);
            }
            assert!(shape.extent().grown(1e-9).distance(&point) == 0.0);
        }
    }
    assert!(hits > 1000, "only {hits} hits");
}

#[test]
fn the_hierarchy_finds_what_a_search_of_all_finds() {
    let many: Vec<Shape> = (0..40)
        .map(|k| {
            let a = f64::from(k);
            let foot = Vector3::new(2.0 * (1.3 * a).sin(), 2.0 * (2.1 * a).cos(), (0.7 * a).sin());
            Shape::block(foot, [0.3, 0.2, 0.4], a)
        })
        .chain(shapes())
        .collect();
    let bvh = Bvh::new(&many);
    let mut hits = 0;
    for (origin, direction) in rays(3000) {
        let all = many
            .iter()
            .enumerate()
            .filter_map(|(i, s)| s.intersect(&origin, &direction, f64::INFINITY).map(|t| (i, t)));
        let expected = all.min_by(|a, b| a.1.total_cmp(&b.1));
        let found = bvh.nearest(&many, &origin, &direction, f64::INFINITY);
        assert_eq!(found.map(|f| f.1), expected.map(|e| e.1));
        hits += usize::from(found.is_some());
    }
    assert!(hits > 500);
    assert_eq!(Bvh::default().nearest(&[], &Vector3::zeros(), &Vector3::x(), 9.0), None);
}

#[test]
fn the_shell_is_met_from_inside_in_every_direction() {
    let shell = Shape::Shell { min: Vector3::new(-1.0, -2.0, 0.0), max: Vector3::new(3.0, 2.0, 4.0) };
    for (_, direction) in rays(500) {
        let origin = Vector3::new(0.5, 0.5, 1.0);
        let t = shell.intersect(&origin, &direction, f64::INFINITY).unwrap();
        assert!(t > MIN_T && shell.distance(&(origin + direction * t)) < 1e-12);
    }
    let straight = shell.intersect(&Vector3::new(0.0, 0.0, 1.0), &Vector3::x(), f64::INFINITY);
    assert_eq!(straight, Some(3.0));
}

#[test]
fn a_wide_footprint_sees_the_mean_of_a_fine_pattern() {
    // A checkerboard of one texel per field: the worst case for aliasing.
    let checker = Texture::bake([1.0, 1.0], 1.0 / 64.0, |v, us, out| {
        for (&u, texel) in us.iter().zip(out) {
            let odd = ((u * 64.0) as i32 + (v * 64.0) as i32) % 2 == 1;
            *texel = if odd { 65_535 } else { 0 };
        }
    });
    for k in 0..50 {
        let uv = [0.01 * f64::from(k) + 0.2, 0.5];
        assert!((checker.read(uv, 4.0 / 64.0) - 0.5).abs() < 0.01);
    }
    let range = |footprint: f32| {
        let values: Vec<f32> =
            (0..64).map(|k| checker.read([(f64::from(k) + 0.5) / 64.0, 0.5078], footprint)).collect();
        values.iter().copied().fold(0.0, f32::max) - values.iter().copied().fold(1.0, f32::min)
    };
    assert!(range(1.0 / 64.0) > 0.9, "texels are read as they are");
}

#[test]
fn textures_are_rich_and_do_not_repeat() {
    let kinds = [
        material::Kind::Plaster,
        material::Kind::Brick,
        material::Kind::Concrete,
        material::Kind::Planks,
        material::Kind::Tiles,
        material::Kind::Cardboard,
        material::Kind::Metal,
        material::Kind::Fabric,
    ];
    for kind in kinds {
        let m = material::Material { kind, seed: 5, tone: 0.45 };
        let strip = |from: f32| -> Vec<f32> {
            (0..400).map(|k| m.albedo(from + 0.005 * k as f32, 0.3, [8.0, 4.0], 0.005)).collect()
        };
        let (a, b) = (strip(0.0), strip(4.0));
        let mean = |x: &[f32]| x.iter().sum::<f32>() / x.len() as f32;
        let (ma, mb) = (mean(&a), mean(&b));
        let covariance = |x: &[f32], mx: f32, y: &[f32], my: f32| -> f32 {
            x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f32>() / x.len() as f32
        };
        let (sa, sb) = (covariance(&a, ma, &a, ma).sqrt(), covariance(&b, mb, &b, mb).sqrt());
        assert!(sa > 0.02 && sb > 0.02, "{kind:?}: contrast {sa} {sb}");
        let correlation = covariance(&a, ma, &b, mb) / (sa * sb);
        assert!(correlation < 0.7, "{kind:?} repeats: {correlation}");
    }
}

#[test]
fn equal_areas_of_a_face_are_equal_areas_of_surface() {
    // The ball's map: points even in (u, v) have even heights.
    let ball = Shape::Ball { center: Vector3::zeros(), radius: 0.5 };
    let [u, v] = ball.face_size(0);
    assert!((u * v - 4.0 * PI * 0.25).abs() < 1e-12);
    let (p, n) = ball.at(0, [0.3 * u, 0.75 * v]).unwrap();
    assert!((p.norm() - 0.5).abs() < 1e-12 && (n.z - 0.5).abs() < 1e-12);
}
