//! One suite for every camera model, over the examples that each model ships.

use nalgebra::{Matrix2, Matrix3x2, SVector, Vector2, Vector3};
use proptest::prelude::*;
use vidar_core::camera::{
    CameraError, CameraModel, DoubleSphere, Equidistant, Fov, ParametricCamera, Pinhole, RadTan,
};
use vidar_core::testing::check_jacobian;

/// Two unit vectors across `direction`.
fn across(direction: &Vector3<f64>) -> Matrix3x2<f64> {
    let other = if direction.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let a = direction.cross(&other).normalize();
    Matrix3x2::from_columns(&[a, direction.cross(&a)])
}

/// How far a rounding of the pixel can turn the direction: large near a fold, where the map flattens.
fn radians_per_pixel(camera: &CameraModel, direction: &Vector3<f64>) -> f64 {
    camera.project_with_jacobian(direction).map_or(f64::INFINITY, |(_, jacobian)| {
        let turn: Matrix2<f64> = jacobian * across(direction);
        1.0 / turn.singular_values().min()
    })
}

/// Directions over the whole sphere, a quarter of them close to the axis or to the side.
fn direction() -> impl Strategy<Value = Vector3<f64>> {
    let component = -1.0..1.0_f64;
    let anywhere = (component.clone(), component.clone(), component)
        .prop_filter_map("too short", |(x, y, z)| Vector3::new(x, y, z).try_normalize(0.1));
    let near_axis = (
        0.0..6.3_f64,
        prop::sample::select(vec![0.0_f64, 1e-12, 1e-9, 1e-7, 1e-3, std::f64::consts::PI - 3e-6]),
    )
        .prop_map(|(around, off)| {
            let (sin, cos) = off.sin_cos();
            Vector3::new(sin * around.cos(), sin * around.sin(), cos)
        });
    prop_oneof![3 => anywhere, 1 => near_axis]
}

fn round_trip_of_direction(camera: &CameraModel, direction: &Vector3<f64>) -> Result<(), TestCaseError> {
    let Some(pixel) = camera.project(direction) else { return Ok(()) };
    let name = camera.name();
    // Where a pixel is worth more than a tenth of a radian the direction is lost in roundings.
    let per_pixel = radians_per_pixel(camera, direction);
    if per_pixel > 0.1 {
        return Ok(());
    }
    let Some(back) = camera.unproject(&pixel) else {
        return Err(TestCaseError::fail(format!("{name}: {direction:?} -> {pixel:?} -> nothing")));
    };
    let error = (back - direction).norm();
    let bound = 1e-12 + 1e-13 * per_pixel * pixel.norm().max(1e3);
    prop_assert!(error <= bound, "{name}: {direction:?} came back {error:.2e} off, bound {bound:.2e}");
    // A projection does not depend on the distance.
    let far = camera.project(&(direction * 37.5));
    let slope = camera.project_with_jacobian(direction).map_or(0.0, |(_, j)| j.amax());
    let bound = 1e-11 * pixel.norm().max(1e3) + 1e-13 * slope;
    prop_assert!(far.is_some_and(|p| (p - pixel).norm() <= bound), "{name}: {far:?}");
    Ok(())
}

fn jacobian_is_numeric(camera: &CameraModel, point: &Vector3<f64>) -> Result<(), TestCaseError> {
    // Steps of the differences must stay inside the domain.
    let all_inside = (0..3).all(|axis| {
        let mut step = Vector3::zeros();
        step[axis] = 2e-4 * point.norm().max(1.0);
        camera.project(&(point + step)).is_some() && camera.project(&(point - step)).is_some()
    });
    let Some((pixel, jacobian)) = camera.project_with_jacobian(point).filter(|_| all_inside) else {
        return Ok(());
    };
    prop_assert_eq!(Some(pixel), camera.project(point));
    // Grazing directions of a pinhole and the point behind a fisheye move by more than 1e5 px/rad: no difference
    // quotient resolves that.
    if jacobian.amax() * point.norm() > 1e5 {
        return Ok(());
    }
    let f = |p: &Vector3<f64>| camera.project(p).unwrap_or_else(|| Vector2::repeat(f64::NAN));
    check_jacobian(camera.name(), &jacobian, f, point, 1e-6).map_err(TestCaseError::fail)
}

