//! Whether a solved window is accepted as the start.

use super::{
    Fit, GOOD_INERTIAL_FIT, InFlightInitializer, InFlightSolution, MAX_ACCEL_BIAS, MAX_GYRO_BIAS,
    MAX_LOG_SCALE_SIGMA, MOST_LEFT_OUT, MOST_LEFT_OUT_PROVISIONAL, PROVISIONAL_SECS, median,
};
use crate::backend::Smoother;
use crate::imu::Bias;
use crate::initialization::failure::{InitFailure, InitFailureReason};
use nalgebra::Vector3;
use vidar_core::FrameId;

/// Most standard deviation of log(scale) of a provisional start: a body that moves steadily shows no scale for long, and a camera that is not
/// tracked meanwhile loses what would show it later. At 0.15 seven of eighteen such recordings (`vidar synth --flight orbit` and `sweep`, a
/// phone in motion from the first image on) had no state at all.
const PROVISIONAL_LOG_SCALE_SIGMA: f64 = 1.0;

/// The length of a window up to which a well-known scale is waited for, s: a lively flight of 5 s that began after 1.8 s with 4.5 % was 1.3 % off in the
/// end, 0.1 % when it began after 2.2 s with 3 %.
const SOON_SECS: f64 = 2.2;

/// Most change of scale between two successive solutions, relative.
const MAX_SCALE_CHANGE: f64 = 0.1;

/// Highest valid speed, m/s: more comes of a wrong scale.
const MAX_SPEED_MPS: f64 = 15.0;

/// χ² per degree of freedom beyond which a solution is rejected.
const MAX_CHI2_PER_DOF: f64 = 3.0;

impl InFlightInitializer {
    /// Step 4, of a window of so many seconds. Where its scale is assumed, since the IMU does not tell it, it need not agree with that of another.
    pub(super) fn evaluate(
        &mut self,
        mut smoother: Smoother,
        fit: &Fit,
        (span_secs, is_assumed): (f64, bool),
    ) -> Result<InFlightSolution, InitFailure> {
        let places: Vec<(FrameId, Vector3<f64>)> = smoother
            .frames()
            .filter_map(|id| Some((id, smoother.state(id)?.world_from_body.translation)))
            .collect();
        let previous = self.last.replace(places.clone());
        let sigma = smoother.log_scale_sigma().unwrap_or(f64::INFINITY);
        let fastest =
            smoother.frames().filter_map(|id| Some(smoother.state(id)?.velocity.norm())).fold(0.0, f64::max);
        let bias = smoother.newest().map_or(Bias::ZERO, |(.., s)| s.bias);
        let median_distance_m = median(smoother.landmarks().map(|l| 1.0 / l.inverse_distance)).unwrap_or(0.0);
        // A well-known scale is taken as soon as it is there; a provisional one only from a long stretch that fits well, and not where a well-known
        // one comes soon: σ falls with the square of a window's length.
        let comes_soon = span_secs * (sigma / MAX_LOG_SCALE_SIGMA).sqrt() <= SOON_SECS;
        let (max_sigma, max_left_out) = match span_secs >= PROVISIONAL_SECS && !comes_soon {
            true if sigma > MAX_LOG_SCALE_SIGMA => (PROVISIONAL_LOG_SCALE_SIGMA, MOST_LEFT_OUT_PROVISIONAL),
            _ => (MAX_LOG_SCALE_SIGMA, MOST_LEFT_OUT),
        };
        let at_most = [
            (InitFailureReason::ScaleUncertainty, sigma, max_sigma),
            (InitFailureReason::OutlierShare, fit.left_out, max_left_out),
            (InitFailureReason::ImageChi2, fit.image, MAX_CHI2_PER_DOF),
            (InitFailureReason::ImuChi2, fit.inertial, GOOD_INERTIAL_FIT),
            (InitFailureReason::Speed, fastest, MAX_SPEED_MPS),
            (InitFailureReason::AccelBias, bias.accel.norm(), MAX_ACCEL_BIAS),
            (InitFailureReason::GyroBias, bias.gyro.norm(), MAX_GYRO_BIAS),
            (InitFailureReason::SceneDistance, median_distance_m, 200.0),
            (InitFailureReason::SceneDistance, 0.02 / median_distance_m.max(1e-9), 1.0),
        ];
        // A NaN must not pass.
        if let Some((reason, measured, limit)) = at_most.into_iter().find(|(_, m, limit)| !(m <= limit)) {
            return Err(InitFailure::new(reason, measured, limit));
        }
        let change = previous.and_then(|p| scale_change(&p, &places)).unwrap_or(f64::INFINITY);
        let max_change = MAX_SCALE_CHANGE.max(sigma);
        if !is_assumed && !(change <= max_change) {
            return Err(InitFailure::new(InitFailureReason::ScaleAgreement, change, max_change));
        }
        self.last = None;
        Ok(InFlightSolution { smoother, log_scale_sigma: sigma, median_distance_m })
    }
}

/// Relative change of the path's extent over the frames that both solutions know.
fn scale_change(before: &[(FrameId, Vector3<f64>)], now: &[(FrameId, Vector3<f64>)]) -> Option<f64> {
    let common: Vec<(Vector3<f64>, Vector3<f64>)> = before
        .iter()
        .filter_map(|(id, p)| Some((*p, now.iter().find(|(other, _)| other == id)?.1)))
        .collect();
    if common.len() < 3 {
        return None;
    }
    let n = common.len() as f64;
    let (a, b) = common.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), (p, q)| (a + p, b + q));
    let (a, b) = (a / n, b / n);
    let before = common.iter().map(|c| (c.0 - a).norm_squared()).sum::<f64>().sqrt();
    let now = common.iter().map(|c| (c.1 - b).norm_squared()).sum::<f64>().sqrt();
    Some((now / before.max(1e-12)).ln().abs())
}
