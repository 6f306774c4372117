//! A transformer block on the device; see the CPU's for keys and shapes.

use super::load;
use crate::config::Ffn;
use crate::error::Da3Error;
use crate::model::backbone::{BlockShape, QK_EPS};
use crate::weights::Scope;
use vidar_gpu::ops::{AttendSpec, End, Norm, Rotation, Rows, attend, layer_norm, prepare_heads, product};
use vidar_gpu::{Buffer, Gpu, GpuError, Matrix, Recorder, Storage};

/// A block's layers.
pub(super) struct Block {
    norm1: Norm,
    qkv: Matrix,
    q_norm_k_norm: Option<(Norm, Norm)>,
    proj: Matrix,
    ls1: Buffer,
    norm2: Norm,
    first: Matrix,
    second: Matrix,
    ls2: Buffer,
    shape: BlockShape,
}

/// Buffers that the blocks of a run share.
pub(super) struct Scratch {
    /// `[group, D]`.
    pub normed: Buffer,
    /// `[tokens of a sequence of all views, or a group, 3, D]`.
    pub qkv: Buffer,
    /// `[group, D]`.
    attended: Buffer,
    /// `[rows at a time, inner width]`.
    hidden: Buffer,
    hidden_rows: usize,
}

/// The inner width of a block.
pub(super) fn inner_width(ffn: Ffn) -> usize {
    match ffn {
        Ffn::Mlp { hidden } | Ffn::SwiGlu { hidden } => hidden,
    }
}

impl Scratch {
    /// For groups of `group` tokens and sequences of `sequence`; `hidden_rows` go through the feed-forward part at a time.
    pub fn new(
        gpu: &Gpu,
        (dim, inner): (usize, usize),
        group: usize,
        sequence: usize,
        hidden_rows: usize,
    ) -> Result<Self, GpuError> {
        Ok(Self {
            normed: gpu.buffer("normed tokens", group * dim)?,
            qkv: gpu.buffer("queries, keys and values", sequence.max(group) * 3 * dim)?,
            attended: gpu.buffer("attended tokens", group * dim)?,
            hidden: gpu.buffer("inner width of the feed-forward part", hidden_rows * inner)?,
            hidden_rows,
        })
    }
}

impl Block {
    pub fn load(gpu: &Gpu, scope: &Scope, shape: BlockShape, storage: Storage) -> Result<Self, Da3Error> {
        let BlockShape { dim, heads, ffn, has_qk_norm, eps } = shape;
        let (attn, mlp) = (scope.at("attn"), scope.at("mlp"));
        let qk = |part| load::norm(gpu, &attn, part, dim / heads, QK_EPS);
        let matrix = |scope, part, sizes| load::matrix(gpu, scope, part, sizes, storage);
        let (first, second) = match ffn {
            Ffn::Mlp { hidden } => (matrix(&mlp, "fc1", [dim, hidden])?, matrix(&mlp, "fc2", [hidden, dim])?),
            Ffn::SwiGlu { hidden } => {
                let first = load::gated(gpu, &mlp, "w12", [dim, 2 * hidden], storage)?;
                (first, matrix(&mlp, "w3", [hidden, dim])?)
            }
        };
        Ok(Self {
            norm1: load::norm(gpu, scope, "norm1", dim, eps)?,
            qkv: matrix(&attn, "qkv", [dim, 3 * dim])?,
            q_norm_k_norm: if has_qk_norm { Some((qk("q_norm")?, qk("k_norm")?)) } else { None },
            proj: matrix(&attn, "proj", [dim, dim])?,
            ls1: load::vector(gpu, scope, "ls1.gamma", dim)?,
            norm2: load::norm(gpu, scope, "norm2", dim, eps)?,
            first,
            second,
            ls2: load::vector(gpu, scope, "ls2.gamma", dim)?,
            shape,
        })
    }

    /// Queries, keys and values of `rows` tokens from `first` on, written from token `to` on.
    pub fn project(
        &self,
        recorder: &mut Recorder,
        x: &Buffer,
        (first, rows): (usize, usize),
        to: usize,
        scratch: &Scratch,
    ) -> Result<(), GpuError> {
        let dim = self.shape.dim;
        let tokens = Rows::of(x, dim).from_row(first);
        layer_norm(recorder, &self.norm1, tokens, rows, Rows::of(&scratch.normed, dim))?;
        let out = Rows::of(&scratch.qkv, 3 * dim).from_row(to);
        product(recorder, Rows::of(&scratch.normed, dim), rows, &self.qkv, out, End::Store)
    }

    /// Norm and rotation of the queries and keys of `tokens` tokens.
    pub fn prepare(
        &self,
        recorder: &mut Recorder,
        tokens: usize,
        rotation: Option<&Rotation>,
        scratch: &Scratch,
    ) -> Result<(), GpuError> {
        let norms = self.q_norm_k_norm.as_ref().map(|(q, k)| (q, k));
        prepare_heads(recorder, &scratch.qkv, tokens, self.heads(), norms, rotation)
    }

    fn heads(&self) -> (usize, usize) {
        (self.shape.heads, self.shape.dim / self.shape.heads)
    }

    /// Attention and the rest of the block for `rows` tokens of `x` from `first` on. `queries` and `keys` are in tokens of
    /// the queries, keys and values at hand; each of `sequences` sequences attends to itself.
    pub fn attend_and_finish(
        &self,
        recorder: &mut Recorder,
        x: &Buffer,
        (first, rows): (usize, usize),
        (queries, keys, sequences): ((usize, usize), (usize, usize), usize),
        scratch: &Scratch,
    ) -> Result<(), GpuError> {
        let dim = self.shape.dim;
        let (heads, head_dim) = self.heads();
        let spec = AttendSpec { heads, head_dim, queries, keys, out: 0, sequences };
        attend(recorder, &scratch.qkv, &scratch.attended, &spec)?;
        let tokens = Rows::of(x, dim).from_row(first);
        let attended = Rows::of(&scratch.attended, dim);
        product(recorder, attended, rows, &self.proj, tokens, End::Scaled(&self.ls1))?;
        layer_norm(recorder, &self.norm2, tokens, rows, Rows::of(&scratch.normed, dim))?;
        let (inner, is_gated) = match self.shape.ffn {
            Ffn::Mlp { hidden } => (hidden, false),
            Ffn::SwiGlu { hidden } => (hidden, true),
        };
        for from in (0..rows).step_by(scratch.hidden_rows) {
            let rows = scratch.hidden_rows.min(rows - from);
            let (normed, hidden) =
                (Rows::of(&scratch.normed, dim).from_row(from), Rows::of(&scratch.hidden, inner));
            let end = if is_gated { End::Gated } else { End::Gelu };
            product(recorder, normed, rows, &self.first, hidden, end)?;
            product(recorder, hidden, rows, &self.second, tokens.from_row(from), End::Scaled(&self.ls2))?;
        }
        Ok(())
    }
}
