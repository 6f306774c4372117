//! Kernels: the only place with `unsafe` code.
//!
//! A kernel is written once over [`Simd`] and instantiated for each kernel set: it is a struct that holds its arguments
//! and implements [`Kernel`]; [`dispatch`] runs it inside a function compiled for the processor features of the set.

pub(crate) mod gemm;
pub(crate) mod map;
pub(crate) mod math;
pub(crate) mod shared;
pub(crate) mod simd;

use crate::compute::Isa;
use simd::{Portable, Simd};

/// Work that is compiled once per kernel set. `run` and everything hot that it calls must be `#[inline(always)]`, so that
/// the code ends up inside the function that has the processor features enabled.
pub(crate) trait Kernel {
    type Output;
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Runs a kernel on a kernel set, which must be available (a `Compute` proves it).
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    match isa {
        _ => kernel.run(Portable),
    }
}

/// Whether a kernel set runs on this machine.
pub(crate) fn is_available(isa: Isa) -> bool {
    matches!(isa, Isa::Portable)
}
