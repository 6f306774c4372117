//! What an image has of its own: a lens that moves while filming, and a stamp that is not when it was exposed.
//!
//! Autofocus changes the focal length by up to 2 % ("focus breathing"). With one for all images, each change looks like a motion along the
//! optical axis, which the IMU contradicts only weakly: rendered phones whose focal length changed by 1 % every few seconds had their scale 5 %
//! off at a stated 1.1 %. Optical stabilisation shifts the image against the shake of the hand by up to a degree; without that the camera seems
//! to turn otherwise than the gyroscope says. Where the recording shows it, every image has a focal length `f exp(z)` and a shift of its
//! own, each an Ornstein-Uhlenbeck process: a random walk that stays about zero.
//!
//! Phones and drivers stamp images when they arrive, some ms sooner or later after the exposure from one to the next; at 60°/s a camera turns by two pixels
//! in 4 ms. Two real phones scatter by 4 and 6 ms. Where the recording shows it, every image has a delay of its own, as a process of the same kind.

use super::image_prior::{ImagePrior, ImageUnknown, Process};
use super::observation::MovingBody;
use super::problem::{FRAME_DIM, Problem};
use super::system::{ByImage, ImageBlock, LandmarkBlock, ObservationBlock, Part, System};
use crate::backend::product;
use nalgebra::{Matrix3, Vector3};

impl ImageUnknown {
    pub(super) fn of(self, body: &MovingBody) -> f64 {
        let lens = &body.lens;
        match self {
            Self::LogFocal => lens.log_focal,
            Self::ShiftX => lens.shift.x,
            Self::ShiftY => lens.shift.y,
            Self::ShiftRateX => lens.shift_rate.x,
            Self::ShiftRateY => lens.shift_rate.y,
            Self::Delay => body.delay_secs,
        }
    }

    /// Changes its value.
    pub(super) fn add(self, body: &mut MovingBody, step: f64) {
        let lens = &mut body.lens;
        *match self {
            Self::LogFocal => &mut lens.log_focal,
            Self::ShiftX => &mut lens.shift.x,
            Self::ShiftY => &mut lens.shift.y,
            Self::ShiftRateX => &mut lens.shift_rate.x,
            Self::ShiftRateY => &mut lens.shift_rate.y,
            Self::Delay => &mut body.delay_secs,
        } += step;
    }
}

/// How the prior ties an unknown to that of the state before: `z = share · before`, with a weight. The first one is tied to zero.
#[derive(Clone, Copy)]
struct Tie {
    share: f64,
    weight: f64,
}

fn ties(problem: &Problem, process: Process) -> impl Iterator<Item = Tie> {
    let variance = process.sigma * process.sigma;
    let of = move |k: usize| {
        let before = k.checked_sub(1).map(|before| problem.frames[before].time);
        let share = before
            .map_or(0.0, |before| (-(problem.frames[k].time - before).as_secs_f64() / process.secs).exp());
        Tie { share, weight: 1.0 / (variance * (1.0 - share * share)) }
    };
    (0..problem.frames.len()).map(of)
}

/// `ln` of the determinant of a prior's information.
pub(super) fn log_det(problem: &Problem, prior: &ImagePrior) -> f64 {
    prior.processes().flat_map(|(_, process)| ties(problem, process)).map(|tie| tie.weight.ln()).sum()
}

/// What an unknown of state `k` departs from its tie by.
fn departure(problem: &Problem, unknown: ImageUnknown, k: usize, tie: Tie) -> f64 {
    let value = |k: usize| unknown.of(&problem.frames[k].body);
    value(k) - tie.share * k.checked_sub(1).map_or(0.0, value)
}

/// Cost of the prior.
pub(super) fn cost(problem: &Problem) -> f64 {
    let mut cost = 0.0;
    for (unknown, process) in problem.prior.image.processes() {
        for (k, tie) in ties(problem, process).enumerate() {
            cost += 0.5 * tie.weight * departure(problem, unknown, k, tie).powi(2);
        }
    }
    cost
}

/// Adds the prior to the normal equations.
pub(super) fn add_prior(problem: &Problem, system: &mut System) {
    for (at, (unknown, process)) in problem.prior.image.processes().enumerate() {
        for (k, tie) in ties(problem, process).enumerate() {
            let row = problem.offset(k) + FRAME_DIM + at;
            let slope = tie.weight * departure(problem, unknown, k, tie);
            system.gradient[row] += slope;
            system.h.add(row, row, tie.weight);
            if k > 0 {
                let before = problem.offset(k - 1) + FRAME_DIM + at;
                system.gradient[before] -= tie.share * slope;
                system.h.add(before, before, tie.share * tie.share * tie.weight);
                system.h.add(row, before, -tie.share * tie.weight);
            }
        }
    }
}

