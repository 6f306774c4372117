//! Whether a recording shows that the focal length changes, and what it was found to be.

use super::focus::log_det;
use super::optimise;
use super::problem::{FRAME_DIM, FocusPrior, Problem};
use super::system::System;
use crate::backend::dot;

/// `ln` of the Bayes factor from which the focal length is taken to change: "decisive" is 4.6. Whole recordings of a fixed lens have -42 and less
/// (real MH_01, 17 rendered phones, sweeps, orbits and flights; -0.2 and less of their first seconds), those whose focal length changes by 1 % 126 to
/// 1120, those that were given one 2 % off 240 to 320.
const DECISIVE: f64 = 10.0;

/// Whether the measurements speak for a focal length that changes; `system` is that of the solution with one for all.
pub(super) fn changes(problem: &Problem, system: &System) -> bool {
    log_bayes_factor(problem, system, FocusPrior::HARMFUL).is_some_and(|ln| ln > DECISIVE)
}

/// `ln` of how many times more probable the measurements are with a focal length of its own for every image than with one for all (Laplace's
/// approximation at the solution with one); `None` where the system is singular.
fn log_bayes_factor(problem: &Problem, system: &System, prior: FocusPrior) -> Option<f64> {
    let one = Fit::of(system);
    let mut with = problem.clone();
    with.prior.focus = Some(prior);
    let each = Fit::of(&optimise::solution(&with)?);
    let prior_log_det = log_det(problem, prior);
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
    fn of(system: &System) -> Self {
        let mut whitened = system.gradient.clone();
        system.factor.forward(&mut whitened);
        let log_det = 2.0 * (0..system.factor.dim()).map(|k| system.factor.diagonal(k).ln()).sum::<f64>();
        Self { decrease: 0.5 * dot(&whitened, &whitened), log_det }
    }
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
    problem.calibration.camera = problem.calibration.camera.with_longer_focal(mean).ok()?;
    problem.frames.iter_mut().for_each(|f| f.body.log_focal -= mean);
    Some(Focus { mean, mean_sigma, spread })
}
