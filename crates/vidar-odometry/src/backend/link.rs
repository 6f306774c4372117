//! What the IMU says between two neighbouring frames: the inertial factor in the window's normal equations.

use super::Smoother;
use super::image_shift::BodyState;
use super::inertial::{by_ends, by_time_offset, jacobians, residual};
use super::linearise::shift_between;
use super::prior::Part;
use super::system::System;
use super::window::{Frame, OFFSET_AT};
use crate::imu::{Matrix15, NavState, Vector15};
use nalgebra::SMatrix;

/// A factor's residual and derivatives by both states and the clock offset, whitened.
struct Link {
    residual: Vector15,
    /// Of the first and the second frame: derivative, and where its motion and its pose are.
    ends: [(Matrix15, Part, Part); 2],
    by_offset: Option<Vector15>,
}

impl Link {
    /// Adds what both states and the clock offset do.
    fn add_states(&self, system: &mut System) {
        let [(ji, motion_i, pose_i), (jj, motion_j, pose_j)] = &self.ends;
        let parts = [*motion_i, *motion_j, *pose_i, *pose_j];
        for a in 0..4 {
            for b in 0..a {
                system.couple(parts[a], parts[b]);
            }
        }
        let [mi, mj, pi, pj] = parts.map(|p| system.offset(p));
        let (ii, ji_t) = (ji.transpose() * ji, jj.transpose() * ji);
        let jj_t = jj.transpose() * jj;
        for (square, m, p) in [(&ii, mi, pi), (&jj_t, mj, pj)] {
            system.add(m, m, &square.fixed_view::<9, 9>(6, 6).into_owned(), 1.0);
            system.add(p, m, &square.fixed_view::<6, 9>(0, 6).into_owned(), 1.0);
            system.add(p, p, &square.fixed_view::<6, 6>(0, 0).into_owned(), 1.0);
        }
        system.add(mj, mi, &ji_t.fixed_view::<9, 9>(6, 6).into_owned(), 1.0);
        system.add(pj, mi, &ji_t.fixed_view::<6, 9>(0, 6).into_owned(), 1.0);
        system.add(pi, mj, &ji_t.fixed_view::<9, 6>(6, 0).transpose(), 1.0);
        system.add(pj, pi, &ji_t.fixed_view::<6, 6>(0, 0).into_owned(), 1.0);
        for (j, m, p) in [(ji, mi, pi), (jj, mj, pj)] {
            let g = j.transpose() * self.residual;
            system.add_gradient(m, &g.fixed_rows::<9>(6).into_owned(), 1.0);
            system.add_gradient(p, &g.fixed_rows::<6>(0).into_owned(), 1.0);
        }
        if let Some(d) = &self.by_offset {
            let at = system.offset(Part::Calibration) + OFFSET_AT;
            system.add(at, at, &(d.transpose() * d), 1.0);
            for (j, m, p) in [(ji, mi, pi), (jj, mj, pj)] {
                let row = d.transpose() * j;
                system.add(at, m, &row.fixed_columns::<9>(6).into_owned(), 1.0);
                system.add(at, p, &row.fixed_columns::<6>(0).into_owned(), 1.0);
            }
            system.gradient[at] += d.dot(&self.residual);
        }
    }

    /// Adds what an unknown of one of the two frames does.
    fn add_unknown<const C: usize>(&self, system: &mut System, unknown: Part, by: &SMatrix<f64, 15, C>) {
        let at = system.offset(unknown);
        for (j, motion, pose) in &self.ends {
            system.couple(unknown, *motion);
            system.couple(*pose, unknown);
            let row = by.transpose() * j;
            let (m, p) = (system.offset(*motion), system.offset(*pose));
            system.add(at, m, &row.fixed_columns::<9>(6).into_owned(), 1.0);
            system.add(p, at, &row.fixed_columns::<6>(0).transpose(), 1.0);
        }
        if let Some(by_offset) = &self.by_offset {
            let clock = system.offset(Part::Calibration) + OFFSET_AT;
            system.add(clock, at, &(by_offset.transpose() * by), 1.0);
        }
        system.add_gradient(at, &(by.transpose() * self.residual), 1.0);
        system.add(at, at, &(by.transpose() * by), 1.0);
    }
}

