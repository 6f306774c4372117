//! The vision transformer on the device; see the CPU's for what it computes.
//!
//! Tokens of all views lie in one buffer. A local block takes a few views at a time; a global one writes queries, keys and
//! values of all views, then outputs for a few views at a time.

mod features;

pub(super) use features::Features;

use super::block::{Block, Scratch, inner_width};
use super::{Context, load, show};
use crate::config::{BackboneConfig, PATCH};
use crate::error::Da3Error;
use crate::model::backbone::{
    CameraTokens, Embed, NORM_EPS, Pixels, block_shape, choose_reference, rope_tables,
};
use crate::run::Run;
use crate::weights::{Residency, Scope, Slot};
use vidar_gpu::ops::{End, Norm, Rotation, Rows, add, layer_norm, patchify, product};
use vidar_gpu::{Buffer, Gpu, Matrix, Recorder};

/// Tokens that go through a block at once.
const GROUP_TOKENS: usize = 8192;
/// Tokens that go through the feed-forward part at once.
pub(super) const FFN_ROWS: usize = 4096;

/// Views that go through a block at once.
pub(super) fn group_views(views: usize, tokens: usize) -> usize {
    (GROUP_TOKENS / tokens).clamp(1, views.max(1))
}

/// The backbone's layers.
pub(super) struct Backbone {
    gpu: Gpu,
    config: BackboneConfig,
    embed: Embed,
    proj: Matrix,
    cls_token: Buffer,
    /// `[2, D]`.
    camera_token: Option<Vec<f32>>,
    blocks: Vec<Slot<Block>>,
    norm: Norm,
}

/// What stays the same during a run.
struct Walk<'a> {
    run: &'a Run<'a>,
    /// Tokens of a view, and views.
    tokens: usize,
    views: usize,
    group: usize,
    rotations: Option<(Rotation, Rotation)>,
    layers: &'a [usize],
    scratch: Scratch,
}

/// Tokens of all views: as they are, and as they were before the block.
struct State {
    x: Buffer,
    before: Buffer,
    /// Position to view.
    order: Vec<usize>,
}

impl Backbone {
    pub fn load(
        context: &Context,
        scope: &Scope,
        config: &BackboneConfig,
        residency: Residency,
    ) -> Result<Self, Da3Error> {
        let gpu = context.gpu();
        let (dim, depth) = (config.dim, config.depth);
        let blocks = (0..depth).map(|i| {
            let (scope, shape) = (scope.at(&format!("blocks.{i}")), block_shape(config, i));
            let (gpu, storage) = (gpu.clone(), context.of_block(i, depth));
            Slot::new(residency, move || Block::load(&gpu, &scope, shape, storage))
        });
        let camera_token = match config.alternate_from {
            Some(_) => Some(scope.weight("camera_token", &[1, 2, dim])?.to_f32()),
            None => None,
        };
        let proj = scope.at("patch_embed").at("proj");
        let weight = proj.weight("weight", &[dim, 3, PATCH, PATCH])?;
        let (bias, sizes) = (proj.vector("bias", dim)?, [dim, 3 * PATCH * PATCH]);
        let storage = context.of_block(0, depth);
        Ok(Self {
            embed: Embed::load(scope, config)?,
            proj: Matrix::new(gpu, weight.name(), &weight.to_f32(), Some(&bias), sizes, storage)?,
            cls_token: gpu.upload("cls_token", &scope.weight("cls_token", &[1, 1, dim])?.to_f32())?,
            camera_token,
            blocks: blocks.collect::<Result<_, _>>()?,
            norm: load::norm(gpu, scope, "norm", dim, NORM_EPS)?,
            gpu: gpu.clone(),
            config: config.clone(),
        })
    }

