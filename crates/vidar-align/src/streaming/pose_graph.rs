//! The Sim(3) pose graph of the reference: chain edges, loop edges, Levenberg-Marquardt on logarithms.
//!
//! Variables are `gₖ = Log(Xₖ⁻¹)`, Xₖ = chunk 0 from chunk k, changed by addition. Edge (i, j, C): residual
//! `r = Log(C ∘ Exp(gᵢ) ∘ Exp(gⱼ)⁻¹)`, all weights 1, tangents ordered `[τ, φ, σ]` here as in the reference (the rest of
//! VIDAR orders `[φ, τ, σ]`). Jacobians use the reference's truncated series of the left Jacobian:
//! `∂r/∂gᵢ = Jl⁻¹(r) Ad(C) Jl(gᵢ)`, `∂r/∂gⱼ = −Jl⁻¹(r) Ad(C Exp(gᵢ) Exp(gⱼ)⁻¹) Jl(gⱼ)`.
//! The gauge is held by the damping alone; the result is given as relatives, which do not depend on it.
//!
//! This is here to be the reference. The graph VIDAR trusts is the coupled one.

use super::StreamingError;
use nalgebra::{Dyn, Matrix3, SMatrix, SVector, Vector3};
use vidar_core::{LieGroup, Sim3};
use vidar_solve::NormalEquations;
use vidar_solve::levenberg_marquardt::{Decrease, Increase, LeastSquares, Limits, Schedule, Trial, minimise};

type Tangent = SVector<f64, 7>;
type Matrix7 = SMatrix<f64, 7, 7>;

/// When the optimiser stops and how it starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseGraphConfig {
    /// Most iterations, rejected ones counted.
    pub max_iterations: usize,
    /// First damping.
    pub initial_lambda: f64,
}

impl Default for PoseGraphConfig {
    fn default() -> Self {
        Self { max_iterations: 30, initial_lambda: SCHEDULE.first }
    }
}

/// A loop between two chunks of the chain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopConstraint {
    /// The later chunk.
    pub a: usize,
    /// The earlier chunk.
    pub b: usize,
    /// Maps chunk a to chunk b.
    pub b_from_a: Sim3,
}

/// One iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LmStep {
    /// Damping used.
    pub lambda: f64,
    /// Mean square of the residuals' entries before.
    pub cost_before: f64,
    /// The same after the step that was tried.
    pub cost_after: f64,
    /// Whether it was taken.
    pub is_accepted: bool,
}

/// The chain after optimisation.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseGraphOutcome {
    /// "chunk k+1 → chunk k", as many as were given.
    pub previous_from_next: Vec<Sim3>,
    /// Every iteration.
    pub steps: Vec<LmStep>,
}

/// The reference's: an unsolvable system ends it.
const SCHEDULE: Schedule = Schedule {
    first: 1e-6,
    least: 0.0,
    on_accepted: Decrease::Factor(0.5),
    on_rejected: Increase::by(2.0),
    on_unsolvable: None,
};

struct Edge {
    i: usize,
    j: usize,
    j_from_i: Sim3,
}

/// Changes the chain so that loops close.
///
/// # Errors
/// [`StreamingError::BadLoop`] and [`StreamingError::Unsolvable`].
pub fn optimise_chain(
    previous_from_next: &[Sim3],
    loops: &[LoopConstraint],
    config: &PoseGraphConfig,
) -> Result<PoseGraphOutcome, StreamingError> {
    let chunks = previous_from_next.len() + 1;
    if let Some(l) = loops.iter().find(|l| l.a >= chunks || l.b >= chunks || l.a == l.b) {
        return Err(StreamingError::BadLoop { a: l.a, b: l.b, chunks });
    }
    let mut first_from_chunk = vec![Sim3::IDENTITY];
    first_from_chunk.extend(super::accumulate(previous_from_next));
    let logs: Vec<Tangent> = first_from_chunk.iter().map(|x| log(&x.inverse())).collect();
    let chain = previous_from_next.iter().enumerate().map(|(k, s)| Edge { i: k + 1, j: k, j_from_i: *s });
    let loops = loops.iter().map(|l| Edge { i: l.a, j: l.b, j_from_i: l.b_from_a });
    let edges: Vec<Edge> = chain.chain(loops).collect();

    let equations = NormalEquations::new(&vec![7; chunks]);
    let cost = cost(&edges, &logs);
    let mut chain = Chain { edges, logs, equations, steps: Vec::new() };
    let schedule = Schedule { first: config.initial_lambda, ..SCHEDULE };
    minimise(&mut chain, cost, &schedule, &Limits { trials: config.max_iterations, ..Limits::NONE })?;
    let Chain { logs, steps, .. } = chain;
    let optimised: Vec<Sim3> = logs.iter().map(|g| exp(g).inverse()).collect();
    if let Some(k) = optimised.iter().position(|x| !x.is_finite()) {
        return Err(StreamingError::Unsolvable { reason: format!("chunk {k} is not finite") });
    }
    let relatives = optimised.windows(2).map(|x| x[0].inverse() * x[1]).collect();
    Ok(PoseGraphOutcome { previous_from_next: relatives, steps })
}

/// The chain while it is optimised.
struct Chain {
    edges: Vec<Edge>,
    logs: Vec<Tangent>,
    equations: NormalEquations,
    steps: Vec<LmStep>,
}

