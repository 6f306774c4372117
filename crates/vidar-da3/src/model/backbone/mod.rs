//! The vision transformer, `backbone.pretrained` (DA3, section on the backbone; DINOv2's blocks).
//!
//! Blocks are local (each view attends to itself) or global (all views in one sequence); from `alternate_from` on the
//! odd ones are global. Before that the reference view is chosen and put first, and at that block the first token of
//! every view becomes a camera token: the reference's, the others', or an encoded camera that was given.
//! After four blocks features are taken: the tokens after the last local block beside those after this one.
//!
//! Views stream: local blocks run on a few views at a time; a global block first packs keys and values of all views and
//! writes their queries, then runs view by view. Memory is that of the tokens (1), queries (1), packed keys and values
//! (2, half of it in bf16), and of a few views' intermediate results.
//!
//! Rotary positions: in local blocks the class token is at (0, 0) and patch (r, c) at (r+1, c+1). In global blocks
//! every patch of every view is at (1, 1), so that patches do not turn against each other: the same is computed here
//! with patches at (0, 0) and the special token at (−1, −1).

mod block;
mod embed;
mod reference;

#[cfg(feature = "gpu")]
pub(crate) use block::QK_EPS;
use block::resize;
pub(crate) use block::{Block, BlockCompute, BlockScratch, BlockShape, FFN_ROWS};
pub(crate) use embed::Embed;
pub use reference::{ReferenceStrategy, choose as choose_reference};

use crate::arithmetic::is_deep;
use crate::config::{BackboneConfig, PATCH};
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{Residency, Scope, Slot};
use vidar_nn::{LayerNorm, RopeTable};

/// Epsilon of the blocks' norms.
const BLOCK_EPS: f32 = 1e-6;
/// Epsilon of the final norm.
pub(crate) const NORM_EPS: f32 = 1e-5;
const ROPE_BASE: f32 = 100.0;
/// Tokens that go through a local block at once.
pub(crate) const GROUP_TOKENS: usize = 4096;

/// Normalised images: `[views, 3, rows, columns]`, sides multiples of the patch.
#[derive(Clone, Copy, Debug)]
pub struct Pixels<'a> {
    /// The numbers.
    pub data: &'a [f32],
    /// Images.
    pub views: usize,
    /// Rows of each.
    pub rows: usize,
    /// Columns of each.
    pub columns: usize,
}

impl<'a> Pixels<'a> {
    /// Checks sizes.
    pub fn new(data: &'a [f32], views: usize, rows: usize, columns: usize) -> Result<Self, Da3Error> {
        let is_side = |n: usize| n >= PATCH && n.is_multiple_of(PATCH);
        if views == 0 || !is_side(rows) || !is_side(columns) || data.len() != 3 * views * rows * columns {
            let reason = format!(
                "{} numbers for {views} views of {columns}x{rows}; sides must be multiples of {PATCH}",
                data.len()
            );
            return Err(Da3Error::BadInput { what: "pixels", reason });
        }
        Ok(Self { data, views, rows, columns })
    }

    /// Rows and columns of patches.
    pub fn patches(&self) -> (usize, usize) {
        (self.rows / PATCH, self.columns / PATCH)
    }

    fn view(&self, view: usize) -> &'a [f32] {
        let length = 3 * self.rows * self.columns;
        &self.data[view * length..(view + 1) * length]
    }
}

/// What the views' first tokens become where the alternation begins.
#[derive(Clone, Copy)]
pub(crate) enum CameraTokens<'a> {
    /// The trained tokens; the reference view is chosen.
    Trained(ReferenceStrategy),
    /// Encoded cameras, `[views, D]`; the first view is the reference.
    Given(&'a [f32]),
}

/// One view's feature after one of the four layers.
pub(crate) struct Feature<'a> {
    /// Which of the four.
    pub stage: usize,
    /// Which view, in the order given.
    pub view: usize,
    /// Tokens after the last local block, `[tokens, D]`; for networks of one view the same as `global`.
    pub local: &'a [f32],
    /// Tokens after this block.
    pub global: &'a [f32],
}

/// Who takes the features.
pub(crate) trait FeatureSink {
    fn take(&mut self, run: &Run<'_>, feature: Feature<'_>) -> Result<(), Da3Error>;
    /// Normalised patch tokens after an extra layer that was asked for, `[patches, D]`.
    fn take_extra(&mut self, layer: usize, view: usize, patches: Vec<f32>);
}

/// The backbone's layers.
pub(crate) struct Backbone {
    config: BackboneConfig,
    embed: Embed,
    /// `[2, D]`.
    camera_token: Option<Vec<f32>>,
    blocks: Vec<Slot<Block>>,
    norm: LayerNorm,
}