    /// Runs all blocks; features go to `features` as they come. Returns the reference view.
    pub fn run(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        pixels: &Pixels<'_>,
        cameras: CameraTokens<'_>,
        layers: &[usize],
        features: &mut Features<'_>,
    ) -> Result<usize, Da3Error> {
        let (rows, columns) = pixels.patches();
        let (tokens, views, dim) = (1 + rows * columns, pixels.views, self.config.dim);
        let group = group_views(views, tokens);
        let sequence = if self.config.alternate_from.is_some() { views * tokens } else { group * tokens };
        let mut state = State {
            x: self.gpu.buffer("tokens", views * tokens * dim)?,
            before: self.gpu.buffer("tokens before a block", views * tokens * dim)?,
            order: (0..views).collect(),
        };
        self.embed(run, recorder, pixels, &state.x)?;
        let inner = inner_width(self.config.ffn);
        let walk = Walk {
            run,
            tokens,
            views,
            group,
            rotations: self.rotations(rows, columns)?,
            layers,
            scratch: Scratch::new(
                &self.gpu,
                (dim, inner),
                group * tokens,
                sequence,
                FFN_ROWS.min(group * tokens),
            )?,
        };
        for i in 0..self.config.depth {
            run.part(i, self.config.depth).check_cancelled()?;
            if self.config.alternate_from == Some(i + 1) {
                self.put_reference_first(recorder, &walk, &mut state, cameras)?;
            }
            if self.config.alternate_from == Some(i) {
                self.place_camera_tokens(recorder, &walk, &state, cameras)?;
            }
            self.block(recorder, &walk, i, &state)?;
            self.emit(recorder, &walk, i, &state, features)?;
            recorder.submit()?;
        }
        features.camera_tokens = recorder.read(&features.camera, 0, features.camera.len())?;
        Ok(state.order.first().copied().unwrap_or(0))
    }

    fn embed(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        pixels: &Pixels<'_>,
        x: &Buffer,
    ) -> Result<(), Da3Error> {
        let (rows, columns) = pixels.patches();
        let (patches, dim) = (rows * columns, self.config.dim);
        let positions = self.gpu.upload("position embedding", &self.embed.positions(rows, columns))?;
        let length = 3 * pixels.rows * pixels.columns;
        let picture = self.gpu.buffer("pixels", length)?;
        let unfolded = self.gpu.buffer("patches", length)?;
        for view in 0..pixels.views {
            run.check_cancelled()?;
            let first = view * (1 + patches) * dim;
            picture.write(&self.gpu, 0, &pixels.data[view * length..(view + 1) * length]);
            patchify(recorder, (&picture, 0), [pixels.rows, pixels.columns, PATCH], &unfolded)?;
            let out = Rows { buffer: x, at: first + dim, stride: dim };
            product(recorder, Rows::of(&unfolded, self.proj.inputs()), patches, &self.proj, out, End::Store)?;
            show(run, recorder, ("patch_embed", view), &[patches, dim], (x, first + dim))?;
            recorder.copy((&self.cls_token, 0), (x, first), dim);
            add(recorder, (&positions, 0), (x, first), (1 + patches) * dim)?;
            show(run, recorder, ("tokens_in", view), &[1 + patches, dim], (x, first))?;
            // The next view's pixels are written before what is recorded then, not before what is recorded now.
            recorder.submit()?;
        }
        Ok(())
    }

    fn rotations(&self, rows: usize, columns: usize) -> Result<Option<(Rotation, Rotation)>, Da3Error> {
        let head_dim = self.config.head_dim();
        let there =
            |table: &vidar_nn::RopeTable| Rotation::new(&self.gpu, table.cos(), table.sin(), head_dim);
        match rope_tables(&self.config, rows, columns) {
            Some((local, global)) => Ok(Some((there(&local)?, there(&global)?))),
            None => Ok(None),
        }
    }

    fn block(
        &self,
        recorder: &mut Recorder,
        walk: &Walk<'_>,
        i: usize,
        state: &State,
    ) -> Result<(), Da3Error> {
        let block = self.blocks[i].get()?;
        let is_global = self.config.is_global(i);
        let (tokens, scratch) = (walk.tokens, &walk.scratch);
        let rotation = walk.rotations.as_ref().filter(|_| self.config.has_rope(i));
        let groups = || (0..walk.views).step_by(walk.group).map(|v| (v, walk.group.min(walk.views - v)));
        if is_global && self.config.out_layers.contains(&i) {
            recorder.copy((&state.x, 0), (&state.before, 0), state.x.len());
        }
        if !is_global {
            for (first, views) in groups() {
                walk.run.check_cancelled()?;
                let part = (first * tokens, views * tokens);
                block.project(recorder, &state.x, part, 0, scratch)?;
                block.prepare(recorder, part.1, rotation.map(|r| &r.0), scratch)?;
                let meeting = ((0, tokens), (0, tokens), views);
                block.attend_and_finish(recorder, &state.x, part, meeting, scratch)?;
                recorder.submit()?;
            }
            return Ok(());
        }
        for (first, views) in groups() {
            walk.run.check_cancelled()?;
            let part = (first * tokens, views * tokens);
            block.project(recorder, &state.x, part, part.0, scratch)?;
            recorder.submit()?;
        }
        let all = walk.views * tokens;
        block.prepare(recorder, all, rotation.map(|r| &r.1), scratch)?;
        for (first, views) in groups() {
            walk.run.check_cancelled()?;
            let part = (first * tokens, views * tokens);
            block.attend_and_finish(recorder, &state.x, part, (part, (0, all), 1), scratch)?;
            recorder.submit()?;
        }
        Ok(())
    }

