use super::*;
use nalgebra::Vector6;

fn keyframes() -> Vec<Se3> {
    let make =
        |axis: Vector3<f64>, angle, t| Se3 { rotation: So3::from_axis_angle(&axis, angle), translation: t };
    vec![
        make(Vector3::new(0.2, 1.0, -0.4), 0.7, Vector3::new(1.0, 2.0, -0.5)),
        make(Vector3::new(-0.6, 0.3, 0.8), 1.1, Vector3::new(1.4, 1.7, -0.2)),
    ]
}

fn chunks() -> Vec<Sim3> {
    let make = |axis: Vector3<f64>, angle, t, s| Sim3::new(So3::from_axis_angle(&axis, angle), t, s).unwrap();
    vec![
        make(Vector3::new(0.9, 0.1, 0.3), 2.1, Vector3::new(-3.0, 0.2, 1.0), 0.6),
        make(Vector3::new(0.1, -0.7, 0.3), 1.3, Vector3::new(2.0, 1.2, -1.0), 1.9),
    ]
}

fn factors() -> Vec<Factor> {
    let (t, x) = (keyframes(), chunks());
    let near = Se3::exp(&Vector6::new(0.1, -0.2, 0.05, 0.03, 0.2, -0.1));
    let close = Sim3::exp(&SVector::<f64, 7>::from_column_slice(&[0.1, 0.05, -0.2, 0.3, -0.1, 0.2, 0.15]));
    let whitening = Matrix6::from_fn(|r, c| if r == c { 3.0 + r as f64 } else { 0.1 * (r + 2 * c) as f64 });
    let seen = x[1].inverse().transform_pose(&(t[0] * near));
    let attachment = Attachment {
        i: 0,
        k: 1,
        chunk_from_camera: seen,
        rotation_std_rad: 0.1,
        position_std_m: 0.2,
        kernel: Kernel::Cauchy { k: 3.0 },
        moves_keyframe: true,
    };
    vec![
        Factor::Odometry {
            i: 0,
            j: 1,
            i_from_j: t[0].inverse() * t[1] * near,
            whitening: Box::new(whitening),
        },
        Factor::Gravity {
            i: 1,
            up_in_camera: UnitVector3::new_normalize(Vector3::new(0.3, -0.8, 0.2)),
            std_rad: 0.01,
        },
        Factor::Attachment(attachment),
        Factor::Relative(RelativeChunk {
            k: 0,
            l: 1,
            l_from_k: x[1].inverse() * x[0] * close,
            whitening: Box::new(SMatrix::from_diagonal(&[50.0, 50.0, 50.0, 20.0, 20.0, 20.0, 100.0].into())),
            kernel: Kernel::GemanMcClure { k: 4.0 },
        }),
        Factor::Scale { k: 1, log_scale: 0.4, std: 0.02, kernel: Kernel::Quadratic },
        Factor::ScaleWalk { k: 1, l: 0, log_ratio: 0.8, std: 0.02 },
        Factor::GaugePrior {
            i: 0,
            world_from_camera: t[0] * near,
            position_std_m: 1e-2,
            heading_std_rad: 1e-2,
        },
    ]
}

#[test]
fn every_jacobian_is_the_derivative_of_its_residual() {
    for factor in factors() {
        let linear = factor.linearise(&keyframes(), &chunks()).unwrap();
        assert!(!linear.residual.is_empty());
        for (variable, jacobian) in &linear.jacobians {
            for column in 0..jacobian.ncols() {
                let step = 1e-6;
                let moved = |sign: f64| {
                    let (mut t, mut x) = (keyframes(), chunks());
                    match *variable {
                        Variable::Keyframe(i) => {
                            let mut d = Vector6::zeros();
                            d[column] = sign * step;
                            t[i] = t[i].plus(&d);
                        }
                        Variable::Chunk(k) => {
                            let mut d = SVector::<f64, 7>::zeros();
                            d[column] = sign * step;
                            x[k] = x[k].plus(&d);
                        }
                    }
                    nalgebra::DVector::from_vec(factor.linearise(&t, &x).unwrap().residual)
                };
                let numeric = (moved(1.0) - moved(-1.0)) / (2.0 * step);
                let error = (&numeric - jacobian.column(column)).amax();
                assert!(error < 1e-6 * (1.0 + numeric.amax()), "{factor:?} {variable:?} {column}: {error:e}");
            }
        }
    }
}

#[test]
fn what_agrees_leaves_no_residual() {
    let (t, x) = (keyframes(), chunks());
    let seen = x[1].inverse().transform_pose(&t[0]);
    let exact = [
        Factor::Attachment(Attachment {
            i: 0,
            k: 1,
            chunk_from_camera: seen,
            rotation_std_rad: 1.0,
            position_std_m: 1.0,
            kernel: Kernel::Quadratic,
            moves_keyframe: false,
        }),
        Factor::Gravity {
            i: 0,
            up_in_camera: UnitVector3::new_normalize(t[0].rotation.inverse().act(&Vector3::z())),
            std_rad: 1.0,
        },
        Factor::Scale { k: 0, log_scale: 0.6_f64.ln(), std: 1.0, kernel: Kernel::Quadratic },
    ];
    for factor in exact {
        let linear = factor.linearise(&t, &x).unwrap();
        assert!(linear.residual.iter().all(|r| r.abs() < 1e-12), "{factor:?}");
    }
}
