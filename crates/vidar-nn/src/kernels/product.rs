//! What a matrix product is: its factors and where its sums go.

use super::pack::Columns;
use super::shared::SharedMut;
use super::source::Source;

/// What happens to a sum before it is stored, after the bias.
#[derive(Debug, Clone, Copy)]
pub(crate) enum End<'a> {
    Store,
    Gelu,
    Relu,
    /// `out += gamma * sum`
    Accumulate(Option<&'a [f32]>),
    /// `out = other + sum`, `other` laid out as `out`
    Add(&'a [f32]),
    /// The first half of the columns gates the second: `out = silu(gate) * value`, half as wide.
    SwiGlu,
}

/// Where row m of the product goes: rows come in lines of `line`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OutLayout {
    pub(crate) line: usize,
    pub(crate) line_stride: usize,
    pub(crate) row_stride: usize,
    pub(crate) offset: usize,
}

impl OutLayout {
    /// Dense rows of `width`.
    pub(crate) fn dense(rows: usize, width: usize) -> Self {
        Self { line: rows.max(1), line_stride: rows * width, row_stride: width, offset: 0 }
    }

    pub(super) fn at(&self, row: usize) -> usize {
        self.offset + row / self.line * self.line_stride + row % self.line * self.row_stride
    }
}

/// `out = end(A B + bias)`.
pub(crate) struct Product<'a> {
    pub(crate) source: Source<'a>,
    pub(crate) columns: &'a dyn Columns,
    /// Number of columns of B.
    pub(crate) width: usize,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) end: End<'a>,
    pub(crate) layout: OutLayout,
}

/// Words of packed weights that exist at a time.
pub(crate) const PACKED_WORDS: usize = 1 << 20;

/// Where sums go and what is done with them.
pub(crate) struct Target<'a> {
    pub(crate) width: usize,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) end: End<'a>,
    pub(crate) layout: OutLayout,
    pub(crate) out: SharedMut<'a>,
}
