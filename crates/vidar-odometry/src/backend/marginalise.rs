//! Frames that leave the window.
//!
//! A frame that is marginalised passes on everything that is said of it: IMU measurements on both sides, the anchor, the prior,
//! and the landmarks that it hosts. Every landmark's rows lose their landmark by three Householder steps, what is left is
//! stacked with the rest, and a QR of the stack with the frame's columns in front leaves the new prior below them.
//!
//! A landmark that is still seen lives on with a newer keyframe as its host: its older observations go into the prior,
//! its newer ones stay, and none is used twice.

use super::dense::Tall;
use super::inertial::{body_velocity, by_time_offset, gauge_prior_at, jacobians, residual};
use super::linearise::{Scene, calibration_weights, shift_between};
use super::prior::Part;
use super::system::System;
use super::visual;
use super::window::{
    CALIBRATION_DIM, Landmark, LandmarkObservation, MAX_INVERSE_DISTANCE, MIN_INVERSE_DISTANCE, OFFSET_AT,
};
use super::{Linearisation, Smoother, SmootherError};
use crate::imu::Vector15;
use nalgebra::{SMatrix, SVector};
use vidar_core::{FrameId, LandmarkId};

/// What happened to landmarks when a frame left. Refill one to stay free of allocations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MarginalisationReport {
    /// Landmarks that have a new host now.
    pub rehosted: Vec<LandmarkId>,
    /// Landmarks that are gone.
    pub ended: Vec<LandmarkId>,
}

/// What became of the IMU measurements after a frame that leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NextImuFactor {
    /// They are in the prior.
    InPrior,
    /// They were joined with those before the frame.
    Joined,
}

/// IMU measurements' memory that is kept for later.
const MOST_SPARE: usize = 8;

/// Memory for marginalising.
#[derive(Clone, Debug, Default)]
pub(crate) struct Workspace {
    parts: Vec<Part>,
    starts: Vec<usize>,
    stack: Tall,
    one: Tall,
    leaving: Vec<(usize, usize)>,
    parting: Vec<LandmarkObservation>,
}

impl Workspace {
    fn column(&self, part: Part) -> Option<usize> {
        self.parts.iter().position(|&p| p == part).map(|at| self.starts[at])
    }

    fn rhs(&self) -> usize {
        self.stack.cols() - 1
    }

    fn insert(&mut self, part: Part) {
        if !self.parts.contains(&part) {
            self.parts.push(part);
        }
    }

    /// Writes a block of rows of one part and, for parts that already have a step, its share of the right-hand side.
    fn put<const R: usize, const C: usize>(
        &mut self,
        row: usize,
        part: Part,
        block: &SMatrix<f64, R, C>,
        step: Option<SVector<f64, C>>,
    ) {
        let Some(col) = self.column(part) else { return };
        let rhs = self.rhs();
        for c in 0..C {
            for r in 0..R {
                self.stack.add(row + r, col + c, block[(r, c)]);
            }
        }
        if let Some(step) = step {
            let shift = block * step;
            for r in 0..R {
                self.stack.add(row + r, rhs, -shift[r]);
            }
        }
    }

    fn put_rhs(&mut self, row: usize, values: &[f64]) {
        let rhs = self.rhs();
        for (r, v) in values.iter().enumerate() {
            self.stack.add(row + r, rhs, *v);
        }
    }
}

