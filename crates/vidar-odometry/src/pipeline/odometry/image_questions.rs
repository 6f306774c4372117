//! Whether image stamps scatter, or a stabiliser shifts the images, asked of the window while images come (decisions 43 and 44).

use super::{Odometry, Phase};
use crate::backend::FrameUnknown;
use crate::bundle_adjustment::{HARMFUL_DELAY, HARMFUL_SHIFT, IMAGE_SHIFT_RAD, STAMP_SCATTER_SECS};
use crate::config::OdometryConfig;
use vidar_core::Timestamp;

/// Time between questions, s: by then the window has other frames but for its keyframes. So many are asked at most.
const PAUSE_SECS: f64 = 1.0;
const MOST: usize = 120;

/// Sum of the logarithms of Bayes factors from which images have an unknown of their own, by which it is ahead of the other one, and
/// below zero at which the sum stays: a hand that holds still says no until it moves (the cumulative sum test of Page, "Continuous inspection schemes", 1954).
/// Of rendered recordings by ten devices those whose stamps scatter by 3 ms had more than 20 after one to three questions, the others -60 to -240 after twenty.
const DECISIVE: f64 = 20.0;

/// What is asked, with the least of it that does harm.
const ASKED: [FrameUnknown; 2] = [
    FrameUnknown::Delay { sigma_secs: HARMFUL_DELAY },
    FrameUnknown::ImageShift { sigma_rad: HARMFUL_SHIFT },
];

/// What is taken of the images where the answer is yes.
const TAKEN: [FrameUnknown; 2] = [
    FrameUnknown::Delay { sigma_secs: STAMP_SCATTER_SECS },
    FrameUnknown::ImageShift { sigma_rad: IMAGE_SHIFT_RAD },
];

/// The questions so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageQuestions {
    asked: usize,
    last: Option<Timestamp>,
    /// Of a delay and of a shift; `None` where that is known already.
    log_factors: [Option<f64>; 2],
    is_over: bool,
}

impl ImageQuestions {
    /// Asks what the settings leave open.
    pub fn new(config: &OdometryConfig, has_imu: bool) -> Self {
        let is_open = [config.stamp_scatter_ms.is_none(), config.image_shift_deg.is_none()];
        let log_factors = is_open.map(|open| (open && has_imu).then_some(0.0));
        Self { asked: 0, last: None, log_factors, is_over: log_factors == [None, None] }
    }

    fn is_due(&self, now: Timestamp) -> bool {
        !self.is_over && self.last.is_none_or(|last| (now - last).as_secs_f64() >= PAUSE_SECS)
    }

    /// Takes the answers at `now`; says which of both images have. Stabilised images look as if stamps scattered and the other way round, so that one has to be
    /// far ahead of the other.
    fn take(&mut self, answers: [f64; 2], now: Timestamp) -> Option<usize> {
        self.last = Some(now);
        self.asked += 1;
        for (sum, answer) in self.log_factors.iter_mut().zip(answers) {
            *sum = sum.map(|sum| (sum + answer).max(-DECISIVE));
        }
        let sums = self.log_factors.map(|sum| sum.unwrap_or(f64::NEG_INFINITY));
        let best = usize::from(sums[1] > sums[0]);
        let is_told = sums[best] > DECISIVE.max(sums[1 - best] + DECISIVE);
        self.is_over = is_told || self.asked == MOST;
        is_told.then_some(best)
    }
}

impl Odometry {
    /// Asks the window at `now` where that is due; where images have an unknown of their own, every frame has it from here on.
    pub(super) fn question_images(&mut self, now: Timestamp) {
        let Phase::Tracking(window) = &mut self.phase else { return };
        // With a clock that is off images turn otherwise than the gyroscope, too.
        if !self.time_calibration.is_settled() || !self.questions.is_due(now) {
            return;
        }
        let answers = ASKED.map(|unknown| window.smoother.log_evidence(unknown).unwrap_or(0.0));
        let Some(told) = self.questions.take(answers, now) else { return };
        match TAKEN[told] {
            FrameUnknown::Delay { sigma_secs } => self.config.stamp_scatter_ms = Some(1e3 * sigma_secs),
            FrameUnknown::ImageShift { sigma_rad } => {
                self.config.image_shift_deg = Some(sigma_rad.to_degrees())
            }
        }
        window.smoother.set_image_unknowns(&self.config);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Duration;

    fn at(secs: f64) -> Timestamp {
        Timestamp::from_nanos(0) + Duration::from_secs_f64(secs)
    }

    fn open() -> ImageQuestions {
        ImageQuestions::new(&OdometryConfig::default(), true)
    }

    #[test]
    fn questions_end_with_an_answer() {
        assert!(!ImageQuestions::new(&OdometryConfig::default(), false).is_due(at(0.0)));
        let mut questions = open();
        assert!(questions.is_due(at(0.0)) && questions.take([15.0, -5.0], at(0.0)).is_none());
        assert!(!questions.is_due(at(0.5)) && questions.is_due(at(1.0)));
        assert!(questions.take([15.0, -5.0], at(1.0)) == Some(0) && !questions.is_due(at(9.0)));
        let mut questions = open();
        assert!(
            questions.take([-300.0; 2], at(0.0)).is_none() && questions.take([10.0, 39.0], at(1.0)).is_none()
        );
        assert_eq!(questions.take([1.0, 2.0], at(2.0)), Some(1), "neither at first, but then");
        let mut questions = open();
        let nothing =
            |k: usize| questions.is_due(at(k as f64)) && questions.take([0.01; 2], at(k as f64)).is_none();
        assert!((0..MOST).all(nothing));
        assert!(!questions.is_due(at(99.0)), "nothing was told");
    }

    #[test]
    fn of_two_explanations_the_better_one_is_taken_where_it_is_far_better() {
        let mut questions = open();
        assert!(questions.take([40.0, 55.0], at(0.0)).is_none() && questions.is_due(at(1.0)));
        assert_eq!(questions.take([10.0, 20.0], at(1.0)), Some(1));
    }

    #[test]
    fn what_is_known_is_not_asked() {
        let known = OdometryConfig { stamp_scatter_ms: Some(0.0), ..Default::default() };
        let mut questions = ImageQuestions::new(&known, true);
        assert_eq!(questions.take([100.0, 30.0], at(0.0)), Some(1));
        let both = OdometryConfig { image_shift_deg: Some(0.0), ..known };
        assert!(!ImageQuestions::new(&both, true).is_due(at(0.0)));
    }
}
