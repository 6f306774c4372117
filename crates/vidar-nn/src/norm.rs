//! Layer normalisation over the last axis: biased variance, affine.

use rayon::prelude::*;

use crate::error::NnError;
use crate::linear::{vector, wrong_shape};
use crate::weight::Weight;

/// `y = (x - mean) / sqrt(var + eps) * weight + bias` over rows of `features` numbers.
#[derive(Debug, Clone)]
pub struct LayerNorm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    eps: f32,
}

/// Rows of one task.
const TASK_ROWS: usize = 32;

impl LayerNorm {
    /// Puts a layer together from `[features]` vectors. DA3 uses eps 1e-6 in its blocks and 1e-5 elsewhere.
    ///
    /// # Errors
    /// [`NnError::WeightShape`] when the shapes do not fit.
    pub fn new(weight: Weight, bias: Weight, eps: f32) -> Result<Self, NnError> {
        let &[features] = weight.shape() else {
            return Err(wrong_shape("layer norm", &weight, "[features]"));
        };
        let Some(bias) = vector("layer norm", Some(bias), features)? else {
            return Ok(Self::identity(features, eps));
        };
        Ok(Self { weight: weight.to_f32(), bias, eps })
    }

    fn identity(features: usize, eps: f32) -> Self {
        Self { weight: vec![1.0; features], bias: vec![0.0; features], eps }
    }

    /// Length of a row.
    pub fn features(&self) -> usize {
        self.weight.len()
    }

    /// The factors.
    pub fn weight(&self) -> &[f32] {
        &self.weight
    }

    /// The offsets.
    pub fn bias(&self) -> &[f32] {
        &self.bias
    }

    /// The number added to the variance.
    pub fn eps(&self) -> f32 {
        self.eps
    }

    /// Normalises each row of `x` (`[rows, features]`) into `out`.
    ///
    /// # Panics
    /// When the lengths differ or are no whole number of rows.
    pub fn apply(&self, x: &[f32], out: &mut [f32]) {
        assert_eq!(x.len(), out.len(), "layer norm: input and output");
        out.copy_from_slice(x);
        self.apply_in_place(out);
    }

    /// Normalises each row of `x` (`[rows, features]`) where it stands.
    ///
    /// # Panics
    /// When the length is no whole number of rows.
    pub fn apply_in_place(&self, x: &mut [f32]) {
        let n = self.features();
        if n == 0 {
            return;
        }
        assert_eq!(x.len() % n, 0, "layer norm: whole rows of {n}");
        x.par_chunks_mut(TASK_ROWS * n)
            .for_each(|rows| rows.chunks_exact_mut(n).for_each(|row| self.row(row)));
    }

    /// Normalises one row.
    pub(crate) fn row(&self, row: &mut [f32]) {
        let n = row.len() as f32;
        let mean = lane_sum(row, |x| x) / n;
        let variance = lane_sum(row, |x| (x - mean) * (x - mean)) / n;
        let scale = 1.0 / (variance + self.eps).sqrt();
        for ((x, w), b) in row.iter_mut().zip(&self.weight).zip(&self.bias) {
            *x = (*x - mean) * scale * w + b;
        }
    }
}

/// Sum in sixteen interleaved parts, so that it vectorises and loses little.
fn lane_sum(row: &[f32], f: impl Fn(f32) -> f32) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (chunks, rest) = row.as_chunks::<16>();
    for chunk in chunks {
        for (lane, x) in lanes.iter_mut().zip(chunk) {
            *lane += f(*x);
        }
    }
    for (lane, x) in lanes.iter_mut().zip(rest) {
        *lane += f(*x);
    }
    lanes.iter().sum()
}
