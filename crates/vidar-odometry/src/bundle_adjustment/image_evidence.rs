//! Whether a recording shows that the lens moves or stamps scatter, and what both were found to do.

use super::image_prior::ImagePrior;
use super::image_unknowns::log_det;
use super::observation::MovingBody;
use super::optimise;
use super::problem::{FRAME_DIM, Problem};
use super::system::System;
use crate::backend::dot;

/// `ln` of the Bayes factor from which the lens is taken to move, or stamps to scatter: "decisive" is 4.6. Whole recordings of a fixed lens have -42 and less
/// for the focal length (real MH_01, 17 rendered phones, sweeps, orbits and flights; -0.2 and less of their first seconds), those whose focal length changes by 1 % 126
/// to 1120, those that were given one 2 % off 240 to 320. Stamps that are right have -3 and less,
/// those that scatter by 3 to 5 ms 22 to 2390 (two rendered phones and a RealSense, with a least delay of 1 ms).
const DECISIVE: f64 = 10.0;

/// The least motions that do harm. At changes of the focal length of 0.4 % the scale was 0.4 to 0.8 % off, within what was stated; a tenth of a degree is a
/// pixel, and so is what a camera turns by in 2 ms at 60°/s.
const HARMFUL_FOCUS: f64 = 0.005;
pub(crate) const HARMFUL_SHIFT: f64 = 0.002;
pub(crate) const HARMFUL_DELAY: f64 = 2e-3;

/// What a lens does that moves: autofocus of a phone, up to 2 % between near and far; optical stabilisation, up to a degree or two.
const FOCUS: f64 = 0.015;
/// Standard deviation of how far a stabiliser shifts an image, focal lengths: 0.86 degrees.
pub const IMAGE_SHIFT_RAD: f64 = 0.015;
/// Standard deviation of image stamps that say when an image arrived, s: real phones scatter by 4 and 6 ms, up to 20.
pub const STAMP_SCATTER_SECS: f64 = 5e-3;

/// What the measurements say that images have of their own beyond what they are taken to have; `None` where they do not. `system` is that of the solution.
pub(super) fn moves(problem: &Problem, system: &System) -> Option<ImagePrior> {
    let known = problem.prior.image;
    let none = ImagePrior::default();
    let candidates = [
        (
            known.focal,
            ImagePrior { focal: Some(HARMFUL_FOCUS), ..none },
            ImagePrior { focal: Some(FOCUS), ..known },
        ),
        (
            known.shift,
            ImagePrior { shift: Some(HARMFUL_SHIFT), ..none },
            ImagePrior { shift: Some(IMAGE_SHIFT_RAD), ..known },
        ),
        (
            known.delay,
            ImagePrior { delay: Some(HARMFUL_DELAY), ..none },
            ImagePrior { delay: Some(STAMP_SCATTER_SECS), ..known },
        ),
    ];
    // One at a time: what a shift explains looks in part like a focal length that changes.
    let ln = |new: ImagePrior| log_bayes_factor(problem, system, new).unwrap_or(f64::NEG_INFINITY);
    let unknown = candidates.into_iter().filter(|(known, ..)| known.is_none());
    let best = unknown.map(|(_, harmful, found)| (ln(harmful), found)).max_by(|a, b| a.0.total_cmp(&b.0));
    best.filter(|(ln, _)| *ln > DECISIVE).map(|(_, found)| found)
}

/// `ln` of how many times more probable the measurements are where images have of their own what `new` says, besides what the problem knows of it (Laplace's
/// approximation at the problem's solution); `None` where the system is singular.
fn log_bayes_factor(problem: &Problem, system: &System, new: ImagePrior) -> Option<f64> {
    let without = Fit::of(system);
    let mut with = problem.clone();
    with.prior.image = with.prior.image.or(new);
    let with = Fit::of(&optimise::solution(&with)?);
    let occam = 0.5 * (log_det(problem, &new) - (with.log_det - without.log_det));
    Some(with.decrease - without.decrease + occam)
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

/// What lens and clock were found to do from image to image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct FoundImages {
    /// Where every image has a focal length of its own.
    pub(super) focus: Option<Focus>,
    /// Where every image has a shift of its own: root mean square, focal lengths.
    pub(super) shift: Option<f64>,
    /// Where every image has a delay of its own: root mean square, s.
    pub(super) delay: Option<f64>,
}

/// Takes the mean of the focal length over the images into the calibration; what was found of the images. `system` is that of the solution.
pub(super) fn centre(problem: &mut Problem, system: &System) -> FoundImages {
    let rms = |squared: fn(&MovingBody) -> f64| {
        (problem.frames.iter().map(|f| squared(&f.body)).sum::<f64>() / problem.frames.len() as f64).sqrt()
    };
    let shift = problem.prior.image.shift.map(|_| rms(|body| body.lens.shift.norm_squared()));
    let delay = problem.prior.image.delay.map(|_| rms(|body| body.delay_secs * body.delay_secs));
    FoundImages { focus: centre_focus(problem, system), shift, delay }
}

fn centre_focus(problem: &mut Problem, system: &System) -> Option<Focus> {
    problem.prior.image.focal?;
    let count = problem.frames.len() as f64;
    let all = || problem.frames.iter().map(|f| f.body.lens.log_focal);
    let mean = all().sum::<f64>() / count;
    let spread = (all().map(|z| (z - mean).powi(2)).sum::<f64>() / count).sqrt();
    let mut slope = vec![0.0; problem.dim()];
    (0..problem.frames.len()).for_each(|k| slope[problem.offset(k) + FRAME_DIM] = 1.0 / count);
    let mean_sigma = system.sigma_of(slope);
    problem.calibration.camera = problem.calibration.camera.with_longer_focal(mean).ok()?;
    problem.frames.iter_mut().for_each(|f| f.body.lens.log_focal -= mean);
    Some(Focus { mean, mean_sigma, spread })
}
