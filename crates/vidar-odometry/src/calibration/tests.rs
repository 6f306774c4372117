//! Derivatives, the tracker, noise, and what cannot be observed.

use super::parameters::{DIM, Parameters, Tangent};
use super::path::GyroPath;
use super::window::{Node, NodeObservation, Noise, Point, Turns, Window};
use super::*;
use crate::simulate::{Handheld, Random};
use nalgebra::Vector2;
use vidar_core::{AngularRate, FrameImage, Image, LieGroup, SpecificForce};

fn log_of(truth: &Handheld) -> CalibrationLog {
    let recording = truth.record();
    let mut log = CalibrationLog::default();
    recording.samples.iter().for_each(|s| log.add_gyro(s));
    recording.images.into_iter().for_each(|(stamp, features)| log.add_image(stamp, features.into_iter()));
    log
}

fn mounted(assumed: &So3) -> KnownCamera<'_> {
    KnownCamera { assumed_mount: Some(assumed), ..KnownCamera::default() }
}

/// A stretch of four images with nothing special about it.
fn small() -> (Window, Parameters, Vec<RateSample>) {
    let mut r = Random::new(5);
    let samples: Vec<RateSample> = (0..300)
        .map(|k| {
            let t = f64::from(k) * 0.005;
            RateSample { secs: t, rate: Vector3::new((3.0 * t).sin(), 0.8, (2.0 * t).cos()) }
        })
        .collect();
    let nodes = (0..4)
        .map(|k| Node {
            secs: 0.3 + 0.1 * f64::from(k),
            drift: r.normal3() * 1e-3,
            position: r.normal3() * 0.05,
        })
        .collect();
    let points = (0..6)
        .map(|k| Point {
            direction: Vector3::new(0.1 * f64::from(k) - 0.3, 0.2 - 0.07 * f64::from(k), 1.0).normalize(),
            inverse_distance: 0.5 + 0.2 * f64::from(k),
            observations: (0..4)
                .map(|node| NodeObservation {
                    node,
                    pixel: Vector2::new(300.0 + 20.0 * r.normal(), 240.0 + 20.0 * r.normal()),
                    row: 0.3 * r.normal(),
                })
                .collect(),
        })
        .collect();
    let parameters = Parameters {
        lens: LensModel::RadTan,
        focal: 420.0,
        k1: -0.1,
        k2: 0.03,
        centre: Vector2::new(310.0, 250.0),
        offset_secs: 0.02,
        readout_secs: 0.03,
        body_from_camera: So3::exp(&Vector3::new(0.1, -0.05, 0.07)),
        bias: Vector3::new(0.01, 0.02, -0.01),
        scale: Vector3::new(0.01, -0.01, 0.02),
    };
    (Window { nodes, points, reference: 2, shakes: None }, parameters, samples)
}

/// Both kinds of turns, and the stretch with the shakes of the second.
fn turned(turns: Turns) -> (Window, Parameters, Vec<RateSample>, Noise) {
    let (mut window, parameters, samples) = small();
    if turns.is_stabilised() {
        window.find_shakes(&parameters, &GyroPath::new(&samples, &parameters.bias, &parameters.scale));
    }
    (window, parameters, samples, Noise { pixel: 40.0, turns })
}

const TURNS: [Turns; 2] = [Turns::Gyroscope(1e-3), Turns::STABILISED];

#[test]
fn the_gradient_of_the_parameters_is_that_of_the_cost() {
    // A shift's axes turn with clock and mount, which is left out: of second order in the shift.
    for (turns, tolerance) in TURNS.into_iter().zip([2e-3, 5e-2]) {
        let (mut window, parameters, samples, noise) = turned(turns);
        let path = |p: &Parameters| GyroPath::new(&samples, &p.bias, &p.scale);
        let cost = |window: &Window, p: &Parameters| window.cost(p, &path(p), &noise);
        // At the optimum of everything else, the reduced gradient is the derivative of the cost by the parameters alone.
        for _ in 0..60 {
            let reduced = window.reduce(&parameters, &path(&parameters), &noise, 1e-9).unwrap();
            window.step(&reduced, &Tangent::zeros());
        }
        let reduced = window.reduce(&parameters, &path(&parameters), &noise, 0.0).unwrap();
        for p in 0..DIM {
            let mut step = Tangent::zeros();
            // Pixels, and numbers of order one.
            let h = if (3..5).contains(&p) { 1e-3 } else { 1e-6 };
            step[p] = h;
            let slope = (cost(&window, &parameters.plus(&step)) - cost(&window, &parameters.plus(&-step)))
                / (2.0 * h);
            let expected = -reduced.gradient[p];
            assert!(
                (slope - expected).abs() < tolerance * expected.abs().max(0.05),
                "{turns:?}, {p}: {slope} instead of {expected}"
            );
        }
    }
}

