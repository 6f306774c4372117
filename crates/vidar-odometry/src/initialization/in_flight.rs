//! Start in motion.

mod acceptance;
mod assumed;

use super::failure::{InitFailure, InitFailureReason};
use super::gyro_bias::{RayPair, gyro_bias};
use super::linear::{self, LinearSolution};
use super::log::LoggedFrame;
use super::static_start::leveled;
use super::views::{self, Track, View};
use crate::backend::{GaugePriorSigmas, OptimiseReport, Smoother, SmootherConfig, SmootherError};
use crate::imu::{Bias, NavState};
use nalgebra::Vector3;
use vidar_core::{CameraModel, FrameId, LandmarkId, LieGroup, Se3, So3};
use vidar_solve::statistics::median_upper;

/// Longest stretch of the log that is used, s.
pub const WINDOW_SECS: f64 = 2.8;

/// Shortest stretch that is tried, s: in less the acceleration hardly changes, and the scale follows from its change.
const MIN_SECS: f64 = 0.7;

/// Most frames that are chosen from it.
const KEYFRAMES: usize = 15;

/// Fewest tracks that at least three chosen frames share.
const MIN_TRACKS: usize = 25;

/// Least median parallax, degrees.
const MIN_PARALLAX_DEG: f64 = 1.0;

/// The same of a provisional start, over a turn of so many degrees. A body that turns on the spot shows 0.2 degrees and 1 % of its turn, by errors of
/// the gyroscope (0.28 at 10, 0.65 at 33; `pure_rotation_is_never_accepted`); one that moves in a hall shows little, however long it goes on.
fn least_parallax_deg(turned_deg: f64) -> f64 {
    (0.5 + 0.015 * turned_deg).min(MIN_PARALLAX_DEG)
}

/// Most standard deviation of log(scale) of a start. 0.03 lets half of the starts be within 2 %.
pub const MAX_LOG_SCALE_SIGMA: f64 = 0.03;

/// A stretch of the log from which on the scale may be provisional, s: the state starts with whatever scale is known then, and its
/// standard deviation is reported.
pub(super) const PROVISIONAL_SECS: f64 = 1.8;

/// Standard deviation of the accelerometer's bias before anything is known, m/s².
const ACCEL_BIAS_SIGMA: f64 = 0.15;

/// Standard deviation of the gyroscope's bias before anything is known, rad/s.
const GYRO_BIAS_SIGMA: f64 = 0.1;

/// A metric state found in motion.
#[derive(Clone, Debug)]
pub struct InFlightSolution {
    /// The window, solved; it goes on as the running smoother. World: z up, origin and heading of its first frame.
    pub smoother: Smoother,
    /// Standard deviation of log(scale).
    pub log_scale_sigma: f64,
    /// Median distance of landmarks from their first camera, m.
    pub median_distance_m: f64,
}

/// Result of an attempt to initialise.
#[derive(Clone, Debug)]
pub enum InitOutcome {
    /// A metric state.
    Solved(Box<InFlightSolution>),
    /// No metric state yet, and why.
    Failed(InitFailure),
}

/// Largest valid biases, m/s² and rad/s.
const MAX_ACCEL_BIAS: f64 = 0.6;
const MAX_GYRO_BIAS: f64 = 0.3;

/// Steps of the window's solution.
const STEPS: usize = 20;

/// Damping that the window's solution begins with: its start is rough.
const FIRST_LAMBDA: f64 = 3e-3;

/// What rays miss their points by in the linear system, relative to their noise: rotations are only as good as the first
/// gyroscope bias, and an accelerometer bias must not make up for that.
const LINEAR_INFLATION: f64 = 100.0;

/// A gyroscope bias that an earlier solution knows this well (rad/s) is taken over.
const KNOWN_GYRO_BIAS: f64 = 5e-3;

/// Scales of the linear solution that the window is solved from, until one fits.
const SCALES: [f64; 4] = [1.0, 3.0, 9.0, 0.4];

