//! What the heads get of the backbone: stage projections, camera tokens, tokens of layers.

use crate::error::Da3Error;
use crate::gpu::head::Grids;
use crate::gpu::{Network, show};
use crate::model::backbone::Pixels;
use crate::run::Run;
use std::collections::BTreeMap;
use std::ops::Range;
use vidar_gpu::ops::{Rows, copy_rows, embed, layer_norm};
use vidar_gpu::{Buffer, Recorder};

/// Stage projections of the wanted views, camera tokens, and tokens of layers that were asked for.
pub(in crate::gpu) struct Features<'a> {
    net: &'a Network,
    grids: &'a Grids,
    size: (usize, usize),
    wanted: Range<usize>,
    /// A feature of one view, and as the head wants it normed, `[patches, feature width]`.
    joined: Buffer,
    normed: Buffer,
    /// `[views, feature width]`.
    pub(super) camera: Buffer,
    /// By view, then by stage.
    stages: Vec<Vec<Buffer>>,
    /// Of the last stage, `[views, feature width]`.
    pub(super) camera_tokens: Vec<f32>,
    /// By layer and view: normalised patch tokens.
    pub(super) layers: Layers,
}

/// Tokens by layer and view.
type Layers = BTreeMap<usize, Vec<Vec<f32>>>;

impl<'a> Features<'a> {
    pub fn new(
        net: &'a Network,
        pixels: &Pixels<'_>,
        wanted: Range<usize>,
        grids: &'a Grids,
    ) -> Result<Self, Da3Error> {
        let (rows, columns) = pixels.patches();
        let width = net.net.backbone.feature_dim();
        Ok(Self {
            net,
            grids,
            size: (rows, columns),
            wanted,
            joined: net.gpu.buffer("a feature", rows * columns * width)?,
            normed: net.gpu.buffer("a normed feature", rows * columns * width)?,
            camera: net.gpu.buffer("camera tokens", pixels.views * width)?,
            stages: (0..pixels.views).map(|_| Vec::with_capacity(4)).collect(),
            camera_tokens: Vec::new(),
            layers: BTreeMap::new(),
        })
    }

    /// Stages by view, camera tokens, and tokens of layers.
    pub fn into_parts(self) -> (Vec<Vec<Buffer>>, Vec<f32>, Layers) {
        (self.stages, self.camera_tokens, self.layers)
    }

    /// The local half stays as it is, the global half is normed; the camera token is neither. Networks of single views have
    /// the global half only. `first` is the view's first token.
    pub(super) fn take(
        &mut self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        (view, stage): (usize, usize),
        (local, global, first): (&Buffer, &Buffer, usize),
    ) -> Result<(), Da3Error> {
        let dim = self.net.net.backbone.dim;
        let width = self.net.net.backbone.feature_dim();
        let (patches, token) = (self.size.0 * self.size.1, view * width);
        let has_local = width > dim;
        let global_at = if has_local { dim } else { 0 };
        recorder.copy((global, first * dim), (&self.camera, token + global_at), dim);
        if has_local {
            recorder.copy((local, first * dim), (&self.camera, token), dim);
        }
        show(run, recorder, (&format!("camtok{stage}"), view), &[width], (&self.camera, token))?;
        if !self.wanted.contains(&view) {
            return Ok(());
        }
        let rows = |buffer| Rows::of(buffer, dim).from_row(first + 1);
        let joined = |at| Rows { buffer: &self.joined, at, stride: width };
        if has_local {
            copy_rows(recorder, rows(local), (patches, dim), joined(0))?;
        }
        layer_norm(recorder, &self.net.backbone.norm, rows(global), patches, joined(global_at))?;
        show(run, recorder, (&format!("feat{stage}"), view), &[patches, width], (&self.joined, 0))?;
        let head = &self.net.head;
        let feature = match head.norm() {
            Some(norm) => {
                layer_norm(recorder, norm, joined(0), patches, Rows::of(&self.normed, width))?;
                &self.normed
            }
            None => &self.joined,
        };
        let channels = head.stages().channels(stage);
        let map = self.net.gpu.buffer("a stage", patches * channels)?;
        head.stages().project(run, recorder, (view, stage), (feature, self.size), &map)?;
        if let Some(grid) = self.grids.stage(stage) {
            embed(recorder, grid, &map)?;
        }
        self.stages[view].push(map);
        Ok(())
    }
}
