//! Linearises the window's factors into its normal equations ([`System`]); landmarks are eliminated.

use super::inertial::{Shift, body_velocity, gauge_prior_at};
use super::prior::Part;
use super::products::{product, transposed_product};
use super::reprojection::{Scene, WeightedObservation};
use super::system::{EliminatedLandmark, PoseLandmarkBlock, System};
use super::visual::CameraPose;
use super::window::{CALIBRATION_DIM, CalibrationState, Frame, Landmark};
use super::{Linearisation, Smoother, SmootherConfig};
use nalgebra::{SMatrix, SVector};
use vidar_core::simd::kernel;

/// How far the instants of two frames lie from where the IMU measurements between them were cut.
pub(crate) fn shift_between(calibration: &CalibrationState, from: &Frame, to: &Frame) -> Shift {
    let now = calibration.time_offset_secs;
    Shift { begin: now - from.clock_secs + from.delay.now.x, end: now - to.clock_secs + to.delay.now.x }
}

/// Inverse standard deviations of the calibration's own prior; 0 for what is not estimated.
pub(crate) fn calibration_weights(config: &SmootherConfig) -> [f64; CALIBRATION_DIM] {
    let rotation = 1.0 / config.camera_rotation_sigma_deg.to_radians();
    let position = 1.0 / config.camera_position_sigma_m;
    let clock = 1.0 / (config.time_offset_sigma_ms * 1e-3);
    let on = |yes: bool, w: f64| if yes { w } else { 0.0 };
    let r = on(config.estimate_camera_rotation, rotation);
    let p = on(config.estimate_camera_position, position);
    [r, r, r, p, p, p, on(config.estimate_time_offset, clock)]
}

impl Smoother {
    /// Fills places and linearisation points of all frames.
    pub(crate) fn place_cameras(&self, system: &mut System) {
        let fej = self.config.first_estimates();
        let (now, at) = (self.calibration.body_from_camera, self.calibration.at(fej));
        system.camera_poses.clear();
        system.camera_poses_at.clear();
        system.states_at.clear();
        for frame in &self.frames {
            let state_at = frame.at(fej);
            system.camera_poses.push(CameraPose::new(&frame.state.world_from_body, &now));
            system.camera_poses_at.push(CameraPose::new(&state_at.world_from_body, &at));
            system.states_at.push(state_at);
        }
    }

    /// Builds the system at the present states and returns the robust cost.
    pub(crate) fn linearise(&mut self, system: &mut System, lambda: f64) -> f64 {
        system.begin(
            self.frames.len(),
            self.config.delay_sigma().is_some(),
            self.config.image_shift_sigma().is_some(),
            self.config.calibrates(),
        );
        self.place_cameras(system);
        let mut cost = self.add_prior(system);
        cost += self.add_anchor(system);
        for k in 0..self.frames.len() {
            cost += self.add_link(system, k);
            cost += self.add_delay(system, k);
            cost += self.add_image_shift(system, k);
            cost += self.add_standstill_factor(system, k);
            cost += self.add_rest_factor(system, k);
        }
        if self.config.calibrates() {
            cost += self.add_calibration(system);
        }
        cost += self.add_landmarks(system, lambda);
        // Unknowns without any factor stay where they are.
        for i in 0..system.n {
            if system.h[i * system.n + i] <= 0.0 {
                system.h[i * system.n + i] = 1.0;
            }
        }
        cost
    }

    fn add_prior(&mut self, system: &mut System) -> f64 {
        let cost = self.prior.evaluate(&self.frames, &self.calibration);
        let constrained = self.config.linearisation == Linearisation::ObservabilityConstrained;
        self.prior.constrain(&self.frames, constrained);
        let prior = &self.prior;
        for (a, &part_a) in prior.parts.iter().enumerate() {
            let row = system.offset(part_a);
            if row >= system.n {
                continue;
            }
            for i in 0..part_a.dim() {
                system.gradient[row + i] += prior.gradient[prior.starts[a] + i];
            }
            for (b, &part_b) in prior.parts.iter().enumerate() {
                let col = system.offset(part_b);
                if col > row || col >= system.n {
                    continue;
                }
                system.couple(part_a, part_b);
                for i in 0..part_a.dim() {
                    let at = prior.starts[a] + i;
                    let from = at * prior.dim + prior.starts[b];
                    let to = (row + i) * system.n + col;
                    let source = &prior.information[from..from + part_b.dim()];
                    let columns = prior.starts[b]..prior.starts[b] + part_b.dim();
                    let target = &mut system.h[to..to + part_b.dim()];
                    for ((target, value), j) in target.iter_mut().zip(source).zip(columns) {
                        *target += value + prior.correction(at, j);
                    }
                }
            }
        }
        cost
    }