fn parameter_jacobian_is_numeric<const N: usize, M: ParametricCamera<N>>(
    camera: &M,
    model: &CameraModel,
    point: &Vector3<f64>,
) -> Result<(), TestCaseError> {
    let found = camera.project_with_parameter_jacobian(point);
    prop_assert_eq!(found.map(|f| f.0), model.project(point));
    let Some((pixel, jacobian)) = found else { return Ok(()) };
    if pixel.norm() > 5e3 {
        return Ok(());
    }
    let (width, height) = (model.width(), model.height());
    let f = |parameters: &SVector<f64, N>| {
        let parameters: [f64; N] = (*parameters).into();
        let moved = M::from_parameters(&parameters, width, height).ok();
        moved
            .and_then(|m| m.project_with_parameter_jacobian(point))
            .map_or(Vector2::repeat(f64::NAN), |(pixel, _)| pixel)
    };
    let at = SVector::from(camera.parameters());
    // A parameter at the border of its domain (alpha = 0) has no difference to both sides.
    let both_sides = (0..N).all(|i| {
        let (mut up, mut down) = (at, at);
        up[i] += 1e-4 * at[i].abs().max(1.0);
        down[i] -= 1e-4 * at[i].abs().max(1.0);
        !f(&up).x.is_nan() && !f(&down).x.is_nan()
    });
    if both_sides {
        check_jacobian("d_pixel_d_parameters", &jacobian, f, &at, 1e-6).map_err(TestCaseError::fail)?;
    }
    let dynamic = model.project_with_parameter_jacobian(point);
    prop_assert_eq!(dynamic.as_ref().map(|d| d.1.as_slice()), Some(jacobian.as_slice()));
    Ok(())
}

fn bad_examples_are_refused<const N: usize, M: ParametricCamera<N> + std::fmt::Debug>() {
    let examples = M::invalid_examples();
    assert!(examples.len() > 10);
    for example in examples {
        let found = M::from_parameters(&example.parameters, example.width, example.height);
        // Texts are compared because a NaN is not equal to itself.
        assert_eq!(found.map_err(|e| e.to_string()).err(), Some(example.expected.to_string()), "{example:?}");
    }
}

