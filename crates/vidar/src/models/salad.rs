//! SALAD: descriptors of places from its published checkpoint (Izquierdo and Civera 2024).
//!
//! A DINOv2 ViT-B/14 sees the picture at 336×336; its tokens are gathered by [`SaladHead`]. The checkpoint is published
//! as a Python pickle; `tools/salad_to_safetensors.py` writes the same tensors under the same keys as a file that can be
//! read without running anything.

use crate::error::Error;
use image::imageops::{FilterType, resize};
use image::{ImageBuffer, Rgb};
use std::path::Path;
use std::sync::Arc;
use vidar_align::streaming::{Perceptron, SaladHead};
use vidar_core::Image;
use vidar_da3::preprocess::normalise;
use vidar_da3::{Da3Error, ImageEncoder};
use vidar_nn::Checkpoint;

/// Side of the picture that the network sees, px (DA3-Streaming's `image_size`).
const SIDE: usize = 336;
const ENCODER: &str = "backbone.model";

/// SALAD, ready to describe pictures.
pub struct Salad {
    encoder: ImageEncoder,
    head: SaladHead,
}

impl Salad {
    /// Opens the converted checkpoint.
    ///
    /// # Errors
    /// A file that is not there, not safetensors, or lacks a tensor: named, with how to convert the published one.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let unusable = |reason: String| Error::Usage {
            what: format!("{} is no checkpoint of SALAD: {reason}", path.display()),
            hint: "convert the published one: python tools/salad_to_safetensors.py dino_salad.ckpt \
                   dino_salad.safetensors"
                .into(),
        };
        if !path.is_file() {
            return Err(Error::io("read", path, std::io::ErrorKind::NotFound.into()));
        }
        let checkpoint = Checkpoint::open(path).map_err(|e| unusable(e.to_string()))?;
        let head = head(&checkpoint).map_err(unusable)?;
        let shapes = checkpoint.clone();
        let shape_of = |key: &str| shapes.tensor(key).ok().map(|t| t.shape.to_vec());
        let encoder = ImageEncoder::load(Arc::new(checkpoint), ENCODER, &shape_of)
            .map_err(|e| unusable(e.to_string()))?;
        Ok(Self { encoder, head })
    }

    /// The unit-length descriptor of a picture.
    ///
    /// # Errors
    /// Weights whose sizes do not fit each other.
    pub fn describe(&self, picture: &Image<[u8; 3]>) -> Result<Vec<f32>, Error> {
        self.describe_pixels(&normalise(&resized(picture)), SIDE, SIDE)
    }

    fn describe_pixels(&self, pixels: &[f32], rows: usize, columns: usize) -> Result<Vec<f32>, Error> {
        let tokens = self.encoder.encode(pixels, rows, columns)?;
        let channels = self.encoder.channels();
        let count = tokens.patches.len() / channels;
        let mut by_channel = vec![0.0; tokens.patches.len()];
        for (t, token) in tokens.patches.chunks_exact(channels).enumerate() {
            token.iter().enumerate().for_each(|(c, v)| by_channel[c * count + t] = *v);
        }
        self.head.describe(&by_channel, count, &tokens.class).map_err(|e| {
            Error::Da3(Da3Error::UnknownNetwork { origin: "SALAD".into(), reason: e.to_string() })
        })
    }
}

/// At `SIDE` × `SIDE`, by a triangle filter as wide as the reduction, as Pillow's bilinear is.
fn resized(picture: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let (width, height) = (picture.width() as u32, picture.height() as u32);
    let bytes = picture.data().as_flattened().to_vec();
    let buffer: ImageBuffer<Rgb<u8>, Vec<u8>> =
        ImageBuffer::from_raw(width, height, bytes).unwrap_or_else(|| ImageBuffer::new(1, 1));
    let small = resize(&buffer, SIDE as u32, SIDE as u32, FilterType::Triangle);
    Image::from_fn(SIDE, SIDE, |x, y| small.get_pixel(x as u32, y as u32).0)
}

fn head(checkpoint: &Checkpoint) -> Result<SaladHead, String> {
    let values = |key: &str| -> Result<Vec<f32>, String> {
        checkpoint.tensor(key).and_then(|t| t.to_f32()).map_err(|e| e.to_string())
    };
    // Layers are numbered with activations and dropout between them: the two that have weights count.
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
    Ok(SaladHead {
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
    fn a_small_salad_says_what_pytorch_says() {
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
    fn pictures_of_any_size_become_unit_descriptors_and_other_pictures_others() {
        let salad = Salad::open(Path::new(GOLDEN)).unwrap();
        let picture =
            |shift: usize| Image::from_fn(90, 70, |x, y| [(x * 3 + shift) as u8, (y * 2) as u8, 90]);
        let (a, b) = (salad.describe(&picture(0)).unwrap(), salad.describe(&picture(60)).unwrap());
        assert!((a.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4);
        assert!(a.iter().zip(&b).any(|(x, y)| (x - y).abs() > 1e-4));
    }

    #[test]
    fn what_is_no_salad_is_named_with_how_to_convert_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("dino_salad.ckpt");
        std::fs::write(&path, b"PK\x03\x04 a pickle").unwrap();
        let Err(error) = Salad::open(&path) else { panic!("opened") };
        assert!(error.to_string().contains("is no checkpoint of SALAD"), "{error}");
        assert!(Salad::open(&folder.path().join("nothing")).is_err());
    }
}
