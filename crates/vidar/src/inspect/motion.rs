//! What the IMU shows of how a recording was filmed, and what to film differently next time.

use super::ImageHealth;
use nalgebra::Vector3;
use serde::Serialize;
use vidar_core::{ImuSample, LieGroup, So3};

/// Length of the pieces that are looked at, s: a hand speeds up and slows down within one.
const PIECE_SECS: f64 = 2.0;
/// Longest time between samples across which rotation is integrated, s.
const LONGEST_STEP_SECS: f64 = 0.1;

/// Median change of velocity per time, m/s², below which the scale is poorly seen. Twenty rendered recordings of 20 s, slow
/// walks among them, have 0.33 to 3.9, and the real EuRoC MH_01 excerpt 1.2; their scale was known to 0.3 to 3 %.
const LITTLE_ACCELERATION: f64 = 0.25;
/// Rate of turning, °/s, that blurs: a pixel in 4 ms of exposure at f 500 px. The same recordings stay below it in 95 % of the
/// time, but for the fastest.
const FAST_DEG_PER_S: f64 = 110.0;
/// Rate below which the camera does not turn, °/s, and acceleration below which it does not move, m/s².
const STILL_DEG_PER_S: f64 = 1.0;
const STILL_ACCELERATION: f64 = 0.08;
/// Turning per second, °, about the two axes that turn less, below which the camera's mounting is poorly seen.
const LITTLE_TURNING: f64 = 1.0;
/// Image statistics of a dark and of a blurred image, see [`ImageHealth`].
const DARK: f64 = 40.0;
const BLURRED: f64 = 20.0;

/// How the camera moved, from the IMU alone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Motion {
    /// Median and 95th percentile of the rate of turning, °/s.
    pub turning_deg_per_s: [f64; 2],
    /// Turning per second about each axis of the IMU, °/s.
    pub turning_by_axis_deg_per_s: [f64; 3],
    /// Median over pieces of two seconds of the standard deviation of acceleration, m/s².
    pub acceleration_m_per_s2: f64,
    /// Share of the pieces in which it neither moves nor turns, 0…1.
    pub still: f64,
}

impl Motion {
    /// `None` for less than two pieces.
    pub(super) fn of(imu: &[ImuSample]) -> Option<Self> {
        let mut pieces = Vec::new();
        let mut rest = imu;
        while let Some(first) = rest.first() {
            let end = rest.partition_point(|s| (s.time - first.time).as_secs_f64() < PIECE_SECS);
            let (piece, after) = rest.split_at(end);
            // The last piece is shorter.
            if !after.is_empty() {
                pieces.push(Piece::of(piece));
            }
            rest = after;
        }
        if pieces.len() < 2 {
            return None;
        }
        let mut rates: Vec<f64> = imu.iter().map(|s| s.gyro.0.norm().to_degrees()).collect();
        rates.sort_by(f64::total_cmp);
        let mut accelerations: Vec<f64> = pieces.iter().map(|p| p.acceleration).collect();
        accelerations.sort_by(f64::total_cmp);
        let by_axis = imu.iter().map(|s| s.gyro.0.abs()).sum::<Vector3<f64>>() / imu.len() as f64;
        let still = pieces.iter().filter(|p| p.is_still()).count() as f64 / pieces.len() as f64;
        Some(Self {
            turning_deg_per_s: [rates[rates.len() / 2], rates[rates.len() * 95 / 100]],
            turning_by_axis_deg_per_s: by_axis.map(f64::to_degrees).into(),
            acceleration_m_per_s2: accelerations[accelerations.len() / 2],
            still,
        })
    }

    /// In words.
    pub(super) fn words(&self) -> String {
        let [median, p95] = self.turning_deg_per_s;
        format!(
            "turns {median:.0} °/s in the median (95 %: {p95:.0}), accelerates by {:.2} m/s², stands still {:.0} % of the time",
            self.acceleration_m_per_s2,
            100.0 * self.still
        )
    }

    /// What to film differently.
    pub(super) fn advice(&self) -> Vec<String> {
        let mut advice = Vec::new();
        let mut by_axis = self.turning_by_axis_deg_per_s;
        by_axis.sort_by(f64::total_cmp);
        let [median, p95] = self.turning_deg_per_s;
        if self.still > 0.5 {
            advice.push("it stands still most of the time: begin to film when you begin to move".into());
        }
        if self.acceleration_m_per_s2 < LITTLE_ACCELERATION {
            advice.push(match median > 10.0 {
                true => "turn less on the spot, move sideways for two seconds, there and back: the scale comes from changes of speed",
                false => "move more briskly, there and back, two seconds each way: the scale comes from changes of speed",
            }.into());
        }
        if by_axis[1] < LITTLE_TURNING {
            advice.push(
                "tilt and roll the camera by 20° now and then: turning about one axis does not show how it is mounted on the IMU"
                    .into(),
            );
        }
        if p95 > FAST_DEG_PER_S {
            advice.push(format!(
                "turn more slowly: {p95:.0} °/s blurs images and bends them by the rolling shutter"
            ));
        }
        advice
    }
}

