//! Integer-nanosecond time. Seconds as `f64` lose the last 200 ns of a Unix stamp, so they never occur inside.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::ops::{Add, AddAssign, Neg, Sub};

/// An instant in the dataset's own clock, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Timestamp(i64);

/// A signed span of time in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Duration(i64);

/// Why a text is not a time.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TimeError {
    /// The text is not a plain or exponent-form decimal number.
    #[error("not a decimal number of seconds: {text:?}")]
    NotANumber {
        /// The text as found.
        text: String,
    },
    /// The value does not fit 64-bit nanoseconds (±292 years).
    #[error("time out of range (|t| must be below 9.2e9 s): {text:?}")]
    OutOfRange {
        /// The text as found.
        text: String,
    },
}

const NANOS_PER_SEC: i64 = 1_000_000_000;

impl Timestamp {
    /// The instant `nanos` nanoseconds after the clock's zero.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// Nanoseconds after the clock's zero.
    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds after the clock's zero; for printing and plotting only (a Unix stamp keeps about 200 ns).
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Reads decimal seconds (`1403636580.838555648`, also `1.4e9`) without going through `f64`.
    ///
    /// Digits beyond the ninth decimal are rounded half away from zero.
    pub fn parse_secs(text: &str) -> Result<Self, TimeError> {
        parse_scaled(text, 9).map(Self)
    }

    /// Reads a number given in units of 10^`-digits` seconds (0: s, 3: ms, 6: µs, 9: ns) into nanoseconds.
    pub fn parse_unit(text: &str, digits: u32) -> Result<Self, TimeError> {
        parse_scaled(text, 9 - i32::try_from(digits.min(9)).unwrap_or(9)).map(Self)
    }

    /// Decimal seconds with exactly nine decimals, the format of TUM files.
    pub fn to_secs_string(self) -> String {
        format_nanos(self.0)
    }

    /// The span from `earlier` to `self`, saturating at the range of the clock.
    pub fn since(self, earlier: Self) -> Duration {
        Duration(self.0.saturating_sub(earlier.0))
    }
}

impl Duration {
    /// No time at all.
    pub const ZERO: Self = Self(0);

    /// A span of `nanos` nanoseconds.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// A span of `millis` milliseconds.
    pub const fn from_millis(millis: i64) -> Self {
        Self(millis.saturating_mul(1_000_000))
    }

    /// A span of `secs` seconds, rounded to the nanosecond; not-a-number becomes zero, the rest saturates.
    pub fn from_secs_f64(secs: f64) -> Self {
        Self((secs * NANOS_PER_SEC as f64).round() as i64)
    }

    /// Nanoseconds.
    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// The span without its sign.
    pub fn abs(self) -> Self {
        Self(self.0.saturating_abs())
    }
}

impl Add<Duration> for Timestamp {
    type Output = Self;
    fn add(self, span: Duration) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Duration> for Timestamp {
    type Output = Self;
    fn sub(self, span: Duration) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}

impl Sub for Timestamp {
    type Output = Duration;
    fn sub(self, earlier: Self) -> Duration {
        self.since(earlier)
    }
}

impl Add for Duration {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

impl AddAssign for Duration {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sub for Duration {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }
}

impl Neg for Duration {
    type Output = Self;
    fn neg(self) -> Self {
        Self(self.0.saturating_neg())
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&format_nanos(self.0))
    }
}

impl fmt::Display for Duration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} s", self.as_secs_f64())
    }
}

fn format_nanos(nanos: i64) -> String {
    let sign = if nanos < 0 { "-" } else { "" };
    let magnitude = nanos.unsigned_abs();
    format!("{sign}{}.{:09}", magnitude / 1_000_000_000, magnitude % 1_000_000_000)
}

