//! Functions of single numbers, over slices.

use rayon::prelude::*;

use crate::compute::Compute;
use crate::kernels::simd::Simd;
use crate::kernels::{Kernel, dispatch, math};

/// Numbers of one task; also the unit of vectorised work, so results do not depend on the number of threads.
const TASK: usize = 16 * 1024;

#[derive(Debug, Clone, Copy)]
enum Function {
    Gelu,
    Relu,
    Exp,
    Silu,
}

struct Map<'a> {
    x: &'a mut [f32],
    function: Function,
}

impl Kernel for Map<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        for x in self.x.chunks_mut(S::LANES) {
            let v = s.load_part(x);
            let v = match self.function {
                Function::Gelu => math::gelu(s, v),
                Function::Relu => math::relu(s, v),
                Function::Exp => math::exp(s, v),
                Function::Silu => math::silu(s, v),
            };
            s.store_part(x, v);
        }
    }
}

fn map(c: &Compute, x: &mut [f32], function: Function) {
    x.par_chunks_mut(TASK).for_each(|x| dispatch(c.isa(), Map { x, function }));
}

/// GELU in its exact form, x Φ(x), in place.
pub fn gelu(c: &Compute, x: &mut [f32]) {
    map(c, x, Function::Gelu);
}

/// max(x, 0) in place; NaN stays NaN.
pub fn relu(c: &Compute, x: &mut [f32]) {
    map(c, x, Function::Relu);
}

/// e^x in place.
pub fn exp(c: &Compute, x: &mut [f32]) {
    map(c, x, Function::Exp);
}

/// x / (1 + e^-x) in place.
pub fn silu(c: &Compute, x: &mut [f32]) {
    map(c, x, Function::Silu);
}

/// Softmax of each row of `row` numbers, in place.
///
/// # Panics
/// When the length is no whole number of rows.
pub fn softmax(c: &Compute, x: &mut [f32], row: usize) {
    if x.is_empty() {
        return;
    }
    assert!(row > 0 && x.len().is_multiple_of(row), "softmax: whole rows of {row}");
    x.par_chunks_mut(row).for_each(|x| {
        let top = x.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        x.iter_mut().for_each(|x| *x -= top);
        dispatch(c.isa(), Map { x, function: Function::Exp });
        let total = x.iter().map(|x| f64::from(*x)).sum::<f64>() as f32;
        x.iter_mut().for_each(|x| *x /= total);
    });
}