macro_rules! model_suite {
    ($name:ident, $model:ident, $parameters:literal) => {
        mod $name {
            use super::*;

            fn models() -> Vec<CameraModel> {
                let examples = $model::examples();
                assert!(examples.len() >= 3);
                examples.into_iter().map(CameraModel::$model).collect()
            }

            proptest! {
                #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..Default::default() })]

                #[test]
                fn directions_survive_the_round_trip(direction in direction()) {
                    for camera in models() {
                        round_trip_of_direction(&camera, &direction)?;
                    }
                }

                #[test]
                fn jacobians_agree_with_differences(direction in direction(), distance in 0.3..50.0_f64) {
                    for (camera, model) in $model::examples().iter().zip(models()) {
                        jacobian_is_numeric(&model, &(direction * distance))?;
                        parameter_jacobian_is_numeric(camera, &model, &(direction * distance))?;
                    }
                }

                #[test]
                fn any_bits_are_answered_without_panic(x in any::<f64>(), y in any::<f64>(), z in any::<f64>()) {
                    for camera in models() {
                        let point = Vector3::new(x, y, z);
                        if let Some(pixel) = camera.project(&point) {
                            prop_assert!(pixel.iter().all(|v| v.is_finite()), "{point:?} -> {pixel:?}");
                        }
                        if let Some(ray) = camera.unproject(&Vector2::new(x, y)) {
                            prop_assert!((ray.norm() - 1.0).abs() < 1e-12, "{x} {y} -> {ray:?}");
                        }
                        let _ = camera.project_with_jacobian(&point);
                        let _ = camera.project_with_parameter_jacobian(&point);
                    }
                }
            }

            #[test]
            fn pixels_of_the_image_survive_the_round_trip() {
                for camera in models() {
                    let (mut with_ray, mut all) = (0, 0);
                    for y in (0..camera.height()).step_by(7) {
                        for x in (0..camera.width()).step_by(7) {
                            let pixel = Vector2::new(x as f64 + 0.25, y as f64 - 0.25);
                            all += 1;
                            let Some(ray) = camera.unproject(&pixel) else { continue };
                            with_ray += 1;
                            let back = camera.project(&ray).unwrap();
                            assert!((back - pixel).norm() < 1e-9, "{camera:?}: {pixel:?} came back as {back:?}");
                        }
                    }
                    assert!(2 * with_ray > all, "{camera:?}: only {with_ray} of {all} pixels have a ray");
                }
            }

            #[test]
            fn what_is_not_a_point_has_no_pixel() {
                for camera in models() {
                    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                        for axis in 0..3 {
                            let mut point = Vector3::new(0.1, 0.1, 1.0);
                            point[axis] = bad;
                            assert_eq!(camera.project(&point), None, "{camera:?} {point:?}");
                            assert!(camera.project_with_jacobian(&point).is_none());
                            assert!(camera.project_with_parameter_jacobian(&point).is_none());
                        }
                        assert_eq!(camera.unproject(&Vector2::new(bad, 10.0)), None);
                        assert_eq!(camera.unproject(&Vector2::new(10.0, bad)), None);
                    }
                    assert_eq!(camera.project(&Vector3::zeros()), None);
                    assert_eq!(camera.project(&-Vector3::z()), None);
                    assert_eq!(camera.project(&Vector3::new(1e-9, 0.0, -1.0)), None);
                }
            }

            #[test]
            fn bad_parameters_are_refused_by_name() {
                bad_examples_are_refused::<$parameters, $model>();
            }

            #[test]
            fn parameters_rebuild_the_same_camera() {
                for camera in models() {
                    assert_eq!(camera.parameters().len(), camera.parameter_names().len());
                    assert_eq!(camera.with_parameters(&camera.parameters()), Ok(camera.clone()));
                    let error = camera.with_parameters(&[1.0]).unwrap_err();
                    assert!(matches!(error, CameraError::WrongParameterCount { found: 1, .. }), "{error}");
                }
            }
        }
    };
}

model_suite!(pinhole, Pinhole, 4);
model_suite!(radtan, RadTan, 9);
model_suite!(equidistant, Equidistant, 8);
model_suite!(double_sphere, DoubleSphere, 6);
model_suite!(fov, Fov, 5);

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..Default::default() })]

    #[test]
    fn every_double_sphere_maps_one_to_one(xi in -0.95..1.0_f64, alpha in 0.0..1.0_f64, d in direction()) {
        let pinhole = Pinhole::new(300.0, 300.0, 320.0, 240.0, 640, 480).unwrap();
        let camera = CameraModel::DoubleSphere(DoubleSphere::new(pinhole, xi, alpha).unwrap());
        round_trip_of_direction(&camera, &d)?;
    }

    #[test]
    fn every_radtan_maps_one_to_one_inside_its_domain(
        k1 in -0.5..0.5_f64, k2 in -0.5..0.5_f64, k3 in -0.5..0.5_f64,
        p1 in -0.01..0.01_f64, p2 in -0.01..0.01_f64,
        x in -1.0..1.0_f64, y in -1.0..1.0_f64,
    ) {
        let pinhole = Pinhole::new(300.0, 300.0, 320.0, 240.0, 640, 480).unwrap();
        let camera = CameraModel::RadTan(RadTan::with_k3(pinhole, [k1, k2, p1, p2], k3).unwrap());
        round_trip_of_direction(&camera, &Vector3::new(x, y, 1.0).normalize())?;
    }

    #[test]
    fn every_equidistant_maps_one_to_one(
        k1 in -0.1..0.1_f64, k2 in -0.05..0.05_f64, k3 in -0.02..0.02_f64, k4 in -0.01..0.01_f64, d in direction(),
    ) {
        let pinhole = Pinhole::new(300.0, 300.0, 320.0, 240.0, 640, 480).unwrap();
        let camera = CameraModel::Equidistant(Equidistant::new(pinhole, [k1, k2, k3, k4]).unwrap());
        round_trip_of_direction(&camera, &d)?;
    }
}

