//! Delays of images whose stamps scatter: every frame has one, an unknown of the inertial factors on both of its sides.

use super::Smoother;
use super::own_value::OwnValue;
use crate::imu::NavState;
use nalgebra::{SVector, Vector1, Vector3};
use vidar_core::{LieGroup, Se3, So3};

/// How much later than its stamp (plus the clock offset) an image was exposed, s.
pub(crate) type Delay = OwnValue<1>;

impl Smoother {
    /// Applies a frame's step. What of it follows from the later instant is the motion until then, of the state that it leads to: velocity times delay is
    /// a millimetre where the IMU knows a hundredth of one, and a linear step would miss by its square.
    pub(crate) fn apply_with_delay(
        &mut self,
        k: usize,
        pose: &SVector<f64, 6>,
        motion: &SVector<f64, 9>,
        delay_secs: f64,
    ) {
        let imu = |k: usize| Some(&self.frames.get(k)?.imu_factor.as_ref()?.preintegration);
        let rates = imu(k).map(|p| (p.ends()[1], p.model().gravity()));
        let rates = rates.or_else(|| imu(k + 1).map(|p| (p.ends()[0], p.model().gravity())));
        let frame = &mut self.frames[k];
        let Some((rates, gravity)) = rates else {
            frame.apply(pose, motion);
            return;
        };
        let acceleration = |state: &NavState| state.world_from_body.rotation * rates.force + gravity;
        let (mut pose, mut motion) = (*pose, *motion);
        let mut take = |at: usize, by: Vector3<f64>| {
            let mut part = pose.fixed_rows_mut::<3>(at);
            part -= by * delay_secs;
        };
        take(0, rates.turn);
        take(3, frame.state.velocity);
        let mut velocity = motion.fixed_rows_mut::<3>(0);
        velocity -= acceleration(&frame.state) * delay_secs;
        frame.apply(&pose, &motion);
        let state = &mut frame.state;
        let by = acceleration(state);
        let from = state.world_from_body;
        let shift = state.velocity * delay_secs + by * (0.5 * delay_secs * delay_secs);
        let turn = So3::exp(&(rates.turn * delay_secs));
        state.world_from_body = Se3::new(from.rotation * turn, from.translation + shift);
        state.velocity += by * delay_secs;
        frame.delay.apply(&Vector1::new(delay_secs));
        frame.step = frame.state.minus(&frame.linearised);
    }
}