impl LeastSquares for Chain {
    type Error = StreamingError;
    type Values = Vec<Tangent>;

    fn linearise(&mut self, cost: f64) -> Result<f64, StreamingError> {
        linearise(&self.edges, &self.logs, &mut self.equations);
        Ok(cost)
    }

    fn try_step(&mut self, lambda: f64) -> Result<Option<(f64, Vec<Tangent>)>, StreamingError> {
        let step = match self.equations.solve(|diagonal| diagonal * (1.0 + lambda)) {
            Ok(step) => step,
            // The reference keeps what it has; without a single step there is no solution to keep.
            Err(error) if self.steps.is_empty() => {
                return Err(StreamingError::Unsolvable { reason: error.to_string() });
            }
            Err(_) => return Ok(None),
        };
        let moved = self.logs.iter().zip(step.chunks_exact(7));
        let moved: Vec<Tangent> = moved.map(|(g, d)| g + Tangent::from_column_slice(d)).collect();
        Ok(Some((cost(&self.edges, &moved), moved)))
    }

    fn accept(&mut self, logs: Vec<Tangent>) {
        self.logs = logs;
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        let Trial { damping: lambda, cost_before, cost_after, is_accepted } = *trial;
        self.steps.push(LmStep { lambda, cost_before, cost_after, is_accepted });
        let earlier = self.steps.iter().rev().nth(4);
        cost_before < 1e-5 && earlier.is_some_and(|e| e.cost_before / cost_before < 1.5)
    }
}

fn residual(edge: &Edge, logs: &[Tangent]) -> (Sim3, Tangent) {
    let error = edge.j_from_i * exp(&logs[edge.i]) * exp(&logs[edge.j]).inverse();
    (error, log(&error))
}

fn cost(edges: &[Edge], logs: &[Tangent]) -> f64 {
    let sum: f64 = edges.iter().map(|e| residual(e, logs).1.norm_squared()).sum();
    sum / (7 * edges.len()).max(1) as f64
}

fn linearise(edges: &[Edge], logs: &[Tangent], equations: &mut NormalEquations) {
    equations.clear();
    for edge in edges {
        let (error, r) = residual(edge, logs);
        let left_inverse = left_jacobian_inverse(&r);
        let d_r_d_i = left_inverse * adjoint(&edge.j_from_i) * left_jacobian(&logs[edge.i]);
        let d_r_d_j = -(left_inverse * adjoint(&error) * left_jacobian(&logs[edge.j]));
        equations.add(
            &[(edge.i, d_r_d_i.as_view::<Dyn, Dyn, _, _>()), (edge.j, d_r_d_j.as_view::<Dyn, Dyn, _, _>())],
            r.as_slice(),
        );
    }
}

/// `[τ, φ, σ]` of a similarity.
fn log(x: &Sim3) -> Tangent {
    let v = LieGroup::log(x);
    Tangent::from_column_slice(&[v[3], v[4], v[5], v[0], v[1], v[2], v[6]])
}

/// The similarity of `[τ, φ, σ]`.
fn exp(v: &Tangent) -> Sim3 {
    Sim3::exp(&Tangent::from_column_slice(&[v[3], v[4], v[5], v[0], v[1], v[2], v[6]]))
}

fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// The adjoint map, `[τ, φ, σ]` order.
fn adjoint(x: &Sim3) -> Matrix7 {
    let rotation = x.rotation.matrix();
    let mut a = Matrix7::identity();
    a.fixed_view_mut::<3, 3>(0, 0).copy_from(&(rotation * x.scale));
    a.fixed_view_mut::<3, 3>(0, 3).copy_from(&(hat(&x.translation) * rotation));
    a.fixed_view_mut::<3, 1>(0, 6).copy_from(&-x.translation);
    a.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    a
}

/// The adjoint of a tangent, `[τ, φ, σ]` order.
fn small_adjoint(v: &Tangent) -> Matrix7 {
    let (tau, phi, sigma) = (Vector3::new(v[0], v[1], v[2]), Vector3::new(v[3], v[4], v[5]), v[6]);
    let mut a = Matrix7::zeros();
    a.fixed_view_mut::<3, 3>(0, 0).copy_from(&(hat(&phi) + Matrix3::identity() * sigma));
    a.fixed_view_mut::<3, 3>(0, 3).copy_from(&hat(&tau));
    a.fixed_view_mut::<3, 1>(0, 6).copy_from(&-tau);
    a.fixed_view_mut::<3, 3>(3, 3).copy_from(&hat(&phi));
    a
}

/// `I + X/2 + X²/6 + X³/24 + X⁴/120 + X⁵/720`, as far as the reference goes.
fn left_jacobian(v: &Tangent) -> Matrix7 {
    let x = small_adjoint(v);
    let mut power = Matrix7::identity();
    let mut sum = Matrix7::identity();
    let mut factorial = 1.0;
    for n in 1..=5 {
        power *= x;
        factorial *= f64::from(n + 1);
        sum += power / factorial;
    }
    sum
}

/// `I − X/2 + X²/12 − X⁴/720`.
fn left_jacobian_inverse(v: &Tangent) -> Matrix7 {
    let x = small_adjoint(v);
    let x2 = x * x;
    Matrix7::identity() - x / 2.0 + x2 / 12.0 - x2 * x2 / 720.0
}

#[cfg(test)]
mod tests;
