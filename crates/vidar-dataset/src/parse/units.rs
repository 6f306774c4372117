//! Decides the unit of a column of times.
//!
//! Each format has a unit, but files may use another: EuRoC lists in seconds, TUM lists in nanoseconds. A unit is plausible when
//! the median step lies between 0.1 ms and 10 s and no time is past the year 2100. The unit of the format is kept
//! if it is plausible; else the plausible one whose times are years 2000–2100 is taken, else the one whose step
//! is nearest to 20 ms (in the logarithm), and a warning reports the decision.

use crate::error::DatasetError;
use crate::options::TimeUnit;
use crate::source::{Row, Source, quoted};
use vidar_core::{Timestamp, Warning};

/// How the unit of a file's times is decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnitRule {
    /// Given by the user.
    Given(TimeUnit),
    /// That of the format, unless it is implausible.
    Expected(TimeUnit),
    /// Not stated; decided by the numbers.
    Guess,
}

impl UnitRule {
    /// The unit given by the user if there is one, else that of the format.
    pub fn given_or(given: Option<TimeUnit>, expected: TimeUnit) -> Self {
        given.map_or(Self::Expected(expected), Self::Given)
    }
}

/// Rows looked at for the decision.
const SAMPLE: usize = 1000;
/// Year 2000 and year 2100, seconds after 1970.
const EPOCH_SECS: std::ops::Range<f64> = 9.4e8..4.1e9;
/// Steps from 10 kHz to one in ten seconds.
const STEP_SECS: std::ops::RangeInclusive<f64> = 1e-4..=10.0;

/// Statistics of the numbers in a time column.
struct TimeColumnStatistics {
    largest: f64,
    median_step: Option<f64>,
    has_fraction: bool,
}

impl TimeColumnStatistics {
    fn of<'a>(times: impl Iterator<Item = &'a str>) -> Self {
        let mut values = Vec::new();
        let mut has_fraction = false;
        for text in times.take(SAMPLE) {
            if let Ok(v) = text.parse::<f64>()
                && v.is_finite()
            {
                has_fraction |= v.fract() != 0.0;
                values.push(v);
            }
        }
        let largest = values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let mut steps: Vec<f64> =
            values.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|s| *s > 0.0).collect();
        steps.sort_by(f64::total_cmp);
        Self { largest, median_step: steps.get(steps.len() / 2).copied(), has_fraction }
    }

    fn is_plausible(&self, unit: TimeUnit) -> bool {
        let per_second = 10f64.powi(unit.digits() as i32);
        self.largest / per_second < EPOCH_SECS.end
            && self.median_step.is_none_or(|s| STEP_SECS.contains(&(s / per_second)))
    }

    fn best(&self) -> Option<TimeUnit> {
        let plausible = || TimeUnit::ALL.into_iter().filter(|&u| self.is_plausible(u));
        let in_epoch = |u: &TimeUnit| EPOCH_SECS.contains(&(self.largest / 10f64.powi(u.digits() as i32)));
        if let Some(unit) = plausible().find(in_epoch) {
            return Some(unit);
        }
        if self.has_fraction && self.is_plausible(TimeUnit::Seconds) {
            return Some(TimeUnit::Seconds);
        }
        let distance = |u: TimeUnit| {
            let step_secs = self.median_step.unwrap_or(1.0) / 10f64.powi(u.digits() as i32);
            (step_secs / 0.02).ln().abs()
        };
        plausible().min_by(|&a, &b| distance(a).total_cmp(&distance(b)))
    }
}

/// Decides the unit of the times of `source`.
pub(crate) fn decide_unit<'a>(
    rule: UnitRule,
    times: impl Iterator<Item = &'a str>,
    place: &str,
    notes: &mut Vec<Warning>,
) -> TimeUnit {
    let statistics = match rule {
        UnitRule::Given(unit) => return unit,
        _ => TimeColumnStatistics::of(times),
    };
    let description = |e: &TimeColumnStatistics| match e.median_step {
        Some(step) => format!("values up to {:e} with a median step of {step:e}", e.largest),
        None => format!("values up to {:e}", e.largest),
    };
    match rule {
        UnitRule::Given(unit) => unit,
        UnitRule::Expected(unit) if statistics.is_plausible(unit) => unit,
        UnitRule::Expected(unit) => match statistics.best() {
            Some(best) if best != unit => {
                notes.push(
                    Warning::new(
                        "unit-slip",
                        format!(
                            "times should be in {unit} but {} look like {best}; read as {best}",
                            description(&statistics)
                        ),
                    )
                    .at(place)
                    .hint(format!("--time-unit {unit} keeps the unit of the format")),
                );
                best
            }
            _ => unit,
        },
        UnitRule::Guess => {
            let unit = statistics.best().unwrap_or(TimeUnit::Seconds);
            notes.push(
                Warning::new("time-unit", format!("{}: read as {unit}", description(&statistics)))
                    .at(place)
                    .hint("--time-unit s|ms|us|ns sets the unit"),
            );
            unit
        }
    }
}

/// Reads one time.
pub(crate) fn read_time(
    source: &Source<'_>,
    row: &Row<'_>,
    text: &str,
    unit: TimeUnit,
) -> Result<Timestamp, DatasetError> {
    Timestamp::parse_unit(text, unit.digits())
        .map_err(|_| source.malformed(row.line, quoted(text), format!("a time in {unit}")))
}
