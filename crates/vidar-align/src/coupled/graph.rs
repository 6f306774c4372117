//! The solver: Levenberg-Marquardt over keyframes and chunks, robust, graduated for loops, with a way back.

use super::factor::{Factor, Variable};
use nalgebra::{DMatrix, SVector, Vector6};
use serde::{Deserialize, Serialize};
use thiserror::Error;
use vidar_core::{LieGroup, Se3, Sim3};
use vidar_solve::levenberg_marquardt::{Decrease, Increase, LeastSquares, Limits, Schedule, Trial, minimise};
use vidar_solve::{Kernel, NormalEquations, SolveError};

/// What is estimated.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CoupledState {
    /// `world_from_camera` of each keyframe, m.
    pub keyframes: Vec<Se3>,
    /// `world_from_chunk` of each chunk.
    pub chunks: Vec<Sim3>,
}

/// When the solver stops and when its result is rejected.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CoupledConfig {
    /// Most iterations of each descent.
    pub max_iterations: usize,
    /// Relative change of cost that ends a descent.
    pub tolerance: f64,
    /// Shoulders of bounded kernels during the graduated descent, as multiples of their own, last 1.
    pub graduation: [f64; 3],
    /// Mean χ² per degree of freedom of the odometry above which the coupled poses are rejected.
    pub max_odometry_chi2: f64,
}

impl Default for CoupledConfig {
    fn default() -> Self {
        Self { max_iterations: 15, tolerance: 1e-6, graduation: [16.0, 4.0, 1.0], max_odometry_chi2: 2.0 }
    }
}

/// Which way information flowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InformationFlow {
    /// Chunks corrected keyframes and keyframes chunks.
    Coupled,
    /// The chunks would have bent the odometry beyond belief: keyframes come from odometry alone, chunks are fitted to them.
    OneWay,
}

/// The estimate with its statistics.
#[derive(Clone, Debug)]
pub struct Solution {
    /// The estimate.
    pub state: CoupledState,
    /// Which way information flowed.
    pub flow: InformationFlow,
    /// Robust cost at the start and at the end.
    pub cost: [f64; 2],
    /// Iterations of all descents.
    pub iterations: usize,
    /// Mean χ² per degree of freedom of the odometry's residuals (1 when its covariance is right).
    pub odometry_chi2: f64,
    /// Weight in [0, 1] that each factor ended with; near 0 where it was let go.
    pub weights: Vec<f64>,
}

