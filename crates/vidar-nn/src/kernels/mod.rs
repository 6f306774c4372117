//! Kernels: the only place with `unsafe` code.
//!
//! A kernel is written once over [`Simd`] (or, for products, over [`Multiply`]) and instantiated for each kernel set: it is
//! a struct that holds its arguments and implements [`Kernel`] or [`ProductKernel`]; [`dispatch`] and [`dispatch_product`]
//! run it inside a function compiled for the processor features of the set.

pub(crate) mod attend;
pub(crate) mod centre;
pub(crate) mod gemm;
pub(crate) mod head;
pub(crate) mod map;
pub(crate) mod math;
#[cfg(target_arch = "aarch64")]
mod neon;
pub(crate) mod norm;
pub(crate) mod pack;
pub(crate) mod product;
pub(crate) mod resample;
pub(crate) mod scratch;
pub(crate) mod shape;
pub(crate) mod shared;
pub(crate) mod simd;
pub(crate) mod source;
pub(crate) mod tile;
pub(crate) mod winograd;
#[cfg(target_arch = "x86_64")]
mod x86;

use crate::compute::{Compute, Precision};
use crate::isa::Isa;
use simd::{Portable, Simd};
use tile::{InBf16, InF32, Multiply};

/// Work that is compiled once per kernel set. `run` and everything hot that it calls must be `#[inline(always)]`, so that
/// the code ends up inside the function that has the processor features enabled.
pub(crate) trait Kernel {
    type Output;
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Work that is compiled once per kernel set and number format of factors.
pub(crate) trait ProductKernel {
    type Output;
    fn run<M: Multiply>(self, multiply: M) -> Self::Output;
}

/// The number format of the factors of a product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Factors {
    F32,
    Bf16,
}

impl Factors {
    /// What a kernel set does for a precision: bf16 only where the processor multiplies it (elsewhere `f32` is as fast).
    pub(crate) fn of(c: &Compute) -> Self {
        match c.precision() {
            Precision::Bf16 if c.isa().multiplies_bf16() => Self::Bf16,
            _ => Self::F32,
        }
    }
}

/// Runs a kernel on a kernel set, which must be available (a `Compute` proves it).
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    isa.record();
    match isa {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a kernel set reaches this point only after `Isa::is_available`.
        Isa::Avx2 => unsafe { in_avx2(kernel) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Isa::Avx512 => unsafe { in_avx512(kernel) },
        #[cfg(target_arch = "aarch64")]
        // SAFETY: as above.
        Isa::Neon => unsafe { in_neon(kernel) },
        _ => kernel.run(Portable),
    }
}

/// Runs a kernel on a kernel set, which must be available, with factors in a number format.
pub(crate) fn dispatch_product<K: ProductKernel>(isa: Isa, factors: Factors, kernel: K) -> K::Output {
    isa.record();
    match (isa, factors) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: bf16 is checked here, the rest before a kernel set reaches this point.
        (Isa::Avx512, Factors::Bf16) if isa.multiplies_bf16() => unsafe { in_avx512_bf16(kernel) },
        (_, Factors::Bf16) => kernel.run(InBf16(Portable)),
        (_, Factors::F32) => dispatch(isa, F32Product(kernel)),
    }
}

struct F32Product<K>(K);

impl<K: ProductKernel> Kernel for F32Product<K> {
    type Output = K::Output;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> K::Output {
        self.0.run(InF32(simd))
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn in_avx2<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function's own condition.
    kernel.run(unsafe { x86::Avx2::new() })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
unsafe fn in_avx512<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function's own condition.
    kernel.run(unsafe { x86::Avx512::<false>::new() })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx2,fma")]
unsafe fn in_avx512_bf16<K: ProductKernel>(kernel: K) -> K::Output {
    // SAFETY: this function's own condition.
    kernel.run(InBf16(unsafe { x86::Avx512::<true>::new() }))
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
unsafe fn in_neon<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function's own condition.
    kernel.run(unsafe { neon::Neon::new() })
}
