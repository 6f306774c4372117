//! Bytes to the network's numbers: `(v/255 − mean)/std` per channel, rounded to `f32` at every step.

use vidar_core::Image;

/// Channel means of ImageNet, red first.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Channel deviations of ImageNet.
const STD: [f32; 3] = [0.229, 0.224, 0.225];

/// The same numbers as the official way back uses them, in double precision.
const MEAN_EXACT: [f64; 3] = [0.485, 0.456, 0.406];
/// As [`MEAN_EXACT`].
const STD_EXACT: [f64; 3] = [0.229, 0.224, 0.225];

/// The 256 values a byte can become, per channel.
fn table() -> [[f32; 256]; 3] {
    std::array::from_fn(|c| std::array::from_fn(|v| (v as f32 / 255.0 - MEAN[c]) / STD[c]))
}

/// An image as `[3, rows, columns]`.
pub fn normalise(image: &Image<[u8; 3]>) -> Vec<f32> {
    let mut planes = vec![0.0; 3 * image.width() * image.height()];
    normalise_into(image, &mut planes);
    planes
}

/// As [`normalise`], into a buffer of three times the pixels.
pub fn normalise_into(image: &Image<[u8; 3]>, planes: &mut [f32]) {
    let table = table();
    let area = image.width() * image.height();
    for (c, plane) in planes.chunks_exact_mut(area.max(1)).enumerate().take(3) {
        for (out, pixel) in plane.iter_mut().zip(image.data()) {
            *out = table[c][usize::from(pixel[c])];
        }
    }
}

/// The official way back to bytes: `trunc((x·std + mean)·255)`, which loses one level in about a quarter of the bytes.
///
/// `VIDAR`'s own prediction carries the processed image itself; this is for comparison with official outputs.
pub fn denormalise(planes: &[f32], width: usize, height: usize) -> Image<[u8; 3]> {
    let area = width * height;
    Image::from_fn(width, height, |x, y| {
        std::array::from_fn(|c| {
            let value = planes.get(c * area + y * width + x).copied().unwrap_or(0.0);
            ((f64::from(value) * STD_EXACT[c] + MEAN_EXACT[c]).clamp(0.0, 1.0) * 255.0) as u8
        })
    })
}
