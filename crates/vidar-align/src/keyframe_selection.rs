//! Which frames become keyframes: those that moved or turned enough since the last one.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use vidar_core::{Duration, LieGroup, Se3, Timestamp};

/// Which frames carry geometry.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct KeyframeConfig {
    /// A frame becomes a keyframe when the camera moved at least this far (m) since the last keyframe.
    pub min_translation_m: f64,
    /// … or turned at least this much (degrees).
    pub min_rotation_deg: f64,
    /// Most keyframes; beyond it both distances are widened by one factor. 0 means no limit.
    pub max_count: usize,
    /// Time between keyframes (s) where no poses are known beforehand (`coupling.mode` `pose-free` or `da3-streaming` without
    /// a trajectory). Lower it for fast motion.
    pub unposed_interval_secs: f64,
}

impl Default for KeyframeConfig {
    fn default() -> Self {
        Self { min_translation_m: 0.05, min_rotation_deg: 8.0, max_count: 0, unposed_interval_secs: 0.2 }
    }
}

/// Selects keyframes frame by frame, without a limit on their number.
#[derive(Clone, Debug)]
pub struct KeyframeSelector {
    min_translation_m: f64,
    min_rotation_rad: f64,
    last: Option<Se3>,
}

impl KeyframeSelector {
    /// A selector without frames.
    pub fn new(config: &KeyframeConfig) -> Self {
        Self::widened(config, 1.0)
    }

    /// A selector without frames whose keyframes are `factor` times as far apart.
    pub fn widened(config: &KeyframeConfig, factor: f64) -> Self {
        let mut selector = Self { min_translation_m: 0.0, min_rotation_rad: 0.0, last: None };
        selector.widen(config, factor);
        selector
    }

    /// Selects keyframes that are `factor` times as far apart from here on; the last one stays the last.
    pub fn widen(&mut self, config: &KeyframeConfig, factor: f64) {
        self.min_translation_m = config.min_translation_m * factor;
        self.min_rotation_rad = config.min_rotation_deg.to_radians() * factor;
    }

    /// Whether the frame at this pose (m) is a keyframe: the first frame, frames far enough from the last keyframe, and
    /// frames that `is_preferred` (those with landmarks of the odometry, for example).
    pub fn push(&mut self, world_from_camera: &Se3, is_preferred: bool) -> bool {
        let is_far = self.last.is_none_or(|last| {
            let last_from_this = last.inverse() * *world_from_camera;
            last_from_this.translation.norm() >= self.min_translation_m
                || last_from_this.rotation.angle_rad() >= self.min_rotation_rad
        });
        let is_keyframe = is_far || is_preferred;
        if is_keyframe {
            self.last = Some(*world_from_camera);
        }
        is_keyframe
    }
}

/// Indices of the keyframes among frames with metric poses, ascending.
///
/// With [`KeyframeConfig::max_count`], the distances are widened by the smallest factor (found by bisection) that obeys it,
/// and no frame is preferred.
pub fn select_by_motion(
    world_from_camera: &[Se3],
    is_preferred: impl Fn(usize) -> bool,
    config: &KeyframeConfig,
) -> Vec<usize> {
    let selected = |factor: f64, is_preferred: &dyn Fn(usize) -> bool| -> Vec<usize> {
        let mut selector = KeyframeSelector::widened(config, factor);
        let frames = world_from_camera.iter().enumerate();
        frames.filter(|(i, pose)| selector.push(pose, is_preferred(*i))).map(|(i, _)| i).collect()
    };
    let all = selected(1.0, &is_preferred);
    if config.max_count == 0 || all.len() <= config.max_count {
        return all;
    }
    let is_too_many = |factor: f64| selected(factor, &|_| false).len() > config.max_count;
    let (mut low, mut high) = (1.0, 2.0);
    while is_too_many(high) && high < 1e9 {
        (low, high) = (high, high * 2.0);
    }
    for _ in 0..30 {
        let factor = 0.5 * (low + high);
        if is_too_many(factor) { low = factor } else { high = factor }
    }
    selected(high, &|_| false)
}

/// Indices of the keyframes among frames without poses: one every [`KeyframeConfig::unposed_interval_secs`], the interval
/// widened in steps of 10 % until [`KeyframeConfig::max_count`] is obeyed. Times ascend.
pub fn select_by_time(times: &[Timestamp], config: &KeyframeConfig) -> Vec<usize> {
    let mut interval = Duration::from_secs_f64(config.unposed_interval_secs);
    loop {
        let mut chosen: Vec<usize> = Vec::new();
        for (i, time) in times.iter().enumerate() {
            if chosen.last().is_none_or(|&last| *time - times[last] >= interval) {
                chosen.push(i);
            }
        }
        if config.max_count == 0 || chosen.len() <= config.max_count {
            return chosen;
        }
        interval = Duration::from_secs_f64(interval.as_secs_f64() * 1.1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::So3;

    fn pose(x: f64, yaw: f64) -> Se3 {
        Se3::new(So3::exp(&Vector3::new(0.0, yaw, 0.0)), Vector3::new(x, 0.0, 0.0))
    }

    fn line(count: usize, step: f64) -> Vec<Se3> {
        (0..count).map(|i| pose(i as f64 * step, 0.0)).collect()
    }

    fn config() -> KeyframeConfig {
        KeyframeConfig { min_translation_m: 0.1, min_rotation_deg: 10.0, ..KeyframeConfig::default() }
    }

    #[test]
    fn enough_motion_or_rotation_makes_a_keyframe() {
        assert_eq!(select_by_motion(&line(11, 0.0401), |_| false, &config()), [0, 3, 6, 9]);
        let turning: Vec<Se3> = (0..7).map(|i| pose(0.0, f64::from(i) * 0.0901)).collect();
        assert_eq!(select_by_motion(&turning, |_| false, &config()), [0, 2, 4, 6]);
    }

    #[test]
    fn preferred_frames_are_selected_in_addition_unless_the_number_is_limited() {
        assert_eq!(select_by_motion(&line(11, 0.0401), |i| i == 4, &config()), [0, 3, 4, 7, 10]);
        let few = KeyframeConfig { max_count: 2, ..config() };
        assert!(select_by_motion(&line(11, 0.0401), |_| true, &few).len() <= 2);
    }

    #[test]
    fn standing_still_gives_one_keyframe_and_no_frames_give_none() {
        assert_eq!(select_by_motion(&line(50, 0.0), |_| false, &config()), [0]);
        assert!(select_by_motion(&[], |_| false, &config()).is_empty());
        assert!(select_by_time(&[], &config()).is_empty());
    }

    #[test]
    fn a_limit_widens_the_distances_evenly_over_the_path() {
        let config = KeyframeConfig { min_translation_m: 0.01, max_count: 10, ..config() };
        let chosen = select_by_motion(&line(1000, 0.02), |_| false, &config);
        assert_eq!(chosen.len(), 10);
        assert!(chosen[9] > 880, "the end of the path has no keyframe: {chosen:?}");
    }

    #[test]
    fn frames_without_poses_become_keyframes_at_even_times() {
        let times: Vec<Timestamp> = (0..100).map(|i| Timestamp::from_nanos(i * 50_000_000)).collect();
        let config = KeyframeConfig { unposed_interval_secs: 0.2, ..KeyframeConfig::default() };
        assert_eq!(select_by_time(&times, &config)[..3], [0, 4, 8]);
        let few = select_by_time(&times, &KeyframeConfig { max_count: 5, ..config });
        assert!((4..=5).contains(&few.len()), "{}", few.len());
    }
}