/// Inertial χ² per degree of freedom of a window that fits. Most of these degrees of freedom follow the images, so what
/// fits lies far below 1.
const GOOD_INERTIAL_FIT: f64 = 0.4;

/// Share of observations that may be left out as wrong.
const MOST_LEFT_OUT: f64 = 0.2;
/// The same for a provisional start, whose scale gives less evidence that the solution is right.
const MOST_LEFT_OUT_PROVISIONAL: f64 = 0.1;

/// How well a solved window fits.
#[derive(Clone, Copy, Debug)]
struct Fit {
    /// χ² per degree of freedom of the observations kept.
    image: f64,
    /// χ² per degree of freedom of the IMU measurements.
    inertial: f64,
    /// Share of observations that were left out.
    left_out: f64,
    converged: bool,
}

impl Fit {
    fn is_good(&self) -> bool {
        self.converged && self.inertial < GOOD_INERTIAL_FIT && self.left_out < MOST_LEFT_OUT
    }

    fn score(&self) -> f64 {
        self.inertial / GOOD_INERTIAL_FIT
            + self.left_out / MOST_LEFT_OUT
            + f64::from(u8::from(!self.converged))
    }
}

/// Finds the first metric state in motion. Give it the log whenever a frame came; it remembers its last solution.
#[derive(Clone, Debug)]
pub struct InFlightInitializer {
    smoother_config: SmootherConfig,
    camera: CameraModel,
    body_from_camera: Se3,
    gyro_bias: Vector3<f64>,
    gyro_bias_known: bool,
    last: Option<Vec<(FrameId, Vector3<f64>)>>,
}

impl InFlightInitializer {
    /// Nothing is known yet but the calibration.
    pub fn new(smoother_config: SmootherConfig, camera: CameraModel, body_from_camera: Se3) -> Self {
        Self {
            smoother_config,
            camera,
            body_from_camera,
            gyro_bias: Vector3::zeros(),
            gyro_bias_known: false,
            last: None,
        }
    }

    /// Gyroscope bias as found by the last attempt that came so far, rad/s.
    pub fn gyro_bias(&self) -> &Vector3<f64> {
        &self.gyro_bias
    }

    /// Starts over.
    pub fn forget(&mut self) {
        self.gyro_bias_known = false;
        self.last = None;
    }

    /// Looks for a metric state in the log (oldest first).
    ///
    /// # Errors
    /// A smoother that cannot be built, which is a fault of the settings.
    pub fn attempt(&mut self, log: &[LoggedFrame]) -> Result<InitOutcome, SmootherError> {
        match self.solve(log)? {
            Ok(started) => Ok(InitOutcome::Solved(Box::new(started))),
            Err(failure) => Ok(InitOutcome::Failed(failure)),
        }
    }

