//! The scale between two predictions of the same pixels from their depths alone, `d₁ ≈ s d₂`.

use super::overlap::median;
use super::{Compat, StreamingError};
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};

/// How the scale is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScaleMethod {
    /// Both; their mean when both are good, else the better one.
    #[default]
    Auto,
    /// A line through the origin that most pixels agree with.
    Ransac,
    /// The weighted median of the ratios.
    Weighted,
}

/// A scale and how far to trust it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthScale {
    /// Units of the first per unit of the second.
    pub scale: f64,
    /// 0 (nothing known) to 1.
    pub quality: f64,
}

const MIN_PIXELS: usize = 100;
const MAX_PIXELS: usize = 10_000;
const TRIALS: usize = 1000;
const RESIDUAL: f64 = 0.1;
const GOOD: f64 = 0.7;

/// Finds s with `first ≈ s · second` over pixels that are confident in both and between 1 mm and 100 units away.
///
/// Fewer than 100 such pixels give scale 1 of quality 0. Samples are drawn from a fixed seed: same input, same answer.
/// With [`Compat::Reference`] the weighted ratio is the 0.9 quantile that the reference returns, which is biased high.
///
/// # Errors
/// [`StreamingError::WrongLength`].
pub fn depth_scale(
    first: (&[f32], &[f32]),
    second: (&[f32], &[f32]),
    method: ScaleMethod,
    compat: Compat,
) -> Result<DepthScale, StreamingError> {
    let ((d1, c1), (d2, c2)) = (first, second);
    for (what, found) in [("confidences", c1.len()), ("depths", d2.len()), ("confidences", c2.len())] {
        if found != d1.len() {
            return Err(StreamingError::WrongLength { what, found, expected: d1.len() });
        }
    }
    let threshold = (0.1 * median(c1)).max(0.1 * median(c2)).max(1e-6);
    let usable = |d: f32| d > 1e-3 && d < 100.0;
    let pixels: Vec<Pixel> = (0..d1.len())
        .filter(|&i| c1[i] > threshold && c2[i] > threshold && usable(d1[i]) && usable(d2[i]))
        .map(|i| Pixel {
            first: f64::from(d1[i]),
            second: f64::from(d2[i]),
            weight: (f64::from(c1[i]) * f64::from(c2[i])).powi(2),
        })
        .collect();
    if pixels.len() < MIN_PIXELS {
        return Ok(DepthScale { scale: 1.0, quality: 0.0 });
    }
    Ok(match method {
        ScaleMethod::Ransac => by_consensus(&pixels),
        ScaleMethod::Weighted => by_quantile(&pixels, compat),
        ScaleMethod::Auto => {
            let (a, b) = (by_consensus(&pixels), by_quantile(&pixels, compat));
            if a.quality > GOOD && b.quality > GOOD {
                DepthScale { scale: 0.5 * (a.scale + b.scale), quality: 0.5 * (a.quality + b.quality) }
            } else if a.quality >= b.quality {
                a
            } else {
                b
            }
        }
    })
}

struct Pixel {
    first: f64,
    second: f64,
    weight: f64,
}

fn by_consensus(pixels: &[Pixel]) -> DepthScale {
    let mut rng = ChaCha8Rng::seed_from_u64(42);
    let chosen: Vec<&Pixel> = if pixels.len() > MAX_PIXELS {
        sample(&mut rng, pixels.len(), MAX_PIXELS).into_iter().map(|i| &pixels[i]).collect()
    } else {
        pixels.iter().collect()
    };
    let drawn = 10.max(chosen.len() / 100);
    let slope = |of: &mut dyn Iterator<Item = &Pixel>| {
        let (xy, xx) = of.fold((0.0, 0.0), |(xy, xx), p| (xy + p.first * p.second, xx + p.second * p.second));
        xy / xx
    };
    let agrees = |p: &Pixel, scale: f64| (p.first - scale * p.second).abs() <= RESIDUAL;
    let mut best = (0usize, 1.0);
    for _ in 0..TRIALS {
        let picked = sample(&mut rng, chosen.len(), drawn);
        let scale = slope(&mut picked.iter().map(|i| chosen[i]));
        let count = chosen.iter().filter(|p| agrees(p, scale)).count();
        if count > best.0 {
            best = (count, scale);
        }
    }
    let scale = slope(&mut chosen.iter().copied().filter(|p| agrees(p, best.1)));
    let quality = best.0 as f64 / chosen.len() as f64;
    if scale > 0.1 && scale < 10.0 {
        DepthScale { scale, quality }
    } else {
        DepthScale { scale: 1.0, quality }
    }
}

fn by_quantile(pixels: &[Pixel], compat: Compat) -> DepthScale {
    let total: f64 = pixels.iter().map(|p| p.weight).sum();
    let mut ratios: Vec<(f64, f64)> =
        pixels.iter().map(|p| (p.first / (p.second + 1e-8), p.weight / total)).collect();
    ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
    let quantile = if compat.is_reference() { 0.9 } else { 0.5 };
    let mut sum = 0.0;
    let at = ratios.iter().position(|(_, w)| {
        sum += w;
        sum >= quantile
    });
    let scale = ratios[at.unwrap_or(ratios.len() - 1)].0;
    let entropy: f64 = ratios.iter().filter(|(_, w)| *w > 0.0).map(|(_, w)| -w * w.ln()).sum();
    DepthScale { scale, quality: 1.0 - entropy / (ratios.len() as f64).ln() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tenth_of_gross_errors_does_not_move_the_scale() {
        let second: Vec<f32> = (0..4000).map(|i| 1.0 + (i % 97) as f32 * 0.03).collect();
        let first: Vec<f32> =
            second.iter().enumerate().map(|(i, d)| if i % 10 == 0 { 20.0 } else { 0.8 * d }).collect();
        let ones = vec![1.0; second.len()];
        for method in [ScaleMethod::Ransac, ScaleMethod::Weighted, ScaleMethod::Auto] {
            let found = depth_scale((&first, &ones), (&second, &ones), method, Compat::Off).unwrap();
            assert!((found.scale - 0.8).abs() < 1e-6, "{method:?} {found:?}");
        }
    }

    #[test]
    fn too_few_pixels_say_nothing() {
        let d = vec![1.0; 50];
        let found = depth_scale((&d, &d), (&d, &d), ScaleMethod::Auto, Compat::Off).unwrap();
        assert_eq!(found, DepthScale { scale: 1.0, quality: 0.0 });
    }
}