/// The order in which views are computed: position to view.
struct Order(Vec<usize>);

impl Backbone {
    pub fn load(scope: &Scope, config: &BackboneConfig, residency: Residency) -> Result<Self, Da3Error> {
        let blocks = (0..config.depth).map(|i| {
            let (scope, shape) = (scope.at(&format!("blocks.{i}")), block_shape(config, i));
            Slot::new(residency, move || Block::load(&scope, shape))
        });
        let camera_token = config
            .alternate_from
            .map(|_| scope.weight("camera_token", &[1, 2, config.dim]))
            .transpose()?
            .map(|token| token.to_f32());
        Ok(Self {
            embed: Embed::load(scope, config)?,
            camera_token,
            blocks: blocks.collect::<Result<_, _>>()?,
            norm: scope.norm("norm", config.dim, NORM_EPS)?,
            config: config.clone(),
        })
    }

    /// The final norm, for the second half of the features.
    pub fn norm(&self) -> &LayerNorm {
        &self.norm
    }

    /// Runs all blocks; features go to `sink` as they come. `extra` are layers whose tokens are wanted besides.
    /// Returns the reference view.
    pub fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        cameras: CameraTokens<'_>,
        extra: &[usize],
        sink: &mut dyn FeatureSink,
    ) -> Result<usize, Da3Error> {
        let (rows, columns) = pixels.patches();
        let length = (1 + rows * columns) * self.config.dim;
        let mut x = vec![0.0; pixels.views * length];
        for (view, tokens) in x.chunks_exact_mut(length).enumerate() {
            run.check_cancelled()?;
            self.embed.apply(run, view, pixels.view(view), (pixels.rows, pixels.columns), tokens);
        }
        let rope = RopeTables { tables: rope_tables(&self.config, rows, columns) };
        let mut order = Order((0..pixels.views).collect());
        let mut scratch = BlockScratch::default();
        for i in 0..self.config.depth {
            let run = &run.part(i, self.config.depth);
            run.check_cancelled()?;
            if self.config.alternate_from == Some(i + 1) {
                order = self.put_reference_first(&mut x, length, cameras);
            }
            if self.config.alternate_from == Some(i) {
                self.place_camera_tokens(&mut x, length, cameras);
            }
            let layers = run.block(i, self.config.depth);
            let attention = if is_deep(self.config.depth) { layers } else { run.backbone };
            let compute = BlockCompute { layers, attention };
            let mut step = Step { run, compute, order: &order, layer: i, length, extra, sink: &mut *sink };
            let block = self.blocks[i].get()?;
            if self.config.is_global(i) {
                self.global(&mut step, &block, &mut x, rope.global(self.config.has_rope(i)), &mut scratch)?;
            } else {
                self.local(&mut step, &block, &mut x, rope.local(self.config.has_rope(i)), &mut scratch)?;
            }
        }
        Ok(order.0.first().copied().unwrap_or(0))
    }

    fn local(
        &self,
        step: &mut Step<'_, '_>,
        block: &Block,
        x: &mut [f32],
        rope: Option<&RopeTable>,
        scratch: &mut BlockScratch,
    ) -> Result<(), Da3Error> {
        let views = (GROUP_TOKENS / (step.length / self.config.dim)).max(1);
        let (run, groups) = (step.run, x.len().div_ceil(views * step.length));
        for (group, x) in x.chunks_mut(views * step.length).enumerate() {
            run.part(group, groups).check_cancelled()?;
            block.run(&step.compute, x, x.len() / step.length, rope, scratch);
            for (i, x) in x.chunks_exact(step.length).enumerate() {
                self.emit(step, group * views + i, x, x)?;
            }
        }
        Ok(())
    }

    fn global(
        &self,
        step: &mut Step<'_, '_>,
        block: &Block,
        x: &mut [f32],
        rope: Option<&RopeTable>,
        scratch: &mut BlockScratch,
    ) -> Result<(), Da3Error> {
        let compute = step.compute;
        let mut queries = std::mem::take(&mut scratch.queries);
        resize(&mut queries, x.len());
        let mut sequence = block.key_values(&compute, x.len() / self.config.dim);
        let (run, parts) = (step.run, 2 * (x.len() / step.length));
        for (i, (x, queries)) in x.chunks(step.length).zip(queries.chunks_mut(step.length)).enumerate() {
            run.part(i, parts).check_cancelled()?;
            block.push(&compute, x, rope, (&mut sequence, queries), scratch);
        }
        let mut before = Vec::new();
        let mut views = x.chunks_exact_mut(step.length).zip(queries.chunks_exact(step.length)).enumerate();
        views.try_for_each(|(i, (x, queries))| {
            run.part(parts / 2 + i, parts).check_cancelled()?;
            before.clear();
            if self.config.out_layers.contains(&step.layer) {
                before.extend_from_slice(x);
            }
            block.run_in_sequence(&compute, x, rope, (&sequence, queries), scratch);
            self.emit(step, i, &before, x)
        })?;
        scratch.queries = queries;
        Ok(())
    }

    /// Shows a view's tokens after a block and hands over what is wanted of them.
    fn emit(
        &self,
        step: &mut Step<'_, '_>,
        position: usize,
        local: &[f32],
        global: &[f32],
    ) -> Result<(), Da3Error> {
        let (dim, layer) = (self.config.dim, step.layer);
        step.run.show(&format!("block{layer:02}"), position, &[global.len() / dim, dim], global);
        let view = step.order.0[position];
        if let Some(stage) = self.config.out_layers.iter().position(|l| *l == layer) {
            step.sink.take(step.run, Feature { stage, view, local, global })?;
        }
        if step.extra.contains(&layer) {
            let mut patches = global[dim..].to_vec();
            self.norm.apply_in_place(&step.compute.layers, &mut patches);
            step.sink.take_extra(layer, view, patches);
        }
        Ok(())
    }

    fn put_reference_first(&self, x: &mut [f32], length: usize, cameras: CameraTokens<'_>) -> Order {
        let views = x.len() / length;
        let CameraTokens::Trained(strategy) = cameras else {
            return Order((0..views).collect());
        };
        let tokens: Vec<&[f32]> = x.chunks_exact(length).map(|v| &v[..self.config.dim]).collect();
        let reference = choose_reference(&tokens, strategy);
        // The reference first, the others in their order: the views before it move one place on.
        x[..(reference + 1) * length].rotate_right(length);
        let others = (0..views).filter(|v| *v != reference);
        Order(std::iter::once(reference).chain(others).collect())
    }

    fn place_camera_tokens(&self, x: &mut [f32], length: usize, cameras: CameraTokens<'_>) {
        let dim = self.config.dim;
        for (i, view) in x.chunks_exact_mut(length).enumerate() {
            let token = match (cameras, &self.camera_token) {
                (CameraTokens::Given(tokens), _) => &tokens[i * dim..(i + 1) * dim],
                (CameraTokens::Trained(_), Some(pair)) => {
                    let which = i.min(1);
                    &pair[which * dim..(which + 1) * dim]
                }
                (CameraTokens::Trained(_), None) => continue,
            };
            view[..dim].copy_from_slice(token);
        }
    }
}