    fn add_anchor(&self, system: &mut System) -> f64 {
        let Some(gauge_prior) = &self.gauge_prior else { return 0.0 };
        let k = gauge_prior.frame;
        let (r, j) = gauge_prior_at(
            &gauge_prior.reference,
            &gauge_prior.sigmas,
            &self.frames[k].state,
            &system.states_at[k],
        );
        let (pose, motion) = (Part::Pose(k), Part::Motion(k));
        let (jp, jm) = (j.fixed_columns::<6>(0).into_owned(), j.fixed_columns::<9>(6).into_owned());
        let (at_pose, at_motion) = (system.offset(pose), system.offset(motion));
        system.couple(pose, motion);
        system.add(at_motion, at_motion, &(jm.transpose() * jm), 1.0);
        system.add(at_pose, at_motion, &(jp.transpose() * jm), 1.0);
        system.add(at_pose, at_pose, &(jp.transpose() * jp), 1.0);
        system.add_gradient(at_motion, &(jm.transpose() * r), 1.0);
        system.add_gradient(at_pose, &(jp.transpose() * r), 1.0);
        0.5 * r.norm_squared()
    }

    /// That a frame's delay is about zero.
    fn add_delay(&self, system: &mut System, k: usize) -> f64 {
        let Some(sigma) = self.config.delay_sigma() else { return 0.0 };
        let (at, r) = (system.offset(Part::Delay(k)), self.frames[k].delay.now.x / sigma);
        system.h[at * system.n + at] += 1.0 / (sigma * sigma);
        system.gradient[at] += r / sigma;
        0.5 * r * r
    }

    fn add_standstill_factor(&self, system: &mut System, k: usize) -> f64 {
        let Some(sigma) = self.frames[k].standstill_sigma else { return 0.0 };
        let weight = 1.0 / sigma;
        let r = body_velocity(&self.frames[k].state).0 * weight;
        let (_, by_rotation, by_velocity) = body_velocity(&system.states_at[k]);
        let (jr, jv) = (by_rotation * weight, by_velocity * weight);
        let (pose, motion) = (Part::Pose(k), Part::Motion(k));
        let (p, m) = (system.offset(pose), system.offset(motion));
        system.couple(pose, motion);
        system.add(m, m, &(jv.transpose() * jv), 1.0);
        system.add(p, m, &(jr.transpose() * jv), 1.0);
        system.add(p, p, &(jr.transpose() * jr), 1.0);
        system.add_gradient(m, &(jv.transpose() * r), 1.0);
        system.add_gradient(p, &(jr.transpose() * r), 1.0);
        0.5 * r.norm_squared()
    }

    /// The calibration's own prior, until it is part of the window's.
    fn add_calibration(&self, system: &mut System) -> f64 {
        if self.calibration.in_prior {
            return 0.0;
        }
        let weights = calibration_weights(&self.config);
        let difference = self.calibration.minus_given();
        let at = system.offset(Part::Calibration);
        let mut cost = 0.0;
        for k in 0..CALIBRATION_DIM {
            let r = weights[k] * difference[k];
            cost += 0.5 * r * r;
            system.h[(at + k) * system.n + at + k] += weights[k] * weights[k];
            system.gradient[at + k] += weights[k] * r;
        }
        cost
    }

    fn add_landmarks(&mut self, system: &mut System, lambda: f64) -> f64 {
        let camera_poses = std::mem::take(&mut system.camera_poses);
        let camera_poses_at = std::mem::take(&mut system.camera_poses_at);
        let scene = Scene {
            camera: &self.camera,
            config: &self.config,
            camera_poses: &camera_poses,
            camera_poses_at: &camera_poses_at,
        };
        let cost = add_each_landmark(system, &scene, &mut self.landmarks, lambda);
        system.camera_poses = camera_poses;
        system.camera_poses_at = camera_poses_at;
        cost
    }
}

kernel! {
    // Blocks of six by six are too small for 512 bits: 8 % slower with them on a Zen 4.
    up to Avx2;
    /// Adds all landmarks.
    fn add_each_landmark(system: &mut System, scene: &Scene<'_>, landmarks: &mut [Landmark], lambda: f64) -> f64 {
        add_observed(system, scene, landmarks, lambda)
    }
}

#[inline(always)]
fn add_observed(system: &mut System, scene: &Scene<'_>, landmarks: &mut [Landmark], lambda: f64) -> f64 {
    let mut cost = 0.0;
    for (slot, landmark) in landmarks.iter_mut().enumerate() {
        if landmark.alive && !landmark.observations.is_empty() {
            cost += add_landmark(system, scene, landmark, slot, lambda);
        }
    }
    cost
}

