//! What a simulated network believes of each pixel: depth and confidence.

use super::PredictionErrors;
use super::field::{Field, blurred};
use crate::random::Gaussian;
use rand::Rng;
use vidar_core::{Confidence, Image, RelativeDepth};

/// Half waves across the image of what decides where confidence is wrong and where holes are.
const BLOTCH_ORDER: usize = 8;

/// Blur of the error before it is perceived, pixels: confidence is smoother than depth.
const PERCEPTION_PX: f64 = 1.5;

/// Errors of one view that are drawn before its pixels.
pub(super) struct ViewErrors {
    /// ln of chunk units per metre.
    pub log_scale: f64,
    /// Deformation of variance 1.
    pub deformation: Field,
    /// Whether depth has nothing to do with the truth.
    pub failed: bool,
}

/// Depth in chunk units and confidence from the true z-depth in metres.
pub(super) fn believed<R: Rng>(
    truth: &Image<f32>,
    view: &ViewErrors,
    errors: &PredictionErrors,
    random: &mut Gaussian<R>,
) -> (RelativeDepth, Confidence) {
    let (width, height) = (truth.width(), truth.height());
    let doubt = Field::random(BLOTCH_ORDER, random).image(width, height);
    let blotches = Field::random(BLOTCH_ORDER, random).image(width, height);
    let far = if errors.sky_beyond_m > 0.0 { errors.sky_beyond_m as f32 } else { f32::INFINITY };
    let seen: Vec<f32> = truth.data().iter().map(|&z| if z < far { z } else { f32::NAN }).collect();

    // Inverse depth of a plane is affine over the image: a symmetric blur leaves it alone and only edges bleed.
    let inverse: Vec<f32> = seen.iter().map(|z| 1.0 / z).collect();
    let bled = blurred(&inverse, width, errors.bleeding_px);
    let bends = errors.deformation_sigma > 0.0 || view.failed;
    let field = if bends { view.deformation.image(width, height) } else { vec![0.0; width * height] };
    let noise = errors.noise_sigma;
    // ln(believed/true), the chunk's and the view's scale aside.
    let log_errors: Vec<f32> = (0..width * height)
        .map(|i| {
            let bleeding = if errors.bleeding_px > 0.0 { (inverse[i] / bled[i]).ln() } else { 0.0 };
            let white = if noise > 0.0 { (noise * random.next()) as f32 } else { 0.0 };
            if view.failed {
                // A wavy wall two metres away.
                return (2.0 / seen[i]).ln() + 0.4 * field[i] + white;
            }
            bleeding + errors.deformation_sigma as f32 * field[i] + white
        })
        .collect();
    let size: Vec<f32> = log_errors.iter().map(|e| e.abs()).collect();
    let perceived = blurred(&size, width, if is_exact(&size) { 0.0 } else { PERCEPTION_PX });
    let hole = hole_level(&blotches, errors.hole_share);

    let scale = view.log_scale.exp() as f32;
    let mut depth = vec![f32::NAN; width * height];
    let mut confidence = vec![0.0; width * height];
    for i in 0..width * height {
        if seen[i].is_nan() || blotches[i] >= hole {
            continue;
        }
        depth[i] = seen[i] * log_errors[i].exp() * scale;
        // A network whose prediction failed does not know it.
        let error = if view.failed { errors.confidence_tolerance as f32 } else { perceived[i] };
        let error = error * (errors.confidence_noise as f32 * doubt[i]).exp();
        let relative = error / errors.confidence_tolerance as f32;
        confidence[i] = 1.0 / (1.0 + relative * relative);
    }
    let image = |values: Vec<f32>| {
        let values = values.into_iter();
        let mut values = values;
        Image::from_fn(width, height, |_, _| values.next().unwrap_or(f32::NAN))
    };
    (RelativeDepth::new(image(depth)), Confidence::new(image(confidence)))
}

fn is_exact(errors: &[f32]) -> bool {
    errors.iter().all(|e| *e == 0.0 || e.is_nan())
}

/// The value that `share` of the pixels reach.
fn hole_level(blotches: &[f32], share: f64) -> f32 {
    if share <= 0.0 || blotches.is_empty() {
        return f32::INFINITY;
    }
    let mut sorted = blotches.to_vec();
    sorted.sort_by(f32::total_cmp);
    let kept = ((1.0 - share) * sorted.len() as f64) as usize;
    sorted.get(kept).copied().unwrap_or(f32::INFINITY)
}