    fn solve(&mut self, log: &[LoggedFrame]) -> Result<Result<InFlightSolution, InitFailure>, SmootherError> {
        let most = KEYFRAMES.min(self.smoother_config.max_frames - 1).max(3);
        let mut views = views::choose(log, WINDOW_SECS, most);
        let span = match (views.first(), views.last()) {
            (Some(first), Some(last)) => (last.logged.time - first.logged.time).as_secs_f64(),
            _ => 0.0,
        };
        if !(span >= MIN_SECS) {
            return Ok(Err(InitFailure::new(InitFailureReason::Seconds, span, MIN_SECS)));
        }
        if views.len() < 5 {
            return Ok(Err(InitFailure::new(InitFailureReason::Frames, views.len() as f64, 5.0)));
        }
        let tracks = views::gather(&views, &self.camera);
        if tracks.len() < MIN_TRACKS {
            let wanted = MIN_TRACKS as f64;
            return Ok(Err(InitFailure::new(InitFailureReason::Tracks, tracks.len() as f64, wanted)));
        }
        if !self.gyro_bias_known {
            self.find_gyro_bias(&views, &tracks);
        }
        let bias = Bias { gyro: self.gyro_bias, accel: Vector3::zeros() };
        views.iter_mut().filter_map(|v| v.preintegration.as_mut()).for_each(|r| r.reintegrate(bias));
        let turns = views::rotations(&views, &bias);
        let (parallax, turned) = views::median_parallax_deg(&tracks, &turns, &self.body_from_camera.rotation);
        let least = if span >= PROVISIONAL_SECS { least_parallax_deg(turned) } else { MIN_PARALLAX_DEG };
        if !(parallax >= least) {
            return Ok(Err(InitFailure::new(InitFailureReason::Parallax, parallax, least)));
        }
        let Some(first) = self.linear_start(&views, &tracks, &turns) else {
            return Ok(Err(InitFailure::new(
                InitFailureReason::ScaleUncertainty,
                f64::INFINITY,
                MAX_LOG_SCALE_SIGMA,
            )));
        };
        let mut best: Option<(Smoother, Fit)> = None;
        // The linear system leans towards small scenes, where every miss is short; larger ones are tried when it failed.
        for scale in SCALES {
            let mut smoother = self.build(&views, &tracks, &turns, &first.scaled(scale))?;
            let fit = self.refine(&mut smoother);
            let good = fit.is_good();
            if best.as_ref().is_none_or(|(_, held)| fit.score() < held.score()) {
                best = Some((smoother, fit));
            }
            if good {
                break;
            }
        }
        let Some((mut smoother, mut fit)) = best else {
            return Ok(Err(InitFailure::new(InitFailureReason::Frames, 0.0, 1.0)));
        };
        let mut is_assumed = false;
        if span >= PROVISIONAL_SECS
            && !Self::tells_scale(&mut smoother)
            && let Some(assumed) = Self::at_assumed_distance(&smoother, &views, &tracks)
        {
            smoother = self.build(&views, &tracks, &turns, &assumed)?;
            fit = self.refine_with_assumed_distances(&mut smoother);
            is_assumed = true;
        }
        self.learn_gyro_bias(&mut smoother);
        Ok(self.evaluate(smoother, &fit, (span, is_assumed)))
    }

