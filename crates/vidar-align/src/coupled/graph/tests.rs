use super::*;
use crate::coupled::{Attachment, RelativeChunk};
use nalgebra::{Matrix6, SMatrix, SVector, UnitVector3, Vector3};
use vidar_core::So3;

fn circle(n: usize) -> Vec<Se3> {
    (0..n)
        .map(|i| {
            let a = std::f64::consts::TAU * i as f64 / n as f64;
            let rotation = So3::from_axis_angle(&Vector3::z(), a);
            Se3 { rotation, translation: Vector3::new(3.0 * a.cos(), 3.0 * a.sin(), 0.2 * (3.0 * a).sin()) }
        })
        .collect()
}

fn odometry(poses: &[Se3]) -> Vec<Factor> {
    let link = |i: usize| Factor::Odometry {
        i,
        j: i + 1,
        i_from_j: poses[i].inverse() * poses[i + 1],
        whitening: Box::new(Matrix6::identity() * 100.0),
    };
    (0..poses.len() - 1).map(link).collect()
}

fn gauge_prior(pose: &Se3) -> Factor {
    Factor::GaugePrior { i: 0, world_from_camera: *pose, position_std_m: 1e-3, heading_std_rad: 1e-3 }
}

fn attach(poses: &[Se3], k: usize, gauge: &Sim3) -> Vec<Factor> {
    let seen = |i: usize| {
        Factor::Attachment(Attachment {
            i,
            k,
            chunk_from_camera: gauge.inverse().transform_pose(&poses[i]),
            rotation_std_rad: 0.01,
            position_std_m: 0.02,
            kernel: Kernel::Cauchy { k: 3.0 },
            moves_keyframe: true,
        })
    };
    (0..poses.len()).map(seen).collect()
}

fn gauge() -> Sim3 {
    Sim3::new(So3::from_axis_angle(&Vector3::new(1.0, 2.0, 0.5), 1.2), Vector3::new(4.0, -1.0, 2.0), 0.4)
        .unwrap()
}

#[test]
fn a_chunk_finds_its_gauge_and_keyframes_stay_when_all_agree() {
    let truth = circle(12);
    let mut factors = odometry(&truth);
    factors.push(gauge_prior(&truth[0]));
    // Without gravity the whole would be free to tilt about the first keyframe.
    factors.extend(truth.iter().enumerate().map(|(i, pose)| Factor::Gravity {
        i,
        up_in_camera: UnitVector3::new_normalize(pose.rotation.inverse().act(&Vector3::z())),
        std_rad: 0.01,
    }));
    factors.extend(attach(&truth, 0, &gauge()));
    let off = SVector::<f64, 7>::from_column_slice(&[0.1, -0.1, 0.05, 0.2, 0.1, -0.3, 0.1]);
    let start = CoupledState { keyframes: truth.clone(), chunks: vec![gauge() * Sim3::exp(&off)] };
    let solved =
        solve(&start, &factors, &CoupledConfig { max_iterations: 60, ..Default::default() }).unwrap();
    assert_eq!(solved.flow, InformationFlow::Coupled);
    assert!(solved.state.chunks[0].minus(&gauge()).norm() < 1e-6, "{:?}", solved.state.chunks[0]);
    for (a, b) in solved.state.keyframes.iter().zip(&truth) {
        assert!(a.minus(b).norm() < 1e-6);
    }
}

#[test]
fn a_false_loop_is_let_go_and_a_true_one_is_kept() {
    let truth = circle(24);
    let gauges = [gauge(), gauge() * Sim3::exp(&SVector::<f64, 7>::repeat(0.1))];
    let mut factors = odometry(&truth);
    factors.push(gauge_prior(&truth[0]));
    factors.extend(attach(&truth[..12], 0, &gauges[0]));
    factors.extend(attach(&truth[12..], 1, &gauges[1]).into_iter().map(|f| match f {
        Factor::Attachment(a) => Factor::Attachment(Attachment { i: a.i + 12, ..a }),
        other => other,
    }));
    let link = |l_from_k| {
        let (r, t) = (0.01, 0.05 / gauges[1].scale);
        let variances = [r, r, r, t, t, t, 0.02].map(|s| s * s);
        let covariance = SMatrix::from_diagonal(&SVector::from(variances));
        let kernel = Kernel::GemanMcClure { k: 4.0 };
        Factor::Relative(RelativeChunk::from_covariance(1, 0, l_from_k, &covariance, kernel).unwrap())
    };
    let right = gauges[0].inverse() * gauges[1];
    let wrong =
        right * Sim3::exp(&SVector::<f64, 7>::from_column_slice(&[0.5, 0.2, 0.0, 2.0, -1.0, 0.5, 0.2]));
    factors.extend([link(right), link(wrong)]);
    let start = CoupledState { keyframes: truth.clone(), chunks: gauges.to_vec() };
    let solved = solve(&start, &factors, &CoupledConfig::default()).unwrap();
    let [.., kept, let_go] = solved.weights[..] else { panic!() };
    assert!(kept > 0.9 && let_go < 0.01, "{kept} {let_go}");
    for (a, b) in solved.state.keyframes.iter().zip(&truth) {
        assert!((a.translation - b.translation).norm() < 0.02);
    }
}

#[test]
fn a_model_that_contradicts_the_odometry_does_not_bend_it() {
    let truth = circle(12);
    // The model says that the path is three times as curved, with great confidence.
    let bent: Vec<Se3> = (0..12)
        .map(|i| {
            let a = 0.9 * i as f64;
            Se3 {
                rotation: So3::from_axis_angle(&Vector3::z(), a),
                translation: Vector3::new(a.cos(), a.sin(), 0.0),
            }
        })
        .collect();
    let mut factors = odometry(&truth);
    factors.push(gauge_prior(&truth[0]));
    factors.extend(attach(&bent, 0, &Sim3::IDENTITY).into_iter().map(|f| match f {
        Factor::Attachment(a) => Factor::Attachment(Attachment {
            rotation_std_rad: 1e-3,
            position_std_m: 1e-3,
            kernel: Kernel::Quadratic,
            ..a
        }),
        other => other,
    }));
    let start = CoupledState { keyframes: truth.clone(), chunks: vec![Sim3::IDENTITY] };
    let solved = solve(&start, &factors, &CoupledConfig::default()).unwrap();
    assert_eq!(solved.flow, InformationFlow::OneWay);
    assert!(solved.odometry_chi2 > 2.0);
    for (a, b) in solved.state.keyframes.iter().zip(&truth) {
        assert!(a.minus(b).norm() < 1e-6);
    }
}

#[test]
fn factors_that_point_nowhere_or_are_not_finite_are_named() {
    let truth = circle(3);
    let start = CoupledState { keyframes: truth.clone(), chunks: vec![Sim3::IDENTITY] };
    let lost = Factor::Scale { k: 4, log_scale: 0.0, std: 1.0, kernel: Kernel::Quadratic };
    let error = solve(&start, &[lost], &CoupledConfig::default()).unwrap_err();
    assert_eq!(error.to_string(), "factor 0 touches chunk 4, there are 1");
    let broken = Factor::Scale { k: 0, log_scale: f64::NAN, std: 1.0, kernel: Kernel::Quadratic };
    let error = solve(&start, &[gauge_prior(&truth[0]), broken], &CoupledConfig::default()).unwrap_err();
    assert_eq!(error, GraphError::NotFinite { factor: 1 });
}
