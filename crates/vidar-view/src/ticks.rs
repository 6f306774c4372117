//! Tick marks at 1, 2 or 5 times a power of ten, and their labels.

/// Values beyond this are not drawn: no quantity of a map is that large, and differences would lose all digits.
pub(crate) const LARGEST: f64 = 1e15;

/// The smallest step of the form {1, 2, 5}·10ᵏ that divides `span` into at most `max_intervals` parts.
///
/// A span that is zero, negative or not finite gives 1.
pub fn nice_step(span: f64, max_intervals: usize) -> f64 {
    let raw = span / max_intervals.max(1) as f64;
    if !(raw.is_finite() && raw > 0.0) {
        return 1.0;
    }
    let exponent = raw.log10().floor();
    for k in [exponent, exponent + 1.0] {
        for mantissa in [1.0, 2.0, 5.0] {
            let step = scaled(mantissa, k as i32);
            // A small tolerance: 0.3 / 3 must not round up to 0.2.
            if step >= raw * (1.0 - 1e-9) && step > 0.0 {
                return step;
            }
        }
    }
    raw
}

/// `mantissa · 10^exponent`, exact for as long as possible: 5e-1 is 5/10, not 5·0.1.
fn scaled(mantissa: f64, exponent: i32) -> f64 {
    if exponent < 0 { mantissa / 10f64.powi(-exponent) } else { mantissa * 10f64.powi(exponent) }
}

/// Tick positions within a range.
#[derive(Clone, Debug, PartialEq)]
pub struct Ticks {
    /// Distance between neighbours.
    pub step: f64,
    /// Positions, ascending, all within the range.
    pub values: Vec<f64>,
}

impl Ticks {
    /// Ticks between `low` and `high`, at most `max_intervals` + 1 of them.
    pub fn between(low: f64, high: f64, max_intervals: usize) -> Self {
        Self::with_step(low, high, nice_step(high - low, max_intervals))
    }

    /// Ticks at the multiples of `step` between `low` and `high`.
    pub(crate) fn with_step(low: f64, high: f64, step: f64) -> Self {
        let slack = 1e-9 * step;
        let (first, last) = (((low - slack) / step).ceil(), ((high + slack) / step).floor());
        if !(first.is_finite() && last.is_finite() && last - first < 1000.0) {
            return Self { step, values: Vec::new() };
        }
        let values = (0..=(last - first).max(-1.0) as i64)
            .filter(|_| last >= first)
            .map(|i| (first + i as f64) * step)
            .map(|v| if v == 0.0 { 0.0 } else { v }) // no "-0"
            .collect();
        Self { step, values }
    }

    /// The label of a tick, with as many digits as the step needs.
    pub fn label(&self, value: f64) -> String {
        let largest = self.values.iter().fold(self.step, |m, v| m.max(v.abs()));
        let decimals = (-self.step.log10().floor()).max(0.0);
        if largest >= 1e6 || decimals > 4.0 {
            return exponent_form(value, self.step);
        }
        format!("{value:.*}", decimals as usize)
    }

    /// All labels.
    pub(crate) fn labels(&self) -> Vec<String> {
        self.values.iter().map(|&v| self.label(v)).collect()
    }
}

fn exponent_form(value: f64, step: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let digits = (value.abs().log10().floor() - step.log10().floor()).clamp(0.0, 15.0);
    format!("{value:.*e}", digits as usize)
}

/// The range of the finite values, or `None` without any.
pub(crate) fn range_of(values: impl IntoIterator<Item = f64>) -> Option<(f64, f64)> {
    values.into_iter().filter(|v| v.abs() <= LARGEST).fold(None, |range, v| match range {
        None => Some((v, v)),
        Some((low, high)) => Some((low.min(v), high.max(v))),
    })
}

/// `range` with `share` of its width added on both sides; a range without width is widened around its value.
pub(crate) fn padded((low, high): (f64, f64), share: f64) -> (f64, f64) {
    let span = high - low;
    let scale = low.abs().max(high.abs());
    if span <= scale * 1e-12 {
        let half = if scale > 0.0 { scale * 0.1 } else { 0.5 };
        return (low - half, high + half);
    }
    (low - share * span, high + share * span)
}

/// A short number for captions: at most three significant digits, without an exponent where that is readable.
pub(crate) fn short_number(value: f64) -> String {
    let size = value.abs();
    if !value.is_finite() {
        return "n/a".to_owned();
    }
    match size {
        0.0 => "0".to_owned(),
        s if !(1e-4..1e6).contains(&s) => format!("{value:.2e}"),
        s => {
            let decimals = (2.0 - s.log10().floor()).clamp(0.0, 6.0) as usize;
            let text = format!("{value:.decimals$}");
            if decimals == 0 { text } else { text.trim_end_matches('0').trim_end_matches('.').to_owned() }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_one_two_or_five_times_a_power_of_ten() {
        let mut span = 1.3e-9;
        while span < 1e12 {
            for max in 1..12 {
                let step = nice_step(span, max);
                let mantissa = step / 10f64.powf(step.log10().floor());
                let near = [1.0, 2.0, 5.0, 10.0].iter().any(|m| (mantissa - m).abs() < 1e-9);
                assert!(near, "step {step} of span {span}");
                assert!(span / step <= max as f64 + 1e-6, "span {span}, step {step}, at most {max}");
                // Not coarser than needed: the next finer step would be too fine.
                assert!(span / step > max as f64 / 2.6, "span {span}, step {step}, at most {max}");
            }
            span *= 1.37;
        }
    }

    #[test]
    fn ticks_lie_within_the_range_and_on_multiples() {
        let ticks = Ticks::between(-0.31, 0.74, 6);
        assert_eq!(ticks.step, 0.2);
        assert_eq!(ticks.labels(), ["-0.2", "0.0", "0.2", "0.4", "0.6"]);
        assert_eq!(Ticks::between(0.0, 1.0, 5).values.len(), 6);
    }

    #[test]
    fn labels_are_never_minus_zero_and_use_exponents_only_for_extreme_values() {
        assert_eq!(Ticks::between(-1.0, 1.0, 4).labels(), ["-1.0", "-0.5", "0.0", "0.5", "1.0"]);
        assert_eq!(Ticks::between(0.0, 2e7, 2).labels(), ["0", "1e7", "2e7"]);
        assert_eq!(Ticks::between(0.0, 3e-6, 3).labels(), ["0", "1e-6", "2e-6", "3e-6"]);
    }

    #[test]
    fn degenerate_ranges_give_few_ticks_and_no_panic() {
        for (low, high) in [(1.0, 1.0), (f64::NAN, 1.0), (0.0, f64::INFINITY), (5.0, -5.0), (-1e308, 1e308)] {
            assert!(Ticks::between(low, high, 6).values.len() <= 7);
        }
        assert_eq!(padded((3.0, 3.0), 0.05), (2.7, 3.3));
        assert_eq!(padded((0.0, 0.0), 0.05), (-0.5, 0.5));
    }

    #[test]
    fn short_numbers_have_three_digits_and_no_trailing_zeros() {
        let texts = [0.012_34, 0.4, 100.0, 98_765.0, 0.0, 1e-7, f64::NAN].map(short_number);
        assert_eq!(texts, ["0.0123", "0.4", "100", "98765", "0", "1.00e-7", "n/a"]);
    }
}
