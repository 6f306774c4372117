//! Joint refinement over all stretches, from several starts, with standard deviations.

use super::hand_eye::BASIN_SECS;
use super::parameters::{DIM, GivenLens, LENS, OFFSET, Parameters, ROTATION, Tangent, prior_sigmas};
use super::path::GyroPath;
use super::window::{Noise, Reduced, Turns, Window, rms_per_axis, shift_sigma};
use crate::gyro_alignment::RateSample;
use nalgebra::{SMatrix, Vector3};
use rayon::prelude::*;
use std::convert::Infallible;
use vidar_core::LieGroup;
use vidar_solve::levenberg_marquardt::{Decrease, Increase, LeastSquares, Limits, Schedule, Trial, minimise};
use vidar_solve::statistics::{STD_PER_MAD, median};

/// Rounds of scale estimation, which go on beyond these while the score falls, where there may be more.
const ROUNDS: usize = 5;
/// In so many of them, the first, the clock stays where it starts: while positions and points are far off, it went astray by 150 ms.
const CLOCK_HELD: usize = 3;
/// What its information is multiplied by meanwhile.
const HELD: f64 = 1e9;
/// What is spent on few stretches and on all. The way to the focal length is long and flat where the body turns about one axis (a
/// GoPro's walk: 336 ± 25 px with six, 374 ± 1 with these), and so is that to the clock where it goes round a room.
const COARSE: Effort = Effort { rounds: ROUNDS, trials: 4 };
const FINE: Effort = Effort { rounds: 20, trials: 24 };
/// Largest mean squared change of the gyroscope's drift, in units of its noise, where images turn as the gyroscope says. Rendered recordings by twelve
/// devices: 0.04 to 1.1 where they do, 1.6 to 9 of four stabilised ones, 2.1 of one whose stamps scatter.
const MAX_DRIFT_CHI2: f64 = 1.3;

/// Share of the margin within which solutions explain a recording equally well: a round that gains less ends them.
const SETTLED: f64 = 0.05;

const SCHEDULE: Schedule = Schedule {
    first: 1e-3,
    least: 1e-9,
    on_accepted: Decrease::Factor(0.2),
    on_rejected: Increase { most: 1e6, ..Increase::by(10.0) },
    on_unsolvable: Some(Increase::by(10.0)),
};

/// Starts that are refined on few stretches, and clocks of them on all.
const MAX_STARTS: usize = 18;
const MAX_CLOCKS: usize = 5;

/// Standard deviation of a measured pixel: bounds of what the residuals say, pixels. Below, rounding of grey levels and
/// the patch model err; above, the model does not fit.
const PIXEL_SIGMA: (f64, f64) = (0.1, 12.0);

/// Standard deviations from the residuals are multiplied by this: found on simulated recordings
/// (`tests/calibration.rs`), where the share of errors beyond 3 σ has to be below 2 %.
const SIGMA_FACTOR: f64 = 1.5;

/// Few stretches tell little of errors that each of them shares: standard deviations are multiplied by 1 + this over their
/// number. Ten simulated recordings of 3 s had errors of 0.2 to 0.4 standard deviations (RMS) with 3 here; real lenses have
/// more that the model leaves out than simulated ones.
const FEW_STRETCHES: f64 = 1.0;

/// Most rounds of a refinement, and steps that are tried in each.
#[derive(Clone, Copy)]
struct Effort {
    rounds: usize,
    trials: usize,
}

/// Samples, stretches and what is believed of them.
pub(super) struct Problem<'a> {
    pub samples: &'a [RateSample],
    pub width: f64,
    pub prior: Parameters,
    /// The lens, where it is given.
    pub lens: Option<GivenLens>,
    /// Standard deviation of the mount about the prior's, rad, where it is believed at all.
    pub mount_sigma: Option<f64>,
    pub turns: Turns,
    /// Solutions whose scores differ by less explain the recording equally well.
    pub margin: f64,
}

/// A solution.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    pub parameters: Parameters,
    pub windows: Vec<Window>,
    pub cost: f64,
    pub noise: Noise,
    /// How far from it others lie that explain the recording equally well (root mean square).
    pub spread: Tangent,
}