/// Why there is no estimate.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum GraphError {
    /// A factor names an unknown that does not exist.
    #[error("factor {factor} touches {what} {index}, there are {count}")]
    OutOfRange {
        /// Which factor.
        factor: usize,
        /// Keyframe or chunk.
        what: &'static str,
        /// Which one.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// A factor's residual is not finite at the start.
    #[error("factor {factor} is not finite at the start")]
    NotFinite {
        /// Which factor.
        factor: usize,
    },
    /// The equations cannot be solved.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

/// Estimates keyframes and chunks from all factors, starting at `start`.
///
/// # Errors
/// [`GraphError`]; a factor that is an outlier is down-weighted by its kernel and is no error.
pub fn solve(
    start: &CoupledState,
    factors: &[Factor],
    config: &CoupledConfig,
) -> Result<Solution, GraphError> {
    check(start, factors)?;
    let all: Vec<&Factor> = factors.iter().collect();
    let (state, iterations) = descend_graduated(start, &all, config)?;
    let odometry_chi2 = odometry_chi2(&state, factors);
    let (state, flow, iterations) = if odometry_chi2 <= config.max_odometry_chi2 {
        (state, InformationFlow::Coupled, iterations)
    } else {
        let (state, more) = one_way(start, factors, config)?;
        (state, InformationFlow::OneWay, iterations + more)
    };
    let weights = factors.iter().map(|f| f.kernel().weight(squared_error(f, &state))).collect();
    let cost = [cost(start, &all, 1.0), cost(&state, &all, 1.0)];
    Ok(Solution { state, flow, cost, iterations, odometry_chi2, weights })
}

/// Keyframes from what is known of them without chunks, then chunks with keyframes held.
fn one_way(
    start: &CoupledState,
    factors: &[Factor],
    config: &CoupledConfig,
) -> Result<(CoupledState, usize), GraphError> {
    let of_keyframes = |f: &&Factor| f.variables().iter().all(|v| matches!(v, Variable::Keyframe(_)));
    let first: Vec<&Factor> = factors.iter().filter(of_keyframes).collect();
    let held: Vec<Factor> = factors.iter().filter(|f| !of_keyframes(f)).cloned().map(hold_keyframe).collect();
    let (state, a) = descend_graduated(start, &first, config)?;
    let (state, b) = descend_graduated(&state, &held.iter().collect::<Vec<_>>(), config)?;
    Ok((state, a + b))
}

fn hold_keyframe(factor: Factor) -> Factor {
    match factor {
        Factor::Attachment(a) => Factor::Attachment(super::Attachment { moves_keyframe: false, ..a }),
        other => other,
    }
}

fn check(state: &CoupledState, factors: &[Factor]) -> Result<(), GraphError> {
    for (factor, f) in factors.iter().enumerate() {
        for variable in f.variables() {
            let (what, index, count) = match variable {
                Variable::Keyframe(i) => ("keyframe", i, state.keyframes.len()),
                Variable::Chunk(k) => ("chunk", k, state.chunks.len()),
            };
            if index >= count {
                return Err(GraphError::OutOfRange { factor, what, index, count });
            }
        }
        if !squared_error(f, state).is_finite() {
            return Err(GraphError::NotFinite { factor });
        }
    }
    Ok(())
}

/// |r|² of a whitened residual; infinite where it does not exist (two rotations half a turn apart).
fn squared_error(factor: &Factor, state: &CoupledState) -> f64 {
    let linear = factor.linearise(&state.keyframes, &state.chunks);
    linear.map_or(f64::INFINITY, |l| l.residual.iter().map(|r| r * r).sum())
}

fn odometry_chi2(state: &CoupledState, factors: &[Factor]) -> f64 {
    let odometry = factors.iter().filter(|f| matches!(f, Factor::Odometry { .. }));
    let (sum, count) =
        odometry.fold((0.0, 0usize), |(sum, count), f| (sum + squared_error(f, state), count + 6));
    if count == 0 { 0.0 } else { sum / count as f64 }
}

/// Bounded kernels are first wide, so that a true loop far from its place still pulls, then narrow, so that a false one
/// does not (graduated non-convexity, Yang 2020).
fn descend_graduated(
    start: &CoupledState,
    factors: &[&Factor],
    config: &CoupledConfig,
) -> Result<(CoupledState, usize), GraphError> {
    let bounded = factors.iter().any(|f| matches!(f.kernel(), Kernel::GemanMcClure { .. }));
    let stages = if bounded { &config.graduation[..] } else { &[1.0] };
    let (mut state, mut total) = (start.clone(), 0);
    for widening in stages {
        let (next, iterations) = descend(state, factors, *widening, config)?;
        state = next;
        total += iterations;
    }
    Ok((state, total))
}

fn kernel_of(factor: &Factor, widening: f64) -> Kernel {
    match factor.kernel() {
        bounded @ Kernel::GemanMcClure { .. } => bounded.widened(widening),
        other => other,
    }
}

fn cost(state: &CoupledState, factors: &[&Factor], widening: f64) -> f64 {
    factors.iter().map(|f| kernel_of(f, widening).loss(squared_error(f, state))).sum()
}

const SCHEDULE: Schedule = Schedule {
    first: 1e-6,
    least: 1e-9,
    on_accepted: Decrease::Factor(0.2),
    on_rejected: Increase { least: 1e-6, ..Increase::by(10.0) },
    on_unsolvable: None,
};
/// A step that does not help is retried shorter; eight times less a million is as good as standing still.
const LIMITS: Limits = Limits { trials_per_iteration: 8, ..Limits::NONE };

fn descend(
    state: CoupledState,
    factors: &[&Factor],
    widening: f64,
    config: &CoupledConfig,
) -> Result<(CoupledState, usize), GraphError> {
    let layout = Layout { keyframes: state.keyframes.len(), touched: touched(&state, factors) };
    if layout.touched.is_empty() {
        return Ok((state, 0));
    }
    let equations = NormalEquations::new(&layout.sizes());
    let cost = cost(&state, factors, widening);
    let mut descent = Descent { state, factors, widening, tolerance: config.tolerance, layout, equations };
    let limits = Limits { iterations: config.max_iterations, ..LIMITS };
    let report = minimise(&mut descent, cost, &SCHEDULE, &limits)?;
    Ok((descent.state, report.iterations))
}

/// The graph while it is solved with kernels of one width.
struct Descent<'a> {
    state: CoupledState,
    factors: &'a [&'a Factor],
    widening: f64,
    tolerance: f64,
    layout: Layout,
    equations: NormalEquations,
}