#[inline(always)]
fn add_landmark(
    system: &mut System,
    scene: &Scene<'_>,
    landmark: &mut Landmark,
    slot: usize,
    lambda: f64,
) -> f64 {
    let Some((mut cost, own)) = scene.host(landmark) else { return 0.0 };
    let calibrates = scene.config.calibrates_camera();
    let at_calibration = system.offset(Part::Calibration);
    let host = landmark.host.frame;
    let at_host = system.offset(Part::Pose(host));
    let mut square = own.jacobians.by_landmark.transpose() * own.jacobians.by_landmark;
    let mut gradient = own.jacobians.by_landmark.transpose() * own.residual;
    if let Some(prior) = landmark.prior {
        let (r, slope) = prior.residual(landmark.rho);
        square[(2, 2)] += slope * slope;
        gradient.z += slope * r;
        cost += 0.5 * r * r;
    }
    let mut host_square = SMatrix::<f64, 6, 6>::zeros();
    let mut host_gradient = SVector::<f64, 6>::zeros();
    let mut by_calibration = SMatrix::<f64, CALIBRATION_DIM, 3>::zeros();
    let cross_begin = system.cross.len();
    system.cross.push(PoseLandmarkBlock { frame: host, value: SMatrix::zeros() });
    let mut observations = std::mem::take(&mut landmark.observations);
    for s in &mut observations {
        let (part, weighted) = scene.observation(landmark, s);
        cost += part;
        let Some(WeightedObservation { residual: r, jacobians: j, by_calibration: c }) = weighted else {
            continue;
        };
        let target = system.offset(Part::Pose(s.frame));
        host_square += transposed_product(&j.by_host, &j.by_host);
        host_gradient += transposed_product(&j.by_host, &r);
        system.add(target, target, &transposed_product(&j.by_target, &j.by_target), 1.0);
        system.add_either(target, at_host, &transposed_product(&j.by_target, &j.by_host), 1.0);
        system.add_gradient(target, &transposed_product(&j.by_target, &r), 1.0);
        square += transposed_product(&j.by_landmark, &j.by_landmark);
        gradient += transposed_product(&j.by_landmark, &r);
        system.cross[cross_begin].value += transposed_product(&j.by_host, &j.by_landmark);
        let value = transposed_product(&j.by_target, &j.by_landmark);
        system.cross.push(PoseLandmarkBlock { frame: s.frame, value });
        if let Some(c) = c {
            by_calibration += c.transpose() * j.by_landmark;
            system.add(at_calibration, at_calibration, &(c.transpose() * c), 1.0);
            system.add(at_calibration, at_host, &(c.transpose() * j.by_host), 1.0);
            system.add(at_calibration, target, &(c.transpose() * j.by_target), 1.0);
            system.add_gradient(at_calibration, &(c.transpose() * r), 1.0);
        }
    }
    landmark.observations = observations;
    system.add(at_host, at_host, &host_square, 1.0);
    system.add_gradient(at_host, &host_gradient, 1.0);
    let mut damped = square;
    for k in 0..3 {
        damped[(k, k)] += lambda * square[(k, k)] + 1e-12;
    }
    let Some(inverse) = damped.try_inverse() else {
        system.cross.truncate(cross_begin);
        return cost;
    };
    landmark.rho_sigma = inverse[(2, 2)].max(0.0).sqrt();
    // Schur complement: H −= W V⁻¹ Wᵀ, g −= W V⁻¹ g_l.
    let cross_end = system.cross.len();
    for a in cross_begin..cross_end {
        let PoseLandmarkBlock { frame, value } = system.cross[a];
        let weighted = product(&value, &inverse);
        let row = system.offset(Part::Pose(frame));
        system.add_gradient(row, &product(&weighted, &gradient), -1.0);
        for b in cross_begin..=a {
            let other = system.cross[b];
            let col = system.offset(Part::Pose(other.frame));
            system.subtract_outer((row, &weighted), (col, &other.value));
        }
        if calibrates {
            system.add(at_calibration, row, &(by_calibration * weighted.transpose()), -1.0);
        }
    }
    if calibrates {
        let weighted = by_calibration * inverse;
        system.add(at_calibration, at_calibration, &(weighted * by_calibration.transpose()), -1.0);
        system.add_gradient(at_calibration, &(weighted * gradient), -1.0);
    }
    system.eliminated.push(EliminatedLandmark {
        slot,
        inverse,
        gradient,
        cross_begin,
        cross_end,
        by_calibration,
    });
    cost
}