#[test]
fn steps_of_nodes_and_points_descend_to_the_optimum() {
    for turns in TURNS {
        let (mut window, parameters, samples, noise) = turned(turns);
        let path = GyroPath::new(&samples, &parameters.bias, &parameters.scale);
        let mut costs = Vec::new();
        for _ in 0..30 {
            let reduced = window.reduce(&parameters, &path, &noise, 1e-9).unwrap();
            costs.push(window.cost(&parameters, &path, &noise));
            window.step(&reduced, &Tangent::zeros());
        }
        let last = costs.len() - 1;
        assert!(
            costs[last] < costs[0] && (costs[last] - costs[last - 1]).abs() < 1e-6 * costs[last],
            "{turns:?}: {costs:?}"
        );
    }
}

#[test]
fn the_same_recording_gives_the_same_bits() {
    let log = log_of(&Handheld { secs: 6.0, ..Handheld::draw(3) });
    let [a, b] = [
        log.calibrate(640, 480, &KnownCamera::default()).unwrap(),
        log.calibrate(640, 480, &KnownCamera::default()).unwrap(),
    ];
    assert_eq!(a.focal_px.value.to_bits(), b.focal_px.value.to_bits());
    assert_eq!(a.time_offset_secs.sigma.to_bits(), b.time_offset_secs.sigma.to_bits());
}

#[test]
fn a_camera_at_rest_is_refused_or_not_observable() {
    let still = Handheld { turning: 1e-4, moving: 1e-4, ..Handheld::draw(4) };
    match log_of(&still).calibrate(640, 480, &KnownCamera::default()) {
        Err(failure) => assert_eq!(failure, CalibrationFailure::TooLittleRotation),
        Ok(found) => {
            assert!(!found.focal_px.is_observable && !found.time_offset_secs.is_observable, "{found:?}");
            assert!(!found.rotation_is_observable, "{found:?}");
        }
    }
}

/// How a camera is mounted cannot be seen where the body turns about one of its axes only, unless it is a camera of a known kind.
#[test]
fn turning_about_one_axis_calibrates_a_camera_that_is_mounted_as_usual() {
    let side = So3::from_axis_angle(&Vector3::y(), std::f64::consts::PI);
    let quarter = So3::from_axis_angle(&Vector3::z(), std::f64::consts::FRAC_PI_2);
    let askew = So3::exp(&Vector3::new(0.02, -0.015, 0.01));
    for seed in [2, 11] {
        let motion = Handheld { main_axis: (1, 0.0), secs: 8.0, turning: 0.5, ..Handheld::draw(seed) };
        let truth = Handheld { pixel_noise: 0.25, outliers: 0.02, ..motion };
        let log = log_of(&truth);
        let none = CalibrationFailure::TooLittleRotation;
        assert_eq!(log.calibrate(640, 480, &KnownCamera::default()).unwrap_err(), none, "{seed}");
        let found = log.calibrate(640, 480, &mounted(&(truth.body_from_camera * askew))).unwrap();
        let turn = (truth.body_from_camera.inverse() * found.body_from_camera).log();
        let off = |found: &Estimate, truth: f64| (found.value - truth).abs() / found.sigma;
        let sigmas = [
            off(&found.focal_px, truth.focal),
            off(&found.time_offset_secs, truth.offset_secs),
            (0..3).map(|a| turn[a].abs() / found.rotation_sigmas[a]).fold(0.0, f64::max),
        ];
        assert!(found.mount_is_assumed && turn.norm() < 0.06, "{seed}: turned by {}", turn.norm());
        assert!(sigmas.iter().all(|s| *s < 3.0), "{seed}: {sigmas:?}, {found:?}");
        // None of these two is told from the one that is turned by half a turn about the body's axis.
        for other in [quarter, quarter * side] {
            let usual = truth.body_from_camera * askew * other;
            match log.calibrate(640, 480, &mounted(&usual)) {
                Err(failure) => assert_eq!(failure, none, "{seed}"),
                Ok(found) => {
                    let turn = (truth.body_from_camera.inverse() * found.body_from_camera).angle_rad();
                    let half = (usual.inverse() * found.body_from_camera).angle_rad();
                    assert!(
                        turn < 0.06 || half < 0.06,
                        "{seed}: turned by {turn}, {half} from what is usual"
                    );
                }
            }
        }
    }
    // Which way it looks shows as soon as the body turns a little about the others.
    let motion = Handheld { main_axis: (1, 0.04), secs: 8.0, turning: 0.5, ..Handheld::draw(11) };
    let truth = Handheld { pixel_noise: 0.25, outliers: 0.02, ..motion };
    let usual = truth.body_from_camera * askew * quarter * side;
    let found = log_of(&truth).calibrate(640, 480, &mounted(&usual)).unwrap();
    let turn = (truth.body_from_camera.inverse() * found.body_from_camera).angle_rad();
    assert!(found.mount_is_assumed && turn < 0.06, "turned by {turn}");
}