impl Smoother {
    /// Takes a frame that is no keyframe out of the window: what it saw is forgotten, its IMU measurements are joined to the next
    /// frame's. Where that is not possible (the prior speaks of it, or it is the last) it is marginalised.
    ///
    /// # Errors
    /// A frame that the window does not hold.
    pub fn drop_frame(
        &mut self,
        id: FrameId,
        marginalisation: &mut MarginalisationReport,
    ) -> Result<(), SmootherError> {
        let at = self.index(id)?;
        let last = self.frames.len() - 1;
        let anchored = self.gauge_prior.is_some_and(|a| a.frame == at);
        let hosts = self.landmarks.iter().any(|l| l.alive && l.host.frame == at);
        let chained = at > 0
            && at < last
            && self.frames[at].imu_factor.is_some() == self.frames[at + 1].imu_factor.is_some();
        if self.prior.touches(at) || anchored || hosts || !chained {
            return self.marginalise(id, marginalisation);
        }
        marginalisation.rehosted.clear();
        marginalisation.ended.clear();
        self.system.factorised = false;
        let (left, right) = self.frames.split_at_mut(at + 1);
        if let (Some(imu_factor), Some(next)) = (left[at].imu_factor.take(), &mut right[0].imu_factor) {
            let mut joined = imu_factor.preintegration;
            joined.append(&next.preintegration);
            let used = std::mem::replace(&mut next.preintegration, joined);
            next.whitening = super::inertial::Whitening::of(&next.preintegration);
            self.spare.push(used);
        }
        // Who rests on a frame that itself rests on another rests on that.
        let both = self.frames[at].zero_motion.and(self.frames[at + 1].zero_motion);
        self.frames[at + 1].zero_motion = both;
        self.remove_frame(at, NextImuFactor::Joined);
        Ok(())
    }

    /// Takes a frame out of the window and puts what is known through it into the prior.
    ///
    /// # Errors
    /// A frame that the window does not hold.
    pub fn marginalise(
        &mut self,
        id: FrameId,
        marginalisation: &mut MarginalisationReport,
    ) -> Result<(), SmootherError> {
        let gone = self.index(id)?;
        self.eliminate(gone, gone, marginalisation);
        self.remove_frame(gone, NextImuFactor::InPrior);
        Ok(())
    }

    /// Puts into the prior what is known through the pose of frame `gone` and the motion (velocity, biases) of frame
    /// `motion`, which is the same or the one before.
    pub(crate) fn eliminate(
        &mut self,
        gone: usize,
        motion: usize,
        marginalisation: &mut MarginalisationReport,
    ) {
        marginalisation.rehosted.clear();
        marginalisation.ended.clear();
        let mut system = std::mem::take(&mut self.system);
        let mut bench = std::mem::take(&mut self.workspace);
        system.factorised = false;
        system.frames = self.frames.len();
        if self.frames.len() > 1 {
            self.relinearise_prior();
            self.place_cameras(&mut system);
            self.choose_leaving(gone, &mut bench);
            self.lay_out(gone, motion, &mut bench);
            self.stack_prior(&mut bench);
            self.stack_frame(gone, motion, &system, &mut bench);
            self.stack_landmarks(gone, &system, &mut bench);
            self.new_prior(gone, &mut bench);
            self.move_hosts(gone, &system, &bench, marginalisation);
        } else {
            self.prior.clear();
            marginalisation.ended.extend(self.landmarks.iter().filter(|l| l.alive).map(|l| l.id));
            for &landmark in &marginalisation.ended {
                self.remove_landmark(landmark);
            }
        }
        self.system = system;
        self.workspace = bench;
    }

    /// Unless first estimates are kept, the prior's linearisation points become the present states.
    fn relinearise_prior(&mut self) {
        if self.config.first_estimates() {
            return;
        }
        let constrained = self.config.linearisation == Linearisation::ObservabilityConstrained;
        self.prior.relinearise(&self.frames, &self.calibration, constrained);
        for frame in &mut self.frames {
            frame.linearised = frame.state;
            frame.step.fill(0.0);
        }
        self.calibration.relinearise();
    }

    /// Landmarks hosted by the leaving frame, each with how many of its observations leave with it.
    fn choose_leaving(&self, gone: usize, bench: &mut Workspace) {
        bench.leaving.clear();
        for (slot, landmark) in self.landmarks.iter().enumerate() {
            if !landmark.alive || landmark.host.frame != gone {
                continue;
            }
            bench.leaving.push((slot, self.split(landmark)));
        }
    }

