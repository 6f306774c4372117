//! Latencies: from an image's arrival to its pose, and from a keyframe's arrival to its surface; and how much of each is computing.

use crate::engine::{MapEvent, ShownKeyframe};
use nalgebra::Vector3;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Instant;
use vidar_core::FrameId;

/// How long something took from the arrival of an image on, s.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// How many were measured.
    pub count: usize,
    /// Half of them took no longer.
    pub median: f64,
    /// 95 % took no longer.
    pub p95: f64,
    /// 99 % took no longer.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

impl Latency {
    /// Of these, by nearest rank; none of none.
    pub(super) fn of(seconds: &[f32]) -> Option<Self> {
        let mut sorted = seconds.to_vec();
        sorted.sort_unstable_by(f32::total_cmp);
        // Nearest rank: the smallest value that this share does not exceed.
        let rank = |percent: usize| (sorted.len() * percent).div_ceil(100).max(1) - 1;
        let at = |percent: usize| sorted.get(rank(percent)).map(|s| f64::from(*s));
        Some(Self {
            count: sorted.len(),
            median: at(50)?,
            p95: at(95)?,
            p99: at(99)?,
            max: f64::from(*sorted.last()?),
        })
    }
}

/// Images whose arrival is remembered until the engine has decided about them: 3 min at 20 Hz.
const MOST_ARRIVALS: usize = 4096;

/// Angle between the rays of two images to a point from which the point's depth counts as seen, rad: what ORB-SLAM asks of a new map
/// point, a cosine of 0.9998.
const TRIANGULATION_ANGLE: f64 = 0.02;

/// Measures keyframes from their arrival until they are in the growing surface.
#[derive(Default)]
pub(in crate::run) struct SurfaceLatency {
    arrivals: BTreeMap<FrameId, Instant>,
    /// Where the cameras of those images were, m.
    positions: BTreeMap<FrameId, Vector3<f64>>,
    /// Keyframes without a surface.
    waiting: BTreeMap<FrameId, Instant>,
    seconds: Vec<f32>,
    seconds_from_parallax: Vec<f32>,
}

/// What was measured of keyframes.
pub(in crate::run) struct Surfaces {
    pub keyframe_to_surface: Option<Latency>,
    pub parallax_to_surface: Option<Latency>,
    /// Keyframes that never got into the growing surface.
    pub without: usize,
}

impl SurfaceLatency {
    /// An image that may become a keyframe.
    pub fn arrived(&mut self, frame: FrameId, at: Instant) {
        self.arrivals.insert(frame, at);
        while self.arrivals.len() > MOST_ARRIVALS {
            self.arrivals.pop_first();
        }
    }

    /// Takes an event of the engine.
    pub fn read(&mut self, event: &MapEvent, now: Instant) {
        match event {
            MapEvent::World { .. } => {
                // What was mapped before is void: its keyframes are selected again.
                self.arrivals.append(&mut self.waiting);
            }
            MapEvent::State(state) => {
                self.positions.insert(state.frame_id, state.world_from_camera.translation);
                while self.positions.len() > MOST_ARRIVALS {
                    self.positions.pop_first();
                }
            }
            MapEvent::Keyframe(keyframe) => {
                let frame = keyframe.stamp.frame_id;
                self.waiting.extend(self.arrivals.get(&frame).map(|at| (frame, *at)));
            }
            MapEvent::SurfaceChanged { shown, .. } => {
                for keyframe in shown {
                    let Some(at) = self.waiting.remove(&keyframe.frame_id) else { continue };
                    self.seconds.push(now.duration_since(at).as_secs_f32());
                    let since = self.parallax(keyframe).map_or(at, |seen| seen.max(at));
                    self.seconds_from_parallax.push(now.saturating_duration_since(since).as_secs_f32());
                }
            }
            _ => {}
        }
    }

    /// When the first image came that sees the keyframe's median depth under [`TRIANGULATION_ANGLE`].
    fn parallax(&self, keyframe: &ShownKeyframe) -> Option<Instant> {
        let position = self.positions.get(&keyframe.frame_id)?;
        let baseline = keyframe.median_depth_m * TRIANGULATION_ANGLE;
        let is_apart = |other: &Vector3<f64>| (other - position).norm() >= baseline;
        let apart = self.positions.iter().filter(|(_, other)| is_apart(other));
        apart.filter_map(|(frame, _)| self.arrivals.get(frame)).min().copied()
    }

    /// What was measured.
    pub fn finish(self) -> Surfaces {
        Surfaces {
            keyframe_to_surface: Latency::of(&self.seconds),
            parallax_to_surface: Latency::of(&self.seconds_from_parallax),
            without: self.waiting.len(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_by_nearest_rank() {
        let seconds: Vec<f32> = (1..=200).rev().map(|i| i as f32).collect();
        let latency = Latency::of(&seconds).unwrap();
        let expected = Latency { count: 200, median: 100.0, p95: 190.0, p99: 198.0, max: 200.0 };
        assert_eq!(latency, expected);
        let one = Latency::of(&[0.5]).unwrap();
        assert_eq!((one.median, one.p99, one.max), (0.5, 0.5, 0.5));
        assert!(Latency::of(&[]).is_none());
    }

    #[test]
    fn what_a_keyframe_waits_for_until_the_camera_moves_is_told_apart() {
        use crate::engine::{FrameStamp, FrameState, MapKeyframe, Surface};
        use vidar_core::{CameraId, Se3, Timestamp};
        let began = Instant::now();
        let at = |i: u32| began + std::time::Duration::from_millis(u64::from(i) * 100);
        let mut latency = SurfaceLatency::default();
        let time = Timestamp::from_nanos(0);
        // A centimetre with every image.
        for i in 0..8 {
            let world_from_camera = Se3::from_translation(Vector3::new(f64::from(i) * 0.01, 0.0, 0.0));
            let frame_id = FrameId(i);
            latency.arrived(frame_id, at(i));
            latency
                .read(&MapEvent::State(FrameState { frame_id, time, segment: 0, world_from_camera }), at(i));
            if i == 2 || i == 6 {
                let stamp = FrameStamp { frame_id, time, camera: CameraId(0) };
                let keyframe = MapKeyframe { stamp, world_from_camera: None, warp: None, odometry: None };
                latency.read(&MapEvent::Keyframe(keyframe), at(i));
            }
        }
        // At 1.45 m 2.9 cm are seen under 0.02 rad: the third image after the keyframe, or one before the other.
        let shown = [2, 6].map(|i| ShownKeyframe { frame_id: FrameId(i), median_depth_m: 1.45 }).to_vec();
        let surface = std::sync::Arc::new(Surface::default());
        latency.read(&MapEvent::SurfaceChanged { surface, shown, is_final: false }, at(9));
        let Surfaces { keyframe_to_surface, parallax_to_surface, without } = latency.finish();
        let ends = |l: Option<Latency>| l.map(|l| [l.median, l.max].map(|s| (s * 10.0).round()));
        assert_eq!(ends(keyframe_to_surface), Some([3.0, 7.0]));
        assert_eq!(ends(parallax_to_surface), Some([3.0, 4.0]));
        assert_eq!(without, 0);
    }
}
