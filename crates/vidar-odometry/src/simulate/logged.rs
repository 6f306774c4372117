//! Logs of simulated flights, for the adjustment after the end.

use super::random::Random;
use super::sensors::Simulation;
use crate::bundle_adjustment::{
    Adjusted, AdjustmentError, AdjustmentInput, CalibrationSigmas, LoggedState, Progress, TrackLog, adjust,
};
use crate::imu::{Bias, ImuModel, NavState};
use nalgebra::Vector3;
use std::ops::ControlFlow;
use vidar_core::{Duration, FrameId, ImuNoise, LieGroup, RigCamera, Se3, So3, Timestamp};

/// What an adjustment of a simulated flight is given.
#[derive(Clone, Debug)]
pub struct AdjustSettings {
    /// Place of the camera that it is told, right-multiplied by this to be wrong.
    pub camera_error: Se3,
    /// What may change.
    pub sigmas: CalibrationSigmas,
    /// The IMU's data sheet, and factors on its white noise to begin with (gyroscope, accelerometer).
    pub noise: ImuNoise,
    /// See `noise`.
    pub noise_factors: [f64; 2],
    /// Scale of the states that it begins with; they are disturbed besides.
    pub first_scale: f64,
}

impl Default for AdjustSettings {
    fn default() -> Self {
        Self {
            camera_error: Se3::IDENTITY,
            sigmas: CalibrationSigmas::default(),
            noise: ImuNoise::EUROC,
            noise_factors: [2.0, 4.0],
            first_scale: 1.05,
        }
    }
}

/// A simulated flight as the odometry would have logged it.
#[derive(Clone, Debug)]
pub struct Logged {
    log: TrackLog,
    camera: RigCamera,
    /// Truth of every image, by its stamp.
    pub truth: Vec<(FrameId, Timestamp, NavState)>,
}

impl Logged {
    /// Logs every `every`th frame of a simulation, with states that are off as the odometry's are.
    pub fn new(simulation: &Simulation, every: usize, seed: u64, settings: &AdjustSettings) -> Self {
        let mut random = Random::new(seed ^ 0x5eed);
        let mut log = TrackLog::new(settings.noise.rate_hz);
        simulation.imu_samples.iter().for_each(|s| log.add_imu(s));
        for (k, frame) in simulation.frames.iter().enumerate() {
            log.add_stamp(frame.id, frame.time);
            if !k.is_multiple_of(every) {
                continue;
            }
            let place = &frame.truth.world_from_body;
            let turn = So3::exp(&(random.normal3() * 0.01));
            let position = place.translation * settings.first_scale + random.normal3() * 0.01;
            let state = NavState {
                world_from_body: Se3::new(place.rotation * turn, position),
                velocity: frame.truth.velocity * settings.first_scale + random.normal3() * 0.02,
                bias: Bias::ZERO,
            };
            let shown = frame.observations.iter().map(|o| (o.landmark, &o.pixel, o.covariance));
            let logged = Some(LoggedState { segment: 0, state });
            log.add_image(frame.id, (frame.id, frame.time), logged, shown);
        }
        let camera = RigCamera {
            model: simulation.camera.clone(),
            body_from_camera: simulation.body_from_camera,
            time_offset: Duration::ZERO,
            rate_hz: Some(10.0),
        };
        let truth = simulation.frames.iter().map(|f| (f.id, f.time, f.truth)).collect();
        Self { log, camera, truth }
    }

    /// Adjusts it.
    ///
    /// # Errors
    /// As [`adjust`].
    pub fn adjust(
        &self,
        settings: &AdjustSettings,
        tell: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    ) -> Result<Adjusted, AdjustmentError> {
        let mut camera = self.camera.clone();
        camera.body_from_camera = camera.body_from_camera * settings.camera_error;
        let [gyro, accel] = settings.noise_factors;
        let input = AdjustmentInput {
            log: &self.log,
            camera: &camera,
            readout_secs: 0.0,
            given_body_from_camera: camera.body_from_camera,
            model: ImuModel::from_data_sheet(&settings.noise, gyro, accel),
            data_sheet: ImuModel::from_data_sheet(&settings.noise, 1.0, 1.0).noise,
            sigmas: &settings.sigmas,
        };
        adjust(&input, tell)
    }

    /// ln(scale) of the adjusted path against the truth: the spread of positions.
    pub fn log_scale_error(&self, adjusted: &Adjusted) -> f64 {
        let pairs: Vec<(Vector3<f64>, Vector3<f64>)> = adjusted
            .images
            .iter()
            .filter_map(|(id, state)| {
                let (.., truth) = self.truth.get(id.index())?;
                Some((state.world_from_body.translation, truth.world_from_body.translation))
            })
            .collect();
        let n = pairs.len() as f64;
        let (sum, true_sum) =
            pairs.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), (p, q)| (a + p, b + q));
        let spread: f64 = pairs.iter().map(|(p, _)| (p - sum / n).norm_squared()).sum();
        let true_spread: f64 = pairs.iter().map(|(_, q)| (q - true_sum / n).norm_squared()).sum();
        0.5 * (spread / true_spread).ln()
    }
}