impl LeastSquares for Descent<'_> {
    type Error = GraphError;
    type Values = CoupledState;

    fn linearise(&mut self, cost: f64) -> Result<f64, GraphError> {
        linearise(&self.state, self.factors, self.widening, &self.layout, &mut self.equations);
        Ok(cost)
    }

    fn try_step(&mut self, lambda: f64) -> Result<Option<(f64, CoupledState)>, GraphError> {
        let step = self.equations.solve(|d| d * (1.0 + lambda) + 1e-9)?;
        let tried = self.layout.moved(&self.state, &step);
        Ok(Some((cost(&tried, self.factors, self.widening), tried)))
    }

    fn improves(&self, cost_before: f64, cost_after: f64) -> bool {
        cost_after <= cost_before
    }

    fn accept(&mut self, state: CoupledState) {
        self.state = state;
    }

    /// Below the second bound only rounding is left.
    fn has_converged(&mut self, trial: &Trial) -> bool {
        let is_small = trial.decrease() <= self.tolerance * trial.cost_before;
        trial.is_accepted && (is_small || trial.cost_after < 1e-18 * self.factors.len() as f64)
    }
}

/// Unknowns that at least one factor moves, in order: keyframes, then chunks.
fn touched(state: &CoupledState, factors: &[&Factor]) -> Vec<Variable> {
    let mut touched: Vec<Variable> = factors
        .iter()
        .filter_map(|f| f.linearise(&state.keyframes, &state.chunks))
        .flat_map(|l| l.jacobians.into_iter().map(|(v, _)| v))
        .collect();
    touched.sort_unstable();
    touched.dedup();
    touched
}

/// Where each unknown stands in the equations.
struct Layout {
    keyframes: usize,
    touched: Vec<Variable>,
}

impl Layout {
    fn size(variable: &Variable) -> usize {
        match variable {
            Variable::Keyframe(_) => 6,
            Variable::Chunk(_) => 7,
        }
    }

    fn sizes(&self) -> Vec<usize> {
        self.touched.iter().map(Self::size).collect()
    }

    fn block(&self, variable: &Variable) -> Option<usize> {
        self.touched.binary_search(variable).ok()
    }

    fn moved(&self, state: &CoupledState, step: &[f64]) -> CoupledState {
        let mut state = state.clone();
        debug_assert_eq!(state.keyframes.len(), self.keyframes);
        let mut at = 0;
        for variable in &self.touched {
            match *variable {
                Variable::Keyframe(i) => {
                    state.keyframes[i] =
                        state.keyframes[i].plus(&Vector6::from_column_slice(&step[at..at + 6]));
                }
                Variable::Chunk(k) => {
                    let delta = SVector::<f64, 7>::from_column_slice(&step[at..at + 7]);
                    state.chunks[k] = state.chunks[k].plus(&delta);
                }
            }
            at += Self::size(variable);
        }
        state
    }
}

fn linearise(
    state: &CoupledState,
    factors: &[&Factor],
    widening: f64,
    layout: &Layout,
    equations: &mut NormalEquations,
) {
    equations.clear();
    for factor in factors {
        let Some(linear) = factor.linearise(&state.keyframes, &state.chunks) else { continue };
        let squared = linear.residual.iter().map(|r| r * r).sum();
        let weight = kernel_of(factor, widening).weight(squared).sqrt();
        let residual: Vec<f64> = linear.residual.iter().map(|r| r * weight).collect();
        let jacobians: Vec<(usize, DMatrix<f64>)> = linear
            .jacobians
            .into_iter()
            .filter_map(|(v, j)| layout.block(&v).map(|block| (block, j * weight)))
            .collect();
        let views: Vec<_> = jacobians.iter().map(|(block, j)| (*block, j.as_view())).collect();
        equations.add(&views, &residual);
    }
}

#[cfg(test)]
mod tests;
