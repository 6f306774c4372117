//! Whether image stamps scatter, asked of the window while images come (decision 43).

use super::{Odometry, Phase};
use crate::bundle_adjustment::{HARMFUL_DELAY, STAMP_SCATTER_SECS};
use vidar_core::Timestamp;

/// Time between questions, s: by then the window has other frames but for its keyframes. So many are asked at most.
const PAUSE_SECS: f64 = 1.0;
const MOST: usize = 30;

/// Sum of the logarithms of Bayes factors from which stamps scatter, and from which they do not. Of rendered recordings by ten devices those whose stamps scatter
/// by 3 ms had more than 20 after one to three questions, the others -60 to -240 after twenty. Stabilised images, which turn against the gyroscope, may have 20, too; their live
/// paths are as wrong with delays as without.
const DECISIVE: f64 = 20.0;

/// The questions so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct StampQuestions {
    asked: usize,
    last: Option<Timestamp>,
    log_factor: f64,
    is_over: bool,
}

impl StampQuestions {
    /// None is asked where `is_known` how much stamps scatter.
    pub fn new(is_known: bool) -> Self {
        Self { asked: 0, last: None, log_factor: 0.0, is_over: is_known }
    }

    fn is_due(&self, now: Timestamp) -> bool {
        !self.is_over && self.last.is_none_or(|last| (now - last).as_secs_f64() >= PAUSE_SECS)
    }

    /// Takes an answer at `now`; says whether stamps scatter.
    fn take(&mut self, log_factor: f64, now: Timestamp) -> bool {
        self.last = Some(now);
        self.asked += 1;
        self.log_factor += log_factor;
        self.is_over = self.log_factor.abs() > DECISIVE || self.asked == MOST;
        self.log_factor > DECISIVE
    }
}

impl Odometry {
    /// Asks the window at `now` where that is due; where stamps scatter, every frame has a delay from here on.
    pub(super) fn question_stamps(&mut self, now: Timestamp) {
        let Phase::Tracking(window) = &mut self.phase else { return };
        if !self.stamps.is_due(now) {
            return;
        }
        let answer = window.smoother.log_scatter(HARMFUL_DELAY).unwrap_or(0.0);
        if self.stamps.take(answer, now) {
            self.config.stamp_scatter_ms = Some(1e3 * STAMP_SCATTER_SECS);
            window.smoother.set_stamp_scatter(STAMP_SCATTER_SECS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Duration;

    #[test]
    fn questions_end_with_an_answer() {
        let at = |secs: f64| Timestamp::from_nanos(0) + Duration::from_secs_f64(secs);
        assert!(!StampQuestions::new(true).is_due(at(0.0)));
        let mut stamps = StampQuestions::new(false);
        assert!(stamps.is_due(at(0.0)) && !stamps.take(15.0, at(0.0)));
        assert!(!stamps.is_due(at(0.5)) && stamps.is_due(at(1.0)));
        assert!(stamps.take(15.0, at(1.0)) && !stamps.is_due(at(9.0)));
        let mut stamps = StampQuestions::new(false);
        assert!(!stamps.take(-21.0, at(0.0)) && !stamps.is_due(at(9.0)), "they do not");
        let mut stamps = StampQuestions::new(false);
        assert!((0..MOST).all(|k| stamps.is_due(at(k as f64)) && !stamps.take(0.1, at(k as f64))));
        assert!(!stamps.is_due(at(99.0)), "nothing was told");
    }
}
