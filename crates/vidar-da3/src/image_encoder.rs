//! The vision transformer alone, as DINOv2 publishes it (Oquab et al. 2023): an image in, a class token and patch tokens out.
//!
//! Depth Anything's backbone is DINOv2's with views that look at each other; without that it is DINOv2's own, key for
//! key. Place recognition by SALAD stands on a DINOv2 ViT-B/14.

use crate::config::{BackboneConfig, Ffn, PATCH};
use crate::error::Da3Error;
use crate::model::backbone::{Backbone, CameraTokens, Feature, FeatureSink, Pixels, ReferenceStrategy};
use crate::run::Run;
use crate::weights::{Residency, Scope};
use std::sync::Arc;
use vidar_nn::{Compute, Isa, LayerNorm, Precision, WeightSource};

/// Epsilon of DINOv2's final norm.
const NORM_EPS: f32 = 1e-6;
/// Channels per attention head in every published DINOv2.
const HEAD: usize = 64;

/// Tokens of an image after the final norm.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageTokens {
    /// The class token, `[channels]`.
    pub class: Vec<f32>,
    /// Patch tokens, `[patches, channels]`, row by row.
    pub patches: Vec<f32>,
}

/// A DINOv2 network of any size.
pub struct ImageEncoder {
    backbone: Backbone,
    norm: LayerNorm,
    dim: usize,
    compute: Compute,
}

impl ImageEncoder {
    /// The network whose keys begin with `root` (`backbone.model`). Its sizes are read from its tensors' shapes, which
    /// `shape_of` tells: width and position grid from `pos_embed`, depth by counting `blocks`, heads of 64 channels.
    ///
    /// # Errors
    /// A key that is missing or of another shape is named.
    pub fn load(
        source: Arc<dyn WeightSource>,
        root: &str,
        shape_of: &dyn Fn(&str) -> Option<Vec<usize>>,
    ) -> Result<Self, Da3Error> {
        let shape = |leaf: &str| {
            let key = format!("{root}.{leaf}");
            shape_of(&key).ok_or_else(|| Da3Error::UnknownNetwork {
                origin: root.to_owned(),
                reason: format!("it has no {key}"),
            })
        };
        let positions = shape("pos_embed")?;
        let (&[1, places, dim], &[hidden, _]) = (&positions[..], &shape("blocks.0.mlp.fc1.weight")?[..])
        else {
            let reason = format!("pos_embed has the shape {positions:?}, expected [1, 1 + places, channels]");
            return Err(Da3Error::UnknownNetwork { origin: root.to_owned(), reason });
        };
        let position_grid = places.saturating_sub(1).isqrt();
        let depth = (0..MAX_DEPTH).take_while(|i| shape(&format!("blocks.{i}.norm1.weight")).is_ok()).count();
        if depth == 0 || !dim.is_multiple_of(HEAD) || position_grid.pow(2) + 1 != places {
            let reason = format!("width {dim}, {depth} blocks and {places} positions are no DINOv2");
            return Err(Da3Error::UnknownNetwork { origin: root.to_owned(), reason });
        }
        let config = BackboneConfig {
            dim,
            depth,
            heads: dim / HEAD,
            ffn: Ffn::Mlp { hidden },
            out_layers: [depth - 1; 4],
            alternate_from: None,
            qk_norm_from: None,
            rope_from: None,
            position_grid,
        };
        let scope = Scope::new(source, root);
        Ok(Self {
            norm: scope.norm("norm", dim, NORM_EPS)?,
            backbone: Backbone::load(&scope, &config, Residency::default())?,
            dim,
            compute: Compute::with_isa(Isa::detect(), Precision::F32)?,
        })
    }

    /// Channels of a token.
    pub fn channels(&self) -> usize {
        self.dim
    }

    /// Encodes normalised pixels `[3, rows, columns]` of one image; both sides are multiples of 14.
    ///
    /// # Errors
    /// [`Da3Error::BadInput`] for other sizes.
    pub fn encode(&self, pixels: &[f32], rows: usize, columns: usize) -> Result<ImageTokens, Da3Error> {
        let pixels = Pixels::new(pixels, 1, rows, columns)?;
        let run = Run {
            backbone: self.compute,
            exact_blocks: None,
            head: self.compute,
            watch: &|_| false,
            share: (0.0, 1.0),
            trace: None,
        };
        let patches = (rows / PATCH) * (columns / PATCH);
        let mut last = Last { dim: self.dim, tokens: Vec::with_capacity((1 + patches) * self.dim) };
        let first = CameraTokens::Trained(ReferenceStrategy::First);
        self.backbone.run(&run, &pixels, first, &[], &mut last)?;
        let mut class = last.tokens;
        self.norm.apply_in_place(&self.compute, &mut class);
        let patches = class.split_off(self.dim);
        Ok(ImageTokens { class, patches })
    }
}

/// More blocks than any network of the family has.
const MAX_DEPTH: usize = 128;

/// Keeps what the last block yields.
struct Last {
    dim: usize,
    tokens: Vec<f32>,
}

impl FeatureSink for Last {
    fn take(&mut self, _: &Run<'_>, feature: Feature<'_>) -> Result<(), Da3Error> {
        debug_assert!(feature.global.len().is_multiple_of(self.dim));
        self.tokens.clear();
        self.tokens.extend_from_slice(feature.global);
        Ok(())
    }

    fn take_extra(&mut self, _: usize, _: usize, _: Vec<f32>) {}
}
