//! SALAD: place recognition descriptors of images (Izquierdo and Civera, *Optimal Transport Aggregation for Visual Place
//! Recognition*, 2024).
//!
//! A DINOv2 ViT-B/14 encodes the image at 336 × 336 pixels ([`ImageEncoder`]); an aggregation head turns
//! its tokens into one unit-length descriptor. Backbone and head were trained together and lie in one checkpoint, so all of
//! SALAD is in this crate, beside the other networks on that backbone. `vidar-align` only searches among descriptors and
//! needs no network.
//!
//! The checkpoint is published as a Python pickle. `tools/salad_to_safetensors.py` writes the same tensors under the same
//! keys to a file that can be read without executing code.

mod aggregation;

use crate::error::Da3Error;
use crate::image_encoder::ImageEncoder;
use crate::preprocess::normalise;
use aggregation::{Aggregation, Perceptron};
use image::imageops::{FilterType, resize};
use image::{ImageBuffer, Rgb};
use std::path::Path;
use std::sync::Arc;
use vidar_core::Image;
use vidar_nn::Checkpoint;

/// Side of the network's input, px (DA3-Streaming's `image_size`).
const SIDE: usize = 336;
/// Prefix of the encoder's keys.
const ENCODER: &str = "backbone.model";

/// SALAD's networks, ready to compute descriptors.
pub struct Salad {
    encoder: ImageEncoder,
    head: Aggregation,
}

impl Salad {
    /// Opens the converted checkpoint.
    ///
    /// # Errors
    /// [`Da3Error::Io`] when there is no file; [`Da3Error::NotSalad`] when it is not safetensors or lacks a tensor.
    pub fn open(path: &Path) -> Result<Self, Da3Error> {
        if !path.is_file() {
            let source = std::io::ErrorKind::NotFound.into();
            return Err(Da3Error::Io { path: path.to_path_buf(), source });
        }
        let not_salad = |reason: String| Da3Error::NotSalad { path: path.to_path_buf(), reason };
        let checkpoint = Checkpoint::open(path).map_err(|e| not_salad(e.to_string()))?;
        let head = aggregation(&checkpoint).map_err(not_salad)?;
        let shapes = checkpoint.clone();
        let shape_of = |key: &str| shapes.tensor(key).ok().map(|t| t.shape.to_vec());
        let encoder = ImageEncoder::load(Arc::new(checkpoint), ENCODER, &shape_of)
            .map_err(|e| not_salad(e.to_string()))?;
        Ok(Self { encoder, head })
    }

    /// The unit-length descriptor of an image of any size.
    ///
    /// # Errors
    /// [`Da3Error::BadInput`] when the sizes of the weights do not fit each other.
    pub fn describe(&self, image: &Image<[u8; 3]>) -> Result<Vec<f32>, Da3Error> {
        self.describe_pixels(&normalise(&resized(image)), SIDE, SIDE)
    }

    /// As [`Salad::describe`], for normalised pixels `[3, rows, columns]`.
    fn describe_pixels(&self, pixels: &[f32], rows: usize, columns: usize) -> Result<Vec<f32>, Da3Error> {
        let tokens = self.encoder.encode(pixels, rows, columns)?;
        let channels = self.encoder.channels();
        let count = tokens.patches.len() / channels;
        let mut by_channel = vec![0.0; tokens.patches.len()];
        for (t, token) in tokens.patches.chunks_exact(channels).enumerate() {
            token.iter().enumerate().for_each(|(c, v)| by_channel[c * count + t] = *v);
        }
        self.head.describe(&by_channel, count, &tokens.class)
    }
}

/// Resizes to `SIDE` × `SIDE` with a triangle filter whose support grows with the reduction, as Pillow's bilinear filter does.
fn resized(image: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    let bytes = image.data().as_flattened().to_vec();
    let buffer: ImageBuffer<Rgb<u8>, Vec<u8>> =
        ImageBuffer::from_raw(width, height, bytes).unwrap_or_else(|| ImageBuffer::new(1, 1));
    let small = resize(&buffer, SIDE as u32, SIDE as u32, FilterType::Triangle);
    Image::from_fn(SIDE, SIDE, |x, y| small.get_pixel(x as u32, y as u32).0)
}

/// Reads the aggregation head's weights.
fn aggregation(checkpoint: &Checkpoint) -> Result<Aggregation, String> {
    let values = |key: &str| -> Result<Vec<f32>, String> {
        checkpoint.tensor(key).and_then(|t| t.to_f32()).map_err(|e| e.to_string())
    };
    // Layer numbers count activations and dropout too; exactly two layers have weights.
    let perceptron = |part: &str| -> Result<Perceptron, String> {
        let prefix = format!("aggregator.{part}.");
        let layer = |name: &str| name.strip_prefix(&prefix)?.strip_suffix(".weight")?.parse::<u32>().ok();
        let mut layers: Vec<u32> = checkpoint.names().filter_map(layer).collect();
        layers.sort_unstable();
        let [first, second] = layers[..] else {
            return Err(format!("{} layers under {prefix}*, expected two", layers.len()));
        };
        Ok(Perceptron {
            first: values(&format!("{prefix}{first}.weight"))?,
            first_bias: values(&format!("{prefix}{first}.bias"))?,
            second: values(&format!("{prefix}{second}.weight"))?,
            second_bias: values(&format!("{prefix}{second}.bias"))?,
        })
    };
    let dust_bin = values("aggregator.dust_bin")?;
    Ok(Aggregation {
        cluster_features: perceptron("cluster_features")?,
        score: perceptron("score")?,
        token_features: perceptron("token_features")?,
        dust_bin: dust_bin.first().copied().ok_or("aggregator.dust_bin is empty")?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Made by `tools/make_salad_golden.py`: a network of two blocks in PyTorch, its input and its descriptor.
    const GOLDEN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/salad_tiny.safetensors");

    #[test]
    fn a_small_salad_matches_pytorch() {
        let salad = Salad::open(Path::new(GOLDEN)).unwrap();
        let golden = Checkpoint::open(Path::new(GOLDEN)).unwrap();
        let tensor = |key: &str| golden.tensor(key).unwrap();
        let (pixels, expected) = (tensor("golden.pixels"), tensor("golden.descriptor"));
        let (rows, columns) = (pixels.shape[1], pixels.shape[2]);
        let found = salad.describe_pixels(&pixels.to_f32().unwrap(), rows, columns).unwrap();
        let expected = expected.to_f32().unwrap();
        assert_eq!(found.len(), expected.len());
        let worst = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 2e-5, "off by {worst}");
    }

    #[test]
    fn images_of_any_size_get_unit_descriptors_and_different_images_different_ones() {
        let salad = Salad::open(Path::new(GOLDEN)).unwrap();
        let image = |shift: usize| Image::from_fn(90, 70, |x, y| [(x * 3 + shift) as u8, (y * 2) as u8, 90]);
        let (a, b) = (salad.describe(&image(0)).unwrap(), salad.describe(&image(60)).unwrap());
        assert!((a.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4);
        assert!(a.iter().zip(&b).any(|(x, y)| (x - y).abs() > 1e-4));
    }

    #[test]
    fn files_that_are_not_salad_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("dino_salad.ckpt");
        std::fs::write(&path, b"PK\x03\x04 a pickle").unwrap();
        let Err(error) = Salad::open(&path) else { panic!("opened") };
        assert!(error.to_string().contains("is not a SALAD checkpoint"), "{error}");
        assert!(matches!(Salad::open(&folder.path().join("nothing")), Err(Da3Error::Io { .. })));
    }
}
