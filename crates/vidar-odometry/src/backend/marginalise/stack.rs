//! The rows of the stack: every factor of the frame that leaves, whitened, in the columns that were laid out.

use super::super::Smoother;
use super::super::inertial::{body_velocity, by_ends, by_time_offset, gauge_prior_at, jacobians, residual};
use super::super::linearise::{calibration_weights, shift_between};
use super::super::prior::Part;
use super::super::reprojection::{Scene, WeightedObservation};
use super::super::system::System;
use super::super::window::{CALIBRATION_DIM, Landmark, OFFSET_AT};
use super::Workspace;
use crate::imu::Vector15;
use nalgebra::{Matrix1, Matrix2, SMatrix, SVector};

impl Smoother {
    pub(super) fn stack_prior(&self, bench: &mut Workspace) {
        let prior = &self.prior;
        let row = bench.stack.add_rows(prior.rows);
        let rhs = bench.rhs();
        for (part, start) in prior.parts.iter().zip(&prior.starts) {
            let Some(col) = bench.column(*part) else { continue };
            for r in 0..prior.rows {
                for c in 0..part.dim() {
                    bench.stack.set(row + r, col + c, prior.root[r * prior.dim + start + c]);
                }
            }
        }
        for r in 0..prior.rows {
            bench.stack.set(row + r, rhs, prior.residual[r]);
        }
    }

    fn pose_step(&self, k: usize) -> Option<SVector<f64, 6>> {
        let frame = &self.frames[k];
        frame.pose_in_prior.then(|| frame.step.fixed_rows::<6>(0).into_owned())
    }

    fn motion_step(&self, k: usize) -> Option<SVector<f64, 9>> {
        let frame = &self.frames[k];
        frame.motion_in_prior.then(|| frame.step.fixed_rows::<9>(6).into_owned())
    }

    fn calibration_step(&self) -> Option<SVector<f64, CALIBRATION_DIM>> {
        self.calibration.in_prior.then_some(self.calibration.step)
    }

    fn put_state(&self, bench: &mut Workspace, row: usize, k: usize, j: &SMatrix<f64, 15, 15>) {
        bench.put(row, Part::Pose(k), &j.fixed_columns::<6>(0).into_owned(), self.pose_step(k));
        bench.put(row, Part::Motion(k), &j.fixed_columns::<9>(6).into_owned(), self.motion_step(k));
    }

