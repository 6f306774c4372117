//! Cost and normal equations: inertial factors, reprojections with the landmarks eliminated, priors.

use super::envelope::Envelope;
use super::image_unknowns;
use super::inertial::{GAIN_DIM, InertialJacobians};
use super::landmark::Landmark;
use super::observation::{self, Linearised, STATE_DIM};
use super::problem::{FRAME_DIM, ObservedLandmark, Problem};
use super::system::{ByState, LandmarkBlock, System};
use crate::backend::{GaugePriorSigmas, gauge_prior_at, product};
use crate::imu::{Matrix15, Vector15};
use nalgebra::{Matrix3, Vector2, Vector3};
use vidar_core::simd::kernel;
use vidar_solve::Kernel;

/// Loss of whitened reprojection errors: quadratic to 2 standard deviations, then without influence in the end. Tracks of the
/// front end have 2 to 5 % gross errors, which Huber's loss lets bend the path.
pub(super) const KERNEL: Kernel = Kernel::Cauchy { k: 2.0 };

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
    let mut blocks = std::mem::take(&mut system.landmarks);
    blocks.resize_with(problem.landmarks.len(), LandmarkBlock::default);
    add_each_landmark(problem, damping, &mut blocks, system);
    system.landmarks = blocks;
}

kernel! {
    up to Avx2;
    /// Adds all landmarks.
    fn add_each_landmark(problem: &Problem, damping: f64, blocks: &mut [LandmarkBlock], system: &mut System) {
        add_landmarks(problem, damping, blocks, system);
    }
}

