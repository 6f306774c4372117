//! A focal length that changes while filming: autofocus moves the lens, and the picture grows or shrinks by up to 2 % ("focus breathing").
//!
//! With one focal length for all images, each change looks like a motion along the optical axis, which the IMU contradicts only weakly:
//! rendered phones whose focal length changed by 1 % every few seconds had their scale 5 % off at a stated 1.1 %. Where the recording shows
//! it, every image has its own, `f exp(z)`, and `z` walks at random.

use super::problem::{FRAME_DIM, FocusPrior, Problem};
use super::system::{LandmarkBlock, System};
use crate::backend::product;
use nalgebra::{Matrix3, Vector3};

/// How long a lens keeps its place, s: autofocus moves every few seconds.
const CORRELATED_SECS: f64 = 5.0;

/// How the prior ties the focal length of a state to that of the one before: `z = share · before`, with a weight. The first one is tied to zero.
#[derive(Clone, Copy)]
struct Tie {
    share: f64,
    weight: f64,
}

fn ties(problem: &Problem, prior: FocusPrior) -> impl Iterator<Item = Tie> {
    let variance = prior.sigma * prior.sigma;
    let of = move |k: usize| {
        let before = k.checked_sub(1).map(|before| problem.frames[before].time);
        let share = before
            .map_or(0.0, |before| (-(problem.frames[k].time - before).as_secs_f64() / CORRELATED_SECS).exp());
        Tie { share, weight: 1.0 / (variance * (1.0 - share * share)) }
    };
    (0..problem.frames.len()).map(of)
}

/// `ln` of the determinant of the prior's information.
pub(super) fn log_det(problem: &Problem, prior: FocusPrior) -> f64 {
    ties(problem, prior).map(|tie| tie.weight.ln()).sum()
}

/// What a state's focal length departs from its tie by.
fn departure(problem: &Problem, k: usize, tie: Tie) -> f64 {
    let before = k.checked_sub(1).map_or(0.0, |before| problem.frames[before].body.log_focal);
    problem.frames[k].body.log_focal - tie.share * before
}

/// Cost of the prior.
pub(super) fn cost(problem: &Problem) -> f64 {
    let Some(prior) = problem.prior.focus else { return 0.0 };
    let one = |(k, tie): (usize, Tie)| 0.5 * tie.weight * departure(problem, k, tie).powi(2);
    ties(problem, prior).enumerate().map(one).sum()
}

/// Adds the prior to the normal equations.
pub(super) fn add_prior(problem: &Problem, system: &mut System) {
    let Some(prior) = problem.prior.focus else { return };
    for (k, tie) in ties(problem, prior).enumerate() {
        let row = problem.offset(k) + FRAME_DIM;
        let slope = tie.weight * departure(problem, k, tie);
        system.gradient[row] += slope;
        system.h.add(row, row, tie.weight);
        if k > 0 {
            let before = problem.offset(k - 1) + FRAME_DIM;
            system.gradient[before] -= tie.share * slope;
            system.h.add(before, before, tie.share * tie.share * tie.weight);
            system.h.add(row, before, -tie.share * tie.weight);
        }
    }
}