    /// Shows the tokens after a block and hands over what is wanted of them.
    fn emit(
        &self,
        recorder: &mut Recorder,
        walk: &Walk<'_>,
        layer: usize,
        state: &State,
        features: &mut Features<'_>,
    ) -> Result<(), Da3Error> {
        let (dim, tokens) = (self.config.dim, walk.tokens);
        for (position, view) in state.order.iter().copied().enumerate() {
            let first = position * tokens;
            let name = format!("block{layer:02}");
            show(walk.run, recorder, (&name, position), &[tokens, dim], (&state.x, first * dim))?;
            if let Some(stage) = self.config.out_layers.iter().position(|l| *l == layer) {
                // A local block's feature has what it gave on both sides.
                let local = if self.config.is_global(layer) { &state.before } else { &state.x };
                features.take(walk.run, recorder, (view, stage), (local, &state.x, first))?;
            }
            if walk.layers.contains(&layer) {
                let normed = self.gpu.buffer("tokens of a layer", (tokens - 1) * dim)?;
                let patches = Rows::of(&state.x, dim).from_row(first + 1);
                layer_norm(recorder, &self.norm, patches, tokens - 1, Rows::of(&normed, dim))?;
                let values = recorder.read(&normed, 0, normed.len())?;
                features.layers.entry(layer).or_insert_with(|| vec![Vec::new(); walk.views])[view] = values;
            }
        }
        Ok(())
    }

    fn put_reference_first(
        &self,
        recorder: &mut Recorder,
        walk: &Walk<'_>,
        state: &mut State,
        cameras: CameraTokens<'_>,
    ) -> Result<(), Da3Error> {
        let CameraTokens::Trained(strategy) = cameras else { return Ok(()) };
        let (dim, length) = (self.config.dim, walk.tokens * self.config.dim);
        let firsts = self.gpu.buffer("class tokens", walk.views * dim)?;
        for view in 0..walk.views {
            recorder.copy((&state.x, view * length), (&firsts, view * dim), dim);
        }
        let values = recorder.read(&firsts, 0, firsts.len())?;
        let tokens: Vec<&[f32]> = values.chunks_exact(dim).collect();
        let reference = choose_reference(&tokens, strategy);
        if reference > 0 {
            state.order =
                std::iter::once(reference).chain((0..walk.views).filter(|v| *v != reference)).collect();
            for (position, view) in state.order.iter().enumerate() {
                recorder.copy((&state.x, view * length), (&state.before, position * length), length);
            }
            std::mem::swap(&mut state.x, &mut state.before);
        }
        Ok(())
    }

    fn place_camera_tokens(
        &self,
        recorder: &mut Recorder,
        walk: &Walk<'_>,
        state: &State,
        cameras: CameraTokens<'_>,
    ) -> Result<(), Da3Error> {
        let (dim, length) = (self.config.dim, walk.tokens * self.config.dim);
        let (values, is_given) = match (cameras, &self.camera_token) {
            (CameraTokens::Given(tokens), _) => (tokens, true),
            (CameraTokens::Trained(_), Some(pair)) => (pair.as_slice(), false),
            (CameraTokens::Trained(_), None) => return Ok(()),
        };
        let tokens = self.gpu.upload("camera tokens", values)?;
        for position in 0..walk.views {
            let which = if is_given { position } else { position.min(1) };
            recorder.copy((&tokens, which * dim), (&state.x, position * length), dim);
        }
        Ok(())
    }
}
