//! What is unknown of a lens that moves while filming, and what is known of it before.

use vidar_core::LensMotion;

/// Most unknowns of a lens.
pub(super) const LENS_DIM: usize = 5;

/// What is known before of how the lens moves while filming (see [`super::lens`]); nothing of it is unknown where it does not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct LensPrior {
    /// Standard deviation of `ln` of an image's focal length over the calibration's, where it changes.
    pub(super) focal: Option<f64>,
    /// Standard deviation of an image's shift in x and in y, focal lengths, where it is shifted; it has a rate, too.
    pub(super) shift: Option<f64>,
}

/// How long a lens keeps its place, s: autofocus moves every few seconds, stabilisation with each tremor of the hand.
const FOCUS_SECS: f64 = 5.0;
const SHIFT_SECS: f64 = 0.2;
const RATE_SECS: f64 = 0.05;
/// How fast a lens is shifted that is shifted by 1, 1/s: a hand shakes three to six times a second.
const RATE_PER_SHIFT: f64 = 30.0;

/// What is unknown of an image's lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum LensUnknown {
    LogFocal,
    ShiftX,
    ShiftY,
    ShiftRateX,
    ShiftRateY,
}

impl LensUnknown {
    pub(super) fn of(self, lens: &LensMotion) -> f64 {
        match self {
            Self::LogFocal => lens.log_focal,
            Self::ShiftX => lens.shift.x,
            Self::ShiftY => lens.shift.y,
            Self::ShiftRateX => lens.shift_rate.x,
            Self::ShiftRateY => lens.shift_rate.y,
        }
    }

    /// Changes its value.
    pub(super) fn add(self, lens: &mut LensMotion, step: f64) {
        *match self {
            Self::LogFocal => &mut lens.log_focal,
            Self::ShiftX => &mut lens.shift.x,
            Self::ShiftY => &mut lens.shift.y,
            Self::ShiftRateX => &mut lens.shift_rate.x,
            Self::ShiftRateY => &mut lens.shift_rate.y,
        } += step;
    }
}

/// A process: its standard deviation, and how long it keeps its value, s.
#[derive(Clone, Copy)]
pub(super) struct Process {
    pub(super) sigma: f64,
    pub(super) secs: f64,
}

impl LensPrior {
    /// Unknowns of an image's lens.
    pub(super) fn dim(&self) -> usize {
        usize::from(self.focal.is_some()) + 4 * usize::from(self.shift.is_some())
    }

    /// What is unknown, in the order in which it follows a state.
    pub(super) fn unknowns(&self) -> impl Iterator<Item = LensUnknown> {
        self.processes().map(|(unknown, _)| unknown)
    }

    pub(super) fn processes(&self) -> impl Iterator<Item = (LensUnknown, Process)> {
        let focal = self.focal.map(|sigma| Process { sigma, secs: FOCUS_SECS });
        let shift = self.shift.map(|sigma| Process { sigma, secs: SHIFT_SECS });
        let rate = self.shift.map(|sigma| Process { sigma: RATE_PER_SHIFT * sigma, secs: RATE_SECS });
        let all = [
            (LensUnknown::LogFocal, focal),
            (LensUnknown::ShiftX, shift),
            (LensUnknown::ShiftY, shift),
            (LensUnknown::ShiftRateX, rate),
            (LensUnknown::ShiftRateY, rate),
        ];
        all.into_iter().filter_map(|(unknown, process)| Some((unknown, process?)))
    }
}
