//! Frames that leave the window.
//!
//! A frame that is marginalised passes on everything that is said of it: IMU measurements on both sides, the anchor, the prior,
//! and the landmarks that it hosts. Every landmark's rows lose their landmark by three Householder steps, what is left is
//! stacked with the rest, and a QR of the stack with the frame's columns in front leaves the new prior below them.
//!
//! A landmark that is still seen lives on with a newer keyframe as its host: its older observations go into the prior,
//! its newer ones stay, and none is used twice.

mod stack;
mod workspace;

use super::prior::Part;
use super::system::System;
use super::visual;
use super::window::{CALIBRATION_DIM, Landmark, MAX_INVERSE_DISTANCE, MIN_INVERSE_DISTANCE};
use super::{Linearisation, Smoother, SmootherError};
use vidar_core::{FrameId, LandmarkId};
pub(crate) use workspace::Workspace;

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
            self.new_prior(&mut bench);
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
            frame.delay.relinearise();
            frame.image_shift.relinearise();
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
        const DELAY: u8 = 4;
        const IMAGE_SHIFT: u8 = 8;
        let has_delays = self.config.delay_sigma().is_some();
        let has_image_shifts = self.config.image_shift_sigma().is_some();
        let by_imu = 3 | if has_delays { DELAY } else { 0 } | if has_image_shifts { IMAGE_SHIFT } else { 0 };
        bench.insert(Part::Pose(gone));
        bench.insert(Part::Motion(motion));
        if has_delays {
            bench.insert(Part::Delay(motion));
        }
        if has_image_shifts {
            bench.insert(Part::ImageShift(motion));
        }
        bench.leaving_parts = bench.parts.len();
        let mut coupled = [0_u8; 64];
        let mut calibration = false;
        for part in &self.prior.parts {
            match part {
                Part::Pose(k) => coupled[*k] |= 1,
                Part::Motion(k) => coupled[*k] |= 2,
                Part::Delay(k) => coupled[*k] |= DELAY,
                Part::ImageShift(k) => coupled[*k] |= IMAGE_SHIFT,
                Part::Calibration => calibration = true,
            }
        }
        for k in [gone, motion].into_iter().filter(|&k| k > 0 && self.frames[k].imu_factor.is_some()) {
            coupled[k - 1] = by_imu;
            calibration |= self.config.estimate_time_offset;
        }
        if self.frames.get(gone + 1).is_some_and(|f| f.imu_factor.is_some()) {
            coupled[gone + 1] = by_imu;
            calibration |= self.config.estimate_time_offset;
        }
        if self.frames[gone].zero_motion.is_some() && gone > 0 {
            coupled[gone - 1] |= 1;
        }
        if self.frames.get(gone + 1).is_some_and(|f| f.zero_motion.is_some()) {
            coupled[gone + 1] |= 1;
        }
        let mut rows = self.prior.rows + 3 * (15 + 6) + 15 + 2 * 3 + CALIBRATION_DIM + 3;
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
            if has_delays {
                bench.insert(Part::Delay(gone));
            }
            if has_image_shifts {
                bench.insert(Part::ImageShift(gone));
            }
        }
        for k in (0..self.frames.len()).filter(|&k| k != gone) {
            if coupled[k] & 1 != 0 {
                bench.insert(Part::Pose(k));
            }
            if coupled[k] & 2 != 0 {
                bench.insert(Part::Motion(k));
            }
            if coupled[k] & DELAY != 0 {
                bench.insert(Part::Delay(k));
            }
            if coupled[k] & IMAGE_SHIFT != 0 {
                bench.insert(Part::ImageShift(k));
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

    /// Eliminates the leaving frame's columns; what is left is the prior.
    fn new_prior(&mut self, bench: &mut Workspace) {
        let leaving = bench.starts.get(bench.leaving_parts).copied().unwrap_or_else(|| bench.rhs());
        let variables = bench.rhs();
        let begin = bench.stack.triangularise(0, 0, leaving);
        let end = bench.stack.triangularise(begin, leaving, variables);
        let parts = &bench.parts[bench.leaving_parts..];
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
                Part::Delay(k) => self.frames[k].delay.enter_prior(),
                Part::ImageShift(k) => self.frames[k].image_shift.enter_prior(),
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
