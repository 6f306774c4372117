//! Reprojections in the normal equations, with the landmarks eliminated (Schur complement).
//!
//! First each landmark's own block, then the sums: neighbouring rows of the reduced system belong to one thread, which goes through all landmarks
//! in their order, so that the sums have the same bits for any number of threads.

use super::envelope::Rows;
use super::image_unknowns;
use super::observation::{self, Linearised, STATE_DIM};
use super::problem::{FRAME_DIM, ObservedLandmark, Problem};
use super::system::{ByState, ImageBlock, LandmarkBlock, ObservationBlock, Part, System};
use crate::backend::product;
use nalgebra::{Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use vidar_core::simd::kernel;
use vidar_solve::Kernel;

/// Loss of whitened reprojection errors: quadratic to 2 standard deviations, then without influence in the end. Tracks of the
/// front end have 2 to 5 % gross errors, which Huber's loss lets bend the path.
pub(super) const KERNEL: Kernel = Kernel::Cauchy { k: 2.0 };

/// Fewest landmarks that a thread takes at a time: some 50 µs of work.
pub(super) const LANDMARKS_AT_A_TIME: usize = 32;

/// Parts of the states' rows for each thread: rows of one part may take twice the time of another's.
const PARTS_PER_THREAD: usize = 4;

/// Rows of the calibration in one part: a landmark's observations, loaded once, serve all of them.
const CALIBRATION_ROWS: usize = 5;

/// Adds all landmarks' reprojections. `damping` is added, relatively, to the landmarks' diagonal.
pub(super) fn add(problem: &Problem, damping: f64, system: &mut System) {
    let System { h, gradient, landmarks, .. } = system;
    landmarks.resize_with(problem.landmarks.len(), LandmarkBlock::default);
    let blocks = landmarks.par_chunks_mut(LANDMARKS_AT_A_TIME);
    let seen = problem.landmarks.par_chunks(LANDMARKS_AT_A_TIME);
    seen.zip(blocks).for_each(|(seen, blocks)| find_blocks(problem, seen, damping, blocks));
    let mut parts = Vec::new();
    let mut rest = Part::of_all(problem, h.rows(), gradient);
    for bound in bounds(problem, rayon::current_num_threads()) {
        let (part, others) = rest.split_at(problem, bound);
        parts.push(part);
        rest = others;
    }
    parts.push(rest);
    parts.into_par_iter().for_each(|mut part| add_blocks(problem, landmarks, &mut part));
}

kernel! {
    up to Avx2;
    /// Computes the blocks of landmarks.
    fn find_blocks(problem: &Problem, seen: &[ObservedLandmark], damping: f64, blocks: &mut [LandmarkBlock]) {
        for (seen, block) in seen.iter().zip(blocks) {
            find_block(problem, seen, damping, block);
        }
    }
}

kernel! {
    up to Avx2;
    /// Adds all landmarks' blocks to the rows of a part.
    fn add_blocks(problem: &Problem, blocks: &[LandmarkBlock], part: &mut Part<'_>) {
        for block in blocks {
            add_block(problem, block, part);
        }
    }
}

/// Rows at which parts end, for so many threads; one thread has all rows.
fn bounds(problem: &Problem, threads: usize) -> Vec<usize> {
    if threads < 2 {
        return Vec::new();
    }
    // A landmark's observation is coupled to those before.
    let mut work = vec![0; problem.frames.len()];
    for seen in &problem.landmarks {
        seen.observations.iter().enumerate().for_each(|(at, o)| work[o.frame] += at + 1);
    }
    let (all, parts) = (work.iter().sum::<usize>(), PARTS_PER_THREAD * threads);
    let (mut bounds, mut done) = (Vec::new(), 0);
    for (frame, work) in work.iter().enumerate().skip(1) {
        done += work;
        if done * parts > all * (bounds.len() + 1) {
            bounds.push(problem.offset(frame));
        }
    }
    let offset = problem.calibration_offset();
    bounds.extend((offset..offset + problem.active_camera()).step_by(CALIBRATION_ROWS));
    bounds
}

#[inline(always)]
fn find_block(problem: &Problem, seen: &ObservedLandmark, damping: f64, block: &mut LandmarkBlock) {
    let (calibrations, image_dim) = (problem.active_camera(), problem.prior.image.dim());
    block.clear(calibrations);
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
        let with_landmark = by_state.transpose() * by_landmark;
        block.observations.push(ObservationBlock {
            frame: measured.frame,
            residual,
            by_state,
            with_landmark,
        });
        if image_dim > 0 {
            let by_image = whitening * by_image;
            block.images.push(ImageBlock { by_image, with_landmark: by_landmark.tr_mul(&by_image) });
        }
        for (k, index) in problem.active[..calibrations].iter().enumerate() {
            let by_one = whitening * by_calibration[*index];
            block.with_calibration[k] += by_landmark.transpose() * by_one;
            block.by_calibration.push(by_one);
        }
    }
    for k in 0..3 {
        // The floor keeps a landmark whose distance nothing tells where it is.
        own[(k, k)] += damping * own[(k, k)] + 1e-9;
    }
    block.inverse = seen.landmark.inverse_of(&own, &block.gradient);
}