    /// Step 1: gyroscope bias from pairs of neighbouring and next-but-one views.
    fn find_gyro_bias(&mut self, views: &[View<'_>], tracks: &[Track]) {
        let camera_turn = self.body_from_camera.rotation;
        let mut pairs = Vec::new();
        for apart in [1, views.len() / 3, views.len() / 2] {
            for i in 0..views.len().saturating_sub(apart) {
                let j = i + apart;
                let ray =
                    |t: &Track, k: usize| t.observations.iter().find(|(v, ..)| *v == k).map(|(.., ray)| *ray);
                let rays: Vec<_> = tracks.iter().filter_map(|t| Some((ray(t, i)?, ray(t, j)?))).collect();
                if rays.len() < 10 {
                    continue;
                }
                let preintegration = &views[i + 1..=j];
                let rotation = move |bias: &Bias| {
                    let turn = preintegration.iter().filter_map(|v| v.preintegration.as_ref());
                    let body = turn.fold(So3::IDENTITY, |sum, r| sum * r.rotation(bias));
                    camera_turn.inverse() * body * camera_turn
                };
                pairs.push(RayPair { rays, rotation });
            }
        }
        if !pairs.is_empty() {
            self.gyro_bias = gyro_bias(&pairs, self.gyro_bias);
        }
    }

    /// Step 2: velocity, gravity, bias and points, linear.
    fn linear_start(&self, views: &[View<'_>], tracks: &[Track], turns: &[So3]) -> Option<LinearSolution> {
        let gravity_mps2 = views.iter().find_map(|v| v.preintegration.as_ref())?.model().gravity_mps2;
        let (linear_views, rays) = views::linear_input(views, tracks, turns, &self.body_from_camera);
        let sigma_rad = LINEAR_INFLATION * views::ray_sigma_rad(tracks, &self.camera);
        linear::solve(&linear_views, &rays, sigma_rad, ACCEL_BIAS_SIGMA, gravity_mps2)
    }

    /// Step 3: the window as a smoother.
    fn build(
        &self,
        views: &[View<'_>],
        tracks: &[Track],
        turns: &[So3],
        first: &LinearSolution,
    ) -> Result<Smoother, SmootherError> {
        let world_from_first = leveled(&-first.gravity);
        let bias = Bias { gyro: self.gyro_bias, accel: first.accel_bias };
        let mut state = NavState {
            world_from_body: Se3::new(world_from_first, Vector3::zeros()),
            velocity: world_from_first * first.velocity,
            bias,
        };
        let mut smoother =
            Smoother::new(self.smoother_config.clone(), self.camera.clone(), self.body_from_camera)?;
        let sigmas = GaugePriorSigmas {
            gyro_bias: GYRO_BIAS_SIGMA,
            accel_bias: ACCEL_BIAS_SIGMA,
            ..GaugePriorSigmas::GAUGE
        };
        for (k, view) in views.iter().enumerate() {
            let (id, time) = (view.logged.frame, view.logged.time);
            match &view.preintegration {
                Some(preintegration) if k > 0 => {
                    state = preintegration.predict(&state);
                    state.world_from_body.rotation = world_from_first * turns[k];
                    smoother.add_frame(id, time, state, Some(preintegration.clone()))?;
                }
                _ => {
                    // The bias is about zero, not about the start value.
                    smoother.start_about(id, time, state, NavState { bias: Bias::ZERO, ..state }, sigmas)?;
                }
            }
            smoother.mark_keyframe(id)?;
        }
        let fallback = median(first.points.iter().flatten().map(|p| p.norm())).unwrap_or(4.0);
        for (track, point) in tracks.iter().zip(&first.points) {
            let (host, first_seen, _) = track.observations[0];
            let at = smoother.state(views[host].logged.frame).map_or(Se3::IDENTITY, |s| s.world_from_body);
            let distance = point.map_or(fallback, |p| {
                (world_from_first * p - at.act(&self.body_from_camera.translation)).norm()
            });
            let first_seen = first_seen.by(views[host].logged.frame);
            smoother.add_landmark(&first_seen, 1.0 / distance.clamp(0.1, 1e3))?;
            for (view, seen, _) in &track.observations[1..] {
                smoother.add_observation(&seen.by(views[*view].logged.frame))?;
            }
        }
        Ok(smoother)
    }

    /// Solves the window, leaves out what does not fit, and solves again.
    fn refine(&self, smoother: &mut Smoother) -> Fit {
        let mut report = OptimiseReport::default();
        smoother.optimise_from(FIRST_LAMBDA, STEPS, &mut report);
        let all = report.observations.max(1) as f64;
        for _ in 0..3 {
            if report.outliers.is_empty() && report.converged {
                break;
            }
            for outlier in &report.outliers {
                smoother.remove_observation(outlier.frame, outlier.landmark);
            }
            smoother.optimise_from(FIRST_LAMBDA, STEPS / 2, &mut report);
        }
        let lonely: Vec<LandmarkId> =
            smoother.landmarks().filter(|l| l.observations < 2).map(|l| l.id).collect();
        for landmark in lonely {
            smoother.remove_landmark(landmark);
        }
        Fit {
            image: report.chi2_per_dof,
            inertial: smoother.inertial_chi2_per_dof(),
            left_out: 1.0 - report.observations as f64 / all,
            converged: report.converged,
        }
    }

    /// Takes over the gyroscope bias of a solution that knows it, accepted or not: it is the first thing to become sure,
    /// and the next attempt starts the better for it.
    fn learn_gyro_bias(&mut self, smoother: &mut Smoother) {
        let sure = smoother
            .covariance_of_newest()
            .is_some_and(|c| (9..12).all(|k| c[(k, k)] < KNOWN_GYRO_BIAS * KNOWN_GYRO_BIAS));
        if let (true, Some((.., state))) = (sure, smoother.newest())
            && state.bias.gyro.norm() < MAX_GYRO_BIAS
        {
            self.gyro_bias = state.bias.gyro;
            self.gyro_bias_known = true;
        }
    }
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    median_upper(&mut values.collect::<Vec<f64>>())
}