    /// How many observations of a landmark go into the prior: all when it is not seen any more, else the older ones.
    fn split(&self, landmark: &Landmark) -> usize {
        let recent = self.frames.len().saturating_sub(2);
        let alive = landmark.observations.last().is_some_and(|s| s.frame >= recent);
        let keyframes = landmark.observations.iter().filter(|s| self.frames[s.frame].keyframe).count();
        if !alive || keyframes == 0 {
            return landmark.observations.len();
        }
        // The observation that becomes the host's is the one that leaves `rehost_keyframes` keyframes, itself included.
        let skip = keyframes.saturating_sub(self.config.rehost_keyframes);
        let in_keyframes =
            landmark.observations.iter().enumerate().filter(|(_, s)| self.frames[s.frame].keyframe);
        in_keyframes.map(|(at, _)| at).nth(skip).unwrap_or(landmark.observations.len())
    }

    /// Columns: the leaving frame first, then everything it is coupled to, in the order of frames, calibration last.
    fn lay_out(&self, gone: usize, motion: usize, bench: &mut Workspace) {
        bench.parts.clear();
        bench.insert(Part::Pose(gone));
        bench.insert(Part::Motion(motion));
        let mut coupled = [0_u8; 64];
        let mut calibration = false;
        for part in &self.prior.parts {
            match part {
                Part::Pose(k) => coupled[*k] |= 1,
                Part::Motion(k) => coupled[*k] |= 2,
                Part::Calibration => calibration = true,
            }
        }
        for k in [gone, motion].into_iter().filter(|&k| k > 0 && self.frames[k].imu_factor.is_some()) {
            coupled[k - 1] = 3;
            calibration |= self.config.estimate_time_offset;
        }
        if self.frames.get(gone + 1).is_some_and(|f| f.imu_factor.is_some()) {
            coupled[gone + 1] = 3;
            calibration |= self.config.estimate_time_offset;
        }
        if self.frames[gone].zero_motion.is_some() && gone > 0 {
            coupled[gone - 1] |= 1;
        }
        if self.frames.get(gone + 1).is_some_and(|f| f.zero_motion.is_some()) {
            coupled[gone + 1] |= 1;
        }
        let mut rows = self.prior.rows + 3 * (15 + 6) + 15 + 2 * 3 + CALIBRATION_DIM;
        for &(slot, leaving) in &bench.leaving {
            let landmark = &self.landmarks[slot];
            for s in landmark.observations[..leaving].iter().filter(|s| self.frames[s.frame].keyframe) {
                coupled[s.frame] |= 1;
                rows += 2;
                calibration |= self.config.calibrates_camera();
            }
            rows += 3;
        }
        if motion != gone {
            bench.insert(Part::Motion(gone));
        }
        for k in (0..self.frames.len()).filter(|&k| k != gone) {
            if coupled[k] & 1 != 0 {
                bench.insert(Part::Pose(k));
            }
            if coupled[k] & 2 != 0 {
                bench.insert(Part::Motion(k));
            }
        }
        if calibration {
            bench.insert(Part::Calibration);
        }
        bench.starts.clear();
        let mut at = 0;
        for part in &bench.parts {
            bench.starts.push(at);
            at += part.dim();
        }
        bench.stack.reset(rows, at + 1);
    }

