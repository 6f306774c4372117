//! `depth_vis`: image and depth side by side, as JPEG.
//!
//! Depth is shown as its inverse between the view's 2nd and 98th percentile, near is red: x = 1 − clip((1/d − lo)/(hi −
//! lo)). The colours are ColorBrewer's Spectral (eleven classes), interpolated to 256 steps as matplotlib does.

use super::numbers::percentile;
use super::{PredictedView, Prediction};
use crate::error::ExportError;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};
use std::io::Write;
use vidar_core::Image;

const FORMAT: &str = "depth picture";
const QUALITY: u8 = 95;
/// Percentiles of inverse depth that get the ends of the colours.
const LOW: f64 = 2.0;
const HIGH: f64 = 98.0;
/// With fewer depths percentiles are not used.
const LEAST_DEPTHS: usize = 11;

/// ColorBrewer's Spectral in eleven classes (Cynthia Brewer, Apache-2.0).
const SPECTRAL_11: [[u8; 3]; 11] = [
    [158, 1, 66],
    [213, 62, 79],
    [244, 109, 67],
    [253, 174, 97],
    [254, 224, 139],
    [255, 255, 191],
    [230, 245, 152],
    [171, 221, 164],
    [102, 194, 165],
    [50, 136, 189],
    [94, 79, 162],
];

/// The colour at x in 0…1, in 256 steps; red is 0.
///
/// Step by step as matplotlib makes its table, in the same order of operations: truncation to bytes depends on the last bit.
pub fn spectral(x: f64) -> [u8; 3] {
    let step = if x >= 1.0 { 255.0 } else { (x.max(0.0) * 256.0).floor() };
    let class_at = |class: usize| class as f64 * 0.1 * 255.0;
    let at = 255.0 * (step * (1.0 / 255.0));
    let above = (1..10).find(|class| class_at(*class) >= at).unwrap_or(10);
    let t = (at - class_at(above - 1)) / (class_at(above) - class_at(above - 1));
    let mixed = |c: usize| {
        let shade = |class: usize| f64::from(SPECTRAL_11[class][c]) / 255.0;
        let value = match step as usize {
            0 => shade(0),
            255 => shade(10),
            _ => t * (shade(above) - shade(above - 1)) + shade(above - 1),
        };
        (value * 255.0) as u8
    };
    std::array::from_fn(mixed)
}

/// The colours of a depth image; pixels without depth get the colour of the far end.
pub fn depth_colors(depth: &Image<f32>) -> Image<[u8; 3]> {
    let inverse = depth.map(|&d| if d.is_finite() && d > 0.0 { 1.0 / d } else { 0.0 });
    let mut sorted: Vec<f64> = inverse.data().iter().filter(|v| **v > 0.0).map(|v| f64::from(*v)).collect();
    sorted.sort_by(f64::total_cmp);
    let range =
        |percent| percentile(&sorted, percent).filter(|_| sorted.len() >= LEAST_DEPTHS).unwrap_or(0.0);
    let (mut low, mut high) = (range(LOW), range(HIGH));
    if low == high {
        // A constant depth is drawn in the central colour.
        (low, high) = (low - 1e-6, high + 1e-6);
    }
    inverse.map(|&v| spectral(1.0 - ((f64::from(v) - low) / (high - low)).clamp(0.0, 1.0)))
}

/// Writes view `index` as the official format `depth_vis` does: the image, and its depth in colours to the right.
pub fn write_depth_vis(w: &mut dyn Write, prediction: &Prediction, index: usize) -> Result<(), ExportError> {
    prediction.check(FORMAT)?;
    let Some(view) = prediction.views.get(index) else {
        let reason = format!("there are only {} views", prediction.views.len());
        return Err(ExportError::unwritable(FORMAT, format!("view {index}"), reason));
    };
    let pixels = side_by_side(view);
    let (width, height) =
        (view.depth.width() * if view.image.is_some() { 2 } else { 1 }, view.depth.height());
    // JPEG sizes have 16 bits; the encoder reports longer sides.
    let (Ok(columns), Ok(rows)) = (u32::try_from(width), u32::try_from(height)) else {
        return Err(ExportError::unwritable(
            FORMAT,
            format!("{width}x{height} pixels"),
            "JPEG ends at 65535",
        ));
    };
    let encoder = JpegEncoder::new_with_quality(w, QUALITY);
    encoder.write_image(&pixels, columns, rows, ExtendedColorType::Rgb8).map_err(|e| match e {
        image::ImageError::IoError(source) => ExportError::Write { format: FORMAT, source },
        other => ExportError::unwritable(FORMAT, format!("{width}x{height} pixels"), other.to_string()),
    })
}

fn side_by_side(view: &PredictedView) -> Vec<u8> {
    let colors = depth_colors(&view.depth);
    let mut pixels = Vec::with_capacity(colors.data().len() * 6);
    for y in 0..colors.height() {
        if let Some(image) = &view.image {
            pixels.extend_from_slice(image.row(y).as_flattened());
        }
        pixels.extend_from_slice(colors.row(y).as_flattened());
    }
    pixels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_and_the_eleven_classes_are_brewers() {
        assert_eq!(spectral(0.0), SPECTRAL_11[0]);
        assert_eq!(spectral(1.0), SPECTRAL_11[10]);
        assert_eq!(spectral(7.0), SPECTRAL_11[10]);
        assert_eq!(spectral(f64::NAN), SPECTRAL_11[0]);
        // Step 51 of 255 is class 2 exactly.
        assert_eq!(spectral(51.5 / 256.0), SPECTRAL_11[2]);
    }

    #[test]
    fn near_is_red_far_is_blue_and_no_depth_is_far() {
        let depth = Image::from_fn(20, 10, |x, y| if (x, y) == (3, 3) { f32::NAN } else { 1.0 + x as f32 });
        let colors = depth_colors(&depth);
        assert_eq!(colors[(0, 0)], SPECTRAL_11[0]);
        assert_eq!(colors[(19, 9)], SPECTRAL_11[10]);
        assert_eq!(colors[(3, 3)], SPECTRAL_11[10]);
        let wall = depth_colors(&Image::filled(20, 10, 2.0));
        assert_eq!(wall[(5, 5)], spectral(0.5));
        assert_eq!(depth_colors(&Image::filled(2, 2, f32::NAN)).data().len(), 4);
    }
}