/// Reads a decimal number and returns it times 10^`shift`, rounded half away from zero, in integers only.
fn parse_scaled(text: &str, shift: i32) -> Result<i64, TimeError> {
    let not_a_number = || TimeError::NotANumber { text: text.chars().take(64).collect() };
    let out_of_range = || TimeError::OutOfRange { text: text.chars().take(64).collect() };
    let trimmed = text.trim();
    let (negative, unsigned) = match trimmed.as_bytes().first() {
        Some(b'-') => (true, &trimmed[1..]),
        Some(b'+') => (false, &trimmed[1..]),
        _ => (false, trimmed),
    };
    let (mantissa, exponent) = match unsigned.find(['e', 'E']) {
        Some(at) => (&unsigned[..at], unsigned[at + 1..].parse::<i32>().map_err(|_| not_a_number())?),
        None => (unsigned, 0),
    };
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let all_digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if (whole.is_empty() && fraction.is_empty()) || !all_digits(whole) || !all_digits(fraction) {
        return Err(not_a_number());
    }
    if !(-400..=400).contains(&exponent) {
        return Err(out_of_range());
    }
    // Position of the unit's last digit in the digit string `whole ++ fraction`.
    let keep =
        i64::try_from(whole.len()).map_err(|_| out_of_range())? + i64::from(exponent) + i64::from(shift);
    let mut value: i64 = 0;
    let digits = whole.bytes().chain(fraction.bytes());
    let mut read: i64 = 0;
    let mut round_up = false;
    for digit in digits {
        if read < keep {
            value = value
                .checked_mul(10)
                .and_then(|v| v.checked_add(i64::from(digit - b'0')))
                .ok_or_else(out_of_range)?;
        } else if read == keep {
            round_up = digit >= b'5';
        }
        read += 1;
    }
    while read < keep && value != 0 {
        value = value.checked_mul(10).ok_or_else(out_of_range)?;
        read += 1;
    }
    if round_up {
        value = value.checked_add(1).ok_or_else(out_of_range)?;
    }
    Ok(if negative { -value } else { value })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unix_stamps_keep_every_nanosecond() {
        let t = Timestamp::parse_secs("1403636580.838555648").unwrap();
        assert_eq!(t.nanos(), 1_403_636_580_838_555_648);
        assert_eq!(t.to_secs_string(), "1403636580.838555648");
    }

    #[test]
    fn exponents_signs_and_rounding() {
        let ns = |s: &str| Timestamp::parse_secs(s).map(Timestamp::nanos);
        assert_eq!(ns("1.403636580838555648e9"), Ok(1_403_636_580_838_555_648));
        assert_eq!(ns("1.403636579763555580e+09"), Ok(1_403_636_579_763_555_580));
        assert_eq!(ns("-0.0000000015"), Ok(-2));
        assert_eq!(ns("0.0000000014"), Ok(1));
        assert_eq!(ns("+.5"), Ok(500_000_000));
        assert_eq!(ns("3e-10"), Ok(0));
        assert_eq!(ns("5e-10"), Ok(1));
        assert_eq!(ns("7"), Ok(7_000_000_000));
        assert_eq!(Timestamp::from_nanos(-1).to_secs_string(), "-0.000000001");
        assert_eq!(
            Timestamp::parse_unit("1403636580838555648", 9).map(Timestamp::nanos),
            Ok(1_403_636_580_838_555_648)
        );
        assert_eq!(Timestamp::parse_unit("1.5", 3).map(Timestamp::nanos), Ok(1_500_000));
    }

    #[test]
    fn garbage_is_an_error_value() {
        for text in ["", ".", "-", "nan", "inf", "1.2.3", "1e", "0x10", "1,5", "１"] {
            assert!(matches!(Timestamp::parse_secs(text), Err(TimeError::NotANumber { .. })), "{text:?}");
        }
        for text in ["1e20", "99999999999", "1e999"] {
            assert!(matches!(Timestamp::parse_secs(text), Err(TimeError::OutOfRange { .. })), "{text:?}");
        }
    }

    proptest::proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn every_stamp_survives_its_own_text(nanos in -i64::MAX..=i64::MAX) {
            let time = Timestamp::from_nanos(nanos);
            proptest::prop_assert_eq!(Timestamp::parse_secs(&time.to_secs_string()), Ok(time));
            proptest::prop_assert_eq!(Timestamp::parse_unit(&nanos.to_string(), 9), Ok(time));
        }

        #[test]
        fn any_text_is_a_time_or_an_error(text in ".{0,40}", digits in 0..20_u32) {
            let _ = Timestamp::parse_secs(&text);
            let _ = Timestamp::parse_unit(&text, digits);
        }
    }

    #[test]
    fn sums_past_the_end_of_the_clock_saturate() {
        let (last, tick) = (Timestamp::from_nanos(i64::MAX), Duration::from_nanos(1));
        assert_eq!(last + tick, last);
        assert_eq!(last.since(Timestamp::from_nanos(-1)).nanos(), i64::MAX);
        assert_eq!(Duration::from_nanos(i64::MIN).abs().nanos(), i64::MAX);
        assert_eq!(
            (Duration::from_secs_f64(f64::NAN), Duration::from_secs_f64(1.5)),
            (Duration::ZERO, Duration::from_millis(1500))
        );
    }
}
