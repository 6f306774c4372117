//! Sky: filled with the far end of the depth that is not sky (DA3, metric and monocular networks).

use vidar_solve::pcg64::Pcg64;

/// Below this the sky head says "not sky".
pub const SKY_THRESHOLD: f32 = 0.3;
/// Fewer pixels than this on either side leave the depth as it is.
const MIN_PIXELS: usize = 10;
/// The quantile of depth that the sky gets.
const FAR_QUANTILE: f64 = 0.99;
/// More pixels than this are sampled.
pub const MAX_SAMPLES: usize = 100_000;
const SEED: u32 = 42;

/// Sets the depth of sky pixels to the 0.99 quantile of the others, over all views together. At most 100,000 pixels
/// are used; the official code draws them anew each time, here the seed is fixed.
pub fn fill(depth: &mut [f32], sky: &[f32]) {
    let open: Vec<f32> = depth.iter().zip(sky).filter(|(_, s)| is_open(**s)).map(|(d, _)| *d).collect();
    if open.len() <= MIN_PIXELS || depth.len() - open.len() <= MIN_PIXELS {
        return;
    }
    let far = quantile(sampled(open), FAR_QUANTILE) as f32;
    for (d, s) in depth.iter_mut().zip(sky) {
        if !is_open(*s) {
            *d = far;
        }
    }
}

/// Whether a pixel is not sky.
pub fn is_open(sky: f32) -> bool {
    sky < SKY_THRESHOLD
}

/// At most [`MAX_SAMPLES`] of the values, drawn without repetition with a fixed seed.
pub(crate) fn sampled(values: Vec<f32>) -> Vec<f32> {
    if values.len() <= MAX_SAMPLES {
        return values;
    }
    Pcg64::seed(SEED).choose(values.len(), MAX_SAMPLES).into_iter().map(|i| values[i]).collect()
}

/// The quantile with linear interpolation between neighbours; NaN of nothing.
pub(crate) fn quantile(mut values: Vec<f32>, q: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let at = q * (values.len() - 1) as f64;
    let (low, share) = (at.floor() as usize, at.fract());
    let (_, lower, above) = values.select_nth_unstable_by(low, f32::total_cmp);
    let lower = f64::from(*lower);
    let upper = above.iter().copied().min_by(f32::total_cmp).map_or(lower, f64::from);
    lower + (upper - lower) * share
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_interpolate_like_numpy() {
        let values = vec![4.0, 1.0, 3.0, 2.0];
        assert_eq!(quantile(values.clone(), 0.5), 2.5);
        assert!((quantile(values.clone(), 0.99) - 3.97).abs() < 1e-12);
        assert_eq!(quantile(values, 1.0), 4.0);
        assert!(quantile(Vec::new(), 0.5).is_nan());
    }

    #[test]
    fn a_sampled_quantile_is_close_to_the_whole_and_the_same_every_time() {
        let values: Vec<f32> = (0..300_000u32).map(|i| ((i * 7919) % 300_000) as f32).collect();
        let first = quantile(sampled(values.clone()), 0.99);
        assert_eq!(first, quantile(sampled(values), 0.99));
        assert!((first - 297_000.0).abs() < 600.0, "{first}");
    }

    #[test]
    fn sky_gets_the_far_depth_and_little_sky_gets_nothing() {
        let mut depth: Vec<f32> = (0..100).map(|i| i as f32).collect();
        let sky: Vec<f32> = (0..100).map(|i| if i < 20 { 0.9 } else { 0.1 }).collect();
        fill(&mut depth, &sky);
        assert!((depth[0] - 98.21).abs() < 1e-4, "{}", depth[0]);
        assert_eq!(depth[50], 50.0);
        let untouched = depth.clone();
        fill(&mut depth, &[0.1; 100]);
        assert_eq!(depth, untouched);
    }
}