    /// IMU measurements on both sides, anchor and standstill of the leaving frame, and the calibration's own prior.
    pub(super) fn stack_frame(&self, gone: usize, motion: usize, system: &System, bench: &mut Workspace) {
        for k in motion..=gone + 1 {
            let Some(imu_factor) = self.frames.get(k).and_then(|f| f.imu_factor.as_ref()).filter(|_| k > 0)
            else {
                continue;
            };
            let (from, to) = (&self.frames[k - 1], &self.frames[k]);
            let shift = shift_between(&self.calibration, from, to);
            let (now_i, now_j) = (self.body_state_of(from), self.body_state_of(to));
            let r: Vector15 =
                imu_factor.whitening.apply(&residual(&imu_factor.preintegration, &now_i, &now_j, shift));
            let (body_i, body_j) =
                (self.body_of(from, &system.states_at[k - 1]), self.body_of(to, &system.states_at[k]));
            let (state_i, state_j) = (&body_i.state, &body_j.state);
            let (ji, jj) = jacobians(&imu_factor.preintegration, state_i, state_j, shift);
            let ((ji, si), (jj, sj)) = (body_i.through(&ji), body_j.through(&jj));
            let row = bench.stack.add_rows(15);
            bench.put_rhs(row, r.as_slice());
            self.put_state(bench, row, k - 1, &imu_factor.whitening.apply(&ji));
            self.put_state(bench, row, k, &imu_factor.whitening.apply(&jj));
            if self.config.estimate_time_offset {
                let by = imu_factor.whitening.apply(&by_time_offset(
                    &imu_factor.preintegration,
                    state_i,
                    state_j,
                    shift,
                ));
                let mut block = SMatrix::<f64, 15, CALIBRATION_DIM>::zeros();
                block.set_column(OFFSET_AT, &by);
                bench.put(row, Part::Calibration, &block, self.calibration_step());
            }
            if self.config.image_shift_sigma().is_some() {
                for (k, by) in [(k - 1, si), (k, sj)] {
                    let step = self.frames[k].image_shift.step_in_prior();
                    bench.put(row, Part::ImageShift(k), &imu_factor.whitening.apply(&by), step);
                }
            }
            if self.config.delay_sigma().is_some() {
                let ends = by_ends(&imu_factor.preintegration, state_i, state_j, shift);
                for (k, by) in [k - 1, k].into_iter().zip(ends) {
                    bench.put(
                        row,
                        Part::Delay(k),
                        &imu_factor.whitening.apply(&by),
                        self.frames[k].delay.step_in_prior(),
                    );
                }
            }
        }
        if let Some(sigma) = self.config.delay_sigma() {
            let row = bench.stack.add_rows(1);
            bench.put_rhs(row, &[self.frames[motion].delay.now.x / sigma]);
            bench.put(
                row,
                Part::Delay(motion),
                &Matrix1::new(1.0 / sigma),
                self.frames[motion].delay.step_in_prior(),
            );
        }
        if let Some(sigma) = self.config.image_shift_sigma() {
            let row = bench.stack.add_rows(2);
            let shift = &self.frames[motion].image_shift;
            bench.put_rhs(row, (shift.now / sigma).as_slice());
            let by = Matrix2::identity() / sigma;
            bench.put(row, Part::ImageShift(motion), &by, shift.step_in_prior());
        }
        for k in [gone, gone + 1] {
            let Some(rest) = self.frames.get(k).and_then(|f| f.zero_motion).filter(|_| k > 0) else {
                continue;
            };
            let r = rest.residual(&self.frames[k - 1].state, &self.frames[k].state);
            let (ji, jj) = rest.jacobians(&system.states_at[k - 1], &system.states_at[k]);
            let row = bench.stack.add_rows(6);
            bench.put_rhs(row, r.as_slice());
            bench.put(row, Part::Pose(k - 1), &ji, self.pose_step(k - 1));
            bench.put(row, Part::Pose(k), &jj, self.pose_step(k));
        }
        if let Some(gauge_prior) = self.gauge_prior.as_ref().filter(|a| a.frame == gone || a.frame == motion)
        {
            let k = gauge_prior.frame;
            let state = &self.frames[k].state;
            let (r, j) =
                gauge_prior_at(&gauge_prior.reference, &gauge_prior.sigmas, state, &system.states_at[k]);
            let row = bench.stack.add_rows(15);
            bench.put_rhs(row, r.as_slice());
            self.put_state(bench, row, k, &j);
        }
        for k in motion..=gone {
            let Some(sigma) = self.frames[k].standstill_sigma else { continue };
            let r = body_velocity(&self.frames[k].state).0 / sigma;
            let (_, by_rotation, by_velocity) = body_velocity(&system.states_at[k]);
            let mut by_pose = SMatrix::<f64, 3, 6>::zeros();
            by_pose.fixed_view_mut::<3, 3>(0, 0).copy_from(&(by_rotation / sigma));
            let mut by_motion = SMatrix::<f64, 3, 9>::zeros();
            by_motion.fixed_view_mut::<3, 3>(0, 0).copy_from(&(by_velocity / sigma));
            let row = bench.stack.add_rows(3);
            bench.put_rhs(row, r.as_slice());
            bench.put(row, Part::Pose(k), &by_pose, self.pose_step(k));
            bench.put(row, Part::Motion(k), &by_motion, self.motion_step(k));
        }
        if bench.column(Part::Calibration).is_some() && !self.calibration.in_prior {
            let weights = SVector::<f64, CALIBRATION_DIM>::from(calibration_weights(&self.config));
            let row = bench.stack.add_rows(CALIBRATION_DIM);
            bench.put_rhs(row, weights.component_mul(&self.calibration.minus_given()).as_slice());
            bench.put(row, Part::Calibration, &SMatrix::from_diagonal(&weights), None);
        }
    }

