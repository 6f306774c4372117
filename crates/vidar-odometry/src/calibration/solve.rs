//! Joint refinement over all stretches, from several starts, with standard deviations.

use super::parameters::{DIM, Parameters, Tangent, prior_sigmas};
use super::path::GyroPath;
use super::window::{Noise, Reduced, Window};
use crate::gyro_alignment::RateSample;
use nalgebra::SMatrix;
use vidar_solve::statistics::{STD_PER_MAD, median};

/// Rounds of scale estimation, and steps in each.
const COARSE: (usize, usize) = (5, 4);
const FINE: (usize, usize) = (5, 6);
/// Starts that are refined.
const MAX_STARTS: usize = 8;

/// Standard deviation of a measured pixel: bounds of what the residuals say, pixels. Below, rounding of grey levels and
/// the patch model err; above, the model does not fit.
const PIXEL_SIGMA: (f64, f64) = (0.1, 12.0);

/// Samples, stretches and what is believed of them.
pub(super) struct Problem<'a> {
    pub samples: &'a [RateSample],
    pub width: f64,
    pub prior: Parameters,
    pub gyro_noise: f64,
}

/// A solution.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    pub parameters: Parameters,
    pub windows: Vec<Window>,
    pub cost: f64,
    pub noise: Noise,
}

impl Problem<'_> {
    fn path(&self, parameters: &Parameters) -> GyroPath {
        GyroPath::new(self.samples, &parameters.bias, &parameters.scale)
    }

    /// Refines from each start on few stretches, then from the best on all. `None` where nothing converges.
    pub fn solve(&self, starts: &[Parameters], windows: &[Window]) -> Option<Solution> {
        let few: Vec<Window> = thinned(windows);
        let mut best: Option<Solution> = None;
        for start in starts.iter().take(MAX_STARTS) {
            let Some(found) = self.refine(start, &few, COARSE) else { continue };
            if best.as_ref().is_none_or(|b| found.score() < b.score()) {
                best = Some(found);
            }
        }
        self.refine(&best?.parameters, windows, FINE)
    }

    /// Levenberg-Marquardt with the pixel noise estimated anew from the residuals in each round.
    fn refine(&self, start: &Parameters, windows: &[Window], rounds: (usize, usize)) -> Option<Solution> {
        let mut parameters = *start;
        let mut windows = windows.to_vec();
        for window in &mut windows {
            window.restart(&parameters, &self.path(&parameters));
        }
        let mut noise = Noise { pixel: PIXEL_SIGMA.1, gyro: self.gyro_noise };
        let mut damping = 1e-3;
        let mut cost = f64::INFINITY;
        for round in 0..rounds.0 {
            let path = self.path(&parameters);
            // The scale falls by at most four a round, so that the kernel does not close round a wrong start.
            let scale = residual_scale(&windows, &parameters, &path)?.clamp(PIXEL_SIGMA.0, PIXEL_SIGMA.1);
            noise.pixel = if round == 0 { (2.0 * scale).max(1.0) } else { scale };
            cost = self.cost(&parameters, &windows, &noise);
            for _ in 0..rounds.1 {
                let Some((next, moved, there)) = self.step(&parameters, &windows, &noise, damping) else {
                    damping *= 10.0;
                    continue;
                };
                if there < cost {
                    let gain = cost - there;
                    (parameters, windows, cost) = (next, moved, there);
                    damping = (damping * 0.2).max(1e-9);
                    if gain < 1e-5 * cost {
                        break;
                    }
                } else {
                    damping = (damping * 10.0).min(1e6);
                }
            }
        }
        Some(Solution { parameters, windows, cost, noise })
    }

    fn cost(&self, parameters: &Parameters, windows: &[Window], noise: &Noise) -> f64 {
        let path = self.path(parameters);
        let off = parameters.minus(&self.prior).component_div(&prior_sigmas(self.width));
        0.5 * off.norm_squared() + windows.iter().map(|w| w.cost(parameters, &path, noise)).sum::<f64>()
    }

    fn step(
        &self,
        parameters: &Parameters,
        windows: &[Window],
        noise: &Noise,
        damping: f64,
    ) -> Option<(Parameters, Vec<Window>, f64)> {
        let (mut h, mut g, reduced) = self.reduce(parameters, windows, noise, damping)?;
        for p in 0..DIM {
            h[(p, p)] *= 1.0 + damping;
        }
        let step = h.cholesky()?.solve(&g);
        g = step;
        if !g.iter().all(|v| v.is_finite()) {
            return None;
        }
        let next = parameters.plus(&g);
        let mut moved = windows.to_vec();
        moved.iter_mut().zip(&reduced).for_each(|(w, r)| w.step(r, &g));
        let cost = self.cost(&next, &moved, noise);
        cost.is_finite().then_some((next, moved, cost))
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
            .iter()
            .map(|w| w.reduce(parameters, &path, noise, damping))
            .collect::<Option<Vec<Reduced>>>()?;
        let sigmas = prior_sigmas(self.width);
        let off = parameters.minus(&self.prior);
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

    /// Covariance of the parameters: the inverse of the information, and the sandwich of the stretches' own gradients,
    /// which also sees errors that are shared within a stretch (tracking drift, what the model leaves out).
    pub fn covariances(&self, solution: &Solution) -> Option<[SMatrix<f64, DIM, DIM>; 2]> {
        let (h, _, reduced) = self.reduce(&solution.parameters, &solution.windows, &solution.noise, 0.0)?;
        let inverse = h.try_inverse()?;
        let mut spread = SMatrix::<f64, DIM, DIM>::zeros();
        for r in &reduced {
            spread += r.gradient * r.gradient.transpose();
        }
        Some([inverse, inverse * spread * inverse])
    }
}

impl Solution {
    /// Solutions of the same stretches compare by this: the cost grows as the assumed noise shrinks, so the logarithm of the
    /// noise is a part of it.
    fn score(&self) -> f64 {
        let observations: usize =
            self.windows.iter().flat_map(|w| &w.points).map(|p| p.observations.len()).sum();
        self.cost + 2.0 * observations as f64 * self.noise.pixel.ln()
    }
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
