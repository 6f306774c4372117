//! Inertial factors: preintegrated motion between neighbouring frames, standstill, and the anchor of the first frame.

use crate::imu::{Matrix15, NavState, Preintegration, Rates, Vector15, hat};
use nalgebra::{Matrix3, SMatrix, Vector3};
use serde::{Deserialize, Serialize};
use vidar_core::{LieGroup, So3};

pub(crate) type Matrix9 = SMatrix<f64, 9, 9>;

/// Whitening of the inertial factor: the inverse Cholesky factor of the 9×9 covariance and the weights of the walks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Whitening {
    pub(crate) motion: Matrix9,
    pub(crate) gyro_walk: f64,
    pub(crate) accel_walk: f64,
}

impl Whitening {
    pub(crate) fn of(preintegration: &Preintegration) -> Self {
        let model = preintegration.model();
        let root_t = preintegration.secs().max(1e-9).sqrt();
        // A floor keeps exact test data and empty stretches invertible.
        let mut covariance = preintegration.covariance();
        for k in 0..9 {
            covariance[(k, k)] += 1e-18;
        }
        let motion = covariance
            .cholesky()
            .and_then(|c| c.l().try_inverse())
            .unwrap_or_else(|| Matrix9::identity() * 1e-3);
        Self {
            motion,
            gyro_walk: 1.0 / (model.gyro_walk * root_t),
            accel_walk: 1.0 / (model.accel_walk * root_t),
        }
    }

    /// Whitens 15 rows of any width in place: rotation, position, velocity, gyroscope and accelerometer bias.
    pub(crate) fn apply<const C: usize>(&self, rows: &SMatrix<f64, 15, C>) -> SMatrix<f64, 15, C> {
        let mut out = SMatrix::<f64, 15, C>::zeros();
        out.fixed_view_mut::<9, C>(0, 0).copy_from(&(self.motion * rows.fixed_view::<9, C>(0, 0)));
        out.fixed_view_mut::<3, C>(9, 0).copy_from(&(rows.fixed_view::<3, C>(9, 0) * self.gyro_walk));
        out.fixed_view_mut::<3, C>(12, 0).copy_from(&(rows.fixed_view::<3, C>(12, 0) * self.accel_walk));
        out
    }
}

/// How much later than the IMU measurements' first and last instant the two states are, s: the present estimate of the clock offset
/// minus its estimate when the IMU measurements were cut.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Shift {
    pub(crate) begin: f64,
    pub(crate) end: f64,
}

impl Shift {
    #[cfg(test)]
    pub(crate) const NONE: Self = Self { begin: 0.0, end: 0.0 };

    fn is_none(self) -> bool {
        self.begin == 0.0 && self.end == 0.0
    }
}

/// Motion over a stretch, gravity left out: an element of the group whose product is [`MotionIncrement::then`].
#[derive(Clone, Copy, Debug)]
struct MotionIncrement {
    secs: f64,
    turn: So3,
    position: Vector3<f64>,
    velocity: Vector3<f64>,
}

impl MotionIncrement {
    /// At constant rates; `secs` may be negative.
    fn at(rates: &Rates, secs: f64) -> Self {
        Self {
            secs,
            turn: So3::exp(&(rates.turn * secs)),
            position: rates.force * (0.5 * secs * secs),
            velocity: rates.force * secs,
        }
    }

    fn then(&self, next: &Self) -> Self {
        Self {
            secs: self.secs + next.secs,
            turn: self.turn * next.turn,
            position: self.position + self.velocity * next.secs + self.turn * next.position,
            velocity: self.velocity + self.turn * next.velocity,
        }
    }
}

/// The IMU measurements' motion as integrated, and before and after it what the shift takes off or adds.
fn moved(preintegration: &Preintegration, i: &NavState, shift: Shift) -> [MotionIncrement; 3] {
    let (turn, position, velocity) = preintegration.corrected(&i.bias);
    let [first, last] = preintegration.ends();
    let integrated = MotionIncrement { secs: preintegration.secs(), turn, position, velocity };
    [MotionIncrement::at(&first, -shift.begin), integrated, MotionIncrement::at(&last, shift.end)]
}

fn whole([before, integrated, after]: &[MotionIncrement; 3], shift: Shift) -> MotionIncrement {
    if shift.is_none() { *integrated } else { before.then(&integrated.then(after)) }
}

