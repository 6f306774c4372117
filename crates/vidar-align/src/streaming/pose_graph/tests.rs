use super::*;
use vidar_core::So3;

fn ring(n: usize) -> Vec<Sim3> {
    let step = std::f64::consts::TAU / n as f64;
    (0..n)
        .map(|k| {
            let scale = 1.0 + 0.02 * (k as f64).sin();
            Sim3::new(So3::from_axis_angle(&Vector3::z(), step), Vector3::new(1.0, 0.1, 0.0), scale).unwrap()
        })
        .collect()
}

#[test]
fn the_adjoint_carries_a_tangent_through_a_similarity() {
    let x = ring(7)[2] * ring(5)[1];
    let v = Tangent::from_column_slice(&[0.3, -0.1, 0.2, 0.05, 0.4, -0.2, 0.1]);
    let left = x * exp(&v) * x.inverse();
    assert!((log(&left) - adjoint(&x) * v).norm() < 1e-12);
}

#[test]
fn truncated_series_meet_the_derivative_for_small_motions() {
    // Log(Exp(v + d) Exp(v)⁻¹) ≈ Jl(v) d.
    let v = Tangent::from_column_slice(&[0.1, -0.2, 0.15, 0.1, 0.05, -0.12, 0.08]);
    for i in 0..7 {
        let mut d = Tangent::zeros();
        d[i] = 1e-6;
        let change = |d: &Tangent| log(&(exp(&(v + d)) * exp(&v).inverse()));
        let numeric = (change(&d) - change(&-d)) / 2e-6;
        assert!((numeric - left_jacobian(&v).column(i)).norm() < 1e-6, "{i}");
    }
    assert!((left_jacobian(&v) * left_jacobian_inverse(&v) - Matrix7::identity()).norm() < 1e-5);
}

#[test]
fn a_loop_that_agrees_changes_nothing_and_one_that_does_not_is_shared_out() {
    let chain = ring(12);
    let sum = super::super::accumulate(&chain);
    let closed = LoopConstraint { a: 12, b: 0, b_from_a: sum[11] };
    let outcome = optimise_chain(&chain, &[closed], &PoseGraphConfig::default()).unwrap();
    for (a, b) in outcome.previous_from_next.iter().zip(&chain) {
        assert!((a.inverse() * *b).log().norm() < 1e-9);
    }
    let shifted = Sim3 { translation: sum[11].translation + Vector3::new(0.0, 0.0, 0.5), ..sum[11] };
    let constraint = LoopConstraint { b_from_a: shifted, ..closed };
    let outcome = optimise_chain(&chain, &[constraint], &PoseGraphConfig::default()).unwrap();
    let end = super::super::accumulate(&outcome.previous_from_next)[11];
    assert!((end.translation - shifted.translation).norm() < 0.1, "{end:?}");
    let last = outcome.steps.iter().rfind(|s| s.is_accepted).unwrap();
    assert!(last.cost_after < 0.2 * outcome.steps[0].cost_before);
}

#[test]
fn a_loop_to_nowhere_is_refused() {
    let chain = ring(4);
    for (a, b) in [(5, 0), (2, 2)] {
        let constraint = LoopConstraint { a, b, b_from_a: Sim3::IDENTITY };
        let error = optimise_chain(&chain, &[constraint], &PoseGraphConfig::default()).unwrap_err();
        assert!(matches!(error, StreamingError::BadLoop { .. }));
    }
}
