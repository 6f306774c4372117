//! A focal length that changes while filming: autofocus moves the lens, and the picture grows or shrinks by up to 2 % ("focus breathing").
//!
//! With one focal length for all images, each change looks like a motion along the optical axis, which the IMU contradicts only weakly:
//! rendered phones whose focal length changed by 1 % every few seconds had their scale 5 % off at a stated 1.1 %. Where the recording shows
//! it, every image has its own, `f exp(z)`, and `z` walks at random.

use super::linearise::{LandmarkBlock, System, linearise};
use super::problem::{FRAME_DIM, Problem};
use crate::backend::{dot, product};
use nalgebra::{Matrix3, Vector3};

/// What is known of the changes before: an Ornstein-Uhlenbeck process, a random walk that stays about zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FocusPrior {
    /// Standard deviation of `ln` of an image's focal length over the calibration's.
    sigma: f64,
}

impl FocusPrior {
    /// Autofocus of a phone: up to 2 % between near and far.
    pub(super) const AUTOFOCUS: Self = Self { sigma: 0.015 };

    /// The least that does harm: at changes of 0.4 % the scale was 0.4 to 0.8 % off, within what was stated.
    const HARMFUL: Self = Self { sigma: 0.005 };
}

/// How long a lens keeps its place, s: autofocus moves every few seconds.
const CORRELATED_SECS: f64 = 5.0;

/// `ln` of the Bayes factor from which the focal length is taken to change: "decisive" is 4.6. Whole recordings of a fixed lens have -42 and less
/// (real MH_01, 17 rendered phones, sweeps, orbits and flights; -0.2 and less of their first seconds), those whose focal length changes by 1 % 126 to
/// 1120, those that were given one 2 % off 240 to 320.
const DECISIVE: f64 = 10.0;

/// Whether the measurements speak for a focal length that changes.
pub(super) fn changes(problem: &Problem) -> bool {
    log_bayes_factor(problem, FocusPrior::HARMFUL).is_some_and(|ln| ln > DECISIVE)
}

/// The focal lengths that the images have been found to have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Focus {
    /// `ln` of the mean over the images over what was given.
    pub mean: f64,
    /// Standard deviation of `mean`.
    pub mean_sigma: f64,
    /// Standard deviation of the images about the mean.
    pub spread: f64,
}

/// Takes the mean over the images into the calibration; what was found, where every image has a focal length of its own. `system` is that of the
/// solution.
pub(super) fn centre(problem: &mut Problem, system: &System) -> Option<Focus> {
    problem.prior.focus?;
    let count = problem.frames.len() as f64;
    let all = || problem.frames.iter().map(|f| f.body.log_focal);
    let mean = all().sum::<f64>() / count;
    let spread = (all().map(|z| (z - mean).powi(2)).sum::<f64>() / count).sqrt();
    let mut slope = vec![0.0; problem.dim()];
    (0..problem.frames.len()).for_each(|k| slope[problem.offset(k) + FRAME_DIM] = 1.0 / count);
    let mean_sigma = system.sigma_of(slope);
    let mut parameters = problem.calibration.camera.parameters();
    parameters[..2].iter_mut().for_each(|focal| *focal *= mean.exp());
    problem.calibration.camera = problem.calibration.camera.with_parameters(&parameters).ok()?;
    problem.frames.iter_mut().for_each(|f| f.body.log_focal -= mean);
    Some(Focus { mean, mean_sigma, spread })
}

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

/// `ln` of how many times more probable the measurements are with a focal length of its own for every image than with one for all (Laplace's
/// approximation at the solution with one); `None` where the system is singular.
fn log_bayes_factor(problem: &Problem, prior: FocusPrior) -> Option<f64> {
    let one = Fit::of(problem)?;
    let mut with = problem.clone();
    with.prior.focus = Some(prior);
    let each = Fit::of(&with)?;
    let prior_log_det: f64 = ties(problem, prior).map(|tie| tie.weight.ln()).sum();
    let occam = 0.5 * (prior_log_det - (each.log_det - one.log_det));
    Some(each.decrease - one.decrease + occam)
}

/// The quadratic approximation of the cost.
struct Fit {
    /// What its minimum is lower by.
    decrease: f64,
    log_det: f64,
}

impl Fit {
    fn of(problem: &Problem) -> Option<Self> {
        let mut system = System::new(problem);
        linearise(problem, 0.0, &mut system);
        if !system.h.factorise(&vec![0.0; problem.dim()], &mut system.factor) {
            return None;
        }
        let mut whitened = system.gradient.clone();
        system.factor.forward(&mut whitened);
        let log_det = 2.0 * (0..problem.dim()).map(|k| system.factor.diagonal(k).ln()).sum::<f64>();
        Some(Self { decrease: 0.5 * dot(&whitened, &whitened), log_det })
    }
}

#[cfg(test)]
mod tests {
    use super::super::observation::{self, tests::example};
    use super::super::problem::{CalibrationPrior, FrameState, ObservedLandmark, WhitenedObservation};
    use super::*;
    use crate::bundle_adjustment::linearise::cost;
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
        let mut log_det = 0.0;
        for (k, tie) in ties(&problem, prior).enumerate() {
            let mut row = DMatrix::zeros(1, 3);
            row[k] = 1.0;
            if k > 0 {
                row[k - 1] = -tie.share;
            }
            information += row.transpose() * &row * tie.weight;
            log_det += tie.weight.ln();
        }
        let covariance = information.clone().try_inverse().unwrap();
        for k in 0..3 {
            let expected = prior.sigma.powi(2) * (-0.2 * (k as f64) / CORRELATED_SECS).exp();
            assert!((covariance[(k, 0)] - expected).abs() < 1e-9 * expected, "{covariance}");
            assert!((covariance[(k, k)].sqrt() - prior.sigma).abs() < 1e-9, "{covariance}");
        }
        assert!((information.determinant().ln() - log_det).abs() < 1e-9);
    }
}
