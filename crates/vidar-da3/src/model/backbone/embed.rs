//! From pixels to tokens: `patch_embed.proj`, `cls_token`, `pos_embed`.
//!
//! Patches of 14 × 14 pixels are projected to D channels; the class token comes first; the position embedding, trained
//! on a grid of 37 × 37, is resampled to the image's patches by a bicubic (a = −0.75) whose scale factors are
//! `(patches + 0.1)/37`: the tenth enters the mapping of coordinates, not only the size. Shapes: pixels `[3, H, W]`,
//! tokens `[1 + H/14·W/14, D]`.

use crate::config::{BackboneConfig, PATCH};
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use std::sync::{Arc, Mutex, PoisonError};
use vidar_nn::{Conv2d, ConvInput, Epilogue, MapRef, Weight, resize_bicubic_scaled};

/// What is added to the number of patches before the scale of the position grid is taken.
const OFFSET: f64 = 0.1;

/// Embeds images as tokens.
pub(crate) struct Embed {
    proj: Conv2d,
    cls_token: Vec<f32>,
    pos_embed: Weight,
    grid: usize,
    dim: usize,
    /// The position embedding of the size seen last.
    resampled: Mutex<Option<Resampled>>,
}

/// Rows and columns of patches, and the embedding at that size.
type Resampled = ((usize, usize), Arc<Vec<f32>>);

impl Embed {
    pub fn load(scope: &Scope, config: &BackboneConfig) -> Result<Self, Da3Error> {
        let (dim, grid) = (config.dim, config.position_grid);
        let shape = ConvShape { inputs: 3, outputs: dim, side: PATCH, stride: PATCH, padding: 0 };
        Ok(Self {
            proj: scope.at("patch_embed").conv("proj", shape)?,
            cls_token: scope.weight("cls_token", &[1, 1, dim])?.to_f32(),
            pos_embed: scope.weight("pos_embed", &[1, 1 + grid * grid, dim])?,
            grid,
            dim,
            resampled: Mutex::new(None),
        })
    }

    /// Writes a view's tokens; `pixels` are `[3, rows, columns]`.
    pub fn apply(
        &self,
        run: &Run<'_>,
        view: usize,
        pixels: &[f32],
        (rows, columns): (usize, usize),
        tokens: &mut [f32],
    ) {
        let area = rows * columns;
        let mut interleaved = vec![0.0; 3 * area];
        for (c, plane) in pixels.chunks_exact(area).enumerate() {
            for (pixel, value) in interleaved.chunks_exact_mut(3).zip(plane) {
                pixel[c] = *value;
            }
        }
        let (first, patches) = tokens.split_at_mut(self.dim);
        first.copy_from_slice(&self.cls_token);
        let map = MapRef::new(&interleaved, rows, columns);
        self.proj.apply(&run.embedding(), map, patches, ConvInput::None, Epilogue::None);
        run.show("patch_embed", view, &[patches.len() / self.dim, self.dim], patches);
        let positions = self.positions(rows / PATCH, columns / PATCH);
        for (token, position) in tokens.iter_mut().zip(positions.iter()) {
            *token += position;
        }
        run.show("tokens_in", view, &[tokens.len() / self.dim, self.dim], tokens);
    }

    /// The position embedding of the class token and `rows` × `columns` patches.
    pub fn positions(&self, rows: usize, columns: usize) -> Arc<Vec<f32>> {
        let mut kept = self.resampled.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((size, positions)) = kept.as_ref()
            && *size == (rows, columns)
        {
            return Arc::clone(positions);
        }
        let trained = self.pos_embed.to_f32();
        let positions = if (rows, columns) == (self.grid, self.grid) {
            trained
        } else {
            let mut positions = vec![0.0; (1 + rows * columns) * self.dim];
            positions[..self.dim].copy_from_slice(&trained[..self.dim]);
            let scale = |patches: usize| (patches as f64 + OFFSET) / self.grid as f64;
            resize_bicubic_scaled(
                MapRef::new(&trained[self.dim..], self.grid, self.grid),
                self.dim,
                rows,
                columns,
                [scale(rows), scale(columns)],
                &mut positions[self.dim..],
            );
            positions
        };
        let positions = Arc::new(positions);
        *kept = Some(((rows, columns), Arc::clone(&positions)));
        positions
    }
}
