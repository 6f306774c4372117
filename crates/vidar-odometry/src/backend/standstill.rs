//! A body that stands still: its pose is that of the frame before, and one frame may stand for the whole rest.

use super::prior::Part;
use super::system::System;
use super::{MarginalisationReport, Smoother, SmootherError};
use crate::imu::NavState;
use nalgebra::{Matrix3, Matrix6, Vector6};
use vidar_core::{FrameId, LieGroup, So3};

/// How well a pose is known to be that of the frame before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ZeroMotionFactor {
    position_m: f64,
    rotation_rad: f64,
}

impl ZeroMotionFactor {
    fn weights(&self) -> Vector6<f64> {
        let (r, p) = (1.0 / self.rotation_rad, 1.0 / self.position_m);
        Vector6::new(r, r, r, p, p, p)
    }

    /// Whitened `r_θ = Log(R_iᵀ R_j)`, `r_p = R_iᵀ (p_j − p_i)`: in the axes of the earlier body, blind to yaw and shifts.
    pub(crate) fn residual(&self, i: &NavState, j: &NavState) -> Vector6<f64> {
        let moved = i.world_from_body.inverse() * j.world_from_body;
        let (turn, shift) = (moved.rotation.log(), moved.translation);
        Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z).component_mul(&self.weights())
    }

    /// Whitened derivatives of [`ZeroMotionFactor::residual`] by the pose steps of both.
    pub(crate) fn jacobians(&self, i: &NavState, j: &NavState) -> (Matrix6<f64>, Matrix6<f64>) {
        let (from, to) = (&i.world_from_body, &j.world_from_body);
        let back = from.rotation.inverse();
        let turn = (back * to.rotation).log();
        let shift = back * (to.translation - from.translation);
        let log_slope = So3::right_jacobian_inverse(&turn).unwrap_or_else(Matrix3::identity);
        let (mut by_i, mut by_j) = (Matrix6::zeros(), Matrix6::zeros());
        let back_turn = (to.rotation.inverse() * from.rotation).matrix();
        by_i.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-log_slope * back_turn));
        by_j.fixed_view_mut::<3, 3>(0, 0).copy_from(&log_slope);
        by_i.fixed_view_mut::<3, 3>(3, 0).copy_from(&crate::imu::hat(&shift));
        by_i.fixed_view_mut::<3, 3>(3, 3).copy_from(&-back.matrix());
        by_j.fixed_view_mut::<3, 3>(3, 3).copy_from(&back.matrix());
        let weights = Matrix6::from_diagonal(&self.weights());
        (weights * by_i, weights * by_j)
    }
}

impl Smoother {
    /// Says that the body has not moved since the frame before this one, up to `position_m` and `rotation_rad` per axis.
    ///
    /// # Errors
    /// A frame that the window does not hold.
    pub fn add_zero_motion(
        &mut self,
        id: FrameId,
        position_m: f64,
        rotation_rad: f64,
    ) -> Result<(), SmootherError> {
        let at = self.index(id)?;
        self.system.factorised = false;
        let useful = [position_m, rotation_rad].iter().all(|s| *s > 0.0 && s.is_finite());
        self.frames[at].zero_motion = useful.then_some(ZeroMotionFactor { position_m, rotation_rad });
        Ok(())
    }

    /// The newest frame, which rests on the one before ([`Smoother::add_zero_motion`]), becomes one with it: what its IMU measurements
    /// say of biases and inclination goes into the prior, and the frame before takes its time, velocity and biases (which
    /// walked on while the body rested). A rest of any length is held by two frames this way. Its name; `None` when the newest frame does not rest.
    ///
    /// # Errors
    /// None that an own frame could cause.
    pub fn fold_standstill(
        &mut self,
        marginalisation: &mut MarginalisationReport,
    ) -> Result<Option<FrameId>, SmootherError> {
        let Some([before, newest]) = self.frames.last_chunk::<2>() else { return Ok(None) };
        if newest.zero_motion.is_none() {
            return Ok(None);
        }
        let (time, clock_secs, stays) = (newest.time, newest.clock_secs, before.id);
        let gone = self.frames.len() - 1;
        self.eliminate(gone, gone - 1, marginalisation);
        self.inherit_motion(gone);
        self.remove_newest();
        if let Some(frame) = self.frames.last_mut() {
            frame.time = time;
            frame.clock_secs = clock_secs;
        }
        Ok(Some(stays))
    }

