//! What is left out where the map does not keep up: keyframes first, the odometry never.

use super::queue::{CAPACITY, Load, MOST_REPORTS};
use std::time::Duration;
use vidar_align::keyframe_selection::{KeyframeConfig, KeyframeSelector};
use vidar_core::{Se3, Warning};

/// Work that waits when keyframes begin to be taken farther apart. Of the goal from keyframe to surface, 2 s, a chunk of four takes half a
/// second and as much until it is full (two Zen 4 cores).
const THIN_FROM_WORK: Duration = Duration::from_millis(400);
/// How long the first image has waited when they are taken farther apart in any case: what a chunk takes may not be known yet.
const THIN_FROM: Duration = Duration::from_millis(1000);
/// Both when that ends.
const THIN_UNTIL_WORK: Duration = Duration::from_millis(200);
const THIN_UNTIL: Duration = Duration::from_millis(300);
/// Factor of their distance meanwhile, and where twice the work or delay waits all the same. Stereo finds depth from keyframes twice as far
/// apart; four times is a loss.
const WIDENED: [f64; 2] = [2.0, 3.0];

/// How far the map is behind, in words of what is done about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// Every image may become a keyframe.
    All,
    /// Those that are farther apart may: which of [`WIDENED`].
    Thin(usize),
    /// None may.
    None,
}

/// What becomes of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passed {
    /// It will be a keyframe.
    Keyframe,
    /// It may help keyframes.
    Between,
    /// It is left out.
    LeftOut,
}

/// Decides which images may become keyframes.
pub(super) struct Thinning {
    keyframes: KeyframeConfig,
    mode: Mode,
    /// Counts the keyframes that the images would give.
    plain: KeyframeSelector,
    /// Knows the last keyframe that was not left out, from which others are farther apart.
    taken: KeyframeSelector,
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
            taken: KeyframeSelector::new(keyframes),
            thinned: 0,
            dropped: 0,
            poses_dropped: 0,
        }
    }

    /// Looks at what waits; what there is to say if something begins to be left out.
    pub fn observe(&mut self, load: &Load) -> Option<Warning> {
        let before = self.mode;
        let waits = |work: Duration, delay: Duration| load.work >= work || load.delay >= delay;
        self.mode = match before {
            _ if load.images >= CAPACITY => Mode::None,
            _ if waits(2 * THIN_FROM_WORK, 2 * THIN_FROM) => Mode::Thin(1),
            _ if waits(THIN_FROM_WORK, THIN_FROM) => Mode::Thin(0),
            Mode::Thin(level) if waits(THIN_UNTIL_WORK, THIN_UNTIL) => Mode::Thin(level),
            Mode::None if waits(THIN_UNTIL_WORK, THIN_UNTIL) => Mode::Thin(0),
            _ => Mode::All,
        };
        if let Mode::Thin(level) = self.mode
            && before != self.mode
        {
            self.taken.widen(&self.keyframes, WIDENED[level]);
        }
        let (text, kind) = match (before, self.mode) {
            (Mode::All, Mode::Thin(_)) => {
                ("keyframes are taken farther apart until it has caught up", "keyframes-thinned")
            }
            (Mode::All | Mode::Thin(_), Mode::None) => {
                ("no keyframes are taken until there is room again", "keyframes-dropped")
            }
            _ => return None,
        };
        let behind = load.delay.max(load.work).as_secs_f64();
        let message = format!("the map is {behind:.1} s behind: {text}");
        let hint = "a smaller geometry.max_width_px, --preset fast, or a faster machine keeps up";
        Some(match self.mode {
            Mode::None => Warning::degraded(kind, message).hint(hint),
            _ => Warning::new(kind, message).hint(hint),
        })
    }

    /// What becomes of the image with this pose.
    pub fn pass(&mut self, world_from_camera: Option<&Se3>) -> Passed {
        let Some(pose) = world_from_camera else {
            return if self.mode == Mode::All { Passed::Between } else { Passed::LeftOut };
        };
        let would_be_keyframe = self.plain.push(pose, false);
        match self.mode {
            Mode::All if would_be_keyframe => {
                self.taken.push(pose, true);
                Passed::Keyframe
            }
            Mode::All => Passed::Between,
            Mode::Thin(_) if self.taken.push(pose, false) => Passed::Keyframe,
            Mode::Thin(_) => {
                self.thinned += usize::from(would_be_keyframe);
                Passed::LeftOut
            }
            Mode::None => {
                self.dropped += usize::from(would_be_keyframe);
                Passed::LeftOut
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
            let of = |i: usize| t.pass(Some(&at(i as f64 * 0.051)));
            (from..from + 100).map(of).filter(|passed| *passed != Passed::LeftOut).count()
        };
        let ms = Duration::from_millis;
        let load = |images, delay| Load { images, items: images, delay: ms(delay), work: Duration::ZERO };
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

        // What waits will take long: nobody has waited yet.
        let work = |work| Load { images: 8, items: 8, delay: Duration::ZERO, work: ms(work) };
        assert!(thinning.observe(&work(399)).is_none());
        assert_eq!(thinning.observe(&work(400)).unwrap().kind, "keyframes-thinned");
        assert_eq!(pass(&mut thinning, 500), 25);
        // Twice as far apart is not enough.
        assert!(thinning.observe(&work(800)).is_none());
        assert!((16..=17).contains(&pass(&mut thinning, 600)));
        assert!(thinning.observe(&work(200)).is_none());
        assert!(pass(&mut thinning, 700) < 20);
        assert!(thinning.observe(&work(199)).is_none());
        assert_eq!(pass(&mut thinning, 800), 100);

        // Where the distance changes with every image, none is a keyframe for that.
        let changing = (900..1000).filter(|i| {
            thinning.observe(&work(if i % 2 == 0 { 400 } else { 800 }));
            thinning.pass(Some(&at(*i as f64 * 0.051))) == Passed::Keyframe
        });
        assert!((16..=25).contains(&changing.count()));
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
