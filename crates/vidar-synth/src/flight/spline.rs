//! Uniform quintic B-splines of positions and rotations with exact derivatives.
//!
//! Position: `p(u) = Σ B_j(u) c_j` over six control points. Rotation in cumulative form,
//! `R(u) = R_0 · Π_{j=1..5} Exp(λ_j(u) d_j)` with `λ_j = Σ_{m ≥ j} B_m` and `d_j = Log(R_{j−1}⁻¹ R_j)`.
//! Body rate by the recursion of Sommer, Usenko, Schubert, Demmel, Cremers, "Efficient derivative computation for
//! cumulative B-splines on Lie groups", CVPR 2020, eq. 33: `ω_j = Exp(−λ_j d_j) ω_{j−1} + λ̇_j d_j`.
//! Both are four times continuously differentiable in time.

use nalgebra::Vector3;
use vidar_core::{LieGroup, Se3, So3};

/// Control points that act at any instant: a quintic spline has order 6.
pub(crate) const ORDER: usize = 6;

/// Control points before the one whose time begins the segment.
pub(crate) const LEAD: usize = 2;

/// Values and two derivatives by `u` of the six basis functions on one segment.
struct Basis {
    value: [f64; ORDER],
    first: [f64; ORDER],
    second: [f64; ORDER],
}

/// `120 B_j` as polynomials in `u`, coefficients of u⁰…u⁵, for the uniform quintic B-spline.
const QUINTIC: [[f64; ORDER]; ORDER] = [
    [1.0, -5.0, 10.0, -10.0, 5.0, -1.0],
    [26.0, -50.0, 20.0, 20.0, -20.0, 5.0],
    [66.0, 0.0, -60.0, 0.0, 30.0, -10.0],
    [26.0, 50.0, 20.0, -20.0, -20.0, 10.0],
    [1.0, 5.0, 10.0, 10.0, 5.0, -5.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
];

impl Basis {
    fn at(u: f64) -> Self {
        let mut basis = Self { value: [0.0; ORDER], first: [0.0; ORDER], second: [0.0; ORDER] };
        for (j, c) in QUINTIC.iter().enumerate() {
            let (mut value, mut first, mut second) = (0.0, 0.0, 0.0);
            // Horner's scheme for a polynomial and its derivatives at once.
            for &a in c.iter().rev() {
                second = second * u + 2.0 * first;
                first = first * u + value;
                value = value * u + a;
            }
            basis.value[j] = value / 120.0;
            basis.first[j] = first / 120.0;
            basis.second[j] = second / 120.0;
        }
        basis
    }
}

/// What the body does at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightState {
    /// Pose of the body.
    pub world_from_body: Se3,
    /// Velocity of the body's origin in the world, m/s.
    pub velocity_in_world: Vector3<f64>,
    /// Acceleration of the body's origin in the world, m/s² (gravity not included).
    pub acceleration_in_world: Vector3<f64>,
    /// Angular rate of the body relative to the world, in the body frame, rad/s.
    pub angular_rate: Vector3<f64>,
}

/// A pose spline over uniformly spaced control poses.
#[derive(Clone, Debug)]
pub(crate) struct PoseSpline {
    /// Time of control pose 0, s.
    first_secs: f64,
    interval_secs: f64,
    positions: Vec<Vector3<f64>>,
    rotations: Vec<So3>,
    /// `Log(R_j⁻¹ R_{j+1})`.
    steps: Vec<Vector3<f64>>,
}

impl PoseSpline {
    /// A spline whose control pose `k` belongs to time `first_secs + k · interval_secs`; at least [`ORDER`] poses.
    pub(crate) fn new(first_secs: f64, interval_secs: f64, control: &[Se3]) -> Self {
        debug_assert!(control.len() >= ORDER);
        let positions = control.iter().map(|c| c.translation).collect();
        let rotations: Vec<So3> = control.iter().map(|c| c.rotation).collect();
        // Equal rotations step by exactly nothing, where the logarithm of `R⁻¹ R` would leave rounding.
        let step = |w: &[So3]| if w[0] == w[1] { Vector3::zeros() } else { w[1].minus(&w[0]) };
        let steps = rotations.windows(2).map(step).collect();
        Self { first_secs, interval_secs, positions, rotations, steps }
    }

    /// A spline that passes through `poses` at their times (up to `iterations` of refinement), except at the ends.
    ///
    /// Control poses are moved by the error at their own time, which converges for every frequency below Nyquist
    /// (the smallest eigenvalue of the sampled quintic basis is 16/120). Poses before `fixed` are not moved, so that
    /// a body at rest stays exactly at rest.
    pub(crate) fn through(
        first_secs: f64,
        interval_secs: f64,
        poses: &[Se3],
        fixed: usize,
        iterations: usize,
    ) -> Self {
        let mut control = poses.to_vec();
        let mut spline = Self::new(first_secs, interval_secs, &control);
        for _ in 0..iterations {
            let from = fixed.max(LEAD + 1);
            let until = poses.len().saturating_sub(ORDER - LEAD);
            for k in from..until {
                let now = spline.state(first_secs + k as f64 * interval_secs).world_from_body;
                control[k].translation += poses[k].translation - now.translation;
                control[k].rotation = control[k].rotation.plus(&poses[k].rotation.minus(&now.rotation));
            }
            spline = Self::new(first_secs, interval_secs, &control);
        }
        spline
    }

    /// The state at `secs`; outside the control poses the nearest segment is continued.
    pub(crate) fn state(&self, secs: f64) -> FlightState {
        let at = (secs - self.first_secs) / self.interval_secs - LEAD as f64;
        let last = (self.positions.len() - ORDER) as f64;
        let segment = at.floor().clamp(0.0, last);
        let (i, u) = (segment as usize, at - segment);
        let basis = Basis::at(u);
        let rate = 1.0 / self.interval_secs;
        let mut position = Vector3::zeros();
        let mut velocity = Vector3::zeros();
        let mut acceleration = Vector3::zeros();
        // Differences to the first control point keep a body at rest at rest to the last bit.
        let anchor = self.positions[i];
        for j in 1..ORDER {
            let c = self.positions[i + j] - anchor;
            position += c * basis.value[j];
            velocity += c * (basis.first[j] * rate);
            acceleration += c * (basis.second[j] * rate * rate);
        }
        let mut rotation = self.rotations[i];
        let mut angular_rate = Vector3::zeros();
        for j in 1..ORDER {
            let d = self.steps[i + j - 1];
            let lambda: f64 = basis.value[j..].iter().sum();
            let lambda_rate: f64 = basis.first[j..].iter().sum::<f64>() * rate;
            let turn = So3::exp(&(d * lambda));
            rotation = rotation * turn;
            angular_rate = turn.inverse() * angular_rate + d * lambda_rate;
        }
        FlightState {
            world_from_body: Se3::new(rotation, anchor + position),
            velocity_in_world: velocity,
            acceleration_in_world: acceleration,
            angular_rate,
        }
    }
}
