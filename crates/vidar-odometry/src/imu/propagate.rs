//! A state and its covariance carried forward by IMU measurements.

use super::{Matrix15, NavState, Preintegration, hat};
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, So3};

/// A state with its uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct Propagated {
    /// The state.
    pub state: NavState,
    /// Covariance of its error state.
    pub covariance: Matrix15,
}

/// Carries `state` and its `covariance` over the stretch of `IMU measurements`, bias walks included.
pub fn propagate(state: &NavState, covariance: &Matrix15, preintegration: &Preintegration) -> Propagated {
    let t = preintegration.secs();
    let transition = d_end_d_start(state, preintegration);
    let mut noise = Matrix15::zeros();
    // Preintegration's error is on the body side of the end for rotation, in the first frame for the rest.
    let turn = state.world_from_body.rotation.matrix();
    let mut g = nalgebra::SMatrix::<f64, 9, 9>::identity();
    g.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    g.fixed_view_mut::<3, 3>(6, 6).copy_from(&turn);
    noise.fixed_view_mut::<9, 9>(0, 0).copy_from(&(g * preintegration.covariance() * g.transpose()));
    let model = preintegration.model();
    let walk = Matrix3::identity() * t;
    noise.fixed_view_mut::<3, 3>(9, 9).copy_from(&(walk * model.gyro_walk.powi(2)));
    noise.fixed_view_mut::<3, 3>(12, 12).copy_from(&(walk * model.accel_walk.powi(2)));
    let carried = transition * covariance * transition.transpose() + noise;
    Propagated { state: preintegration.predict(state), covariance: (carried + carried.transpose()) * 0.5 }
}

/// Derivative of the error state at the end by that at the start.
pub(crate) fn d_end_d_start(state: &NavState, preintegration: &Preintegration) -> Matrix15 {
    let delta = &preintegration.delta;
    let t = delta.secs;
    let (rotation, position, velocity) = preintegration.corrected(&state.bias);
    let turn = state.world_from_body.rotation.matrix();
    let shift: Vector3<f64> =
        delta.by_gyro_bias.fixed_view::<3, 3>(0, 0) * (state.bias.gyro - preintegration.bias().gyro);
    let mut f = Matrix15::identity();
    f.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation.matrix().transpose());
    f.fixed_view_mut::<3, 3>(0, 9)
        .copy_from(&(So3::right_jacobian(&shift) * delta.by_gyro_bias.fixed_view::<3, 3>(0, 0)));
    for (row, value) in [(3, position), (6, velocity)] {
        f.fixed_view_mut::<3, 3>(row, 0).copy_from(&(-(turn * hat(&value))));
        f.fixed_view_mut::<3, 3>(row, 9).copy_from(&(turn * delta.by_gyro_bias.fixed_view::<3, 3>(row, 0)));
        f.fixed_view_mut::<3, 3>(row, 12).copy_from(&(turn * delta.by_accel_bias.fixed_view::<3, 3>(row, 0)));
    }
    f.fixed_view_mut::<3, 3>(3, 6).copy_from(&(Matrix3::identity() * t));
    f
}
