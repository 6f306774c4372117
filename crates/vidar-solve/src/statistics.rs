//! Medians.
//!
//! Two conventions exist for an even number of values: the mean of the two central ones ([`median`], as in textbooks and
//! NumPy) and the greater of the two ([`median_upper`], which needs one selection and is itself a value of the data). Both
//! take linear time and give the same bits for any order of the values. Values are ordered by `total_cmp`: NaN is the
//! greatest.

/// σ of a normal distribution per median absolute deviation.
pub const STD_PER_MAD: f64 = 1.4826;

/// A floating-point type that has medians.
pub trait Real: Copy {
    /// The total order of IEEE 754.
    fn order(&self, other: &Self) -> std::cmp::Ordering;
    /// ½ (a + b).
    fn mean_of_two(a: Self, b: Self) -> Self;
}

impl Real for f64 {
    #[inline]
    fn order(&self, other: &Self) -> std::cmp::Ordering {
        self.total_cmp(other)
    }

    fn mean_of_two(a: Self, b: Self) -> Self {
        0.5 * (a + b)
    }
}

impl Real for f32 {
    #[inline]
    fn order(&self, other: &Self) -> std::cmp::Ordering {
        self.total_cmp(other)
    }

    fn mean_of_two(a: Self, b: Self) -> Self {
        0.5 * (a + b)
    }
}

/// The central value in order, the greater of the two central ones for an even number; `None` without values. The slice is
/// reordered.
pub fn median_upper<T: Real>(values: &mut [T]) -> Option<T> {
    if values.is_empty() {
        return None;
    }
    let at = values.len() / 2;
    Some(*values.select_nth_unstable_by(at, T::order).1)
}

/// The central value in order, the mean of the two central ones for an even number; `None` without values. The slice is
/// reordered.
pub fn median<T: Real>(values: &mut [T]) -> Option<T> {
    let upper = median_upper(values)?;
    if values.len() % 2 == 1 {
        return Some(upper);
    }
    let below = values[..values.len() / 2].iter().copied();
    below.max_by(T::order).map(|lower| T::mean_of_two(lower, upper))
}

/// The least value below which, itself included, lies half of the weight. Pairs are (value, weight), weights not negative;
/// `None` without pairs, or when the weights do not sum to a number.
pub fn weighted_median(mut values: Vec<(f64, f64)>) -> Option<f64> {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * values.iter().map(|v| v.1).sum::<f64>();
    let mut sum = 0.0;
    values
        .iter()
        .find(|v| {
            sum += v.1;
            sum >= half
        })
        .map(|v| v.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_and_even_numbers_of_values_have_their_medians() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), Some(2.5));
        assert_eq!(median_upper(&mut [4.0_f32, 1.0, 3.0, 2.0]), Some(3.0));
        assert_eq!(median::<f64>(&mut []), None);
        assert_eq!(median_upper::<f32>(&mut []), None);
    }

    #[test]
    fn nan_is_the_greatest_value() {
        assert_eq!(median(&mut [f64::NAN, 1.0, 2.0]), Some(2.0));
        assert!(median(&mut [f64::NAN, 1.0]).unwrap().is_nan());
    }

    #[test]
    fn the_weighted_median_follows_the_weight() {
        assert_eq!(weighted_median(vec![(1.0, 1.0), (3.0, 1.0), (2.0, 1.0)]), Some(2.0));
        assert_eq!(weighted_median(vec![(1.0, 1.0), (2.0, 1.0), (3.0, 5.0)]), Some(3.0));
        assert_eq!(weighted_median(vec![(1.0, 1.0), (2.0, f64::NAN)]), None);
        assert_eq!(weighted_median(Vec::new()), None);
    }
}
