//! One suite of laws, run as properties over SO(3), SE(3) and Sim(3).
//!
//! Angles reach from 0 through 1e-12, 1e-8, 1e-4 to π, translations to 1e3, scales from 1e-3 to 1e3. Tolerances are
//! forward error bounds: a few hundred roundings of the largest number that the computation passes through.

use nalgebra::{Matrix4, SMatrix, SVector, Vector3};
use proptest::prelude::*;
use std::f64::consts::PI;
use vidar_core::testing::{check_jacobian, largest_entry};
use vidar_core::{LieGroup, Se3, Sim3, So3};

const ROUNDINGS: f64 = 1e-13;

/// Above this angle a rounding of the last digit may flip the axis, so that logs are compared through `exp` only.
const NEAR_PI: f64 = PI - 1e-6;

fn probes() -> [Vector3<f64>; 4] {
    [Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::z()]
}

/// Bound on `|x · p|` for `|p| = radius`, and how far roundings inside `x` can move it.
fn reach<const N: usize, G: LieGroup<N>>(x: &G, radius: f64) -> f64 {
    let origin = x.act(&Vector3::zeros());
    origin.norm() + (x.act(&Vector3::x()) - origin).norm() * radius
}

/// Two transforms are one when they map the origin and the unit vectors alike.
fn same<const N: usize, G: LieGroup<N>>(a: &G, b: &G, size: f64, law: &str) -> Result<(), TestCaseError> {
    for p in probes() {
        let error = (a.act(&p) - b.act(&p)).norm();
        prop_assert!(error <= ROUNDINGS * size, "{law}: {error:.2e} at size {size:.2e}\n{a:?}\n{b:?}");
    }
    Ok(())
}

fn close<const R: usize, const C: usize>(
    a: &SMatrix<f64, R, C>,
    b: &SMatrix<f64, R, C>,
    size: f64,
    law: &str,
) -> Result<(), TestCaseError> {
    let error = largest_entry(&(a - b));
    prop_assert!(error <= ROUNDINGS * size, "{law}: {error:.2e} at size {size:.2e}\n{a}{b}");
    Ok(())
}

fn angle_of<const N: usize>(tangent: &SVector<f64, N>) -> f64 {
    tangent.fixed_rows::<3>(0).norm()
}

/// The generator of a one-parameter group of affine maps, as a 4×4 matrix.
fn generator<const N: usize>(tangent: &SVector<f64, N>) -> Matrix4<f64> {
    let at = |i: usize| if i < N { tangent[i] } else { 0.0 };
    let s = at(6);
    Matrix4::new(
        s,
        -at(2),
        at(1),
        at(3), //
        at(2),
        s,
        -at(0),
        at(4), //
        -at(1),
        at(0),
        s,
        at(5), //
        0.0,
        0.0,
        0.0,
        0.0,
    )
}

fn group_axioms<const N: usize, G: LieGroup<N>>(a: &G, b: &G, c: &G) -> Result<(), TestCaseError> {
    let identity = G::identity();
    same(&a.compose(&identity), a, reach(a, 1.0), "right identity")?;
    same(&identity.compose(a), a, reach(a, 1.0), "left identity")?;
    let there_and_back = reach(a, reach(&a.inverse(), 1.0));
    same(&a.compose(&a.inverse()), &identity, there_and_back, "right inverse")?;
    let back_and_there = reach(&a.inverse(), reach(a, 1.0));
    same(&a.inverse().compose(a), &identity, back_and_there, "left inverse")?;
    let chain = reach(a, reach(b, reach(c, 1.0)));
    same(&a.compose(b).compose(c), &a.compose(&b.compose(c)), chain, "associativity")?;
    for p in probes() {
        let error = (a.compose(b).act(&p) - a.act(&b.act(&p))).norm();
        prop_assert!(error <= ROUNDINGS * reach(a, reach(b, 1.0)), "action of a product: {error:.2e}");
    }
    Ok(())
}

fn exponential_laws<const N: usize, G: LieGroup<N>>(tangent: &SVector<f64, N>) -> Result<(), TestCaseError> {
    let x = G::exp(tangent);
    let size = reach(&x, 1.0) + reach(&x.inverse(), 1.0) + tangent.norm();
    // An independent exponential: Padé of the 4×4 generator.
    let reference = generator(tangent).exp();
    for p in probes() {
        let expected = (reference * p.push(1.0)).xyz();
        let error = (x.act(&p) - expected).norm();
        prop_assert!(error <= 1e-12 * size, "matrix exponential: {error:.2e} at size {size:.2e}");
    }
    same(&G::exp(&x.log()), &x, size, "exp of log")?;
    let log = x.log();
    prop_assert!(angle_of(&log) <= PI + 1e-15, "log leaves [0, pi]: {}", angle_of(&log));
    if angle_of(tangent) < NEAR_PI {
        close(&log, tangent, size, "log of exp")?;
    }
    same(&G::exp(&-tangent), &x.inverse(), size, "exp of the negative")?;
    let (part, rest) = (G::exp(&(tangent * 0.3)), G::exp(&(tangent * 0.7)));
    let through = reach(&part, reach(&rest, 1.0)) + size;
    same(&part.compose(&rest), &x, through, "one-parameter subgroup")?;
    same(&G::exp(&SVector::zeros()), &G::identity(), 1.0, "exp of zero")
}