#[test]
fn known_pixels_are_met() {
    // Computed by OpenCV's formulae with pencil and paper at x = 0.5, y = -0.25.
    let pinhole = Pinhole::new(400.0, 500.0, 320.0, 240.0, 640, 480).unwrap();
    let point = Vector3::new(1.0, -0.5, 2.0);
    let radtan = RadTan::with_k3(pinhole, [-0.2, 0.1, 0.01, -0.02], 0.05).unwrap();
    let (r2, x, y) = (0.3125, 0.5, -0.25);
    let d = 1.0 - 0.2 * r2 + 0.1 * r2 * r2 + 0.05 * r2 * r2 * r2;
    let expected = Vector2::new(
        400.0 * (x * d + 2.0 * 0.01 * x * y - 0.02 * (r2 + 2.0 * x * x)) + 320.0,
        500.0 * (y * d + 0.01 * (r2 + 2.0 * y * y) - 2.0 * 0.02 * x * y) + 240.0,
    );
    assert!((radtan.project(&point).unwrap() - expected).norm() < 1e-12);
    // Fisheye without terms: the radius is the angle. At 45 degrees to the right it is pi/4 focal lengths.
    let equidistant = Equidistant::new(pinhole, [0.0; 4]).unwrap();
    let expected = Vector2::new(320.0 + 400.0 * std::f64::consts::FRAC_PI_4, 240.0);
    assert!((equidistant.project(&Vector3::new(3.0, 0.0, 3.0)).unwrap() - expected).norm() < 1e-12);
    // With xi = 0 and alpha = 0 the double sphere is a pinhole.
    let double_sphere = DoubleSphere::new(pinhole, 0.0, 0.0).unwrap();
    assert!((double_sphere.project(&point).unwrap() - pinhole.project(&point).unwrap()).norm() < 1e-12);
    // At half the opening the FOV model's radius is half a focal length over omega, times omega.
    let fov = Fov::new(pinhole, 1.2).unwrap();
    let point = Vector3::new(0.5 / 0.6_f64.tan(), 0.0, 1.0);
    let expected = Vector2::new(320.0 + 400.0 * std::f64::consts::FRAC_PI_4 / 1.2, 240.0);
    assert!((fov.project(&point).unwrap() - expected).norm() < 1e-12);
}

#[test]
fn a_fisheye_sees_beside_and_behind_itself_and_a_pinhole_does_not() {
    let behind = Vector3::new(1.0, 0.0, -0.2);
    assert!(Equidistant::examples()[0].project(&behind).is_some());
    assert!(DoubleSphere::examples()[2].project(&behind).is_some());
    assert!(Pinhole::examples()[0].project(&behind).is_none());
    assert!(RadTan::examples()[0].project(&behind).is_none());
    assert!(Fov::examples()[0].project(&behind).is_none());
}

#[test]
fn every_pixel_of_the_real_cameras_has_a_ray() {
    // The one-to-one domain must not cost a real calibration any of its image.
    let real = [
        CameraModel::Pinhole(Pinhole::examples()[0]),
        CameraModel::RadTan(RadTan::examples()[0]),
        CameraModel::Equidistant(Equidistant::examples()[0]),
        CameraModel::DoubleSphere(DoubleSphere::examples()[0]),
        CameraModel::DoubleSphere(DoubleSphere::examples()[1]),
        CameraModel::Fov(Fov::examples()[0]),
    ];
    for camera in real {
        let (right, bottom) = (camera.width() as f64 - 0.5, camera.height() as f64 - 0.5);
        for (x, y) in [(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)] {
            assert!(camera.unproject(&Vector2::new(x, y)).is_some(), "{camera:?} at {x}, {y}");
        }
    }
}

#[test]
fn a_resized_view_keeps_its_field_of_view() {
    let view = Pinhole::new(250.0, 251.0, 160.0, 110.0, 322, 224).unwrap();
    let large = view.resized(752, 524).unwrap();
    for (from, to) in [((-0.5, -0.5), (-0.5, -0.5)), ((321.5, 223.5), (751.5, 523.5))] {
        let (a, b) = (view.ray(from.0, from.1), large.ray(to.0, to.1));
        assert!((a - b).norm() < 1e-12, "{a} {b}");
    }
}
