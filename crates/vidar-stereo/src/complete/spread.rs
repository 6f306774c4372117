//! How wrong each source of depth is: standard deviations from what was observed.
//!
//! Errors of ln(depth) have a sharp centre and long tails, so they are taken as Laplacian: P(|e| < t) = 1 − exp(−√2 t/σ). The σ is
//! read off where [`QUANTILE`] of the errors lie below, which neither the tails nor a few exact pixels decide.

use crate::confidence::TOLERANCE_RATIO;
use crate::elementary;
use std::f32::consts::SQRT_2;

/// The quantile of |error| at which σ is read off.
const QUANTILE: f64 = 0.7;
/// Number of classes of the distance to what is measured; class k ends at 2^(k+1) pixels of an image of [`REFERENCE_WIDTH_PX`].
const CLASSES: usize = 7;
/// Width to which distances refer: a hole of a given number of degrees has the same class at every size.
const REFERENCE_WIDTH_PX: f32 = 480.0;
/// What other views see of a hole is its easier part: a guess where nobody measured errs more by this factor (HoloLens; with
/// it the stated share of redkitchen's lies within σ, too).
const UNSEEN_FACTOR: f32 = 1.5;
/// Fewer observations than this say nothing: pixels of one hole err together.
const LEAST_OBSERVATIONS: u64 = 2000;
/// Errors are counted in steps of a logarithm from here on: a fifth of stereo's tolerance would not change a decision.
const LEAST_ERROR: f32 = 1e-3;
/// Steps per factor of e, and their number: up to an error of 10⁻³·e⁹·⁵ = 13.
const STEPS_PER_E: f32 = 8.0;
const STEPS: usize = 76;

/// Standard deviations of ln(depth) by source.
#[derive(Clone, Debug, PartialEq)]
pub struct Spread {
    map: f32,
    /// What the planes' own standard deviations are multiplied by.
    plane_factor: f32,
    guess: [f32; CLASSES],
}

impl Default for Spread {
    /// Where too little was observed: what [`ErrorStatistics`] found on the first half of a recording of a real room
    /// (HoloLens), continued to the distances that it has too few of.
    fn default() -> Self {
        Self { map: 0.01, plane_factor: 1.5, guess: [0.03, 0.05, 0.07, 0.13, 0.16, 0.25, 0.3] }
    }
}

impl Spread {
    /// Stereo states the probability of an error within the tolerance.
    pub(super) fn stereo(&self, confidence: f32) -> f32 {
        let missed = (1.0 - confidence).clamp(1e-3, 0.999);
        -SQRT_2 * TOLERANCE_RATIO / elementary::ln(missed)
    }

    /// Of a view's measured pixels on average: what the surface is made of, so what surface and planes may share with it.
    pub(super) fn typical_of_stereo(&self, confidence: &[f32]) -> f32 {
        let measured = || confidence.iter().filter(|c| **c > 0.0);
        self.stereo(measured().sum::<f32>() / measured().count().max(1) as f32)
    }

    pub(super) fn map(&self, shared: f32) -> f32 {
        (self.map * self.map + shared * shared).sqrt()
    }

    pub(super) fn plane(&self, stated: f32, shared: f32) -> f32 {
        let own = self.plane_factor * stated;
        (own * own + shared * shared).sqrt()
    }

    pub(super) fn guess(&self, distance_px: f32, width: usize) -> f32 {
        UNSEEN_FACTOR * self.guess[class(distance_px, width)]
    }
}

/// P(|error of ln(depth)| < `limit`).
pub(super) fn probability_within(limit: f32, log_std: f32) -> f32 {
    1.0 - elementary::exp(-SQRT_2 * limit / log_std)
}

fn class(distance_px: f32, width: usize) -> usize {
    let distance = distance_px * REFERENCE_WIDTH_PX / width as f32;
    (0..CLASSES - 1).find(|k| distance <= (2 << k) as f32).unwrap_or(CLASSES - 1)
}

/// Observed errors, counted; adding them up in any order gives the same.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ErrorStatistics {
    map: Histogram,
    /// Of errors over the planes' own standard deviations.
    plane: Histogram,
    guess: [Histogram; CLASSES],
}

impl Default for ErrorStatistics {
    fn default() -> Self {
        Self { map: Histogram::NONE, plane: Histogram::NONE, guess: [Histogram::NONE; CLASSES] }
    }
}