/// Residual between two states, in the order of the error state:
/// `r_θ = Log(ΔR(b)ᵀ R_iᵀ R_j)`, `r_p = R_iᵀ(p_j − p_i − v_i t − ½ g t²) − Δp(b)`,
/// `r_v = R_iᵀ(v_j − v_i − g t) − Δv(b)`, `r_b = b_j − b_i` (Forster 2017, eq. 45).
///
/// With clocks that are off, Δ is the motion between the shifted instants: `E(−s_i) · Δ · E(s_j)`, where E is motion at the
/// rates that the IMU measurements show at their ends. The states stay those of the images' true instants, so the images' factors
/// know nothing of clocks, and shift and heading stay free.
pub(crate) fn residual(
    preintegration: &Preintegration,
    i: &NavState,
    j: &NavState,
    shift: Shift,
) -> Vector15 {
    let delta = whole(&moved(preintegration, i, shift), shift);
    let t = delta.secs;
    let (from, to) = (&i.world_from_body, &j.world_from_body);
    let back = from.rotation.inverse();
    let gravity = preintegration.model().gravity();
    let turn = (delta.turn.inverse() * (back * to.rotation)).log();
    let moved = back * (to.translation - from.translation - i.velocity * t - gravity * (0.5 * t * t));
    let sped = back * (j.velocity - i.velocity - gravity * t);
    let mut r = Vector15::zeros();
    r.fixed_rows_mut::<3>(0).copy_from(&turn);
    r.fixed_rows_mut::<3>(3).copy_from(&(moved - delta.position));
    r.fixed_rows_mut::<3>(6).copy_from(&(sped - delta.velocity));
    r.fixed_rows_mut::<3>(9).copy_from(&(j.bias.gyro - i.bias.gyro));
    r.fixed_rows_mut::<3>(12).copy_from(&(j.bias.accel - i.bias.accel));
    r
}

/// Derivatives of [`residual`] by the error states of both ends.
pub(crate) fn jacobians(
    preintegration: &Preintegration,
    i: &NavState,
    j: &NavState,
    shift: Shift,
) -> (Matrix15, Matrix15) {
    let delta = &preintegration.delta;
    let parts = moved(preintegration, i, shift);
    let all = whole(&parts, shift);
    let [before, _, after] = &parts;
    let t = all.secs;
    let (from, to) = (&i.world_from_body, &j.world_from_body);
    let back = from.rotation.inverse();
    let back_m = back.matrix();
    let turn = (all.turn.inverse() * (back * to.rotation)).log();
    let log_slope = So3::right_jacobian_inverse(&turn).unwrap_or_else(Matrix3::identity);
    let d_gyro = i.bias.gyro - preintegration.bias().gyro;
    let turn_by_gyro: Matrix3<f64> = delta.by_gyro_bias.fixed_view::<3, 3>(0, 0).into_owned();
    let gravity = preintegration.model().gravity();
    let moved = back * (to.translation - from.translation - i.velocity * t - gravity * (0.5 * t * t));
    let sped = back * (j.velocity - i.velocity - gravity * t);
    let (mut by_i, mut by_j) = (Matrix15::zeros(), Matrix15::zeros());
    let put = |m: &mut Matrix15, row: usize, col: usize, value: Matrix3<f64>| {
        m.fixed_view_mut::<3, 3>(row, col).copy_from(&value);
    };
    put(&mut by_i, 0, 0, -log_slope * (to.rotation.inverse() * from.rotation).matrix());
    // The integrated motion's own error, turned on its right side.
    let own_turn = So3::right_jacobian(&(turn_by_gyro * d_gyro)) * turn_by_gyro;
    let after_turn = after.turn.matrix().transpose();
    put(&mut by_i, 0, 9, -log_slope * So3::exp(&-turn).matrix() * after_turn * own_turn);
    put(&mut by_j, 0, 0, log_slope);
    put(&mut by_i, 3, 0, hat(&moved));
    put(&mut by_i, 3, 3, -back_m);
    put(&mut by_i, 3, 6, back_m * -t);
    put(&mut by_j, 3, 3, back_m);
    put(&mut by_i, 6, 0, hat(&sped));
    put(&mut by_i, 6, 6, -back_m);
    put(&mut by_j, 6, 6, back_m);
    let before_turn = before.turn.matrix();
    let turned = parts[1].turn.matrix();
    for (col, by, by_turn) in
        [(9, &delta.by_gyro_bias, own_turn), (12, &delta.by_accel_bias, Matrix3::zeros())]
    {
        let (position, velocity) = (by.fixed_view::<3, 3>(3, 0), by.fixed_view::<3, 3>(6, 0));
        let position = position + velocity * after.secs - turned * hat(&after.position) * by_turn;
        let velocity = velocity - turned * hat(&after.velocity) * by_turn;
        put(&mut by_i, 3, col, -(before_turn * position));
        put(&mut by_i, 6, col, -(before_turn * velocity));
    }
    for row in [9, 12] {
        put(&mut by_i, row, row, -Matrix3::identity());
        put(&mut by_j, row, row, Matrix3::identity());
    }
    (by_i, by_j)
}

