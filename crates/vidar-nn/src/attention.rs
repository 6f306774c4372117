//! Multi-head attention, computed block by block: memory grows with the number of tokens, not with its square.

use std::ops::Range;

use crate::compute::Compute;
use crate::isa::Isa;
use crate::kernels::attend::{
    Attend, BLOCK, HeadLayout, LayoutOf, PackKeys, Prepare, QUERIES, Tokens, for_each_part,
};
use crate::kernels::scratch::{self, Role, Scratch};
use crate::kernels::shared::SharedMut;
use crate::kernels::{Factors, dispatch_product};
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

    fn check(&self) {
        let d = self.head_dim;
        if let Some((q, k)) = self.qk_norm {
            assert!(q.features() == d && k.features() == d, "attention: norms over {d} channels");
        }
        if let Some(rope) = self.rope {
            assert_eq!(rope.head_dim(), d, "attention: rotation of {d} channels");
        }
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

    fn kernel(self) -> Tokens<'a> {
        Tokens { data: self.data, stride: self.stride }
    }
}

/// Packed keys and values of one sequence, all heads: what queries meet. A sequence of many views can be pushed view by
/// view, so that only this packed form of all views exists at a time (in bf16, 4 bytes per token and channel).
#[derive(Debug)]
pub struct KeyValues {
    words: Scratch,
    layout: HeadLayout,
    heads: usize,
    tokens: usize,
    isa: Isa,
    factors: Factors,
}

impl KeyValues {
    /// Room for `capacity` tokens.
    pub fn new(c: &Compute, spec: &AttentionSpec<'_>, capacity: usize) -> Self {
        let (isa, factors) = (c.isa(), Factors::of(c));
        let layout = dispatch_product(isa, factors, LayoutOf { d: spec.head_dim, keys: capacity });
        Self {
            words: Scratch::with_words(layout.words() * spec.heads),
            layout,
            heads: spec.heads,
            tokens: 0,
            isa,
            factors,
        }
    }

    /// Tokens pushed so far.
    pub fn tokens(&self) -> usize {
        self.tokens
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.words.bytes()
    }

    /// Appends the keys (normalised and rotated as `spec` says) and values of some tokens, whose rotation counts from the
    /// first of them.
    ///
    /// # Panics
    /// When there is no room, the numbers of keys and values differ, a slice is too short, or `spec` has other heads.
    pub fn push(&mut self, spec: &AttentionSpec<'_>, k: TokenRows<'_>, v: TokenRows<'_>) {
        assert_eq!((spec.heads, spec.head_dim), (self.heads, self.layout.d), "keys of other heads");
        assert!(self.tokens + k.tokens <= self.layout.capacity, "{} + {} keys", self.tokens, k.tokens);
        let words = SharedMut::new(self.words.floats(self.layout.words() * self.heads));
        push(self.isa, self.factors, spec, 0..self.heads, [k, v], self.layout, words, self.tokens);
        self.tokens += k.tokens;
    }

    /// Attention of some queries to all tokens pushed so far; `out` is `[q.tokens, heads, head_dim]`. Queries' rotation counts
    /// from the first of them.
    ///
    /// # Panics
    /// When a slice has another length, nothing was pushed, or `spec` has other heads.
    pub fn attend(&self, spec: &AttentionSpec<'_>, q: TokenRows<'_>, out: &mut [f32]) {
        assert_eq!((spec.heads, spec.head_dim), (self.heads, self.layout.d), "queries of other heads");
        assert_eq!(out.len(), q.tokens * spec.width(), "attention: output");
        assert!(self.tokens > 0 || q.tokens == 0, "attention to no keys");
        let words = self.words.filled();
        let out = SharedMut::new(out);
        attend(self.isa, self.factors, spec, 0..self.heads, q, (self.layout, words, self.tokens), out);
    }
}

/// Words of packed keys and values that exist at a time when a whole sequence is at hand: more heads are packed at once
/// for short sequences.
const PACKED_WORDS: usize = 2 << 20;

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
    c: &Compute,
    q: TokenRows<'_>,
    k: TokenRows<'_>,
    v: TokenRows<'_>,
    spec: &AttentionSpec<'_>,
    out: &mut [f32],
) {
    assert_eq!(out.len(), q.tokens * spec.width(), "attention: output");
    if out.is_empty() {
        return;
    }
    assert!(k.tokens > 0, "attention to no keys");
    let (isa, factors) = (c.isa(), Factors::of(c));
    let layout = dispatch_product(isa, factors, LayoutOf { d: spec.head_dim, keys: k.tokens });
    let at_once = (PACKED_WORDS / layout.words().max(1)).clamp(1, spec.heads);
    let out = SharedMut::new(out);
    let mut packed = scratch::borrow(Role::Keys);
    for first in (0..spec.heads).step_by(at_once) {
        let heads = first..(first + at_once).min(spec.heads);
        let packed = &mut packed.words(layout.words() * heads.len())[..layout.words() * heads.len()];
        let words = SharedMut::new(scratch::as_floats_mut(packed));
        push(isa, factors, spec, heads.clone(), [k, v], layout, words, 0);
        attend(isa, factors, spec, heads, q, (layout, packed, k.tokens), out);
    }
}

/// Packs keys and values of some heads, one after the other in `words`, behind `before` keys already there.
#[allow(clippy::too_many_arguments)] // two callers, both above
fn push(
    isa: Isa,
    factors: Factors,
    spec: &AttentionSpec<'_>,
    heads: Range<usize>,
    [k, v]: [TokenRows<'_>; 2],
    layout: HeadLayout,
    words: SharedMut<'_>,
    before: usize,
) {
    spec.check();
    assert_eq!(k.tokens, v.tokens, "attention: keys and values");
    if k.tokens == 0 {
        return;
    }
    let blocks = before / BLOCK..(before + k.tokens).div_ceil(BLOCK);
    let prepare = Prepare { norm: spec.qk_norm.map(|n| n.1.view()), rope: spec.rope };
    for_each_part(heads.len(), blocks.len(), |head, block| {
        let block = blocks.start + block;
        let first = before.max(block * BLOCK);
        let count = ((block + 1) * BLOCK).min(before + k.tokens) - first;
        let pack = PackKeys {
            layout,
            words,
            base: head * layout.words(),
            k: k.kernel(),
            v: v.kernel(),
            prepare,
            channel: (heads.start + head) * spec.head_dim,
            first,
            token: first - before,
            count,
        };
        dispatch_product(isa, factors, pack);
    });
}

/// Takes queries of some heads through packed keys.
fn attend(
    isa: Isa,
    factors: Factors,
    spec: &AttentionSpec<'_>,
    heads: Range<usize>,
    q: TokenRows<'_>,
    (layout, words, keys): (HeadLayout, &[u32], usize),
    out: SharedMut<'_>,
) {
    spec.check();
    let prepare = Prepare { norm: spec.qk_norm.map(|n| n.0.view()), rope: spec.rope };
    for_each_part(heads.len(), q.tokens.div_ceil(QUERIES), |head, part| {
        let first = part * QUERIES;
        let task = Attend {
            layout,
            words: &words[head * layout.words()..(head + 1) * layout.words()],
            keys,
            q: q.kernel(),
            prepare,
            channel: (heads.start + head) * spec.head_dim,
            first,
            count: QUERIES.min(q.tokens - first),
            out,
            out_stride: spec.width(),
        };
        dispatch_product(isa, factors, task);
    });
}
