//! Latencies: from an image's arrival to its pose, and from a keyframe's arrival to its surface.

use crate::engine::MapEvent;
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

/// Measures keyframes from their arrival until they are in the growing surface.
#[derive(Default)]
pub(in crate::run) struct SurfaceLatency {
    arrivals: BTreeMap<FrameId, Instant>,
    /// Keyframes without a surface.
    waiting: BTreeMap<FrameId, Instant>,
    seconds: Vec<f32>,
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
            MapEvent::Keyframe(keyframe) => {
                let frame = keyframe.stamp.frame_id;
                self.waiting.extend(self.arrivals.get(&frame).map(|at| (frame, *at)));
            }
            MapEvent::SurfaceChanged { shown, .. } => {
                for frame in shown {
                    let since = self.waiting.remove(frame);
                    self.seconds.extend(since.map(|at| now.duration_since(at).as_secs_f32()));
                }
            }
            _ => {}
        }
    }

    /// What was measured, and how many keyframes never got into the growing surface.
    pub fn finish(self) -> (Option<Latency>, usize) {
        (Latency::of(&self.seconds), self.waiting.len())
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
}