/// Adds an observation's part in the rows of its image's own unknowns.
#[inline(always)]
pub(super) fn add(problem: &Problem, block: &LandmarkBlock, at: usize, part: &mut Part<'_>) {
    let (Some(ImageBlock { by_image, .. }), seen) = (block.images.get(at), &block.observations[at]) else {
        return;
    };
    let from = problem.offset(seen.frame);
    let with_state = seen.by_state.tr_mul(by_image);
    let square = by_image.tr_mul(by_image);
    for i in 0..problem.prior.image.dim() {
        let row = from + FRAME_DIM + i;
        *part.gradient(row) += by_image.column(i).dot(&seen.residual);
        let sums = part.h.part_mut(row, from, with_state.nrows());
        sums.iter_mut().zip(with_state.column(i).iter()).for_each(|(sum, value)| *sum += value);
        (0..=i).for_each(|j| part.h.add(row, from + FRAME_DIM + j, square[(i, j)]));
    }
}

/// The images' own part of taking a landmark out of the normal equations (Schur complement).
#[inline(always)]
pub(super) fn eliminate(
    problem: &Problem,
    block: &LandmarkBlock,
    inverse: &Matrix3<f64>,
    own_step: &Vector3<f64>,
    part: &mut Part<'_>,
) {
    let unknowns = problem.prior.image.dim();
    let seen = |at: usize| {
        let ObservationBlock { frame, with_landmark, .. } = &block.observations[at];
        (*frame, problem.offset(*frame), with_landmark, &block.images[at].with_landmark)
    };
    for at in 0..block.images.len() {
        let (frame, from, by_state, by_image) = seen(at);
        let row = from + FRAME_DIM;
        let weighted: ByImage = inverse * by_image;
        for k in part.calibrations.clone() {
            for i in 0..unknowns {
                let product = weighted.column(i).dot(&block.with_calibration[k]);
                part.h.add(problem.calibration_offset() + k, row + i, -product);
            }
        }
        if !part.frames.contains(&frame) {
            continue;
        }
        let weighted_state = product(by_state, inverse);
        for i in 0..unknowns {
            *part.gradient(row + i) -= by_image.column(i).dot(own_step);
        }
        for (other_frame, other_from, other_state, other_image) in (0..=at).map(seen) {
            let with_state = other_state * weighted;
            let with_image = weighted.tr_mul(other_image);
            for i in 0..unknowns {
                let sums = part.h.part_mut(row + i, other_from, with_state.nrows());
                sums.iter_mut().zip(with_state.column(i).iter()).for_each(|(sum, value)| *sum -= value);
                let others = if other_frame == frame { i + 1 } else { unknowns };
                for j in 0..others {
                    part.h.add(row + i, other_from + FRAME_DIM + j, -with_image[(i, j)]);
                }
            }
            if other_frame != frame {
                let with_image = weighted_state * other_image;
                for j in 0..unknowns {
                    for (k, value) in with_image.column(j).iter().enumerate() {
                        part.h.add(from + k, other_from + FRAME_DIM + j, -value);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::example::problem;
    use super::*;
    use crate::bundle_adjustment::linearise::{cost, linearise};
    use crate::imu::Vector15;
    use nalgebra::DMatrix;

    /// Moves one unknown: states with their images, clock, landmarks.
    fn moved(problem: &mut Problem, unknown: usize, by: f64) {
        let (dim, reduced) = (problem.frame_dim(), problem.dim());
        if unknown < problem.calibration_offset() {
            let body = &mut problem.frames[unknown / dim].body;
            let k = unknown % dim;
            match problem.prior.image.unknowns().nth(k.wrapping_sub(FRAME_DIM)) {
                Some(unknown) => unknown.add(body, by),
                None => {
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
        let prior = ImagePrior { focal: Some(0.015), ..ImagePrior::default() };
        let (_, process) = prior.processes().next().unwrap();
        let mut information = DMatrix::zeros(3, 3);
        for (k, tie) in ties(&problem, process).enumerate() {
            let mut row = DMatrix::zeros(1, 3);
            row[k] = 1.0;
            if k > 0 {
                row[k - 1] = -tie.share;
            }
            information += row.transpose() * &row * tie.weight;
        }
        let covariance = information.clone().try_inverse().unwrap();
        for k in 0..3 {
            let expected = process.sigma.powi(2) * (-0.2 * (k as f64) / process.secs).exp();
            assert!((covariance[(k, 0)] - expected).abs() < 1e-9 * expected, "{covariance}");
            assert!((covariance[(k, k)].sqrt() - process.sigma).abs() < 1e-9, "{covariance}");
        }
        assert!((information.determinant().ln() - log_det(&problem, &prior)).abs() < 1e-9);
    }
}
