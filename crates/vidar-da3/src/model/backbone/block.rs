//! A transformer block (`blocks.I` of the backbone, `trunk.I` of the camera encoder).
//!
//! `x += g₁·Attn(LN₁ x)`, `x += g₂·FFN(LN₂ x)` (pre-norm, LayerScale). Shapes: x `[tokens, D]`. Keys:
//! `norm1`, `attn.{qkv,q_norm,k_norm,proj}`, `ls1.gamma`, `norm2`, `mlp.{fc1,fc2}` or `mlp.{w12,w3}`, `ls2.gamma`.

use crate::config::Ffn;
use crate::error::Da3Error;
use crate::weights::Scope;
use vidar_nn::{
    AttentionSpec, Compute, Epilogue, KeyValues, LayerNorm, Linear, RopeTable, TokenRows, attention,
};

/// Sizes of a block.
#[derive(Clone, Copy)]
pub(crate) struct BlockShape {
    pub dim: usize,
    pub heads: usize,
    pub ffn: Ffn,
    pub has_qk_norm: bool,
    pub eps: f32,
}

/// A block's layers.
pub(crate) struct Block {
    norm1: LayerNorm,
    attn: Attention,
    ls1: Vec<f32>,
    norm2: LayerNorm,
    mlp: FeedForward,
    ls2: Vec<f32>,
}

struct Attention {
    qkv: Linear,
    q_norm_k_norm: Option<(LayerNorm, LayerNorm)>,
    proj: Linear,
    heads: usize,
}

enum FeedForward {
    Mlp { fc1: Linear, fc2: Linear },
    SwiGlu { w12: Linear, w3: Linear },
}

/// Epsilon of the norms over queries and keys.
pub(crate) const QK_EPS: f32 = 1e-5;

/// Kernels and precision of a block's layers, and of its attention.
///
/// Scores and weights are averages over channels and keys: in backbones of up to 24 blocks bf16 there leaves no trace in
/// depth, not even in the first blocks, whose layers must not be rounded.
#[derive(Clone, Copy)]
pub(crate) struct BlockCompute {
    pub layers: Compute,
    pub attention: Compute,
}

impl From<Compute> for BlockCompute {
    /// Both alike.
    fn from(compute: Compute) -> Self {
        Self { layers: compute, attention: compute }
    }
}

/// Buffers that the blocks of a run share.
#[derive(Default)]
pub(crate) struct BlockScratch {
    normed: Vec<f32>,
    attended: Vec<f32>,
    hidden: Vec<f32>,
    /// `[tokens, 3, D]`.
    qkv: Vec<f32>,
    /// Queries of a sequence of all views, `[tokens, D]`.
    pub queries: Vec<f32>,
}

/// Tokens that go through the feed-forward part at once: its inner width is four times the token's.
pub(crate) const FFN_ROWS: usize = 1024;

impl Block {
    pub fn load(scope: &Scope, shape: BlockShape) -> Result<Self, Da3Error> {
        let BlockShape { dim, heads, ffn, has_qk_norm, eps } = shape;
        let attn = scope.at("attn");
        let head_dim = dim / heads;
        let norms = || -> Result<_, Da3Error> {
            Ok((attn.norm("q_norm", head_dim, QK_EPS)?, attn.norm("k_norm", head_dim, QK_EPS)?))
        };
        let mlp = scope.at("mlp");
        let mlp = match ffn {
            Ffn::Mlp { hidden } => FeedForward::Mlp {
                fc1: mlp.linear("fc1", dim, hidden)?,
                fc2: mlp.linear("fc2", hidden, dim)?,
            },
            Ffn::SwiGlu { hidden } => FeedForward::SwiGlu {
                w12: mlp.linear("w12", dim, 2 * hidden)?,
                w3: mlp.linear("w3", hidden, dim)?,
            },
        };
        Ok(Self {
            norm1: scope.norm("norm1", dim, eps)?,
            attn: Attention {
                qkv: attn.linear("qkv", dim, 3 * dim)?,
                q_norm_k_norm: has_qk_norm.then(norms).transpose()?,
                proj: attn.linear("proj", dim, dim)?,
                heads,
            },
            ls1: scope.vector("ls1.gamma", dim)?,
            norm2: scope.norm("norm2", dim, eps)?,
            mlp,
            ls2: scope.vector("ls2.gamma", dim)?,
        })
    }

    fn dim(&self) -> usize {
        self.ls1.len()
    }