    fn stack_prior(&self, bench: &mut Workspace) {
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
    fn stack_frame(&self, gone: usize, motion: usize, system: &System, bench: &mut Workspace) {
        for k in motion..=gone + 1 {
            let Some(imu_factor) = self.frames.get(k).and_then(|f| f.imu_factor.as_ref()).filter(|_| k > 0)
            else {
                continue;
            };
            let (from, to) = (&self.frames[k - 1], &self.frames[k]);
            let shift = shift_between(&self.calibration, from, to);
            let r: Vector15 = imu_factor.whitening.apply(&residual(
                &imu_factor.preintegration,
                &from.state,
                &to.state,
                shift,
            ));
            let (state_i, state_j) = (&system.states_at[k - 1], &system.states_at[k]);
            let (ji, jj) = jacobians(&imu_factor.preintegration, state_i, state_j, shift);
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
    fn stack_landmarks(&mut self, gone: usize, system: &System, bench: &mut Workspace) {
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
        let mut write = |w: &super::linearise::WeightedObservation, target: Option<(usize, usize)>| {
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

    /// Eliminates the leaving frame's columns; what is left is the prior.
    fn new_prior(&mut self, gone: usize, bench: &mut Workspace) {
        let leaving = Part::Pose(gone).dim() + Part::Motion(gone).dim();
        let variables = bench.rhs();
        let begin = bench.stack.triangularise(0, 0, leaving);
        let end = bench.stack.triangularise(begin, leaving, variables);
        let parts = &bench.parts[2..];
        self.prior.reset(parts, end - begin);
        let n = self.prior.dim;
        for r in 0..self.prior.rows {
            for c in 0..n {
                self.prior.root[r * n + c] = bench.stack.get(begin + r, leaving + c);
            }
            self.prior.residual[r] = bench.stack.get(begin + r, variables);
        }
        self.prior.square();
        for &part in parts {
            match part {
                Part::Pose(k) => self.frames[k].enter_prior(true, false),
                Part::Motion(k) => self.frames[k].enter_prior(false, true),
                Part::Calibration => self.calibration.enter_prior(),
            }
        }
        self.prior.note_heading(&self.frames);
    }

    /// Gives living landmarks their new host and ends the others.
    fn move_hosts(
        &mut self,
        gone: usize,
        system: &System,
        bench: &Workspace,
        marginalisation: &mut MarginalisationReport,
    ) {
        for &(slot, count) in &bench.leaving {
            let landmark = &mut self.landmarks[slot];
            if count >= landmark.observations.len() {
                let id = landmark.id;
                marginalisation.ended.push(id);
                self.remove_landmark(id);
                continue;
            }
            let host = landmark.observations[count];
            let (old, new) = (&system.camera_poses[gone], &system.camera_poses[host.frame]);
            // Unit bearing over inverse distance in the old host; the length of the direction scales the inverse distance.
            let q = visual::direction(old, new, &landmark.bearing, landmark.rho);
            let length = q.norm();
            landmark.observations.drain(..=count);
            landmark.host = host;
            // It went into the prior of the window, with the observations that left.
            landmark.prior = None;
            landmark.bearing = q / length;
            landmark.rho = (landmark.rho / length).clamp(MIN_INVERSE_DISTANCE, MAX_INVERSE_DISTANCE);
            marginalisation.rehosted.push(landmark.id);
        }
    }

    /// Removes the newest frame, which the prior speaks of no more.
    pub(crate) fn remove_newest(&mut self) {
        let gone = self.frames.len() - 1;
        self.remove_frame(gone, NextImuFactor::InPrior);
    }

    /// Removes a frame and every observation in it; places in the window move up.
    fn remove_frame(&mut self, gone: usize, next: NextImuFactor) {
        let frame = self.frames.remove(gone);
        self.spare.extend(frame.imu_factor.map(|imu_factor| imu_factor.preintegration));
        if let (NextImuFactor::InPrior, Some(next)) = (next, self.frames.get_mut(gone)) {
            self.spare.extend(next.imu_factor.take().map(|imu_factor| imu_factor.preintegration));
            next.zero_motion = None;
        }
        self.spare.truncate(MOST_SPARE);
        self.gauge_prior = self.gauge_prior.filter(|a| a.frame != gone).map(|mut a| {
            a.frame -= usize::from(a.frame > gone);
            a
        });
        self.prior.frame_left(gone);
        for landmark in self.landmarks.iter_mut().filter(|l| l.alive) {
            landmark.observations.retain(|s| s.frame != gone);
            landmark.host.frame -= usize::from(landmark.host.frame > gone);
            for s in &mut landmark.observations {
                s.frame -= usize::from(s.frame > gone);
            }
        }
    }
}