/// What the images want.
pub(super) fn advice_of_images(images: &ImageHealth) -> Vec<String> {
    let mut advice = Vec::new();
    if images.brightness < DARK {
        advice.push("more light: the images are dark".to_owned());
    }
    if images.sharpness < BLURRED {
        advice.push(
            "shorter exposure, more light, or walls with something on them: the images show little detail"
                .to_owned(),
        );
    }
    if images.clipped > 0.2 {
        advice.push("lock the exposure darker: a fifth of the pixels is black or white".to_owned());
    }
    advice
}

/// Two seconds.
struct Piece {
    /// Standard deviation of the specific force in a frame that does not turn, m/s².
    acceleration: f64,
    /// Mean rate of turning, °/s.
    turning: f64,
}

impl Piece {
    fn of(samples: &[ImuSample]) -> Self {
        let mut start_from_body = So3::IDENTITY;
        let mut forces = Vec::with_capacity(samples.len());
        for (k, sample) in samples.iter().enumerate() {
            if let Some(before) = k.checked_sub(1).map(|b| &samples[b]) {
                let step = (sample.time - before.time).as_secs_f64().clamp(0.0, LONGEST_STEP_SECS);
                start_from_body = start_from_body * So3::exp(&(before.gyro.0 * step));
            }
            forces.push(start_from_body * sample.accel.0);
        }
        let n = forces.len().max(1) as f64;
        let mean = forces.iter().sum::<Vector3<f64>>() / n;
        let variance = forces.iter().map(|f| (f - mean).norm_squared()).sum::<f64>() / n;
        let turning = samples.iter().map(|s| s.gyro.0.norm()).sum::<f64>() / n;
        Self { acceleration: variance.sqrt(), turning: turning.to_degrees() }
    }

    fn is_still(&self) -> bool {
        self.acceleration < STILL_ACCELERATION && self.turning < STILL_DEG_PER_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{AngularRate, SpecificForce, Timestamp};

    /// Ten seconds at 200 Hz: rate of turning (rad/s) and acceleration (m/s²) of a level body by time.
    fn recording(gyro: fn(f64) -> [f64; 3], accel: fn(f64) -> [f64; 3]) -> Motion {
        let mut world_from_body = So3::IDENTITY;
        let samples: Vec<ImuSample> = (0..2000)
            .map(|k| {
                let t = 0.005 * f64::from(k);
                let rate = Vector3::from(gyro(t));
                let force = Vector3::from(accel(t)) + Vector3::new(0.0, 0.0, 9.81);
                let sample = ImuSample {
                    time: Timestamp::from_nanos(5_000_000 * i64::from(k)),
                    gyro: AngularRate(rate),
                    accel: SpecificForce(world_from_body.inverse() * force),
                };
                world_from_body = world_from_body * So3::exp(&(rate * 0.005));
                sample
            })
            .collect();
        Motion::of(&samples).unwrap()
    }

    fn says(motion: &Motion, words: &[&str]) {
        let advice = motion.advice();
        assert_eq!(advice.len(), words.len(), "{advice:?}");
        advice.iter().zip(words).for_each(|(a, w)| assert!(a.contains(w), "{a}"));
    }

    #[test]
    fn what_is_missing_in_a_motion_is_said() {
        let still = recording(|_| [0.0; 3], |_| [0.0; 3]);
        assert_eq!((still.still, still.acceleration_m_per_s2 < 1e-9), (1.0, true));
        says(&still, &["stands still", "changes of speed", "tilt and roll"]);

        // Gravity turns with the body and is no acceleration.
        let on_the_spot = recording(|t| [0.3 * t.sin(), 0.3 * (1.3 * t).sin(), 0.4], |_| [0.0; 3]);
        assert!(on_the_spot.acceleration_m_per_s2 < 0.02, "{on_the_spot:?}");
        says(&on_the_spot, &["turn less on the spot, move sideways"]);

        let good = recording(|t| [0.2 * t.sin(), 0.1, 0.2 * t.cos()], |t| [(2.0 * t).sin(), 0.0, 0.0]);
        assert!((good.acceleration_m_per_s2 - 0.5_f64.sqrt()).abs() < 0.1, "{good:?}");
        says(&good, &[]);

        let fast = recording(|t| [0.2, 0.3, 3.0 * (t * 3.0).sin().signum()], |t| [(2.0 * t).sin(), 0.0, 0.0]);
        says(&fast, &["turn more slowly: 173 °/s"]);
    }
}
