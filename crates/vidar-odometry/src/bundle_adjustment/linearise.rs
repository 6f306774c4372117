//! Cost and normal equations: inertial factors, reprojections with the landmarks eliminated, priors.

use super::inertial::{GAIN_DIM, InertialJacobians};
use super::landmark::Landmark;
use super::problem::{FRAME_DIM, ObservedLandmark, Problem};
use super::reprojections::{self, KERNEL};
use super::system::System;
use super::{image_unknowns, observation};
use crate::backend::{GaugePriorSigmas, gauge_prior_at};
use crate::imu::{Matrix15, Vector15};

/// Squared whitened error of an observation that does not project at all.
const BEHIND: f64 = 100.0;

/// What the adjustment's total is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Cost {
    pub(super) visual: f64,
    pub(super) inertial: f64,
    pub(super) priors: f64,
}

impl Cost {
    pub(super) fn total(&self) -> f64 {
        self.visual + self.inertial + self.priors
    }
}

/// Squared whitened error of an observation.
pub(super) fn squared_error(problem: &Problem, seen: &ObservedLandmark, at: usize) -> f64 {
    squared_error_of(problem, seen, &seen.landmark, at)
}

/// The same where the landmark is at `landmark`.
fn squared_error_of(problem: &Problem, seen: &ObservedLandmark, landmark: &Landmark, at: usize) -> f64 {
    let measured = &seen.observations[at];
    let body = &problem.frames[measured.frame].body;
    match observation::project(body, landmark, &problem.calibration, &measured.pixel) {
        Some(pixel) => (measured.whitening * (pixel - measured.pixel)).norm_squared(),
        None => BEHIND,
    }
}

/// Cost of a landmark's observations, were it at `landmark`.
pub(super) fn landmark_cost(problem: &Problem, seen: &ObservedLandmark, landmark: &Landmark) -> f64 {
    (0..seen.observations.len()).map(|at| KERNEL.loss(squared_error_of(problem, seen, landmark, at))).sum()
}

/// The cost at the present values.
pub(super) fn cost(problem: &Problem) -> Cost {
    cost_with(problem, problem.landmarks.iter().map(|l| landmark_cost(problem, l, &l.landmark)).sum())
}

/// The same, where the landmarks' cost is known to be `visual`.
pub(super) fn cost_with(problem: &Problem, visual: f64) -> Cost {
    let mut cost = Cost { visual, ..Cost::default() };
    for k in 1..problem.frames.len() {
        cost.inertial += 0.5 * inertial_error(problem, k).map_or(0.0, |r| r.norm_squared());
    }
    let (gauge, _) = gauge_error(problem);
    cost.priors += image_unknowns::cost(problem);
    cost.priors += 0.5 * gauge.norm_squared();
    for (value, sigma) in problem.calibration.minus(&problem.prior.mean).iter().zip(&problem.prior.sigmas) {
        if *sigma > 0.0 {
            cost.priors += 0.5 * (value / sigma).powi(2);
        }
    }
    cost
}

/// Whitened inertial residual between a state and the one before.
pub(super) fn inertial_error(problem: &Problem, k: usize) -> Option<Vector15> {
    let factor = problem.frames[k].inertial.as_ref()?;
    let (i, j) = (&problem.frames[k - 1].body.state, &problem.frames[k].body.state);
    Some(factor.error(i, j, &problem.calibration.gain))
}

/// The same with its derivatives.
pub(super) fn inertial_jacobians(problem: &Problem, k: usize) -> Option<InertialJacobians> {
    let factor = problem.frames[k].inertial.as_ref()?;
    let (i, j) = (&problem.frames[k - 1].body.state, &problem.frames[k].body.state);
    Some(factor.linearise(i, j, &problem.calibration.gain))
}

/// Fills the reduced system at the present values. `damping` is added, relatively, to the landmarks' diagonal.
pub(super) fn linearise(problem: &Problem, damping: f64, system: &mut System) {
    system.h.clear();
    system.gradient.fill(0.0);
    add_priors(problem, system);
    for k in 1..problem.frames.len() {
        add_inertial(problem, k, system);
    }
    reprojections::add(problem, damping, system);
}

/// Whitened difference of the held state from where it is held, and its derivative.
fn gauge_error(problem: &Problem) -> (Vector15, Matrix15) {
    let (held, reference) = &problem.gauge;
    let state = &problem.frames[*held].body.state;
    gauge_prior_at(reference, &GaugePriorSigmas::GAUGE, state, state)
}

fn add_priors(problem: &Problem, system: &mut System) {
    let (residual, jacobian) = gauge_error(problem);
    let at = problem.offset(problem.gauge.0);
    add_block(system, at, at, &(jacobian.transpose() * jacobian));
    add_gradient(system, at, &(jacobian.transpose() * residual));
    let offset = problem.calibration_offset();
    let moved = problem.calibration.minus(&problem.prior.mean);
    image_unknowns::add_prior(problem, system);
    for (k, index) in problem.active.iter().enumerate() {
        let weight = problem.prior.sigmas[*index].powi(-2);
        system.h.add(offset + k, offset + k, weight);
        system.gradient[offset + k] += weight * moved[*index];
    }
}

fn add_inertial(problem: &Problem, k: usize, system: &mut System) {
    let Some(InertialJacobians { residual, by_i, by_j, by_gain }) = inertial_jacobians(problem, k) else {
        return;
    };
    let (at_i, at_j) = (problem.offset(k - 1), problem.offset(k));
    add_block(system, at_i, at_i, &(by_i.transpose() * by_i));
    add_block(system, at_j, at_j, &(by_j.transpose() * by_j));
    let across = by_j.transpose() * by_i;
    for row in 0..FRAME_DIM {
        for column in 0..FRAME_DIM {
            system.h.add(at_j + row, at_i + column, across[(row, column)]);
        }
    }
    add_gradient(system, at_i, &(by_i.transpose() * residual));
    add_gradient(system, at_j, &(by_j.transpose() * residual));
    let (camera, gains) = (problem.active_camera(), problem.calibration.dim() - GAIN_DIM);
    for (row, index) in problem.active.iter().enumerate().skip(camera) {
        let by_one = by_gain.column(index - gains);
        let at = problem.calibration_offset() + row;
        system.gradient[at] += by_one.dot(&residual);
        let (with_i, with_j) = (by_i.transpose() * by_one, by_j.transpose() * by_one);
        for column in 0..FRAME_DIM {
            system.h.add(at, at_i + column, with_i[column]);
            system.h.add(at, at_j + column, with_j[column]);
        }
        for (other, other_index) in problem.active.iter().enumerate().take(row + 1).skip(camera) {
            let product = by_one.dot(&by_gain.column(other_index - gains));
            system.h.add(at, problem.calibration_offset() + other, product);
        }
    }
}

/// Adds a symmetric block of the diagonal.
fn add_block(system: &mut System, at_row: usize, at_column: usize, block: &Matrix15) {
    for row in 0..FRAME_DIM {
        for column in 0..=row {
            system.h.add(at_row + row, at_column + column, block[(row, column)]);
        }
    }
}

fn add_gradient(system: &mut System, at: usize, gradient: &Vector15) {
    for (sum, value) in system.gradient[at..at + FRAME_DIM].iter_mut().zip(gradient.iter()) {
        *sum += value;
    }
}
