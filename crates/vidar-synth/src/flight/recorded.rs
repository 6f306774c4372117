//! A recorded trajectory as a smooth course.

use crate::config::SynthConfig;
use crate::error::SynthError;
use crate::rig;
use nalgebra::Vector3;
use vidar_core::{BodyFrame, Duration, LieGroup, Se3, StampedPose, Timestamp, Trajectory};

/// Longest gap that is bridged, s.
const MAX_GAP_SECS: f64 = 1.0;

/// A recorded trajectory of the body, smoothed by local linear regression under a Gaussian.
pub(super) struct Recorded {
    trajectory: Trajectory,
    begin: Timestamp,
    duration_secs: f64,
    smoothing_secs: f64,
}

impl Recorded {
    pub(super) fn new(trajectory: &Trajectory, config: &SynthConfig) -> Result<Self, SynthError> {
        let bad = |reason: String| SynthError::BadTrajectory { reason };
        let smoothing_secs = config.trajectory_smoothing_secs;
        let trajectory = trajectory.in_frame(BodyFrame::Imu, &rig::rig(config)?)?;
        let Some((begin, end)) = trajectory.time_range() else {
            return Err(bad("it is empty".into()));
        };
        if trajectory.len() < 4 {
            return Err(bad(format!("it has {} poses, at least 4 are needed", trajectory.len())));
        }
        let duration_secs = (end - begin).as_secs_f64();
        if duration_secs < 1.0 {
            return Err(bad(format!("it lasts {duration_secs:.3} s, at least 1 s is needed")));
        }
        for w in trajectory.poses().windows(2) {
            let gap = (w[1].time - w[0].time).as_secs_f64();
            if gap > MAX_GAP_SECS {
                let from = w[0].time;
                return Err(bad(format!("a gap of {gap:.3} s follows {from} s (at most {MAX_GAP_SECS} s)")));
            }
            let step = (w[1].world_from_body.translation - w[0].world_from_body.translation).norm();
            if step > 30.0 * gap.max(0.01) {
                return Err(bad(format!("it jumps by {step:.2} m at {} s", w[1].time)));
            }
        }
        Ok(Self { trajectory, begin, duration_secs, smoothing_secs })
    }

    pub(super) fn duration_secs(&self) -> f64 {
        self.duration_secs
    }

    /// The smoothed pose `secs` after the first one; the ends are held.
    pub(super) fn world_from_body(&self, secs: f64) -> Se3 {
        let secs = secs.clamp(0.0, self.duration_secs);
        let time = self.begin + Duration::from_secs_f64(secs);
        let gap = Duration::from_secs_f64(MAX_GAP_SECS + 1.0);
        let ends = || self.end_pose(time);
        let here = self.trajectory.interpolate(time, gap).unwrap_or_else(ends);
        if self.smoothing_secs <= 0.0 {
            return here;
        }
        let reach = Duration::from_secs_f64(3.0 * self.smoothing_secs);
        let poses = self.trajectory.poses();
        let from = poses.partition_point(|p| p.time < time - reach);
        let until = poses.partition_point(|p| p.time <= time + reach);
        self.regress(&here, time, &poses[from..until])
    }

    fn end_pose(&self, time: Timestamp) -> Se3 {
        let poses = self.trajectory.poses();
        let at = poses.partition_point(|p| p.time < time).min(poses.len() - 1);
        poses[at].world_from_body
    }

    /// Weighted straight-line fit of what the neighbours differ from `here`, read at `time`.
    fn regress(&self, here: &Se3, time: Timestamp, neighbours: &[StampedPose]) -> Se3 {
        let (mut w0, mut w1, mut w2) = (0.0, 0.0, 0.0);
        let mut turn = [Vector3::zeros(); 2];
        let mut shift = [Vector3::zeros(); 2];
        for pose in neighbours {
            let dt = (pose.time - time).as_secs_f64();
            let weight = (-0.5 * (dt / self.smoothing_secs).powi(2)).exp();
            let d_turn = pose.world_from_body.rotation.minus(&here.rotation);
            let d_shift = pose.world_from_body.translation - here.translation;
            w0 += weight;
            w1 += weight * dt;
            w2 += weight * dt * dt;
            for (sums, value) in [(&mut turn, d_turn), (&mut shift, d_shift)] {
                sums[0] += value * weight;
                sums[1] += value * (weight * dt);
            }
        }
        let determinant = w0 * w2 - w1 * w1;
        if neighbours.len() < 3 || determinant <= 1e-12 * w0 * w0 {
            return *here;
        }
        let at_zero = |sums: &[Vector3<f64>; 2]| (sums[0] * w2 - sums[1] * w1) / determinant;
        Se3::new(here.rotation.plus(&at_zero(&turn)), here.translation + at_zero(&shift))
    }
}