impl Problem<'_> {
    fn path(&self, parameters: &Parameters) -> GyroPath {
        GyroPath::new(self.samples, &parameters.bias, &parameters.scale)
    }

    /// Refines from each start on few stretches, then the best of each clock on all, and takes the best of these. `None` where nothing converges.
    pub fn solve(&self, starts: &[Parameters], windows: &[Window]) -> Option<Solution> {
        let few: Vec<Window> = thinned(windows);
        let starts = starts[..starts.len().min(MAX_STARTS)].par_iter();
        let coarse: Vec<Solution> =
            in_order(starts.filter_map(|start| self.refine(start, &few, COARSE)).collect());
        let mut clocks: Vec<&Parameters> = Vec::new();
        for found in &coarse {
            let at = &found.parameters;
            if clocks.iter().all(|other| (other.offset_secs - at.offset_secs).abs() > BASIN_SECS) {
                clocks.push(at);
            }
        }
        clocks.truncate(MAX_CLOCKS);
        let clocks = clocks.into_par_iter();
        let fine: Vec<Solution> =
            in_order(clocks.filter_map(|start| self.refine(start, windows, FINE)).collect());
        let spread = self.spread(&fine);
        let best = fine.into_iter().next()?;
        Some(Solution { spread, ..best })
    }

    /// How far those that explain the recording as well as the first one lie from it (root mean square).
    fn spread(&self, solutions: &[Solution]) -> Tangent {
        let Some(best) = solutions.first() else { return Tangent::zeros() };
        let as_good = solutions.iter().take_while(|other| other.score() - best.score() <= self.margin);
        let (sum, count) = as_good.fold((Tangent::zeros(), 0), |(sum, count), other| {
            let apart = difference(&other.parameters, &best.parameters);
            (sum + apart.component_mul(&apart), count + 1)
        });
        sum.map(|square: f64| (square / f64::from(count.max(1))).sqrt())
    }

    /// Levenberg-Marquardt with the pixel noise estimated anew from the residuals in each round.
    fn refine(&self, start: &Parameters, windows: &[Window], effort: Effort) -> Option<Solution> {
        let mut windows = windows.to_vec();
        for window in &mut windows {
            window.restart(start, &self.path(start));
        }
        let noise = Noise { pixel: PIXEL_SIGMA.1, turns: self.turns };
        let at =
            Solution { parameters: *start, windows, cost: f64::INFINITY, noise, spread: Tangent::zeros() };
        let mut refinement = Refinement { problem: self, at, is_clock_held: true };
        let mut schedule = SCHEDULE;
        let limits = Limits { trials: effort.trials, ..Limits::NONE };
        let mut score = f64::INFINITY;
        for round in 0..effort.rounds {
            refinement.is_clock_held = round < CLOCK_HELD;
            let at = &mut refinement.at;
            let path = self.path(&at.parameters);
            // The scale falls by at most four a round, so that the kernel does not close round a wrong start.
            let scale =
                residual_scale(&at.windows, &at.parameters, &path)?.clamp(PIXEL_SIGMA.0, PIXEL_SIGMA.1);
            at.noise.pixel = if round == 0 { (2.0 * scale).max(1.0) } else { scale };
            if self.turns.is_stabilised() {
                // Shakes depend on the clock, which settles.
                at.windows.iter_mut().for_each(|window| window.find_shakes(&at.parameters, &path));
                if round > 0 {
                    at.noise.turns = Turns::Stabilised(shift_sigma(&at.windows, &at.noise.turns));
                }
            }
            at.cost = self.cost(&at.parameters, &at.windows, &at.noise);
            let cost = at.cost;
            let Ok(report) = minimise(&mut refinement, cost, &schedule, &limits);
            schedule.first = report.damping;
            let before = std::mem::replace(&mut score, refinement.at.score());
            if round + 1 >= ROUNDS && before - score < SETTLED * self.margin {
                break;
            }
        }
        Some(refinement.at)
    }

    /// What is believed of each parameter before the recording is looked at.
    pub fn sigmas(&self) -> Tangent {
        let mut sigmas = match &self.lens {
            Some(given) => given.sigmas(self.width),
            None => prior_sigmas(self.prior.lens, self.width),
        };
        if let Some(sigma) = self.mount_sigma {
            sigmas.fixed_rows_mut::<3>(ROTATION).fill(sigma);
        }
        sigmas
    }

    fn off_prior(&self, parameters: &Parameters) -> Tangent {
        match self.mount_sigma {
            Some(_) => difference(parameters, &self.prior),
            None => parameters.minus(&self.prior),
        }
    }

    fn cost(&self, parameters: &Parameters, windows: &[Window], noise: &Noise) -> f64 {
        let path = self.path(parameters);
        let off = self.off_prior(parameters).component_div(&self.sigmas());
        // Summed in their order, whichever thread is done first.
        let costs: Vec<f64> = windows.par_iter().map(|w| w.cost(parameters, &path, noise)).collect();
        0.5 * off.norm_squared() + costs.iter().sum::<f64>()
    }

    fn step(&self, at: &Solution, damping: f64, is_clock_held: bool) -> Option<Solution> {
        let (mut h, g, reduced) = self.reduce(&at.parameters, &at.windows, &at.noise, damping)?;
        for p in 0..DIM {
            h[(p, p)] *= 1.0 + damping;
        }
        if is_clock_held {
            h[(OFFSET, OFFSET)] *= HELD;
        }
        let step = h.cholesky()?.solve(&g);
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        let parameters = at.parameters.plus(&step);
        let mut windows = at.windows.clone();
        windows.iter_mut().zip(&reduced).for_each(|(w, r)| w.step(r, &step));
        let cost = self.cost(&parameters, &windows, &at.noise);
        cost.is_finite().then_some(Solution { parameters, windows, cost, ..*at })
    }

    fn reduce(
        &self,
        parameters: &Parameters,
        windows: &[Window],
        noise: &Noise,
        damping: f64,
    ) -> Option<(SMatrix<f64, DIM, DIM>, Tangent, Vec<Reduced>)> {
        let path = self.path(parameters);
        let reduced = windows
            .par_iter()
            .map(|w| w.reduce(parameters, &path, noise, damping))
            .collect::<Option<Vec<Reduced>>>()?;
        let (sigmas, off) = (self.sigmas(), self.off_prior(parameters));
        let mut h = SMatrix::<f64, DIM, DIM>::zeros();
        let mut g = Tangent::zeros();
        for p in 0..DIM {
            h[(p, p)] = 1.0 / (sigmas[p] * sigmas[p]);
            g[p] = -off[p] / (sigmas[p] * sigmas[p]);
        }
        for r in &reduced {
            h += r.hessian;
            g += r.gradient;
        }
        Some((h, g, reduced))
    }

    /// How many times the standard deviation of parameter `p` that the residuals alone give it has.
    pub fn understatement(&self, solution: &Solution, p: usize) -> Option<f64> {
        let [formal, spread] = self.covariances(solution)?;
        let factor = sigma_factor(solution.windows.len(), solution.gyro_noise_ratio());
        Some(factor * (spread[(p, p)] / formal[(p, p)]).sqrt().max(1.0))
    }

    /// Covariance of the parameters: the inverse of the information, and the sandwich of the stretches' own gradients,
    /// which also sees errors that are shared within a stretch (tracking drift, what the model leaves out).
    pub fn covariances(&self, solution: &Solution) -> Option<[SMatrix<f64, DIM, DIM>; 2]> {
        let (h, _, reduced) = self.reduce(&solution.parameters, &solution.windows, &solution.noise, 0.0)?;
        let inverse = h.try_inverse()?;
        let mut spread = SMatrix::<f64, DIM, DIM>::zeros();
        for r in &reduced {
            spread += r.gradient * r.gradient.transpose();
        }
        // A given lens is one gradient more, as uncertain as it is: what is multiplied by the factor later is divided by it here.
        if let Some(given) = &self.lens {
            let factor = sigma_factor(solution.windows.len(), solution.gyro_noise_ratio());
            for (p, sigma) in self.sigmas().iter().enumerate().take(LENS) {
                spread[(p, p)] += (given.weight * sigma / factor / (sigma * sigma)).powi(2);
            }
        }
        Some([inverse, inverse * spread * inverse])
    }
}