    /// The frame before `gone` has the motion of `gone` from now on, in the prior too; all that was said of its own motion
    /// is in the prior.
    fn inherit_motion(&mut self, gone: usize) {
        let (left, right) = self.frames.split_at_mut(gone);
        let (Some(before), Some(newest)) = (left.last_mut(), right.first()) else { return };
        for (to, from) in [(&mut before.state, &newest.state), (&mut before.linearised, &newest.linearised)] {
            to.velocity = from.velocity;
            to.bias = from.bias;
        }
        before.step.fixed_rows_mut::<9>(6).copy_from(&newest.step.fixed_rows::<9>(6));
        before.motion_in_prior = newest.motion_in_prior;
        before.delay = newest.delay;
        before.image_shift = newest.image_shift;
        before.standstill_sigma = None;
        self.spare.extend(before.imu_factor.take().map(|imu_factor| imu_factor.preintegration));
        self.gauge_prior = self.gauge_prior.filter(|a| a.frame + 1 != gone);
        for part in &mut self.prior.parts {
            match part {
                Part::Motion(k) | Part::Delay(k) | Part::ImageShift(k) if *k == gone => *k = gone - 1,
                _ => {}
            }
        }
    }

    pub(crate) fn add_rest_factor(&self, system: &mut System, k: usize) -> f64 {
        let Some(zero_motion) = self.frames[k].zero_motion.filter(|_| k > 0) else { return 0.0 };
        let r = zero_motion.residual(&self.frames[k - 1].state, &self.frames[k].state);
        let (ji, jj) = zero_motion.jacobians(&system.states_at[k - 1], &system.states_at[k]);
        let (i, j) = (system.offset(Part::Pose(k - 1)), system.offset(Part::Pose(k)));
        system.add(i, i, &(ji.transpose() * ji), 1.0);
        system.add(j, i, &(jj.transpose() * ji), 1.0);
        system.add(j, j, &(jj.transpose() * jj), 1.0);
        system.add_gradient(i, &(ji.transpose() * r), 1.0);
        system.add_gradient(j, &(jj.transpose() * r), 1.0);
        0.5 * r.norm_squared()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::Se3;

    fn at(turn: [f64; 3], place: [f64; 3]) -> NavState {
        let world_from_body = Se3::new(So3::exp(&Vector3::from(turn)), Vector3::from(place));
        NavState { world_from_body, ..NavState::REST }
    }

    #[test]
    fn the_jacobians_are_the_numeric_ones() {
        let zero_motion = ZeroMotionFactor { position_m: 0.5, rotation_rad: 0.2 };
        let states = [at([0.3, -0.2, 0.5], [1.0, 2.0, -0.5]), at([0.35, -0.1, 0.45], [1.2, 1.9, -0.4])];
        let (by_i, by_j) = zero_motion.jacobians(&states[0], &states[1]);
        for (which, analytic) in [(0, by_i), (1, by_j)] {
            for k in 0..6 {
                let moved = |h: f64| {
                    let mut s = states;
                    let pose = &mut s[which].world_from_body;
                    let mut d = [0.0; 6];
                    d[k] = h;
                    pose.rotation = pose.rotation * So3::exp(&Vector3::new(d[0], d[1], d[2]));
                    pose.translation += Vector3::new(d[3], d[4], d[5]);
                    zero_motion.residual(&s[0], &s[1])
                };
                let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                assert!((numeric - analytic.column(k)).amax() < 1e-7, "{which} {k}");
            }
        }
        // Turning and shifting everything changes nothing.
        let turn = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 0.7)), Vector3::new(3.0, -1.0, 2.0));
        let turned = states.map(|s| NavState { world_from_body: turn * s.world_from_body, ..s });
        let change =
            zero_motion.residual(&turned[0], &turned[1]) - zero_motion.residual(&states[0], &states[1]);
        assert!(change.amax() < 1e-12);
    }
}
