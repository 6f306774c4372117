//! Place recognition: descriptors by SALAD, by the geometry network's own tokens, or by the images.

use super::source::Source;
use crate::chunks::StoredChunk;
use crate::config::{Config, PlaceRecognitionConfig};
use crate::engine::{GeometrySource, PlaceDescriber};
use crate::error::Error;
use crate::models::salad;
use rayon::prelude::*;
use std::path::Path;
use vidar_align::place_recognition::{describe_image, describe_tokens};
use vidar_core::Image;
use vidar_da3::salad::Salad;

/// Describes the places of a chunk.
pub enum PlaceRecognition {
    /// Brightness and gradients on a coarse grid. Costs nothing; recognises the same view, not a place from another side.
    Images,
    /// Averaged tokens of the geometry network, with this number of channels.
    Tokens(usize),
    /// SALAD's network.
    Salad(Box<Salad>),
}

impl PlaceRecognition {
    /// What the configuration asks for; `auto` takes SALAD where its checkpoint is given, the network's tokens where there is
    /// a network, and the images otherwise.
    pub fn open(config: &Config, source: &mut Source) -> Result<Self, Error> {
        let checkpoint = &config.coupling.salad_checkpoint;
        let asked = match config.coupling.place_recognition {
            PlaceRecognitionConfig::Auto if !checkpoint.is_empty() => PlaceRecognitionConfig::Salad,
            PlaceRecognitionConfig::Auto if source.token_channels().is_some() => {
                PlaceRecognitionConfig::Model
            }
            PlaceRecognitionConfig::Auto => PlaceRecognitionConfig::Image,
            asked => asked,
        };
        match (asked, source.token_channels()) {
            (PlaceRecognitionConfig::Salad, _) => {
                Ok(Self::Salad(Box::new(salad::open(Path::new(checkpoint))?)))
            }
            (PlaceRecognitionConfig::Model, Some(channels)) => {
                source.keep_place_tokens();
                Ok(Self::Tokens(channels))
            }
            (PlaceRecognitionConfig::Model, None) => Err(Error::Usage {
                what: format!(
                    "coupling.place_recognition = \"model\", but {} is no network",
                    source.info().name
                ),
                hint: "choose coupling.place_recognition = \"image\", or a network with --geometry".into(),
            }),
            _ => Ok(Self::Images),
        }
    }

    /// Its name in manifests.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Images => "image",
            Self::Tokens(_) => "model",
            Self::Salad(_) => "salad",
        }
    }
}

impl PlaceDescriber for PlaceRecognition {
    fn is_whitened(&self) -> bool {
        matches!(self, Self::Tokens(_))
    }

    fn describe(&self, chunk: &mut StoredChunk, tokens: &[Vec<f32>]) -> Result<(), Error> {
        let views = chunk.prediction.views.len();
        chunk.descriptors = match self {
            Self::Images => Vec::new(),
            Self::Tokens(channels) if tokens.len() == views => {
                tokens.par_iter().map(|t| describe_tokens(t, *channels)).collect()
            }
            Self::Tokens(_) => Vec::new(),
            // The network uses all cores for one image.
            Self::Salad(salad) => chunk.colors.iter().map(|c| salad.describe(c)).collect::<Result<_, _>>()?,
        };
        // A view without a descriptor is not recognised; the others are.
        let length = chunk.descriptors.iter().map(Vec::len).max().unwrap_or(0);
        chunk.descriptors.iter_mut().filter(|l| l.len() != length).for_each(|l| *l = vec![0.0; length]);
        Ok(())
    }

    fn descriptors(&self, chunk: &StoredChunk) -> Vec<Vec<f32>> {
        match self {
            Self::Images => chunk.colors.par_iter().map(|c| describe_image(&gray(c))).collect(),
            _ => chunk
                .descriptors
                .iter()
                .map(|l| if l.iter().all(|v| *v == 0.0) { Vec::new() } else { l.clone() })
                .collect(),
        }
    }
}

fn gray(color: &Image<[u8; 3]>) -> Image<f32> {
    color.map(|[r, g, b]| 0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b))
}
