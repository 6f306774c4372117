//! Layer normalisation over the last axis: biased variance, affine.

use rayon::prelude::*;

use crate::compute::Compute;
use crate::error::NnError;
use crate::kernels::norm::{NormRef, norm_row};
use crate::kernels::scratch::{self, Role};
use crate::kernels::simd::Simd;
use crate::kernels::{Kernel, dispatch};
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
    /// Constructs a layer from `[features]` vectors. DA3 uses eps 1e-6 in its blocks and 1e-5 elsewhere.
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
    pub fn apply(&self, c: &Compute, x: &[f32], out: &mut [f32]) {
        assert_eq!(x.len(), out.len(), "layer norm: input and output");
        let n = self.features();
        if n == 0 {
            return;
        }
        assert_eq!(x.len() % n, 0, "layer norm: whole rows of {n}");
        x.par_chunks(TASK_ROWS * n).zip(out.par_chunks_mut(TASK_ROWS * n)).for_each(|(x, out)| {
            dispatch(c.isa(), Rows { norm: self.view(), x: Some(x), out });
        });
    }

    /// Normalises each row of `x` (`[rows, features]`) in place.
    ///
    /// # Panics
    /// When the length is no whole number of rows.
    pub fn apply_in_place(&self, c: &Compute, x: &mut [f32]) {
        let n = self.features();
        if n == 0 {
            return;
        }
        assert_eq!(x.len() % n, 0, "layer norm: whole rows of {n}");
        x.par_chunks_mut(TASK_ROWS * n).for_each(|out| {
            dispatch(c.isa(), Rows { norm: self.view(), x: None, out });
        });
    }

    /// The kernels' form.
    pub(crate) fn view(&self) -> NormRef<'_> {
        NormRef { weight: &self.weight, bias: &self.bias, eps: self.eps }
    }
}

/// Some rows; without `x` they are normalised in place.
struct Rows<'a> {
    norm: NormRef<'a>,
    x: Option<&'a [f32]>,
    out: &'a mut [f32],
}

impl Kernel for Rows<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let n = self.norm.weight.len();
        match self.x {
            Some(x) => {
                for (x, out) in x.chunks_exact(n).zip(self.out.chunks_exact_mut(n)) {
                    norm_row(s, self.norm, x, out);
                }
            }
            None => {
                let mut scratch = scratch::borrow(Role::Rows);
                let copy = &mut scratch.floats(n)[..n];
                for out in self.out.chunks_exact_mut(n) {
                    copy.copy_from_slice(out);
                    norm_row(s, self.norm, copy, out);
                }
            }
        }
    }
}
