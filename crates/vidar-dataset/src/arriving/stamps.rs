//! Stamps of one sensor as they come: increasing, but for what is left out.

use super::feed::Item;
use vidar_core::{Duration, Timestamp};

/// A stamp this far ahead of the one before is believed once another one goes on from there: longer than a driver stalls, shorter than
/// a clock that is wrong.
const MOST_AHEAD: Duration = Duration::from_millis(10_000);

/// What the stamps of one sensor were so far.
#[derive(Debug, Default)]
pub(super) struct Stamps {
    last: Option<Timestamp>,
    /// Far ahead of the last one.
    suspect: Option<Box<Item>>,
    behind_in_a_row: usize,
    left_out: usize,
}

impl Stamps {
    /// What of a message, and of a suspect one before it, can be used.
    pub fn pass(&mut self, item: Item) -> [Option<Item>; 2] {
        let time = item.time;
        if self.last.is_some_and(|last| time <= last) {
            self.left_out += 1 + usize::from(self.suspect.take().is_some());
            self.behind_in_a_row += 1;
            return [None, None];
        }
        let is_near = |before: Timestamp| time > before && time - before <= MOST_AHEAD;
        let goes_on = self.last.is_none_or(is_near);
        let before = match self.suspect.take() {
            Some(suspect) if !goes_on && is_near(suspect.time) => Some(*suspect),
            Some(_) => {
                self.left_out += 1;
                None
            }
            None => None,
        };
        if !goes_on && before.is_none() {
            self.suspect = Some(Box::new(item));
            return [None, None];
        }
        self.last = Some(time);
        self.behind_in_a_row = 0;
        [before, Some(item)]
    }

    /// Messages that came behind later ones since the last one that did not.
    pub fn behind_in_a_row(&self) -> usize {
        self.behind_in_a_row
    }

    /// Messages that were not used, at the end of the stream.
    pub fn left_out(&self) -> usize {
        self.left_out + usize::from(self.suspect.is_some())
    }
}
