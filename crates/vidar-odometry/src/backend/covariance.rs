//! Uncertainty out of the factor of the normal equations.

use super::Smoother;
use super::prior::Part;
use super::system::System;
use crate::imu::{Matrix15, hat};
use nalgebra::{Matrix6, SMatrix};
use vidar_core::{FrameId, LieGroup, Se3};

/// Calibration as estimated on the way, with standard deviations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationEstimate {
    /// Place of the camera on the body.
    pub body_from_camera: Se3,
    /// Standard deviation of its rotation, rad per axis of the camera; `None` where it is not estimated.
    pub rotation_sigma_rad: Option<[f64; 3]>,
    /// Standard deviation of its position, m per axis of the body; `None` where it is not estimated.
    pub position_sigma_m: Option<[f64; 3]>,
    /// What to add to image stamps to get the IMU's time, s.
    pub time_offset_secs: f64,
    /// Its standard deviation, s; `None` where it is not estimated.
    pub time_offset_sigma_secs: Option<f64>,
}

impl Smoother {
    /// Calibration as estimated, with standard deviations where the states are known.
    pub fn calibration(&mut self) -> CalibrationEstimate {
        let sigmas = self.calibration_sigmas();
        let three = |at: usize| sigmas.map(|s| [s[at], s[at + 1], s[at + 2]]);
        CalibrationEstimate {
            body_from_camera: self.calibration.body_from_camera,
            rotation_sigma_rad: three(0).filter(|_| self.config.estimate_camera_rotation),
            position_sigma_m: three(3).filter(|_| self.config.estimate_camera_position),
            time_offset_secs: self.calibration.time_offset_secs,
            time_offset_sigma_secs: sigmas.map(|s| s[6]).filter(|_| self.config.estimate_time_offset),
        }
    }

    /// Covariance of the newest frame's error state. `None` when empty or when nothing holds the world's origin.
    pub fn covariance_of_newest(&mut self) -> Option<Matrix15> {
        let newest = self.frames.len().checked_sub(1)?;
        self.covariance_at(newest)
    }

    /// Covariance of a frame's error state: rotation (body side), position (world), velocity, biases.
    pub fn covariance(&mut self, id: FrameId) -> Option<Matrix15> {
        let at = self.index(id).ok()?;
        self.covariance_at(at)
    }

    fn covariance_at(&mut self, at: usize) -> Option<Matrix15> {
        self.factorise()?;
        let (pose, motion) = (self.system.offset(Part::Pose(at)), self.system.offset(Part::Motion(at)));
        let columns: [usize; 15] = std::array::from_fn(|k| if k < 6 { pose + k } else { motion + k - 6 });
        let mut out = Matrix15::zeros();
        self.system.inverse_block(&columns, |i, j, v| out[(i, j)] = v);
        Some(out)
    }

    /// Covariance of a frame's pose: rotation (body side, rad), position (world, m).
    pub fn pose_covariance(&mut self, id: FrameId) -> Option<Matrix6<f64>> {
        let at = self.index(id).ok()?;
        self.factorise()?;
        let from = self.system.offset(Part::Pose(at));
        let columns: [usize; 6] = std::array::from_fn(|k| from + k);
        let mut out = Matrix6::zeros();
        self.system.inverse_block(&columns, |i, j, v| out[(i, j)] = v);
        Some(out)
    }

    /// Covariance of `a_from_b` between the bodies of two frames: `a_from_b · exp(δ)`, δ = rotation, translation, both
    /// in the axes of *b* (vidar-core's tangent).
    pub fn relative_covariance(&mut self, a: FrameId, b: FrameId) -> Option<Matrix6<f64>> {
        let (a, b) = (self.index(a).ok()?, self.index(b).ok()?);
        self.factorise()?;
        let starts = [self.system.offset(Part::Pose(a)), self.system.offset(Part::Pose(b))];
        let columns: [usize; 12] = std::array::from_fn(|k| starts[k / 6] + k % 6);
        let mut joint = SMatrix::<f64, 12, 12>::zeros();
        self.system.inverse_block(&columns, |i, j, v| joint[(i, j)] = v);
        let j =
            d_relative_d_poses(&self.frames[a].state.world_from_body, &self.frames[b].state.world_from_body);
        Some(j * joint * j.transpose())
    }