    /// Runs the block on `sequences` sequences of equal length, each attending to itself.
    pub fn run(
        &self,
        c: &BlockCompute,
        x: &mut [f32],
        sequences: usize,
        rope: Option<&RopeTable>,
        scratch: &mut BlockScratch,
    ) {
        let rows = x.len() / self.dim();
        let mut qkv = std::mem::take(&mut scratch.qkv);
        resize(&mut qkv, 3 * x.len());
        self.project_qkv(c, x, &mut qkv, scratch);
        resize(&mut scratch.attended, x.len());
        let spec = self.attn.spec(rope);
        attention(&c.attention, &qkv, sequences, rows / sequences.max(1), &spec, &mut scratch.attended);
        scratch.qkv = qkv;
        self.finish(c, x, scratch);
    }

    /// Queries, keys and values of some tokens: `[tokens, 3, D]`.
    fn project_qkv(&self, c: &BlockCompute, x: &[f32], qkv: &mut [f32], scratch: &mut BlockScratch) {
        resize(&mut scratch.normed, x.len());
        self.norm1.apply(&c.layers, x, &mut scratch.normed);
        self.attn.qkv.apply(&c.layers, &scratch.normed, x.len() / self.dim(), qkv, Epilogue::None);
    }

    /// Room for the keys and values of a sequence of `tokens`.
    pub fn key_values(&self, c: &BlockCompute, tokens: usize) -> KeyValues {
        KeyValues::new(&c.attention, &self.attn.spec(None), tokens)
    }

    /// Appends some tokens' keys and values to a sequence's, and writes their queries, `[tokens, D]`.
    pub fn push(
        &self,
        c: &BlockCompute,
        x: &[f32],
        rope: Option<&RopeTable>,
        (sequence, queries): (&mut KeyValues, &mut [f32]),
        scratch: &mut BlockScratch,
    ) {
        let dim = self.dim();
        let mut qkv = std::mem::take(&mut scratch.qkv);
        resize(&mut qkv, 3 * x.len());
        self.project_qkv(c, x, &mut qkv, scratch);
        let [_, keys, values] = TokenRows::split_qkv(&qkv, dim);
        sequence.push(&self.attn.spec(rope), keys, values);
        for (query, qkv) in queries.chunks_exact_mut(dim).zip(qkv.chunks_exact(3 * dim)) {
            query.copy_from_slice(&qkv[..dim]);
        }
        scratch.qkv = qkv;
    }

    /// Runs the block on some tokens whose queries meet a whole sequence.
    pub fn run_in_sequence(
        &self,
        c: &BlockCompute,
        x: &mut [f32],
        rope: Option<&RopeTable>,
        (sequence, queries): (&KeyValues, &[f32]),
        scratch: &mut BlockScratch,
    ) {
        let (rows, dim) = (x.len() / self.dim(), self.dim());
        resize(&mut scratch.attended, x.len());
        let queries = TokenRows { data: queries, stride: dim, tokens: rows };
        sequence.attend(&self.attn.spec(rope), queries, &mut scratch.attended);
        self.finish(c, x, scratch);
    }

    /// The rest of the block after attention: projection, residual, feed-forward part.
    fn finish(&self, c: &BlockCompute, x: &mut [f32], scratch: &mut BlockScratch) {
        let dim = self.dim();
        let rows = x.len() / dim;
        let residual = Epilogue::Accumulate { gamma: Some(&self.ls1) };
        self.attn.proj.apply(&c.layers, &scratch.attended, rows, x, residual);
        for x in x.chunks_mut(FFN_ROWS * dim) {
            let rows = x.len() / dim;
            resize(&mut scratch.normed, x.len());
            self.norm2.apply(&c.layers, x, &mut scratch.normed);
            let residual = Epilogue::Accumulate { gamma: Some(&self.ls2) };
            match &self.mlp {
                FeedForward::Mlp { fc1, fc2 } => {
                    resize(&mut scratch.hidden, rows * fc1.out_features());
                    fc1.apply(&c.layers, &scratch.normed, rows, &mut scratch.hidden, Epilogue::Gelu);
                    fc2.apply(&c.layers, &scratch.hidden, rows, x, residual);
                }
                FeedForward::SwiGlu { w12, w3 } => {
                    resize(&mut scratch.hidden, rows * w3.in_features());
                    w12.apply_swiglu(&c.layers, &scratch.normed, rows, &mut scratch.hidden);
                    w3.apply(&c.layers, &scratch.hidden, rows, x, residual);
                }
            }
        }
    }
}

impl Attention {
    fn spec<'a>(&'a self, rope: Option<&'a RopeTable>) -> AttentionSpec<'a> {
        let norms = self.q_norm_k_norm.as_ref().map(|(q, k)| (q, k));
        let head_dim = self.proj.in_features() / self.heads;
        AttentionSpec { heads: self.heads, head_dim, qk_norm: norms, rope }
    }
}

/// Sets the length without giving memory back: later parts of a run are no larger than the largest so far.
pub(crate) fn resize(buffer: &mut Vec<f32>, length: usize) {
    buffer.resize(length, 0.0);
}