/// The focal lengths' part of taking a landmark out of the normal equations (Schur complement).
pub(super) fn eliminate(
    problem: &Problem,
    block: &LandmarkBlock,
    inverse: &Matrix3<f64>,
    own_step: &Vector3<f64>,
    system: &mut System,
) {
    let seen = |at: usize| {
        let (frame, by_state) = &block.by_state[at];
        (*frame, problem.offset(*frame), by_state, block.by_focal[at])
    };
    for at in 0..block.by_focal.len() {
        let (frame, from, by_state, by_focal) = seen(at);
        let row = from + FRAME_DIM;
        let weighted = inverse * by_focal;
        let weighted_state = product(by_state, inverse);
        system.gradient[row] -= by_focal.dot(own_step);
        for (other_frame, other_from, other_state, other_focal) in (0..=at).map(seen) {
            let with_state = other_state * weighted;
            for (sum, value) in
                system.h.part_mut(row, other_from, with_state.len()).iter_mut().zip(&with_state)
            {
                *sum -= value;
            }
            system.h.add(row, other_from + FRAME_DIM, -weighted.dot(&other_focal));
            if other_frame != frame {
                let with_focal = weighted_state * other_focal;
                for (k, value) in with_focal.iter().enumerate() {
                    system.h.add(from + k, other_from + FRAME_DIM, -value);
                }
            }
        }
        for (k, by_calibration) in block.by_calibration.iter().enumerate() {
            system.h.add(problem.calibration_offset() + k, row, -weighted.dot(by_calibration));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::observation::{self, tests::example};
    use super::super::problem::{CalibrationPrior, FrameState, ObservedLandmark, WhitenedObservation};
    use super::*;
    use crate::bundle_adjustment::linearise::{cost, linearise};
    use crate::imu::Vector15;
    use nalgebra::{DMatrix, Matrix2};
    use vidar_core::Timestamp;

    /// Three states that see four landmarks where they are, with the clock among the unknowns.
    fn problem() -> Problem {
        let (body, landmark, calibration, measured) = example();
        let mut frames = Vec::new();
        for frame in 0..3 {
            let mut body = body;
            body.state.world_from_body.translation += Vector3::new(0.2, 0.05, -0.1) * f64::from(frame);
            body.log_focal = 0.0;
            let time = Timestamp::from_nanos(i64::from(frame) * 200_000_000);
            frames.push(FrameState { time, body, inertial: None });
        }
        let landmarks = (0..4).map(|k| {
            let aside = Vector3::new(0.02 * f64::from(k), -0.03 * f64::from(k), 0.05);
            let landmark = landmark.plus(&aside);
            let seen = |(frame, state): (usize, &FrameState)| {
                let mut pixel = measured;
                // The row decides on the instant, which decides on the row.
                for _ in 0..20 {
                    pixel = observation::project(&state.body, &landmark, &calibration, &pixel).unwrap();
                }
                WhitenedObservation { frame, pixel, whitening: Matrix2::identity() * 0.1 }
            };
            ObservedLandmark { landmark, observations: frames.iter().enumerate().map(seen).collect() }
        });
        let landmarks = landmarks.collect();
        let mut sigmas = vec![0.0; calibration.dim()];
        sigmas[0] = 0.01;
        let prior =
            CalibrationPrior { sigmas, mean: calibration.clone(), focus: Some(FocusPrior::AUTOFOCUS) };
        let gauge = (0, frames[0].body.state);
        Problem { frames, landmarks, calibration, prior, active: vec![0], gauge }
    }

    /// Moves one unknown: states with focal lengths, clock, landmarks.
    fn moved(problem: &mut Problem, unknown: usize, by: f64) {
        let (dim, reduced) = (problem.frame_dim(), problem.dim());
        if unknown < problem.calibration_offset() {
            let body = &mut problem.frames[unknown / dim].body;
            match unknown % dim {
                FRAME_DIM => body.log_focal += by,
                k => {
                    let mut delta = Vector15::zeros();
                    delta[k] = by;
                    body.state = body.state.plus(&delta);
                }
            }
        } else if unknown < reduced {
            problem.calibration.clock_secs += by;
        } else {
            let at = &mut problem.landmarks[(unknown - reduced) / 3];
            at.landmark = at.landmark.plus(&Vector3::ith((unknown - reduced) % 3, by));
        }
    }

    /// Where every observation fits, the normal equations are the second derivatives of the cost; the landmarks are eliminated from both.
    #[test]
    fn normal_equations_are_the_second_derivatives_of_the_cost() {
        let problem = problem();
        let (reduced, all) = (problem.dim(), problem.dim() + 3 * problem.landmarks.len());
        // Steps that move the image by a hundredth of a pixel or so: the clock's derivative is that of milliseconds.
        let step = |k: usize| if k == problem.calibration_offset() { 1e-6 } else { 1e-5 };
        let at = |moves: &[(usize, f64)]| {
            let mut other = problem.clone();
            moves.iter().for_each(|(unknown, by)| moved(&mut other, *unknown, *by));
            cost(&other).total()
        };
        let dense = DMatrix::from_fn(all, all, |a, b| {
            let (h, k) = (step(a), step(b));
            let apart = |i: f64, j: f64| at(&[(a, i * h), (b, j * k)]);
            (apart(1.0, 1.0) - apart(1.0, -1.0) - apart(-1.0, 1.0) + apart(-1.0, -1.0)) / (4.0 * h * k)
        });
        let own = dense.view((reduced, reduced), (all - reduced, all - reduced)).into_owned();
        let across = dense.view((0, reduced), (reduced, all - reduced)).into_owned();
        let schur = dense.view((0, 0), (reduced, reduced))
            - &across * own.try_inverse().unwrap() * across.transpose();
        let mut system = System::new(&problem);
        linearise(&problem, 0.0, &mut system);
        let scale = |k: usize| dense[(k, k)].abs().sqrt().max(1.0);
        // What biases do within a row's time is left out of the derivatives.
        let is_bias = |k: usize| {
            k < problem.calibration_offset() && (9..FRAME_DIM).contains(&(k % problem.frame_dim()))
        };
        for row in (0..reduced).filter(|k| !is_bias(*k)) {
            for column in (0..=row).filter(|k| !is_bias(*k)) {
                let off = (system.h.entry(row, column) - schur[(row, column)]) / (scale(row) * scale(column));
                assert!(
                    off.abs() < 2e-3,
                    "({row}, {column}): {} not {}",
                    system.h.entry(row, column),
                    schur[(row, column)]
                );
            }
        }
    }

    #[test]
    fn the_prior_is_that_of_a_process_that_stays_about_zero() {
        let problem = problem();
        let prior = FocusPrior::AUTOFOCUS;
        let mut information = DMatrix::zeros(3, 3);
        for (k, tie) in ties(&problem, prior).enumerate() {
            let mut row = DMatrix::zeros(1, 3);
            row[k] = 1.0;
            if k > 0 {
                row[k - 1] = -tie.share;
            }
            information += row.transpose() * &row * tie.weight;
        }
        let covariance = information.clone().try_inverse().unwrap();
        for k in 0..3 {
            let expected = prior.sigma.powi(2) * (-0.2 * (k as f64) / CORRELATED_SECS).exp();
            assert!((covariance[(k, 0)] - expected).abs() < 1e-9 * expected, "{covariance}");
            assert!((covariance[(k, k)].sqrt() - prior.sigma).abs() < 1e-9, "{covariance}");
        }
        assert!((information.determinant().ln() - log_det(&problem, prior)).abs() < 1e-9);
    }
}