    /// Standard deviation of the logarithm of the window's scale: how well the extent of the path is known.
    ///
    /// With positions `p_k` about their mean `m`, `d log s / d p_k = (p_k − m) / Σ |p − m|²`.
    pub fn log_scale_sigma(&mut self) -> Option<f64> {
        self.factorise()?;
        let count = self.frames.len() as f64;
        let place = |k: usize| self.frames[k].state.world_from_body.translation;
        let mean = (0..self.frames.len()).map(place).sum::<nalgebra::Vector3<f64>>() / count;
        let spread: f64 = (0..self.frames.len()).map(|k| (place(k) - mean).norm_squared()).sum();
        if !(spread > 0.0) {
            return Some(f64::INFINITY);
        }
        let system = &mut self.system;
        let mut direction = std::mem::take(&mut system.solved);
        direction.clear();
        direction.resize(system.n, 0.0);
        for k in 0..self.frames.len() {
            let at = system.offset(Part::Pose(k)) + 3;
            let slope = (self.frames[k].state.world_from_body.translation - mean) / spread;
            direction[at..at + 3].copy_from_slice(slope.as_slice());
        }
        system.cholesky.forward(&mut direction);
        let sigma = super::dense::dot(&direction, &direction).sqrt();
        system.solved = direction;
        Some(sigma)
    }

    /// Standard deviations of the calibration: rotation (rad), position (m), clock offset (s); `None` when nothing is
    /// estimated.
    pub fn calibration_sigmas(&mut self) -> Option<[f64; super::window::CALIBRATION_DIM]> {
        if !self.config.calibrates() {
            return None;
        }
        self.factorise()?;
        let from = self.system.offset(Part::Calibration);
        let columns: [usize; super::window::CALIBRATION_DIM] = std::array::from_fn(|k| from + k);
        let mut out = [0.0; super::window::CALIBRATION_DIM];
        self.system.inverse_block(&columns, |i, j, v| {
            if i == j {
                out[i] = v.sqrt();
            }
        });
        Some(out)
    }

    /// Factorises the undamped system at the present states, once.
    pub(crate) fn factorise(&mut self) -> Option<()> {
        if self.frames.is_empty() {
            return None;
        }
        let mut system = std::mem::take(&mut self.system);
        if !system.factorised {
            self.linearise(&mut system, 0.0);
            system.damping.clear();
            system.damping.resize(system.n, 0.0);
            system.factorised = system.cholesky.factorise(&system.h, &system.damping, &system.first);
        }
        self.system = system;
        self.system.factorised.then_some(())
    }
}

impl System {
    /// Entries of the inverse at `columns` × `columns`.
    fn inverse_block(&mut self, columns: &[usize], mut put: impl FnMut(usize, usize, f64)) {
        let n = self.cholesky.dim();
        let solved = &mut self.solved;
        solved.clear();
        solved.resize(n * columns.len(), 0.0);
        for (k, &column) in columns.iter().enumerate() {
            let unit = &mut solved[k * n..(k + 1) * n];
            unit[column] = 1.0;
            self.cholesky.forward_from(column, unit);
        }
        // A⁻¹ = L⁻ᵀ L⁻¹, so its entries are dot products of the columns of L⁻¹.
        for i in 0..columns.len() {
            for j in 0..=i {
                let value = super::dense::dot(&solved[i * n..(i + 1) * n], &solved[j * n..(j + 1) * n]);
                put(i, j, value);
                put(j, i, value);
            }
        }
    }
}

/// Derivative of the tangent of `a_from_b` by the poses of a and b (rotation on the body side, position in the world).
pub(crate) fn d_relative_d_poses(world_from_a: &Se3, world_from_b: &Se3) -> SMatrix<f64, 6, 12> {
    let b_from_world = world_from_b.rotation.matrix().transpose();
    let b_from_a = b_from_world * world_from_a.rotation.matrix();
    let apart = world_from_b.translation - world_from_a.translation;
    let mut j = SMatrix::<f64, 6, 12>::zeros();
    let identity = nalgebra::Matrix3::identity();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-b_from_a);
    j.fixed_view_mut::<3, 3>(0, 6).copy_from(&identity);
    // t = R_aᵀ (p_b − p_a): δt = hat(t) δθ_a + R_aᵀ (δp_b − δp_a), turned into b's axes.
    let in_a = world_from_a.rotation.inverse() * apart;
    j.fixed_view_mut::<3, 3>(3, 0).copy_from(&(b_from_a * hat(&in_a)));
    j.fixed_view_mut::<3, 3>(3, 3).copy_from(&-b_from_world);
    j.fixed_view_mut::<3, 3>(3, 9).copy_from(&b_from_world);
    j
}
