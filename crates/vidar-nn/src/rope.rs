//! Rotary position embedding over image grids.
//!
//! The first half of a head's channels turns with the row, the second with the column. Within a half of `d` channels,
//! channel j pairs with j + d/2 and turns by `p · base^(-2j/d)`.

/// Cosines and sines for the positions of a sequence; token t uses position t modulo the table's length, so that one view's
/// table serves a sequence of many views.
#[derive(Debug, Clone)]
pub struct RopeTable {
    head_dim: usize,
    tokens: usize,
    /// `[tokens][half][head_dim / 4]`
    cos: Vec<f32>,
    sin: Vec<f32>,
}

impl RopeTable {
    /// A table for positions (row, column), head dimension a multiple of 4, `base` 100 in DA3.
    ///
    /// # Panics
    /// When the head dimension is no multiple of 4 or there is no position.
    pub fn new(positions: &[[f32; 2]], head_dim: usize, base: f32) -> Self {
        assert!(head_dim.is_multiple_of(4) && head_dim > 0, "head dimension {head_dim} is no multiple of 4");
        assert!(!positions.is_empty(), "a rotary table needs positions");
        let quarter = head_dim / 4;
        let frequency: Vec<f32> =
            (0..quarter).map(|j| f64::from(base).powf(-(j as f64) / quarter as f64) as f32).collect();
        let angles = || positions.iter().flatten().flat_map(|p| frequency.iter().map(move |f| p * f));
        let cos = angles().map(f32::cos).collect();
        let sin = angles().map(f32::sin).collect();
        Self { head_dim, tokens: positions.len(), cos, sin }
    }

    /// Channels of a head.
    pub fn head_dim(&self) -> usize {
        self.head_dim
    }

    /// Cosines, `[tokens, 2, head_dim / 4]`.
    pub fn cos(&self) -> &[f32] {
        &self.cos
    }

    /// Sines, laid out as the cosines.
    pub fn sin(&self) -> &[f32] {
        &self.sin
    }

    /// Turns one head of token `token` in place.
    #[inline(always)] // into code that is compiled for a kernel set
    pub fn rotate(&self, token: usize, head: &mut [f32]) {
        debug_assert_eq!(head.len(), self.head_dim);
        let quarter = self.head_dim / 4;
        let at = token % self.tokens * 2 * quarter;
        let cos = self.cos[at..at + 2 * quarter].chunks_exact(quarter);
        let sin = self.sin[at..at + 2 * quarter].chunks_exact(quarter);
        for ((half, cos), sin) in head.chunks_exact_mut(2 * quarter).zip(cos).zip(sin) {
            let (a, b) = half.split_at_mut(quarter);
            for (((a, b), cos), sin) in a.iter_mut().zip(b).zip(cos).zip(sin) {
                (*a, *b) = (*a * cos - *b * sin, *b * cos + *a * sin);
            }
        }
    }
}
