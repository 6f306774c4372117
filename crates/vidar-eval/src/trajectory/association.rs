//! Association of the estimate's poses with those of ground truth by time.
//!
//! The rule is evo's: each stamp of the trajectory with fewer poses (the estimate, when both have as many) takes the
//! nearest stamp of the other one, the earlier of two equally near, and is dropped when that one is more than the
//! largest difference away. A pose of the longer trajectory may be matched twice. Unlike evo, differences are integer
//! nanoseconds, so a pair exactly at the limit counts whatever the epoch.

use crate::error::EvalError;
use vidar_core::{Duration, Timestamp, Trajectory};

/// Pairs `(index in estimate, index in truth)` in the order of time.
///
/// Fails when a trajectory is empty or nothing matches; the error names both time ranges and the likely reason.
pub fn associate(
    estimate: &Trajectory,
    truth: &Trajectory,
    max_difference: Duration,
) -> Result<Vec<(usize, usize)>, EvalError> {
    for (which, trajectory) in [("estimated", estimate), ("ground-truth", truth)] {
        if trajectory.is_empty() {
            return Err(EvalError::EmptyTrajectory { which });
        }
    }
    let swapped = truth.len() < estimate.len();
    let (few, many) = if swapped { (truth, estimate) } else { (estimate, truth) };
    let mut pairs = Vec::with_capacity(few.len());
    let mut smallest = Duration::from_nanos(i64::MAX);
    for (i, stamped) in few.poses().iter().enumerate() {
        let (j, difference) = nearest_stamp(many, stamped.time);
        smallest = smallest.min(difference);
        if difference <= max_difference {
            pairs.push(if swapped { (j, i) } else { (i, j) });
        }
    }
    if pairs.is_empty() {
        return Err(no_matches(estimate, truth, max_difference, smallest));
    }
    Ok(pairs)
}

/// Index of the stamp nearest to `time`, the earlier of two equally near, and its distance. Not for empty ones.
fn nearest_stamp(trajectory: &Trajectory, time: Timestamp) -> (usize, Duration) {
    let stamped = trajectory.poses();
    let after = stamped.partition_point(|p| p.time < time).min(stamped.len() - 1);
    let before = after.saturating_sub(1);
    let difference = |i: usize| (stamped[i].time - time).abs();
    if difference(before) <= difference(after) {
        (before, difference(before))
    } else {
        (after, difference(after))
    }
}

fn no_matches(
    estimate: &Trajectory,
    truth: &Trajectory,
    max_difference: Duration,
    nearest: Duration,
) -> EvalError {
    let range = |t: &Trajectory| t.time_range().unwrap_or_default();
    let (estimate_range, truth_range) = (range(estimate), range(truth));
    EvalError::NoMatches {
        max_difference_ms: max_difference.as_secs_f64() * 1e3,
        estimate_first: estimate_range.0,
        estimate_last: estimate_range.1,
        truth_first: truth_range.0,
        truth_last: truth_range.1,
        nearest,
        hint: likely_reason(estimate_range, truth_range, nearest),
    }
}

/// The likely reason for stamps that do not match.
fn likely_reason(
    estimate: (Timestamp, Timestamp),
    truth: (Timestamp, Timestamp),
    nearest: Duration,
) -> String {
    let overlap = estimate.0 <= truth.1 && truth.0 <= estimate.1;
    if overlap {
        return format!(
            "the ranges overlap, so the stamps interleave: allow at least {:.1} ms",
            nearest.as_secs_f64() * 1e3
        );
    }
    let span = |r: (Timestamp, Timestamp)| (r.1 - r.0).as_secs_f64();
    // Stamps of one recording, one side read in a wrong unit: both the values and the spans differ by that factor.
    let of_values = truth.0.as_secs_f64() / estimate.0.as_secs_f64();
    let of_spans = span(truth) / span(estimate);
    for (factor, unit) in [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")] {
        let fits = |ratio: f64, tolerance: f64| (ratio / factor).ln().abs() < tolerance;
        if fits(of_values, 0.1) || fits(of_spans, 1.0) {
            return format!(
                "unit slip: the ground truth's stamps look like {unit} that were read as seconds"
            );
        }
        if fits(1.0 / of_values, 0.1) || fits(1.0 / of_spans, 1.0) {
            return format!("unit slip: the estimate's stamps look like {unit} that were read as seconds");
        }
    }
    format!(
        "different clocks or different recordings: the ground truth starts {:.3} s after the estimate",
        (truth.0 - estimate.0).as_secs_f64()
    )
}
