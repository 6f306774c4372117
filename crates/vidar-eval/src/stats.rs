//! Summary of a list of errors.

use serde::{Deserialize, Serialize};

/// Summary of non-negative errors, in their unit; `std` is the population's (divided by n), as evo and numpy do.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorStats {
    /// Number of errors.
    pub count: usize,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; the mean of the two central values for an even number.
    pub median: f64,
    /// Standard deviation about the mean.
    pub std: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
}

impl ErrorStats {
    /// Summarises `errors`; `None` when there is none or one is not finite.
    pub fn from_errors(errors: &[f64]) -> Option<Self> {
        if errors.is_empty() || errors.iter().any(|e| !e.is_finite()) {
            return None;
        }
        let n = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / n;
        let mean_square = errors.iter().map(|e| e * e).sum::<f64>() / n;
        let variance = errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n;
        let mut sorted = errors.to_vec();
        sorted.sort_unstable_by(f64::total_cmp);
        Some(Self {
            count: errors.len(),
            rmse: mean_square.sqrt(),
            mean,
            median: median_of_sorted(&sorted)?,
            std: variance.sqrt(),
            min: *sorted.first()?,
            max: *sorted.last()?,
        })
    }
}

/// Median of sorted values; the mean of the two central values for an even number.
pub(crate) fn median_of_sorted(sorted: &[f64]) -> Option<f64> {
    let upper = *sorted.get(sorted.len() / 2)?;
    if sorted.len() % 2 == 1 {
        return Some(upper);
    }
    Some(0.5 * (sorted[sorted.len() / 2 - 1] + upper))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summary_of_known_numbers() {
        let s = ErrorStats::from_errors(&[3.0, 1.0, 2.0, 4.0]).unwrap();
        assert_eq!((s.count, s.mean, s.median, s.min, s.max), (4, 2.5, 2.5, 1.0, 4.0));
        assert!((s.rmse - 7.5_f64.sqrt()).abs() < 1e-15);
        assert!((s.std - 1.25_f64.sqrt()).abs() < 1e-15);
        assert_eq!(ErrorStats::from_errors(&[5.0, 1.0, 2.0]).unwrap().median, 2.0);
    }

    #[test]
    fn nothing_and_nan_have_no_summary() {
        assert_eq!(ErrorStats::from_errors(&[]), None);
        assert_eq!(ErrorStats::from_errors(&[1.0, f64::NAN]), None);
    }
}