/// Adds what two unknowns of the frames have in common; `later` lies behind `earlier` in the system.
fn add_pair<const R: usize, const C: usize>(
    system: &mut System,
    (later, by_later): (Part, &SMatrix<f64, 15, R>),
    (earlier, by_earlier): (Part, &SMatrix<f64, 15, C>),
) {
    system.couple(later, earlier);
    let (row, col) = (system.offset(later), system.offset(earlier));
    system.add(row, col, &(by_later.transpose() * by_earlier), 1.0);
}

impl Smoother {
    /// Adds the IMU measurements between frame `k` and the one before.
    pub(super) fn add_link(&mut self, system: &mut System, k: usize) -> f64 {
        if k == 0 {
            return 0.0;
        }
        let before = self.frames[k - 1].state;
        let Some(imu_factor) = &mut self.frames[k].imu_factor else { return 0.0 };
        imu_factor.follow(&before);
        let (from, to) = (&self.frames[k - 1], &self.frames[k]);
        let Some(imu_factor) = &to.imu_factor else { return 0.0 };
        let (measured, whitening) = (&imu_factor.preintegration, &imu_factor.whitening);
        let shift = shift_between(&self.calibration, from, to);
        let (now_i, now_j) = (self.body_state_of(from), self.body_state_of(to));
        let r = whitening.apply(&residual(measured, &now_i, &now_j, shift));
        let (body_i, body_j) =
            (self.body_of(from, &system.states_at[k - 1]), self.body_of(to, &system.states_at[k]));
        let (state_i, state_j) = (&body_i.state, &body_j.state);
        let (ji, jj) = jacobians(measured, state_i, state_j, shift);
        let by_offset = self
            .config
            .estimate_time_offset
            .then(|| whitening.apply(&by_time_offset(measured, state_i, state_j, shift)));
        let by_delays = (system.delays > 0)
            .then(|| by_ends(measured, state_i, state_j, shift).map(|d| whitening.apply(&d)));
        let ((ji, by_shift_i), (jj, by_shift_j)) = (body_i.through(&ji), body_j.through(&jj));
        let by_shifts =
            (system.image_shifts > 0).then(|| [by_shift_i, by_shift_j].map(|s| whitening.apply(&s)));
        let (ji, jj) = (whitening.apply(&ji), whitening.apply(&jj));
        let link = Link {
            residual: r,
            ends: [(ji, Part::Motion(k - 1), Part::Pose(k - 1)), (jj, Part::Motion(k), Part::Pose(k))],
            by_offset,
        };
        link.add_states(system);
        if let Some(by) = &by_delays {
            let parts = [Part::Delay(k - 1), Part::Delay(k)];
            parts.into_iter().zip(by).for_each(|(part, by)| link.add_unknown(system, part, by));
            add_pair(system, (parts[1], &by[1]), (parts[0], &by[0]));
        }
        if let Some(by) = &by_shifts {
            let parts = [Part::ImageShift(k - 1), Part::ImageShift(k)];
            parts.into_iter().zip(by).for_each(|(part, by)| link.add_unknown(system, part, by));
            add_pair(system, (parts[1], &by[1]), (parts[0], &by[0]));
            for (delay, by_delay) in
                [Part::Delay(k - 1), Part::Delay(k)].into_iter().zip(by_delays.iter().flatten())
            {
                parts
                    .into_iter()
                    .zip(by)
                    .for_each(|(part, by)| add_pair(system, (part, by), (delay, by_delay)));
            }
        }
        0.5 * r.norm_squared()
    }

    /// The body's state of a frame whose image has a state, with derivatives.
    pub(crate) fn body_of(&self, frame: &Frame, image: &NavState) -> BodyState {
        match self.config.image_shift_sigma() {
            None => BodyState::unshifted(image),
            Some(_) => BodyState::new(image, &frame.image_shift.now, &self.calibration.body_from_camera),
        }
    }
}