    /// Observations that leave, each landmark eliminated.
    pub(super) fn stack_landmarks(&mut self, gone: usize, system: &System, bench: &mut Workspace) {
        let mut leaving = std::mem::take(&mut bench.leaving);
        for (slot, count) in &leaving {
            let mut landmark = std::mem::replace(&mut self.landmarks[*slot], Landmark::placeholder());
            self.stack_landmark(gone, &mut landmark, *count, system, bench);
            self.landmarks[*slot] = landmark;
        }
        leaving.sort_unstable();
        bench.leaving = leaving;
    }

    fn stack_landmark(
        &self,
        gone: usize,
        landmark: &mut Landmark,
        count: usize,
        system: &System,
        bench: &mut Workspace,
    ) {
        let scene = Scene {
            camera: &self.camera,
            config: &self.config,
            camera_poses: &system.camera_poses,
            camera_poses_at: &system.camera_poses_at,
        };
        let Some((_, own)) = scene.host(landmark) else { return };
        let mut observations = std::mem::take(&mut bench.parting);
        observations.clear();
        observations
            .extend(landmark.observations[..count].iter().filter(|s| self.frames[s.frame].keyframe).copied());
        // The landmark's own three columns, then those of the stack.
        let mut one = std::mem::take(&mut bench.one);
        one.reset(2 * observations.len() + 3, 3 + bench.stack.cols());
        let rhs = 3 + bench.rhs();
        let calibration = bench.column(Part::Calibration).map(|c| c + 3);
        let calibration_step = self.calibration_step();
        let host = bench.column(Part::Pose(gone)).map_or(3, |c| c + 3);
        let mut used = 0;
        let mut write = |w: &WeightedObservation, target: Option<(usize, usize)>| {
            let row = one.add_rows(2);
            let mut r = w.residual;
            let mut put = |col: usize, block: &SMatrix<f64, 2, 6>, step: Option<SVector<f64, 6>>| {
                for c in 0..6 {
                    one.add(row, col + c, block[(0, c)]);
                    one.add(row + 1, col + c, block[(1, c)]);
                }
                if let Some(step) = step {
                    r -= block * step;
                }
            };
            put(host, &w.jacobians.by_host, self.pose_step(gone));
            if let Some((frame, col)) = target {
                put(col, &w.jacobians.by_target, self.pose_step(frame));
            }
            if let (Some(col), Some(c)) = (calibration, &w.by_calibration) {
                for k in 0..CALIBRATION_DIM {
                    one.add(row, col + k, c[(0, k)]);
                    one.add(row + 1, col + k, c[(1, k)]);
                }
                if let Some(step) = calibration_step {
                    r -= c * step;
                }
            }
            for c in 0..3 {
                one.add(row, c, w.jacobians.by_landmark[(0, c)]);
                one.add(row + 1, c, w.jacobians.by_landmark[(1, c)]);
            }
            one.add(row, rhs, r.x);
            one.add(row + 1, rhs, r.y);
        };
        write(&own, None);
        for s in &mut observations {
            let (_, weighted) = scene.observation(landmark, s);
            let target = bench.column(Part::Pose(s.frame)).map(|c| (s.frame, c + 3));
            if let (Some(weighted), Some(target)) = (weighted, target)
                && s.chi2 <= self.config.outlier_chi2
            {
                write(&weighted, Some(target));
                used += 1;
            }
        }
        if let Some(prior) = landmark.prior {
            let (residual, slope) = prior.residual(landmark.rho);
            let row = one.add_rows(1);
            one.add(row, 2, slope);
            one.add(row, rhs, residual);
        }
        if used > 0 {
            let begin = one.triangularise(0, 0, 3);
            let left = one.rows() - begin;
            let row = bench.stack.add_rows(left);
            for c in 0..bench.stack.cols() {
                for r in 0..left {
                    bench.stack.set(row + r, c, one.get(begin + r, 3 + c));
                }
            }
        }
        bench.one = one;
        bench.parting = observations;
    }
}