/// Rotations of local and of global blocks for views of `rows` × `columns` patches, if the network has any.
pub(crate) fn rope_tables(
    config: &BackboneConfig,
    rows: usize,
    columns: usize,
) -> Option<(RopeTable, RopeTable)> {
    config.rope_from?;
    let patches = || (0..rows).flat_map(|r| (0..columns).map(move |c| [(r + 1) as f32, (c + 1) as f32]));
    let local: Vec<[f32; 2]> = std::iter::once([0.0, 0.0]).chain(patches()).collect();
    let global: Vec<[f32; 2]> = std::iter::once([-1.0, -1.0]).chain(patches().map(|_| [0.0, 0.0])).collect();
    let table = |positions: &[[f32; 2]]| RopeTable::new(positions, config.head_dim(), ROPE_BASE);
    Some((table(&local), table(&global)))
}

/// Sizes of block `i`.
pub(crate) fn block_shape(config: &BackboneConfig, i: usize) -> BlockShape {
    BlockShape {
        dim: config.dim,
        heads: config.heads,
        ffn: config.ffn,
        has_qk_norm: config.has_qk_norm(i),
        eps: BLOCK_EPS,
    }
}

/// What a block's run shares with its neighbours.
struct Step<'a, 's> {
    run: &'a Run<'a>,
    compute: BlockCompute,
    order: &'a Order,
    layer: usize,
    /// Numbers of one view.
    length: usize,
    extra: &'a [usize],
    sink: &'s mut dyn FeatureSink,
}

/// Rotations of local and of global blocks.
struct RopeTables {
    tables: Option<(RopeTable, RopeTable)>,
}

impl RopeTables {
    fn local(&self, is_used: bool) -> Option<&RopeTable> {
        self.tables.as_ref().filter(|_| is_used).map(|t| &t.0)
    }

    fn global(&self, is_used: bool) -> Option<&RopeTable> {
        self.tables.as_ref().filter(|_| is_used).map(|t| &t.1)
    }
}
