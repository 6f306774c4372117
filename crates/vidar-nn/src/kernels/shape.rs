//! The shape of packed weights, which depends on the kernel set.

use super::ProductKernel;
use super::simd::Simd;
use super::source::Inner;
use super::tile::Multiply;

/// Asks for the shape of panels.
pub(crate) struct ShapeOf {
    pub(crate) inner: Inner,
}

/// Columns of a panel, and words of a column.
pub(crate) struct Shape {
    pub(crate) panel: usize,
    pub(crate) words: usize,
}

impl ProductKernel for ShapeOf {
    type Output = Shape;
    fn run<M: Multiply>(self, _: M) -> Shape {
        Shape { panel: 2 * M::Simd::LANES, words: self.inner.words::<M>() }
    }
}