/// A mount that was measured shows the clock of a body that turns about one axis, and one that is not the recording's is found out.
#[test]
fn a_given_mount_is_held_where_it_explains_the_tracks() {
    let given = |mount: &So3, truth: &Handheld| {
        let known = KnownCamera { mount: Some(mount), ..KnownCamera::default() };
        log_of(truth).calibrate(640, 480, &known).unwrap()
    };
    let turn = |found: &Calibration, truth: &Handheld| {
        (truth.body_from_camera.inverse() * found.body_from_camera).angle_rad()
    };
    let askew = So3::exp(&Vector3::new(0.01, -0.01, 0.005));
    let motion = Handheld { main_axis: (1, 0.0), secs: 8.0, turning: 0.5, ..Handheld::draw(2) };
    let truth = Handheld { pixel_noise: 0.25, outliers: 0.02, ..motion };
    let found = given(&(truth.body_from_camera * askew), &truth);
    let clock = found.time_offset_secs;
    assert!((clock.value - truth.offset_secs).abs() < 3.0 * clock.sigma && clock.sigma < 2e-3, "{clock:?}");
    assert!(found.mount_is_assumed && turn(&found, &truth) < 0.06, "turned by {}", turn(&found, &truth));

    let truth = Handheld { secs: 8.0, turning: 0.5, ..Handheld::draw(3) };
    let quarter = So3::from_axis_angle(&Vector3::z(), std::f64::consts::FRAC_PI_2);
    let found = given(&(truth.body_from_camera * quarter), &truth);
    assert!(!found.mount_is_assumed && turn(&found, &truth) < 0.03, "turned by {}", turn(&found, &truth));
}

/// What a given lens is turned into projects as it does.
#[test]
fn a_given_lens_projects_as_its_model() {
    use vidar_core::camera::{DoubleSphere, Equidistant, Pinhole, RadTan};
    let pinhole = Pinhole::new(410.0, 411.0, 315.0, 244.0, 640, 480).unwrap();
    let models = [
        CameraModel::Pinhole(pinhole),
        CameraModel::RadTan(RadTan::new(pinhole, [-0.2, 0.04, 3e-4, -2e-4]).unwrap()),
        CameraModel::Equidistant(Equidistant::new(pinhole, [0.03, -0.01, 0.004, -0.001]).unwrap()),
        CameraModel::DoubleSphere(DoubleSphere::new(pinhole, -0.2, 0.55).unwrap()),
    ];
    for model in models {
        let given = GivenLens::of(&model, 0.01).unwrap();
        assert_eq!(given.is_measured, !matches!(model, CameraModel::Pinhole(_)));
        for pixel in [Pixel::new(40.0, 30.0), Pixel::new(320.0, 240.0), Pixel::new(600.0, 100.0)] {
            let ray = model.unproject(&pixel).unwrap();
            let off = (given.camera.project(&ray).unwrap().pixel - pixel).norm();
            assert!(off < 0.6, "{model:?}: {off} px at {pixel}");
        }
    }
}