/// Factor of standard deviations from the residuals of some stretches, with a gyroscope that many times as noisy as it says.
pub(super) fn sigma_factor(stretches: usize, gyro_noise_ratio: f64) -> f64 {
    SIGMA_FACTOR * (1.0 + FEW_STRETCHES / stretches as f64) * gyro_noise_ratio
}

/// A solution while it is refined.
struct Refinement<'a> {
    problem: &'a Problem<'a>,
    at: Solution,
    is_clock_held: bool,
}

impl LeastSquares for Refinement<'_> {
    type Error = Infallible;
    type Values = Solution;

    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, Solution)>, Infallible> {
        Ok(self.problem.step(&self.at, damping, self.is_clock_held).map(|tried| (tried.cost, tried)))
    }

    fn accept(&mut self, values: Solution) {
        self.at = values;
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        trial.is_accepted && trial.decrease() < 1e-5 * trial.cost_after
    }
}

impl Solution {
    /// How many times the gyroscope's noise images turn otherwise than it says; 1 where that is nothing but noise, or explained as a stabiliser's.
    pub fn gyro_noise_ratio(&self) -> f64 {
        if self.noise.turns.is_stabilised() {
            return 1.0;
        }
        let squares = self.off_turns().map(|(off, sigma)| off.norm_squared() / (3.0 * sigma * sigma));
        let (count, sum) = squares.fold((0, 0.0), |(count, sum), square| (count + 1, sum + square));
        let chi2: f64 = sum / f64::from(count.max(1));
        if chi2 > MAX_DRIFT_CHI2 { chi2.sqrt() } else { 1.0 }
    }

