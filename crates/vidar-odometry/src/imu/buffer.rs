//! IMU measurements by time, cut at arbitrary instants.

use std::collections::VecDeque;
use vidar_core::{AngularRate, Duration, ImuSample, SpecificForce, Timestamp};

/// Why an IMU sample is not taken or an interval cannot be given.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BufferError {
    /// Time does not advance.
    #[error("IMU sample at {found} s is not after the one before it at {previous} s; it is left out")]
    NotIncreasing {
        /// Time of the sample.
        found: Timestamp,
        /// Time of the newest sample held.
        previous: Timestamp,
    },
    /// A component is not a number.
    #[error("IMU sample at {found} s is not finite; it is left out")]
    NotFinite {
        /// Time of the sample.
        found: Timestamp,
    },
    /// The IMU measurements held do not reach as far back or ahead as asked.
    #[error("IMU measurements from {from} s to {until} s were asked for, held are {held}")]
    NotCovered {
        /// Begin of the interval.
        from: Timestamp,
        /// End of the interval.
        until: Timestamp,
        /// What is held, in words.
        held: String,
    },
}

/// A stretch without IMU measurements, longer than the IMU's rate explains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// Last sample before it.
    pub after: Timestamp,
    /// Its length.
    pub length: Duration,
}

/// A gap is reported when two IMU measurements lie further apart than this many nominal periods.
const GAP_PERIODS: f64 = 3.5;

/// IMU measurements in the order of time; the oldest are forgotten by [`ImuBuffer::forget_before`].
#[derive(Clone, Debug)]
pub struct ImuBuffer {
    samples: VecDeque<ImuSample>,
    nominal_period: Duration,
}

impl ImuBuffer {
    /// An empty buffer for IMU measurements at about `rate_hz`.
    pub fn new(rate_hz: f64) -> Self {
        let nominal_period = Duration::from_secs_f64(1.0 / rate_hz.max(1.0));
        Self { samples: VecDeque::with_capacity(4096), nominal_period }
    }

    /// Takes an IMU sample.
    ///
    /// # Errors
    /// Time that does not advance, values that are not finite. The buffer is unchanged then.
    pub fn push(&mut self, sample: ImuSample) -> Result<(), BufferError> {
        if !sample.gyro.0.iter().chain(sample.accel.0.iter()).all(|v| v.is_finite()) {
            return Err(BufferError::NotFinite { found: sample.time });
        }
        if let Some(last) = self.samples.back().filter(|last| last.time >= sample.time) {
            return Err(BufferError::NotIncreasing { found: sample.time, previous: last.time });
        }
        self.samples.push_back(sample);
        Ok(())
    }

    /// Forgets what is not needed for intervals that begin at `time` or later.
    pub fn forget_before(&mut self, time: Timestamp) {
        // One sample at or before `time` stays, to interpolate from.
        while self.samples.len() > 1 && self.samples[1].time <= time {
            self.samples.pop_front();
        }
    }

    /// IMU measurements held.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether nothing is held.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Time of the newest sample.
    pub fn newest(&self) -> Option<Timestamp> {
        self.samples.back().map(|s| s.time)
    }

    /// The IMU measurements held, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = &ImuSample> + ExactSizeIterator {
        self.samples.iter()
    }

    /// Time between samples when none is missing.
    pub fn nominal_period(&self) -> Duration {
        self.nominal_period
    }

    /// The sample at `time`, linear between its neighbours; `None` outside what is held.
    pub fn at(&self, time: Timestamp) -> Option<ImuSample> {
        let after = self.samples.partition_point(|s| s.time < time);
        let next = self.samples.get(after)?;
        if next.time == time {
            return Some(*next);
        }
        Some(between(self.samples.get(after.checked_sub(1)?)?, next, time))
    }

    /// Writes the IMU measurements from `from` to `until` into `out` (cleared first), interpolated at both ends, and returns
    /// the longest gap among them, if any is longer than the rate explains.
    ///
    /// # Errors
    /// The interval is empty or reaches beyond the IMU measurements held.
    pub fn interval(
        &self,
        from: Timestamp,
        until: Timestamp,
        out: &mut Vec<ImuSample>,
    ) -> Result<Option<Gap>, BufferError> {
        out.clear();
        let (first, last) = match (self.at(from), self.at(until)) {
            (Some(first), Some(last)) if from < until => (first, last),
            _ => return Err(BufferError::NotCovered { from, until, held: self.held_in_words() }),
        };
        out.push(first);
        let begin = self.samples.partition_point(|s| s.time <= from);
        let end = self.samples.partition_point(|s| s.time < until);
        out.extend(self.samples.range(begin..end));
        out.push(last);
        let limit = Duration::from_secs_f64(self.nominal_period.as_secs_f64() * GAP_PERIODS);
        // Neighbours in the buffer, not in the cut, so that a cut within a gap reports the whole gap.
        let begin = begin.saturating_sub(1);
        let end = (end + 1).min(self.samples.len());
        let pairs = self.samples.range(begin..end).zip(self.samples.range(begin..end).skip(1));
        let longest = pairs.map(|(a, b)| Gap { after: a.time, length: b.time - a.time });
        Ok(longest.filter(|gap| gap.length > limit).max_by_key(|gap| gap.length))
    }

    fn held_in_words(&self) -> String {
        match (self.samples.front(), self.samples.back()) {
            (Some(first), Some(last)) => format!("{} s to {} s", first.time, last.time),
            _ => "none".into(),
        }
    }
}

fn between(a: &ImuSample, b: &ImuSample, time: Timestamp) -> ImuSample {
    let share = (time - a.time).nanos() as f64 / (b.time - a.time).nanos() as f64;
    ImuSample {
        time,
        gyro: AngularRate(a.gyro.0.lerp(&b.gyro.0, share)),
        accel: SpecificForce(a.accel.0.lerp(&b.accel.0, share)),
    }
}
