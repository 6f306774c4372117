//! What is left out where the map does not keep up: keyframes first, the odometry never.

use super::queue::{CAPACITY, Load, MOST_REPORTS};
use std::time::Duration;
use vidar_align::keyframe_selection::{KeyframeConfig, KeyframeSelector};
use vidar_core::{Se3, Warning};

/// How long the first image has waited when keyframes begin to be taken farther apart. Half of the goal from keyframe to surface, 2 s; a
/// chunk is predicted in a third of it where the map keeps up.
const THIN_FROM: Duration = Duration::from_millis(1000);
/// How long when that ends.
const THIN_UNTIL: Duration = Duration::from_millis(300);
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

    /// Looks at what waits; what there is to say if something begins to be left out.
    pub fn observe(&mut self, load: &Load) -> Option<Warning> {
        let before = self.mode;
        let most_delay = if before == Mode::All { THIN_FROM } else { THIN_UNTIL };
        self.mode = match load {
            Load { images: CAPACITY.., .. } => Mode::None,
            Load { delay, .. } if *delay >= most_delay => Mode::Thin,
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
        let message = format!("the map is {:.1} s behind: {text}", load.delay.as_secs_f64());
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

    /// Whether a report without an image is kept while so many items wait: always where it `moves_others`, poses told before it.
    pub fn keeps_report(&mut self, items: usize, moves_others: bool) -> bool {
        let is_kept = items < MOST_REPORTS || moves_others;
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
        let load = |images, millis| Load { images, items: images, delay: Duration::from_millis(millis) };
        assert!(thinning.observe(&load(30, 999)).is_none());
        assert_eq!(pass(&mut thinning, 0), 100, "who keeps up decides for itself");
        assert_eq!(thinning.observe(&load(20, 1000)).unwrap().kind, "keyframes-thinned");
        assert!(thinning.observe(&load(20, 1100)).is_none());
        assert_eq!(pass(&mut thinning, 100), 25, "of 50 keyframes that there would be");
        assert_eq!((thinning.thinned, thinning.dropped), (25, 0));
        assert_eq!(thinning.observe(&load(CAPACITY, 9000)).unwrap().kind, "keyframes-dropped");
        assert_eq!(pass(&mut thinning, 200), 0);
        assert_eq!((thinning.thinned, thinning.dropped), (25, 50));
        // A little room is not yet room for all.
        assert!(thinning.observe(&load(CAPACITY - 1, 8000)).is_none());
        assert!(thinning.observe(&load(6, 300)).is_none());
        assert!(pass(&mut thinning, 300) < 30);
        assert!(thinning.observe(&load(5, 299)).is_none());
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