#[test]
fn nothing_and_nonsense_are_refused() {
    let empty = CalibrationLog::default();
    assert_eq!(
        empty.calibrate(640, 480, &KnownCamera::default()).unwrap_err(),
        CalibrationFailure::TooLittleData
    );
    let truth = Handheld { secs: 3.0, ..Handheld::draw(9) };
    let mut log = CalibrationLog::default();
    for sample in truth.record().samples {
        log.add_gyro(&ImuSample { gyro: AngularRate(Vector3::repeat(f64::NAN)), ..sample });
    }
    assert_eq!(
        log.calibrate(640, 480, &KnownCamera::default()).unwrap_err(),
        CalibrationFailure::TooLittleData
    );
}

#[test]
fn noise_is_found_under_a_hands_motion() {
    let mut r = Random::new(1);
    let samples: Vec<ImuSample> = (0..4000)
        .map(|k| {
            let t = f64::from(k) * 0.005;
            let gyro =
                Vector3::new((3.0 * t).sin(), (7.0 * t).cos(), 0.3) + r.normal3() * (5e-4 * 200_f64.sqrt());
            let accel = Vector3::new((9.0 * t).sin(), 0.0, 9.8) + r.normal3() * (4e-3 * 200_f64.sqrt());
            ImuSample {
                time: Timestamp::from_nanos((t * 1e9) as i64),
                gyro: AngularRate(gyro),
                accel: SpecificForce(accel),
            }
        })
        .collect();
    let found = sensor_noise(&samples).unwrap();
    assert!((found.gyro / 5e-4 - 1.0).abs() < 0.15, "{found:?}");
    assert!((found.accel / 4e-3 - 1.0).abs() < 0.15, "{found:?}");
    assert!(sensor_noise(&samples[..100]).is_none());
}

/// Smooth blobs, shifted.
fn texture(shift: Vector2<f64>) -> FrameImage {
    let value = |x: f64, y: f64| {
        let waves =
            [(0.21, 0.13, 0.4), (-0.17, 0.29, 1.1), (0.35, -0.08, 2.0), (0.07, 0.33, 0.7), (0.5, 0.41, 0.1)];
        let sum: f64 = waves.iter().map(|(a, b, c)| (a * x + b * y + c).sin()).sum();
        // Hard edges between light and dark give corners.
        128.0 + 70.0 * (2.0 * sum).tanh()
    };
    FrameImage::Gray8(Image::from_fn(320, 240, |x, y| {
        value(x as f64 - shift.x, y as f64 - shift.y).round() as u8
    }))
}

#[test]
fn features_are_followed_over_many_images_without_a_camera_model() {
    let mut tracker = FeatureTracker::new(320, 240);
    let motion = |k: f64| Vector2::new(2.3 * k, -1.1 * k + 0.02 * k * k);
    let mut first: Vec<(LandmarkId, Pixel)> = Vec::new();
    let (mut errors, mut kept) = (Vec::new(), 0);
    for k in 0..31 {
        let stamp = Timestamp::from_nanos(k * 33_000_000);
        let Some(features) = tracker.push(stamp, &texture(motion(k as f64))).unwrap() else { continue };
        kept += 1;
        if first.is_empty() {
            first = features;
            continue;
        }
        for (id, pixel) in &features {
            if let Some((_, began)) = first.iter().find(|(other, _)| other == id) {
                errors.push((pixel - began - motion(k as f64)).norm());
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    assert_eq!(kept, 11, "every third of 31 images");
    assert!(first.len() > 40, "{} corners", first.len());
    assert!(errors.len() > 200, "{} matches", errors.len());
    assert!(errors[errors.len() / 2] < 0.15, "median error {} px", errors[errors.len() / 2]);
    assert!(tracker.push(Timestamp::from_nanos(9), &FrameImage::Gray8(Image::filled(10, 10, 0))).is_err());
}