impl ErrorStatistics {
    pub(super) fn push_map(&mut self, error: f32) {
        self.map.push(error);
    }

    pub(super) fn push_plane(&mut self, error: f32, stated: f32) {
        self.plane.push(error / stated);
    }

    pub(super) fn push_guess(&mut self, error: f32, distance_px: f32, width: usize) {
        self.guess[class(distance_px, width)].push(error);
    }

    /// Adds the observations of another view.
    pub fn add(&mut self, other: &Self) {
        self.map.add(&other.map);
        self.plane.add(&other.plane);
        self.guess.iter_mut().zip(&other.guess).for_each(|(to, from)| to.add(from));
    }

    /// The standard deviations that these observations support; `prior` where there are too few.
    pub fn spread(&self, prior: &Spread) -> Spread {
        let ratio = |k: usize| self.guess[k].std().map(|std| std / prior.guess[k]);
        let nearest = |k: usize| (0..CLASSES).filter(|j| ratio(*j).is_some()).min_by_key(|j| j.abs_diff(k));
        let mut guess = prior.guess;
        let mut least = 0.0_f32;
        for (k, std) in guess.iter_mut().enumerate() {
            // A guess does not get better away from what is measured; where it seems so, the classes differ in content.
            *std = (*std * nearest(k).and_then(ratio).unwrap_or(1.0)).max(least);
            least = *std;
        }
        Spread {
            map: self.map.std().unwrap_or(prior.map),
            plane_factor: self.plane.std().unwrap_or(prior.plane_factor),
            guess,
        }
    }
}

/// Counts of |error| in logarithmic steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Histogram([u64; STEPS]);

impl Histogram {
    const NONE: Self = Self([0; STEPS]);

    fn push(&mut self, error: f32) {
        let ratio = error.abs() / LEAST_ERROR;
        if ratio.is_finite() {
            let step = if ratio > 1.0 { elementary::ln(ratio) * STEPS_PER_E } else { 0.0 };
            self.0[(step as usize).min(STEPS - 1)] += 1;
        }
    }

    fn add(&mut self, other: &Self) {
        self.0.iter_mut().zip(other.0).for_each(|(to, from)| *to += from);
    }

    /// σ of the Laplacian whose [`QUANTILE`] is that of the errors; `None` where there are too few.
    fn std(&self) -> Option<f32> {
        let total: u64 = self.0.iter().sum();
        if total < LEAST_OBSERVATIONS {
            return None;
        }
        let mut below = 0;
        let step = self.0.iter().position(|count| {
            below += count;
            below as f64 >= QUANTILE * total as f64
        })?;
        let error = LEAST_ERROR * elementary::exp((step as f32 + 0.5) / STEPS_PER_E);
        Some(SQRT_2 * error / -elementary::ln(1.0 - QUANTILE as f32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_and_standard_deviation_say_the_same() {
        for confidence in [0.05, 0.3, 0.7, 0.95] {
            let stated = probability_within(TOLERANCE_RATIO, Spread::default().stereo(confidence));
            assert!((stated - confidence).abs() < 1e-4, "{confidence}: {stated}");
        }
    }

    #[test]
    fn the_spread_of_laplacian_errors_is_found_again_and_too_few_are_ignored() {
        let mut statistics = ErrorStatistics::default();
        let n = 20_000;
        for i in 0..n {
            // Quantiles of a Laplacian of σ = 0.08.
            let share = (i as f32 + 0.5) / n as f32;
            let error = -0.08 / SQRT_2 * (1.0 - share).ln();
            statistics.push_guess(error, 10.0, 480);
            statistics.push_plane(3.0 * error, 0.08);
            if i < 900 {
                statistics.push_map(1.0);
            }
        }
        let prior = Spread::default();
        let mut twice = statistics.clone();
        twice.add(&statistics);
        for found in [statistics.spread(&prior), twice.spread(&prior)] {
            assert!((found.guess(10.0, 480) / 0.08 / UNSEEN_FACTOR - 1.0).abs() < 0.07, "{found:?}");
            assert!((found.guess(20.0, 960) - found.guess(10.0, 480)).abs() < 1e-9);
            assert!((found.plane(0.01, 0.0) / 0.03 - 1.0).abs() < 0.07, "{found:?}");
            assert!((found.map(0.0) / prior.map(0.0) - 1.0).abs() < 1e-6);
            assert!(found.guess.windows(2).all(|w| w[0] <= w[1]), "{found:?}");
        }
    }
}
