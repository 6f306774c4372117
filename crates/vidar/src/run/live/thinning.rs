//! What is left out where the map does not keep up: keyframes first, the odometry never.

use super::queue::{CAPACITY, MOST_REPORTS};
use vidar_align::keyframe_selection::{KeyframeConfig, KeyframeSelector};
use vidar_core::{Se3, Warning};

/// Images that wait when keyframes begin to be taken farther apart: half of the queue, 6 s at 20 Hz. Predicting a chunk takes less
/// where the map keeps up at all.
const THIN_FROM: usize = CAPACITY / 2;
/// Images that wait when that ends.
const THIN_UNTIL: usize = CAPACITY / 4;
/// Factor of their distance meanwhile. Stereo finds depth from keyframes twice as far apart; four times is a loss.
const WIDENED: f64 = 2.0;

/// How far the map is behind, in words of what is done about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// Every image may become a keyframe.
    All,
    /// Those that are farther apart may.
    Thin,
    /// None may.
    None,
}

/// Decides which images may become keyframes.
pub(super) struct Thinning {
    keyframes: KeyframeConfig,
    mode: Mode,
    /// Counts the keyframes that the images would give.
    plain: KeyframeSelector,
    widened: KeyframeSelector,
    /// Keyframes left out because they were near others.
    pub thinned: usize,
    /// Keyframes left out because the queue was full.
    pub dropped: usize,
    /// Poses left out because even those waited for minutes.
    pub poses_dropped: usize,
}

impl Thinning {
    pub fn new(keyframes: &KeyframeConfig) -> Self {
        Self {
            keyframes: keyframes.clone(),
            mode: Mode::All,
            plain: KeyframeSelector::new(keyframes),
            widened: KeyframeSelector::widened(keyframes, WIDENED),
            thinned: 0,
            dropped: 0,
            poses_dropped: 0,
        }
    }

    /// Looks at how many images wait; what there is to say if something begins to be left out.
    pub fn observe(&mut self, waiting: usize) -> Option<Warning> {
        let before = self.mode;
        self.mode = match (before, waiting) {
            (_, CAPACITY..) => Mode::None,
            (Mode::All, THIN_FROM..) | (Mode::Thin | Mode::None, THIN_UNTIL..) => Mode::Thin,
            _ => Mode::All,
        };
        let (text, kind) = match (before, self.mode) {
            (Mode::All, Mode::Thin) => {
                self.widened = KeyframeSelector::widened(&self.keyframes, WIDENED);
                ("keyframes are taken twice as far apart until it has caught up", "keyframes-thinned")
            }
            (Mode::All | Mode::Thin, Mode::None) => {
                ("no keyframes are taken until there is room again", "keyframes-dropped")
            }
            _ => return None,
        };
        let message = format!("the map is behind, {waiting} images wait: {text}");
        let hint = "a smaller geometry.max_width_px, --preset fast, or a faster machine keeps up";
        Some(match self.mode {
            Mode::None => Warning::degraded(kind, message).hint(hint),
            _ => Warning::new(kind, message).hint(hint),
        })
    }

    /// Whether the image with this pose may become a keyframe.
    pub fn passes(&mut self, world_from_camera: Option<&Se3>) -> bool {
        let Some(pose) = world_from_camera else { return self.mode == Mode::All };
        let would_be_keyframe = self.plain.push(pose, false);
        match self.mode {
            Mode::All => true,
            Mode::Thin => {
                let passes = self.widened.push(pose, false);
                self.thinned += usize::from(would_be_keyframe && !passes);
                passes
            }
            Mode::None => {
                self.dropped += usize::from(would_be_keyframe);
                false
            }
        }
    }

    /// Whether a report without an image is kept while so many items wait.
    pub fn keeps_report(&mut self, items: usize, joins_segments: bool) -> bool {
        let is_kept = items < MOST_REPORTS || joins_segments;
        self.poses_dropped += usize::from(!is_kept);
        is_kept
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn at(x: f64) -> Se3 {
        Se3::from_translation(Vector3::new(x, 0.0, 0.0))
    }

    #[test]
    fn keyframes_are_first_taken_farther_apart_then_not_at_all_and_it_is_said_once_each() {
        let config = KeyframeConfig { min_translation_m: 0.1, ..KeyframeConfig::default() };
        let mut thinning = Thinning::new(&config);
        let pass = |t: &mut Thinning, from: usize| {
            (from..from + 100).filter(|i| t.passes(Some(&at(*i as f64 * 0.051)))).count()
        };
        assert!(thinning.observe(THIN_FROM - 1).is_none());
        assert_eq!(pass(&mut thinning, 0), 100, "who keeps up decides for itself");
        assert_eq!(thinning.observe(THIN_FROM).unwrap().kind, "keyframes-thinned");
        assert!(thinning.observe(THIN_FROM + 1).is_none());
        assert_eq!(pass(&mut thinning, 100), 25, "of 50 keyframes that there would be");
        assert_eq!((thinning.thinned, thinning.dropped), (25, 0));
        assert_eq!(thinning.observe(CAPACITY).unwrap().kind, "keyframes-dropped");
        assert_eq!(pass(&mut thinning, 200), 0);
        assert_eq!((thinning.thinned, thinning.dropped), (25, 50));
        // A little room is not yet room for all.
        assert!(thinning.observe(CAPACITY - 1).is_none() && thinning.observe(THIN_UNTIL).is_none());
        assert!(pass(&mut thinning, 300) < 30);
        assert!(thinning.observe(THIN_UNTIL - 1).is_none());
        assert_eq!(pass(&mut thinning, 400), 100);
    }

    #[test]
    fn poses_are_kept_for_minutes_and_what_joins_two_worlds_always() {
        let mut thinning = Thinning::new(&KeyframeConfig::default());
        assert!(thinning.keeps_report(MOST_REPORTS - 1, false));
        assert!(!thinning.keeps_report(MOST_REPORTS, false));
        assert!(thinning.keeps_report(MOST_REPORTS, true));
        assert_eq!(thinning.poses_dropped, 1);
    }
}