/// What derivatives of [`residual`] by shifts need: the motion from the first instant on, that of all, what the states' turn is beyond it, and the slope of
/// its logarithm.
struct ShiftedTurn {
    rest: MotionIncrement,
    all: MotionIncrement,
    beyond: So3,
    log_slope: Matrix3<f64>,
}

impl ShiftedTurn {
    fn new([before, integrated, after]: &[MotionIncrement; 3], i: &NavState, j: &NavState) -> Self {
        let rest = integrated.then(after);
        let all = before.then(&rest);
        let back = i.world_from_body.rotation.inverse();
        let beyond = all.turn.inverse() * (back * j.world_from_body.rotation);
        let log_slope = So3::right_jacobian_inverse(&beyond.log()).unwrap_or_else(Matrix3::identity);
        Self { rest, all, beyond, log_slope }
    }

    /// Of the rotation's residual, where the motion turns on by `d_turn` at its end.
    fn by(&self, d_turn: Vector3<f64>) -> Vector3<f64> {
        -(self.log_slope * (self.beyond.inverse() * d_turn))
    }
}

/// Derivative of [`residual`] by the clock offset, which shifts both ends alike.
pub(crate) fn by_time_offset(
    preintegration: &Preintegration,
    i: &NavState,
    j: &NavState,
    shift: Shift,
) -> Vector15 {
    let parts = moved(preintegration, i, shift);
    let [before, integrated, _] = &parts;
    let [first, last] = preintegration.ends();
    let shifted = ShiftedTurn::new(&parts, i, j);
    let rest = &shifted.rest;
    let d_turn = last.turn - rest.turn.inverse() * first.turn;
    let d_velocity =
        -first.force + before.turn * (integrated.turn * last.force - first.turn.cross(&rest.velocity));
    let d_rest_position = integrated.velocity + integrated.turn * (last.force * shift.end);
    let d_position = first.force * shift.begin - first.force * rest.secs
        + before.velocity
        + before.turn * (d_rest_position - first.turn.cross(&rest.position));
    let mut by = Vector15::zeros();
    by.fixed_rows_mut::<3>(0).copy_from(&shifted.by(d_turn));
    by.fixed_rows_mut::<3>(3).copy_from(&-d_position);
    by.fixed_rows_mut::<3>(6).copy_from(&-d_velocity);
    by
}

/// Derivatives of [`residual`] by the shifts of the first and of the last instant. Their sum is [`by_time_offset`], in which the length of the stretch
/// drops out.
pub(crate) fn by_ends(
    preintegration: &Preintegration,
    i: &NavState,
    j: &NavState,
    shift: Shift,
) -> [Vector15; 2] {
    let parts = moved(preintegration, i, shift);
    let [before, integrated, _] = &parts;
    let [first, last] = preintegration.ends();
    let shifted = ShiftedTurn::new(&parts, i, j);
    let (rest, all) = (&shifted.rest, &shifted.all);
    let back = i.world_from_body.rotation.inverse();
    let gravity = preintegration.model().gravity();
    // Of the states' part of the residual by the length of the stretch.
    let moved = -(back * (i.velocity + gravity * all.secs));
    let sped = -(back * gravity);
    let by = |d_turn: Vector3<f64>, d_position: Vector3<f64>, d_velocity: Vector3<f64>, d_secs: f64| {
        let mut by = Vector15::zeros();
        by.fixed_rows_mut::<3>(0).copy_from(&shifted.by(d_turn));
        by.fixed_rows_mut::<3>(3).copy_from(&(moved * d_secs - d_position));
        by.fixed_rows_mut::<3>(6).copy_from(&(sped * d_secs - d_velocity));
        by
    };
    let begin = by(
        -(rest.turn.inverse() * first.turn),
        first.force * (shift.begin - rest.secs) - before.turn * first.turn.cross(&rest.position),
        -first.force - before.turn * first.turn.cross(&rest.velocity),
        -1.0,
    );
    let d_rest_position = integrated.velocity + integrated.turn * (last.force * shift.end);
    let end = by(
        last.turn,
        before.velocity + before.turn * d_rest_position,
        before.turn * (integrated.turn * last.force),
        1.0,
    );
    [begin, end]
}