#[inline(always)]
fn add_block(problem: &Problem, block: &LandmarkBlock, part: &mut Part<'_>) {
    if part.is_beside(block) {
        return;
    }
    for (at, seen) in block.observations.iter().enumerate() {
        if part.frames.contains(&seen.frame) {
            add_state(problem, seen, part);
            image_unknowns::add(problem, block, at, part);
        }
        add_calibration(problem, block, at, part);
    }
    if let Some(inverse) = &block.inverse {
        eliminate(problem, block, inverse, part);
    }
}

#[inline(always)]
fn add_state(problem: &Problem, seen: &ObservationBlock, part: &mut Part<'_>) {
    let ObservationBlock { frame, residual, by_state, .. } = seen;
    let from = problem.offset(*frame);
    let square = by_state.transpose() * by_state;
    let gradient = by_state.transpose() * residual;
    for row in 0..STATE_DIM {
        *part.gradient(from + row) += gradient[row];
        for (column, sum) in part.h.part_mut(from + row, from, row + 1).iter_mut().enumerate() {
            *sum += square[(row, column)];
        }
    }
}

#[inline(always)]
fn add_calibration(problem: &Problem, block: &LandmarkBlock, at: usize, part: &mut Part<'_>) {
    let ObservationBlock { frame, residual, by_state, .. } = &block.observations[at];
    let (from, offset) = (problem.offset(*frame), problem.calibration_offset());
    let by_calibration = block.by_calibration(at);
    for k in part.calibrations.clone() {
        let by_one = &by_calibration[k];
        *part.gradient(offset + k) += by_one.dot(residual);
        let with_state = by_state.transpose() * by_one;
        for (row, sum) in part.h.part_mut(offset + k, from, STATE_DIM).iter_mut().enumerate() {
            *sum += with_state[row];
        }
        for (other, by_other) in by_calibration[..=k].iter().enumerate() {
            part.h.add(offset + k, offset + other, by_one.dot(by_other));
        }
        if let Some(image) = block.images.get(at) {
            for i in 0..problem.prior.image.dim() {
                part.h.add(offset + k, from + FRAME_DIM + i, image.by_image.column(i).dot(by_one));
            }
        }
    }
}

#[inline(always)]
fn eliminate(problem: &Problem, block: &LandmarkBlock, inverse: &Matrix3<f64>, part: &mut Part<'_>) {
    let offset = problem.calibration_offset();
    let own_step = inverse * block.gradient;
    for (at, seen) in block.observations.iter().enumerate() {
        let is_own = part.frames.contains(&seen.frame);
        if !is_own && part.calibrations.is_empty() {
            continue;
        }
        let from = problem.offset(seen.frame);
        let weighted = product(&seen.with_landmark, inverse);
        if is_own {
            eliminate_state(problem, &block.observations[..=at], &weighted, &own_step, part);
        }
        for k in part.calibrations.clone() {
            let product = product(&weighted, &block.with_calibration[k]);
            for (row, sum) in part.h.part_mut(offset + k, from, STATE_DIM).iter_mut().enumerate() {
                *sum -= product[row];
            }
        }
    }
    image_unknowns::eliminate(problem, block, inverse, &own_step, part);
    for k in part.calibrations.clone() {
        let by_calibration = &block.with_calibration[k];
        *part.gradient(offset + k) -= by_calibration.dot(&own_step);
        let weighted = inverse * by_calibration;
        for (other, by_other) in block.with_calibration[..=k].iter().enumerate() {
            part.h.add(offset + k, offset + other, -weighted.dot(by_other));
        }
    }
}

/// Takes the last observation's part with those before, and with itself, off its state's rows.
#[inline(always)]
fn eliminate_state(
    problem: &Problem,
    observations: &[ObservationBlock],
    weighted: &ByState,
    own_step: &Vector3<f64>,
    part: &mut Part<'_>,
) {
    let Some(own) = observations.last() else { return };
    let from = problem.offset(own.frame);
    let gradient = own.with_landmark * own_step;
    for row in 0..STATE_DIM {
        *part.gradient(from + row) -= gradient[row];
    }
    for other in observations {
        if other.frame == own.frame {
            subtract_triangle(&mut part.h, from, weighted, &other.with_landmark);
        } else {
            subtract_product(&mut part.h, from, problem.offset(other.frame), weighted, &other.with_landmark);
        }
    }
}

/// Takes `weighted · otherᵀ` off the block of two states.
#[inline(always)]
fn subtract_product(h: &mut Rows<'_>, row: usize, column: usize, weighted: &ByState, other: &ByState) {
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
fn subtract_triangle(h: &mut Rows<'_>, at: usize, weighted: &ByState, own: &ByState) {
    for i in 0..STATE_DIM {
        for (j, sum) in h.part_mut(at + i, at, i + 1).iter_mut().enumerate() {
            let [a, b, c] = [weighted[(i, 0)], weighted[(i, 1)], weighted[(i, 2)]];
            *sum -= a * own[(j, 0)] + b * own[(j, 1)] + c * own[(j, 2)];
        }
    }
}
