//! Frames that carry geometry: those with a metric pose, far enough from the last one.

use crate::config::KeyframeConfig;
use vidar_core::{Duration, FrameId, LieGroup, Se3};
use vidar_dataset::ImageEntry;

/// A frame that carries geometry.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// The image.
    pub image: ImageEntry,
    /// Pose of its camera, where one is known before the map is made.
    pub world_from_camera: Option<Se3>,
}

impl From<PosedFrame> for Keyframe {
    fn from(frame: PosedFrame) -> Self {
        Self { image: frame.image, world_from_camera: Some(frame.world_from_camera) }
    }
}

/// Chooses keyframes where no pose tells motion: one every `keyframes.unposed_interval_secs`.
pub fn select_by_time(images: &[ImageEntry], config: &KeyframeConfig) -> Vec<Keyframe> {
    let mut interval = Duration::from_secs_f64(config.unposed_interval_secs);
    loop {
        let mut chosen: Vec<Keyframe> = Vec::new();
        for image in images {
            if chosen.last().is_none_or(|last| image.time - last.image.time >= interval) {
                chosen.push(Keyframe { image: image.clone(), world_from_camera: None });
            }
        }
        if config.max_count == 0 || chosen.len() <= config.max_count {
            return chosen;
        }
        interval = Duration::from_secs_f64(interval.as_secs_f64() * 1.1);
    }
}

/// A frame with its metric pose.
#[derive(Clone, Debug)]
pub struct PosedFrame {
    /// The image.
    pub image: ImageEntry,
    /// Pose of its camera.
    pub world_from_camera: Se3,
}

/// Chooses keyframes: the first frame, then each that moved or turned enough since the last one chosen.
///
/// `preferred` frames, those of which more is known than their pose, are chosen wherever they come. With `max_count`, the
/// distances are widened by the smallest factor (searched by bisection) that obeys it, and no frame is preferred.
pub fn select_keyframes(
    frames: &[PosedFrame],
    config: &KeyframeConfig,
    preferred: &dyn Fn(FrameId) -> bool,
) -> Vec<PosedFrame> {
    let chosen = choose(frames, config, 1.0, preferred);
    let count = |factor: f64| choose(frames, config, factor, &|_| false).len();
    if config.max_count == 0 || chosen.len() <= config.max_count {
        return pick(frames, &chosen);
    }
    let (mut low, mut high) = (1.0, 2.0);
    while count(high) > config.max_count && high < 1e9 {
        (low, high) = (high, high * 2.0);
    }
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if count(middle) > config.max_count { low = middle } else { high = middle }
    }
    pick(frames, &choose(frames, config, high, &|_| false))
}

fn choose(
    frames: &[PosedFrame],
    config: &KeyframeConfig,
    factor: f64,
    preferred: &dyn Fn(FrameId) -> bool,
) -> Vec<usize> {
    let mut chosen: Vec<usize> = Vec::new();
    let far = config.min_translation_m * factor;
    let turned = config.min_rotation_deg.to_radians() * factor;
    for (index, frame) in frames.iter().enumerate() {
        let Some(&last) = chosen.last() else {
            chosen.push(index);
            continue;
        };
        let last_from_this = frames[last].world_from_camera.inverse() * frame.world_from_camera;
        let moved = last_from_this.translation.norm() >= far || last_from_this.rotation.angle_rad() >= turned;
        if moved || preferred(frame.image.frame_id) {
            chosen.push(index);
        }
    }
    chosen
}

fn pick(frames: &[PosedFrame], chosen: &[usize]) -> Vec<PosedFrame> {
    chosen.iter().map(|&i| frames[i].clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::{CameraId, So3, Timestamp};

    fn frame(i: u32, x: f64, yaw: f64) -> PosedFrame {
        PosedFrame {
            image: ImageEntry {
                frame_id: FrameId(i),
                time: Timestamp::from_nanos(i64::from(i)),
                camera: CameraId(0),
                path: Default::default(),
            },
            world_from_camera: Se3::new(So3::exp(&Vector3::new(0.0, yaw, 0.0)), Vector3::new(x, 0.0, 0.0)),
        }
    }

    fn ids(frames: &[PosedFrame]) -> Vec<u32> {
        frames.iter().map(|f| f.image.frame_id.0).collect()
    }

    const NONE: fn(FrameId) -> bool = |_| false;

    #[test]
    fn preferred_frames_are_chosen_besides() {
        let config =
            KeyframeConfig { min_translation_m: 0.1, min_rotation_deg: 10.0, ..KeyframeConfig::default() };
        let frames: Vec<_> = (0..11).map(|i| frame(i, f64::from(i) * 0.0401, 0.0)).collect();
        assert_eq!(ids(&select_keyframes(&frames, &config, &|id| id == FrameId(4))), [0, 3, 4, 7, 10]);
        let few = KeyframeConfig { max_count: 2, ..config };
        assert!(select_keyframes(&frames, &few, &|_| true).len() <= 2);
    }

    #[test]
    fn moving_or_turning_enough_makes_a_keyframe() {
        let config =
            KeyframeConfig { min_translation_m: 0.1, min_rotation_deg: 10.0, ..KeyframeConfig::default() };
        let frames: Vec<_> = (0..11).map(|i| frame(i, f64::from(i) * 0.0401, 0.0)).collect();
        assert_eq!(ids(&select_keyframes(&frames, &config, &NONE)), [0, 3, 6, 9]);
        let turning: Vec<_> = (0..7).map(|i| frame(i, 0.0, f64::from(i) * 0.0901)).collect();
        assert_eq!(ids(&select_keyframes(&turning, &config, &NONE)), [0, 2, 4, 6]);
    }

    #[test]
    fn standing_still_gives_one_keyframe_and_nothing_gives_none() {
        let config = KeyframeConfig::default();
        let still: Vec<_> = (0..50).map(|i| frame(i, 0.0, 0.0)).collect();
        assert_eq!(ids(&select_keyframes(&still, &config, &NONE)), [0]);
        assert!(select_keyframes(&[], &config, &NONE).is_empty());
    }

    #[test]
    fn a_limit_widens_the_distance_evenly() {
        let config = KeyframeConfig {
            min_translation_m: 0.01,
            min_rotation_deg: 10.0,
            max_count: 10,
            ..KeyframeConfig::default()
        };
        let frames: Vec<_> = (0..1000).map(|i| frame(i, f64::from(i) * 0.02, 0.0)).collect();
        let chosen = ids(&select_keyframes(&frames, &config, &NONE));
        assert_eq!(chosen.len(), 10);
        assert!(*chosen.last().unwrap() > 880, "the end of the path is covered: {chosen:?}");
    }

    #[test]
    fn without_poses_time_makes_keyframes() {
        let images: Vec<_> = (0..100_i64)
            .map(|i| {
                let mut image = frame(i as u32, 0.0, 0.0).image;
                image.time = Timestamp::from_nanos(i * 50_000_000);
                image
            })
            .collect();
        let config = KeyframeConfig { unposed_interval_secs: 0.2, ..KeyframeConfig::default() };
        let chosen = select_by_time(&images, &config);
        assert_eq!(chosen.iter().map(|k| k.image.frame_id.0).take(3).collect::<Vec<_>>(), [0, 4, 8]);
        assert!(chosen.iter().all(|k| k.world_from_camera.is_none()));
        let few = select_by_time(&images, &KeyframeConfig { max_count: 5, ..config });
        assert!((4..=5).contains(&few.len()), "{}", few.len());
    }
}
