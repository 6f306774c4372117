//! Stamps of samples, and the instants that they name.

use vidar_core::Timestamp;

/// Stamp of the sequence's beginning: a day in 2020, so that stamps have as many digits as real ones.
const EPOCH_NANOS: i64 = 1_600_000_000_000_000_000;

/// Stamp of sample `k` at `rate_hz`, and the instant (s after the beginning) that the rounded stamp names.
pub(crate) fn stamp(k: usize, rate_hz: f64) -> (Timestamp, f64) {
    let nanos = (k as f64 * 1e9 / rate_hz).round() as i64;
    (Timestamp::from_nanos(EPOCH_NANOS + nanos), nanos as f64 * 1e-9)
}

/// Stamp nearest to `secs` after the sequence's beginning, and the instant (s) that it names.
pub(crate) fn stamp_at(secs: f64) -> (Timestamp, f64) {
    let nanos = (secs * 1e9).round() as i64;
    (Timestamp::from_nanos(EPOCH_NANOS + nanos), nanos as f64 * 1e-9)
}

/// Seconds after the sequence's beginning of a stamp; the inverse of [`stamp`].
pub(crate) fn secs(time: Timestamp) -> f64 {
    (time.nanos().saturating_sub(EPOCH_NANOS)) as f64 * 1e-9
}