/// Velocity in the body's axes, the residual of standstill, with its derivatives by rotation and velocity.
/// The body's axes keep the factor blind to yaw.
pub(crate) fn body_velocity(state: &NavState) -> (Vector3<f64>, Matrix3<f64>, Matrix3<f64>) {
    let back = state.world_from_body.rotation.inverse();
    let velocity = back * state.velocity;
    (velocity, hat(&velocity), back.matrix())
}

/// What is known of the first state. `f64::INFINITY` says that nothing is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GaugePriorSigmas {
    /// Position in the world, m per axis. Fixes the freedom of the world's origin.
    pub position_m: f64,
    /// Heading about the vertical, rad. Fixes the freedom of the world's heading.
    pub yaw_rad: f64,
    /// Inclination, rad per axis.
    pub tilt_rad: f64,
    /// Velocity, m/s per axis.
    pub velocity_mps: f64,
    /// Gyroscope bias, rad/s per axis.
    pub gyro_bias: f64,
    /// Accelerometer bias, m/s² per axis.
    pub accel_bias: f64,
}

impl GaugePriorSigmas {
    /// Origin and heading fixed, everything else as good as unknown; biases as MEMS parts have them.
    pub const GAUGE: Self = Self {
        position_m: 1e-3,
        yaw_rad: 1e-3,
        tilt_rad: f64::INFINITY,
        velocity_mps: f64::INFINITY,
        gyro_bias: 0.1,
        accel_bias: 0.2,
    };
}

/// The anchor's residual at `state` and derivative at `at`, whitened. Every row but position and yaw is blind to shifts
/// and to yaw.
pub(crate) fn gauge_prior_at(
    reference: &NavState,
    sigmas: &GaugePriorSigmas,
    state: &NavState,
    at: &NavState,
) -> (Vector15, SMatrix<f64, 15, 15>) {
    let weight = |sigma: f64| if sigma.is_finite() && sigma > 0.0 { 1.0 / sigma } else { 0.0 };
    let up = Vector3::z();
    let (mut r, mut j) = (Vector15::zeros(), Matrix15::zeros());
    // Position, rows 0–2.
    let w = weight(sigmas.position_m);
    r.fixed_rows_mut::<3>(0)
        .copy_from(&((state.world_from_body.translation - reference.world_from_body.translation) * w));
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * w));
    // Yaw, row 3: vertical part of the rotation vector in the world.
    let w = weight(sigmas.yaw_rad);
    let turned =
        |s: &NavState| (s.world_from_body.rotation * reference.world_from_body.rotation.inverse()).log();
    r[3] = up.dot(&turned(state)) * w;
    let log_slope = So3::right_jacobian_inverse(&-turned(at)).unwrap_or_else(Matrix3::identity);
    let yaw_row = up.transpose() * log_slope * at.world_from_body.rotation.matrix() * w;
    j.fixed_view_mut::<1, 3>(3, 0).copy_from(&yaw_row);
    // Inclination, rows 4–5: the vertical seen from the body.
    let w = weight(sigmas.tilt_rad);
    let vertical = |s: &NavState| s.world_from_body.rotation.inverse() * up;
    let basis = super::visual::tangent_basis(&vertical(reference));
    r.fixed_rows_mut::<2>(4).copy_from(&(basis.transpose() * vertical(state) * w));
    j.fixed_view_mut::<2, 3>(4, 0).copy_from(&(basis.transpose() * hat(&vertical(at)) * w));
    // Velocity in the body's axes, rows 6–8.
    let w = weight(sigmas.velocity_mps);
    let (velocity, ..) = body_velocity(state);
    let (_, by_rotation, by_velocity) = body_velocity(at);
    let (expected, ..) = body_velocity(reference);
    r.fixed_rows_mut::<3>(6).copy_from(&((velocity - expected) * w));
    j.fixed_view_mut::<3, 3>(6, 0).copy_from(&(by_rotation * w));
    j.fixed_view_mut::<3, 3>(6, 6).copy_from(&(by_velocity * w));
    // Biases, rows 9–14.
    for (row, sigma, difference) in [
        (9, sigmas.gyro_bias, state.bias.gyro - reference.bias.gyro),
        (12, sigmas.accel_bias, state.bias.accel - reference.bias.accel),
    ] {
        let w = weight(sigma);
        r.fixed_rows_mut::<3>(row).copy_from(&(difference * w));
        j.fixed_view_mut::<3, 3>(row, row).copy_from(&(Matrix3::identity() * w));
    }
    (r, j)
}