    /// How far a stabiliser moves the images (root mean square of each axis, rad), where there is one.
    pub fn image_shift_rad(&self) -> Option<f64> {
        let nodes = self.windows.iter().flat_map(|window| &window.nodes);
        self.noise.turns.is_stabilised().then(|| rms_per_axis(nodes.map(|node| node.drift)))
    }

    /// Solutions of the same stretches compare by this: the cost grows as the assumed noise shrinks, so the logarithms of the
    /// standard deviations are a part of it.
    pub fn score(&self) -> f64 {
        let observations: usize =
            self.windows.iter().flat_map(|w| &w.points).map(|p| p.observations.len()).sum();
        let turns: f64 = self.off_turns().map(|(_, sigma)| 3.0 * sigma.ln()).sum();
        self.cost + 2.0 * observations as f64 * self.noise.pixel.ln() + turns
    }

    fn off_turns(&self) -> impl Iterator<Item = (Vector3<f64>, f64)> {
        self.windows.iter().flat_map(|window| window.off_turns(&self.noise.turns))
    }
}

/// `a − b` as a tangent, the rotation included.
fn difference(a: &Parameters, b: &Parameters) -> Tangent {
    let mut apart = a.minus(b);
    let turn = b.body_from_camera.inverse() * a.body_from_camera;
    apart.fixed_rows_mut::<3>(ROTATION).copy_from(&turn.log());
    apart
}

/// The best first.
fn in_order(mut solutions: Vec<Solution>) -> Vec<Solution> {
    solutions.sort_by(|a, b| a.score().total_cmp(&b.score()));
    solutions
}

/// Standard deviation per axis from the median of all residuals, pixels.
fn residual_scale(windows: &[Window], parameters: &Parameters, path: &GyroPath) -> Option<f64> {
    let mut all: Vec<f64> = windows
        .iter()
        .flat_map(|w| w.residuals(parameters, path))
        .flat_map(|r| [r.x.abs(), r.y.abs()])
        .collect();
    if all.len() < 50 {
        return None;
    }
    median(&mut all).map(|m| STD_PER_MAD * m)
}

/// Every third stretch and every second point: enough to choose among starts.
fn thinned(windows: &[Window]) -> Vec<Window> {
    let every = if windows.len() >= 9 {
        3
    } else if windows.len() >= 4 {
        2
    } else {
        1
    };
    let mut few: Vec<Window> = windows.iter().step_by(every).cloned().collect();
    for window in &mut few {
        window.points = window.points.iter().step_by(2).cloned().collect();
    }
    few
}
