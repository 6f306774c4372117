//! Domains of settings.

use crate::error::SynthError;

pub(crate) fn ensure(
    holds: bool,
    key: &'static str,
    expected: &'static str,
    found: impl std::fmt::Display,
) -> Result<(), SynthError> {
    if holds { Ok(()) } else { Err(SynthError::BadConfig { key, expected, found: found.to_string() }) }
}

pub(crate) fn within(
    key: &'static str,
    value: f64,
    low: f64,
    high: f64,
    expected: &'static str,
) -> Result<(), SynthError> {
    ensure(value >= low && value <= high, key, expected, value)
}
