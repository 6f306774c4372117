//! How places are told again: by SALAD, by the geometry network's own tokens, or by the pictures.

use super::source::Source;
use crate::chunks::StoredChunk;
use crate::config::{Config, PlacesConfig};
use crate::error::Error;
use crate::models::salad::Salad;
use rayon::prelude::*;
use std::path::Path;
use vidar_align::place_recognition::{describe_image, describe_tokens};
use vidar_core::Image;

/// Describes the places of a chunk.
pub enum Looks {
    /// Brightness and gradients on a coarse grid. Costs nothing; knows a view again, not a place from another side.
    Pictures,
    /// Averaged tokens of the geometry network, so many channels each.
    Tokens(usize),
    /// SALAD's network.
    Salad(Box<Salad>),
}

impl Looks {
    /// What the configuration asks for, or the best there is: SALAD where its checkpoint is named, the network's tokens
    /// where there is a network, pictures otherwise.
    pub fn open(config: &Config, source: &mut Source) -> Result<Self, Error> {
        let checkpoint = &config.coupling.salad_checkpoint;
        let asked = match config.coupling.places {
            PlacesConfig::Auto if !checkpoint.is_empty() => PlacesConfig::Salad,
            PlacesConfig::Auto if source.token_channels().is_some() => PlacesConfig::Model,
            PlacesConfig::Auto => PlacesConfig::Pictures,
            asked => asked,
        };
        match (asked, source.token_channels()) {
            (PlacesConfig::Salad, _) => Ok(Self::Salad(Box::new(Salad::open(Path::new(checkpoint))?))),
            (PlacesConfig::Model, Some(channels)) => {
                source.keep_place_tokens();
                Ok(Self::Tokens(channels))
            }
            (PlacesConfig::Model, None) => Err(Error::Usage {
                what: format!("coupling.places = \"model\", but {} is no network", source.info().name),
                hint: "choose coupling.places = \"pictures\", or a network with --geometry".into(),
            }),
            _ => Ok(Self::Pictures),
        }
    }

    /// The word as it stands in manifests.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Pictures => "pictures",
            Self::Tokens(_) => "model",
            Self::Salad(_) => "salad",
        }
    }

    /// Whether similarity is that of what sets places apart from their average.
    pub fn are_whitened(&self) -> bool {
        matches!(self, Self::Tokens(_))
    }

    /// Fills in a fresh prediction's descriptors, where they cannot be made from what is stored.
    pub fn describe(&self, chunk: &mut StoredChunk, tokens: &[Vec<f32>]) -> Result<(), Error> {
        let views = chunk.prediction.views.len();
        chunk.looks = match self {
            Self::Pictures => Vec::new(),
            Self::Tokens(channels) if tokens.len() == views => {
                tokens.par_iter().map(|t| describe_tokens(t, *channels, None)).collect()
            }
            Self::Tokens(_) => Vec::new(),
            // The network uses all cores for one picture.
            Self::Salad(salad) => chunk.colors.iter().map(|c| salad.describe(c)).collect::<Result<_, _>>()?,
        };
        // A picture without a descriptor is a place that is not told again; the others are.
        let length = chunk.looks.iter().map(Vec::len).max().unwrap_or(0);
        chunk.looks.iter_mut().filter(|l| l.len() != length).for_each(|l| *l = vec![0.0; length]);
        Ok(())
    }

    /// Descriptors of a chunk's views, in their order; empty ones where there is none.
    pub fn of(&self, chunk: &StoredChunk) -> Vec<Vec<f32>> {
        match self {
            Self::Pictures => chunk.colors.par_iter().map(|c| describe_image(&gray(c))).collect(),
            _ => chunk
                .looks
                .iter()
                .map(|l| if l.iter().all(|v| *v == 0.0) { Vec::new() } else { l.clone() })
                .collect(),
        }
    }
}

fn gray(color: &Image<[u8; 3]>) -> Image<f32> {
    color.map(|[r, g, b]| 0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b))
}