fn adjoint_laws<const N: usize, G: LieGroup<N>>(
    a: &G,
    b: &G,
    delta: &SVector<f64, N>,
) -> Result<(), TestCaseError> {
    let left = a.compose(&G::exp(delta));
    let moved = G::exp(&(a.adjoint() * delta));
    let size = reach(&moved, reach(a, 1.0)) + reach(&left, 1.0) + (a.adjoint() * delta).norm();
    same(&left, &moved.compose(a), size, "x exp(d) = exp(Ad d) x")?;
    let product = a.adjoint() * b.adjoint();
    let size = a.adjoint().amax() * b.adjoint().amax() * 10.0;
    close(&a.compose(b).adjoint(), &product, size, "Ad(ab) = Ad(a) Ad(b)")?;
    let size = a.adjoint().amax() * a.inverse().adjoint().amax() * 10.0;
    let unit = a.adjoint() * a.inverse().adjoint();
    close(&unit, &SMatrix::identity(), size, "Ad(x) Ad(x^-1) = I")
}

fn jacobian_laws<const N: usize, G: LieGroup<N>>(tangent: &SVector<f64, N>) -> Result<(), TestCaseError> {
    let x = G::exp(tangent);
    let zero = SVector::<f64, N>::zeros();
    let (left, right) = (G::left_jacobian(tangent), G::right_jacobian(tangent));
    let fail = TestCaseError::fail;
    check_jacobian("Jl", &left, |d| G::exp(&(tangent + d)).compose(&x.inverse()).log(), &zero, 1e-8)
        .map_err(fail)?;
    check_jacobian("Jr", &right, |d| x.inverse().compose(&G::exp(&(tangent + d))).log(), &zero, 1e-8)
        .map_err(fail)?;
    let size = 10.0 * (x.adjoint().amax() * right.amax()).max(left.amax());
    close(&left, &(x.adjoint() * right), size, "Jl = Ad Jr")?;
    let inverse = G::right_jacobian_inverse(tangent).ok_or_else(|| fail("no inverse below 2 pi".into()))?;
    let size = 10.0 * right.amax() * inverse.amax();
    close(&(right * inverse), &SMatrix::identity(), size, "Jr Jr^-1 = I")?;
    if angle_of(tangent) < PI - 1e-2 {
        check_jacobian("Jr^-1", &inverse, |d| x.plus(d).log(), &zero, 1e-8).map_err(fail)?;
    }
    Ok(())
}

fn action_derivative<const N: usize, G: LieGroup<N>>(
    x: &G,
    point: &Vector3<f64>,
) -> Result<(), TestCaseError> {
    let analytic = x.d_act_d_perturbation(point);
    check_jacobian("d_act", &analytic, |d| x.plus(d).act(point), &SVector::zeros(), 1e-8)
        .map_err(TestCaseError::fail)
}

fn difference_laws<const N: usize, G: LieGroup<N>>(
    a: &G,
    b: &G,
    delta: &SVector<f64, N>,
) -> Result<(), TestCaseError> {
    let between = a.inverse().compose(b);
    let size = reach(a, reach(&a.inverse(), reach(b, 1.0))) + reach(a, reach(&between, 1.0)) + reach(a, 1.0);
    same(&a.plus(&b.minus(a)), b, size, "a + (b - a) = b")?;
    same(&a.interpolate(b, 0.0), a, size, "interpolation starts at a")?;
    same(&a.interpolate(b, 1.0), b, size, "interpolation ends at b")?;
    close(&a.minus(a), &SVector::zeros(), reach(&a.inverse(), reach(a, 1.0)), "a - a = 0")?;
    if angle_of(delta) < NEAR_PI {
        let step = G::exp(delta);
        let size = reach(&a.inverse(), reach(a, reach(&step, 1.0))) + reach(&step.inverse(), 1.0);
        close(&a.plus(delta).minus(a), delta, size + delta.norm(), "(a + d) - a = d")?;
    }
    // The midpoint is equally far from both ends, when the geodesic is unique.
    if angle_of(&b.minus(a)) < NEAR_PI {
        let midpoint = a.interpolate(b, 0.5);
        let size = reach(&midpoint.inverse(), size) + reach(&b.inverse(), size);
        close(&midpoint.minus(a), &b.minus(&midpoint), size, "the midpoint is equally far from both ends")?;
    }
    Ok(())
}