#[inline(always)]
fn add_landmarks(problem: &Problem, damping: f64, blocks: &mut [LandmarkBlock], system: &mut System) {
    for (seen, block) in problem.landmarks.iter().zip(blocks) {
        add_landmark(problem, seen, damping, block, system);
    }
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

/// Adds a landmark's observations, with the landmark eliminated (Schur complement).
#[inline(always)]
fn add_landmark(
    problem: &Problem,
    seen: &ObservedLandmark,
    damping: f64,
    block: &mut LandmarkBlock,
    system: &mut System,
) {
    let (calibrations, image_dim) = (problem.active_camera(), problem.prior.image.dim());
    let offset = problem.calibration_offset();
    block.by_state.clear();
    block.by_image.clear();
    block.by_calibration.clear();
    block.by_calibration.resize(calibrations, Vector3::zeros());
    block.gradient = Vector3::zeros();
    let mut own = Matrix3::zeros();
    for measured in &seen.observations {
        let body = &problem.frames[measured.frame].body;
        let Some(at) = observation::linearise(body, &seen.landmark, &problem.calibration, &measured.pixel)
        else {
            continue;
        };
        let residual: Vector2<f64> = measured.whitening * (at.pixel - measured.pixel);
        let root_weight = KERNEL.weight(residual.norm_squared()).sqrt();
        let whitening = measured.whitening * root_weight;
        let residual = residual * root_weight;
        let by_image = at.by_image(body, &problem.calibration, &problem.prior.image, &measured.pixel);
        let Linearised { by_state, by_landmark, by_calibration, .. } = at;
        let (by_state, by_landmark) = (whitening * by_state, whitening * by_landmark);
        own += by_landmark.transpose() * by_landmark;
        block.gradient += by_landmark.transpose() * residual;
        block.by_state.push((measured.frame, by_state.transpose() * by_landmark));
        let from = problem.offset(measured.frame);
        let square = by_state.transpose() * by_state;
        let gradient = by_state.transpose() * residual;
        for row in 0..STATE_DIM {
            system.gradient[from + row] += gradient[row];
            for (column, sum) in system.h.part_mut(from + row, from, row + 1).iter_mut().enumerate() {
                *sum += square[(row, column)];
            }
        }
        if image_dim > 0 {
            let by_image = whitening * by_image;
            block.by_image.push(by_landmark.tr_mul(&by_image));
            let with_state = by_state.tr_mul(&by_image);
            let square = by_image.tr_mul(&by_image);
            for i in 0..image_dim {
                let row = from + FRAME_DIM + i;
                system.gradient[row] += by_image.column(i).dot(&residual);
                let sums = system.h.part_mut(row, from, STATE_DIM);
                sums.iter_mut().zip(with_state.column(i).iter()).for_each(|(sum, value)| *sum += value);
                (0..=i).for_each(|j| system.h.add(row, from + FRAME_DIM + j, square[(i, j)]));
                for (k, index) in problem.active[..calibrations].iter().enumerate() {
                    let by_one = whitening * by_calibration[*index];
                    system.h.add(offset + k, row, by_image.column(i).dot(&by_one));
                }
            }
        }
        for (k, index) in problem.active[..calibrations].iter().enumerate() {
            let by_one = whitening * by_calibration[*index];
            block.by_calibration[k] += by_landmark.transpose() * by_one;
            system.gradient[offset + k] += by_one.dot(&residual);
            let with_state = by_state.transpose() * by_one;
            for (row, sum) in system.h.part_mut(offset + k, from, STATE_DIM).iter_mut().enumerate() {
                *sum += with_state[row];
            }
            for (other, other_index) in problem.active[..=k].iter().enumerate() {
                system.h.add(
                    offset + k,
                    offset + other,
                    by_one.dot(&(whitening * by_calibration[*other_index])),
                );
            }
        }
    }
    for k in 0..3 {
        // The floor keeps a landmark whose distance nothing tells where it is.
        own[(k, k)] += damping * own[(k, k)] + 1e-9;
    }
    block.inverse = seen.landmark.inverse_of(&own, &block.gradient);
    let Some(inverse) = block.inverse else { return };
    eliminate(problem, block, &inverse, system);
}

#[inline(always)]
fn eliminate(problem: &Problem, block: &LandmarkBlock, inverse: &Matrix3<f64>, system: &mut System) {
    let offset = problem.calibration_offset();
    let own_step = inverse * block.gradient;
    for (at, (frame, by_state)) in block.by_state.iter().enumerate() {
        let from = problem.offset(*frame);
        let weighted = product(by_state, inverse);
        let gradient = by_state * own_step;
        for row in 0..STATE_DIM {
            system.gradient[from + row] -= gradient[row];
        }
        for (other_frame, other) in &block.by_state[..=at] {
            match other_frame == frame {
                true => subtract_triangle(&mut system.h, from, &weighted, other),
                false => {
                    subtract_product(&mut system.h, from, problem.offset(*other_frame), &weighted, other)
                }
            }
        }
        for (k, by_calibration) in block.by_calibration.iter().enumerate() {
            let product = product(&weighted, by_calibration);
            for (row, sum) in system.h.part_mut(offset + k, from, STATE_DIM).iter_mut().enumerate() {
                *sum -= product[row];
            }
        }
    }
    image_unknowns::eliminate(problem, block, inverse, &own_step, system);
    for (k, by_calibration) in block.by_calibration.iter().enumerate() {
        system.gradient[offset + k] -= by_calibration.dot(&own_step);
        let weighted = inverse * by_calibration;
        for (other, by_other) in block.by_calibration[..=k].iter().enumerate() {
            system.h.add(offset + k, offset + other, -weighted.dot(by_other));
        }
    }
}

/// Takes `weighted · otherᵀ` off the block of two states.
#[inline(always)]
fn subtract_product(h: &mut Envelope, row: usize, column: usize, weighted: &ByState, other: &ByState) {
    let (first, rest) = other.as_slice().split_at(STATE_DIM);
    let (second, third) = rest.split_at(STATE_DIM);
    for i in 0..STATE_DIM {
        let [a, b, c] = [weighted[(i, 0)], weighted[(i, 1)], weighted[(i, 2)]];
        let sums = h.part_mut(row + i, column, STATE_DIM);
        for j in 0..STATE_DIM {
            sums[j] -= a * first[j] + b * second[j] + c * third[j];
        }
    }
}

/// The same of a state with itself, of which the lower triangle is held.
#[inline(always)]
fn subtract_triangle(h: &mut Envelope, at: usize, weighted: &ByState, own: &ByState) {
    for i in 0..STATE_DIM {
        for (j, sum) in h.part_mut(at + i, at, i + 1).iter_mut().enumerate() {
            let [a, b, c] = [weighted[(i, 0)], weighted[(i, 1)], weighted[(i, 2)]];
            *sum -= a * own[(j, 0)] + b * own[(j, 1)] + c * own[(j, 2)];
        }
    }
}
