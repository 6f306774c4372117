//! What is unknown of a lens that moves while filming and of a clock that scatters, and what is known of it before.

/// Most unknowns of an image.
pub(super) const IMAGE_DIM: usize = 6;

/// What is known before of how the lens moves while filming, and of how stamps scatter; nothing of it is unknown where they
/// do not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImagePrior {
    /// Standard deviation of `ln` of an image's focal length over the calibration's, where it changes.
    pub focal: Option<f64>,
    /// Standard deviation of an image's shift in x and in y, focal lengths, where it is shifted; it has a rate, too.
    pub shift: Option<f64>,
    /// Standard deviation of how much later than its stamp says an image was exposed, s, where stamps scatter.
    pub delay: Option<f64>,
}

/// How long a lens keeps its place, s: autofocus moves every few seconds, stabilisation with each tremor of the hand. Part of a stamp's error is that of the
/// image alone, part goes with the exposure: delays of two real phones' images 0.14 s apart are correlated by 0.5 and 0.8.
const FOCUS_SECS: f64 = 5.0;
const SHIFT_SECS: f64 = 0.2;
const RATE_SECS: f64 = 0.05;
const DELAY_SECS: f64 = 0.2;
/// How fast a lens is shifted that is shifted by 1, 1/s: a hand shakes three to six times a second.
const RATE_PER_SHIFT: f64 = 30.0;

/// What is unknown of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ImageUnknown {
    LogFocal,
    ShiftX,
    ShiftY,
    ShiftRateX,
    ShiftRateY,
    Delay,
}

/// A process: its standard deviation, and how long it keeps its value, s.
#[derive(Clone, Copy)]
pub(super) struct Process {
    pub(super) sigma: f64,
    pub(super) secs: f64,
}

impl ImagePrior {
    /// What is known here, else there.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self {
            focal: self.focal.or(other.focal),
            shift: self.shift.or(other.shift),
            delay: self.delay.or(other.delay),
        }
    }

    /// Unknowns of an image.
    pub(super) fn dim(&self) -> usize {
        usize::from(self.focal.is_some())
            + 4 * usize::from(self.shift.is_some())
            + usize::from(self.delay.is_some())
    }

    /// What is unknown, in the order in which it follows a state.
    pub(super) fn unknowns(&self) -> impl Iterator<Item = ImageUnknown> {
        self.processes().map(|(unknown, _)| unknown)
    }

    pub(super) fn processes(&self) -> impl Iterator<Item = (ImageUnknown, Process)> {
        let focal = self.focal.map(|sigma| Process { sigma, secs: FOCUS_SECS });
        let shift = self.shift.map(|sigma| Process { sigma, secs: SHIFT_SECS });
        let rate = self.shift.map(|sigma| Process { sigma: RATE_PER_SHIFT * sigma, secs: RATE_SECS });
        let delay = self.delay.map(|sigma| Process { sigma, secs: DELAY_SECS });
        let all = [
            (ImageUnknown::LogFocal, focal),
            (ImageUnknown::ShiftX, shift),
            (ImageUnknown::ShiftY, shift),
            (ImageUnknown::ShiftRateX, rate),
            (ImageUnknown::ShiftRateY, rate),
            (ImageUnknown::Delay, delay),
        ];
        all.into_iter().filter_map(|(unknown, process)| Some((unknown, process?)))
    }
}
