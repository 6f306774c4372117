//! Multi-head attention, computed block by block: memory grows with the number of tokens, not with its square.

use rayon::prelude::*;

use crate::compute::Compute;
use crate::kernels::shared::SharedMut;
use crate::norm::LayerNorm;
use crate::rope::RopeTable;

/// What the heads look like and what is done with queries and keys before they meet.
#[derive(Debug, Clone, Copy)]
pub struct AttentionSpec<'a> {
    /// Number of heads.
    pub heads: usize,
    /// Channels of a head; scores are divided by its square root.
    pub head_dim: usize,
    /// Layer norms over the channels of each head's query and key.
    pub qk_norm: Option<(&'a LayerNorm, &'a LayerNorm)>,
    /// Rotation of queries and keys, after the norm.
    pub rope: Option<&'a RopeTable>,
}

impl AttentionSpec<'_> {
    /// Channels of all heads.
    pub const fn width(&self) -> usize {
        self.heads * self.head_dim
    }
}

/// Rows of a token matrix that may be wider than what is used: token t is `data[t * stride..][..width]`.
#[derive(Debug, Clone, Copy)]
pub struct TokenRows<'a> {
    /// The numbers, from the first used one on.
    pub data: &'a [f32],
    /// Distance from token to token.
    pub stride: usize,
    /// Number of tokens.
    pub tokens: usize,
}

impl<'a> TokenRows<'a> {
    /// Queries, keys and values of `qkv` laid out `[tokens, 3, heads * head_dim]`.
    pub fn split_qkv(qkv: &'a [f32], width: usize) -> [Self; 3] {
        let tokens = if width == 0 { 0 } else { qkv.len() / (3 * width) };
        [0, 1, 2].map(|i| Self { data: qkv.get(i * width..).unwrap_or(&[]), stride: 3 * width, tokens })
    }

    fn token(&self, token: usize, width: usize) -> &'a [f32] {
        &self.data[token * self.stride..][..width]
    }
}

/// Self-attention of `sequences` sequences of `tokens` tokens each. `qkv` is `[sequences * tokens, 3, heads, head_dim]` as
/// a linear layer writes it, `out` is `[sequences * tokens, heads, head_dim]`.
///
/// # Panics
/// When a slice has another length, or a norm or rotation another head dimension.
pub fn attention(
    c: &Compute,
    qkv: &[f32],
    sequences: usize,
    tokens: usize,
    spec: &AttentionSpec<'_>,
    out: &mut [f32],
) {
    let width = spec.width();
    assert_eq!(qkv.len(), sequences * tokens * 3 * width, "attention: queries, keys and values");
    assert_eq!(out.len(), sequences * tokens * width, "attention: output");
    if tokens * width == 0 {
        return;
    }
    for (qkv, out) in qkv.chunks_exact(tokens * 3 * width).zip(out.chunks_exact_mut(tokens * width)) {
        let [q, k, v] = TokenRows::split_qkv(qkv, width);
        attention_separate(c, q, k, v, spec, out);
    }
}

/// Attention of some queries to the keys and values of one sequence; `out` is `[q.tokens, heads, head_dim]`. Query i and key
/// i count from the start of their own rows for the rotation.
///
/// # Panics
/// When the numbers of keys and values differ, a slice is too short, or a norm or rotation has another head dimension.
pub fn attention_separate(
    _c: &Compute,
    q: TokenRows<'_>,
    k: TokenRows<'_>,
    v: TokenRows<'_>,
    spec: &AttentionSpec<'_>,
    out: &mut [f32],
) {
    let (d, width) = (spec.head_dim, spec.width());
    assert_eq!(k.tokens, v.tokens, "attention: keys and values");
    assert_eq!(out.len(), q.tokens * width, "attention: output");
    if let Some((qn, kn)) = spec.qk_norm {
        assert!(qn.features() == d && kn.features() == d, "attention: norms over {d} channels");
    }
    if let Some(rope) = spec.rope {
        assert_eq!(rope.head_dim(), d, "attention: rotation of {d} channels");
    }
    let out = SharedMut::new(out);
    let prepare =
        |rows: TokenRows<'_>, token: usize, head: usize, norm: Option<&LayerNorm>, to: &mut [f32]| {
            to.copy_from_slice(&rows.token(token, width)[head * d..(head + 1) * d]);
            if let Some(norm) = norm {
                norm.row(to);
            }
            if let Some(rope) = spec.rope {
                rope.rotate(token, to);
            }
        };
    for head in 0..spec.heads {
        let mut keys = vec![0.0; k.tokens * d];
        keys.par_chunks_mut(d.max(1)).enumerate().for_each(|(t, to)| {
            prepare(k, t, head, spec.qk_norm.map(|n| n.1), to);
        });
        let scale = 1.0 / (d as f32).sqrt();
        (0..q.tokens).into_par_iter().with_min_len(16).for_each(|t| {
            let mut query = vec![0.0; d];
            prepare(q, t, head, spec.qk_norm.map(|n| n.0), &mut query);
            query.iter_mut().for_each(|x| *x *= scale);
            // SAFETY: each task writes its own token's part of this head.
            let out = unsafe { out.part(t * width + head * d, d) };
            out.fill(0.0);
            let (mut top, mut total) = (f32::NEG_INFINITY, 0.0);
            for first in (0..k.tokens).step_by(64) {
                let count = 64.min(k.tokens - first);
                let mut scores = [0.0f32; 64];
                for (score, key) in
                    scores.iter_mut().zip(keys[first * d..(first + count) * d].chunks_exact(d))
                {
                    let mut lanes = [0.0f32; 8];
                    for (q, k) in query.chunks(8).zip(key.chunks(8)) {
                        for ((lane, q), k) in lanes.iter_mut().zip(q).zip(k) {
                            *lane += q * k;
                        }
                    }
                    *score = lanes.iter().sum();
                }
                let block_top = scores[..count].iter().copied().fold(top, f32::max);
                let shrink = (top - block_top).exp();
                total *= shrink;
                out.iter_mut().for_each(|o| *o *= shrink);
                top = block_top;
                for (i, score) in scores[..count].iter().enumerate() {
                    let p = (score - top).exp();
                    total += p;
                    let value = &v.token(first + i, width)[head * d..(head + 1) * d];
                    for (o, value) in out.iter_mut().zip(value) {
                        *o += p * value;
                    }
                }
            }
            out.iter_mut().for_each(|o| *o /= total);
        });
    }
}