/// A length between 0 and π with difficult values drawn often.
fn angle() -> impl Strategy<Value = f64> {
    prop_oneof![
        3 => prop::sample::select(vec![0.0, 1e-12, 1e-8, 1e-4, 0.3, 1.0, PI - 1e-4, PI - 1e-9, PI]),
        1 => (-14.0..0.0_f64).prop_map(|x| 10f64.powf(x)),
        2 => 0.0..PI,
    ]
}

fn direction() -> impl Strategy<Value = Vector3<f64>> {
    let component = -1.0..1.0_f64;
    prop_oneof![
        1 => prop::sample::select(vec![Vector3::x(), Vector3::y(), -Vector3::z()]),
        4 => (component.clone(), component.clone(), component)
            .prop_filter_map("too short", |(x, y, z)| Vector3::new(x, y, z).try_normalize(0.1)),
    ]
}

/// Tangents of any group: rotation, then translation to 1e3, then the logarithm of a scale in 1e-3…1e3.
fn tangent<const N: usize>() -> impl Strategy<Value = SVector<f64, N>> {
    let length = prop_oneof![Just(0.0), Just(1e-6), 0.0..3.0, 0.0..1e3];
    let log_scale = prop_oneof![Just(0.0), Just(1e-9), Just(-1e-5), -0.5..0.5, -6.907..6.907];
    (direction(), angle(), direction(), length, log_scale).prop_map(
        |(axis, angle, way, length, log_scale)| {
            let (w, r) = (axis * angle, way * length);
            let all = [w.x, w.y, w.z, r.x, r.y, r.z, log_scale];
            SVector::from_fn(|i, _| all[i])
        },
    )
}

/// A tangent of length at most one.
fn small<const N: usize>() -> impl Strategy<Value = SVector<f64, N>> {
    prop::collection::vec(-0.35..0.35, N).prop_map(|v| SVector::from_column_slice(&v))
}

fn point() -> impl Strategy<Value = Vector3<f64>> {
    (direction(), prop_oneof![Just(0.0), 0.0..3.0, 0.0..1e3]).prop_map(|(way, length)| way * length)
}

macro_rules! law_suite {
    ($name:ident, $group:ty, $dof:literal) => {
        mod $name {
            use super::*;
            type G = $group;

            proptest! {
                #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..Default::default() })]

                #[test]
                fn is_a_group_that_acts(a in tangent::<$dof>(), b in tangent::<$dof>(), c in tangent::<$dof>()) {
                    group_axioms::<$dof, G>(&G::exp(&a), &G::exp(&b), &G::exp(&c))?;
                }

                #[test]
                fn exp_and_log_undo_each_other_and_match_the_matrix_exponential(t in tangent::<$dof>()) {
                    exponential_laws::<$dof, G>(&t)?;
                }

                #[test]
                fn adjoint_moves_a_perturbation_across(
                    a in tangent::<$dof>(), b in tangent::<$dof>(), delta in small::<$dof>(),
                ) {
                    adjoint_laws::<$dof, G>(&G::exp(&a), &G::exp(&b), &delta)?;
                }

                #[test]
                fn jacobians_agree_with_differences_and_each_other(t in tangent::<$dof>()) {
                    jacobian_laws::<$dof, G>(&t)?;
                }

                #[test]
                fn derivative_of_the_action_agrees_with_differences(t in tangent::<$dof>(), p in point()) {
                    action_derivative::<$dof, G>(&G::exp(&t), &p)?;
                }

                #[test]
                fn plus_minus_and_interpolation_agree(
                    a in tangent::<$dof>(), b in tangent::<$dof>(), delta in tangent::<$dof>(),
                ) {
                    difference_laws::<$dof, G>(&G::exp(&a), &G::exp(&b), &delta)?;
                }
            }

            #[test]
            fn inverse_jacobian_is_none_at_a_full_turn() {
                let mut t = SVector::<f64, $dof>::zeros();
                t[0] = 2.0 * PI;
                assert!(G::right_jacobian_inverse(&t).is_none());
            }

            #[test]
            fn not_a_number_passes_through_without_panic() {
                let t = SVector::<f64, $dof>::repeat(f64::NAN);
                let x = G::exp(&t);
                assert!(!x.is_finite());
                assert!(x.log().iter().any(|v| v.is_nan()));
                assert!(G::left_jacobian(&t).iter().any(|v| v.is_nan()));
            }
        }
    };
}

law_suite!(so3, So3, 3);
law_suite!(se3, Se3, 6);
law_suite!(sim3, Sim3, 7);
