//! Kernels compiled for the vector instructions of the processor.
//!
//! A kernel consists of plain loops in functions marked `#[inline(always)]`; [`kernel`] compiles them once for each instruction set and
//! calls the widest one that the processor has. Rust never fuses or reorders floating-point operations on its own, so all of them give the
//! same bits.
//!
//! What a kernel calls must be `#[inline(always)]`, too, and not a closure: the compiler may leave a closure a function of its own, which then
//! has the portable instructions only. Those given to `array::from_fn` and `array::map` did that in the detection of corners, which took
//! four times as long.

use std::cell::Cell;

/// Instruction sets that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Instructions {
    /// What the program was built for.
    Portable,
    /// x86-64 with vectors of 256 bits.
    Avx2,
    /// x86-64 with vectors of 512 bits (F, BW, DQ and VL).
    Avx512,
}

/// Defines a function whose body is compiled for each instruction set.
///
/// The body is a call of a function or method `#[inline(always)]`, or short. What needs a `self` gets it as its first argument by another name.
/// `up to Avx2;` before the function leaves AVX-512 out, for what is slower with it.
#[macro_export]
macro_rules! kernel {
    (
        up to Avx2;
        $(#[$meta:meta])* $visibility:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $out:ty)? $body:block
    ) => {
        $(#[$meta])*
        $visibility fn $name($($arg: $type),*) $(-> $out)? {
            #[inline(always)]
            fn portable($($arg: $type),*) $(-> $out)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($arg: $type),*) $(-> $out)? { portable($($arg),*) }
            #[cfg(target_arch = "x86_64")]
            if $crate::simd::available() >= $crate::simd::Instructions::Avx2 {
                // SAFETY: `available` found the instructions on this processor.
                return unsafe { avx2($($arg),*) };
            }
            portable($($arg),*)
        }
    };
    (
        $(#[$meta:meta])* $visibility:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $out:ty)? $body:block
    ) => {
        $(#[$meta])*
        $visibility fn $name($($arg: $type),*) $(-> $out)? {
            #[inline(always)]
            fn portable($($arg: $type),*) $(-> $out)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            fn avx512($($arg: $type),*) $(-> $out)? { portable($($arg),*) }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($arg: $type),*) $(-> $out)? { portable($($arg),*) }
            #[cfg(target_arch = "x86_64")]
            match $crate::simd::available() {
                // SAFETY: `available` found the instructions on this processor.
                $crate::simd::Instructions::Avx512 => return unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                $crate::simd::Instructions::Avx2 => return unsafe { avx2($($arg),*) },
                $crate::simd::Instructions::Portable => {}
            }
            portable($($arg),*)
        }
    };
}
pub use crate::kernel;

thread_local! {
    static LIMIT: Cell<Instructions> = const { Cell::new(Instructions::Avx512) };
}

/// The widest instructions of this processor; tests may [ask for less](crate::testing::with_each_instruction_set).
#[inline]
pub fn available() -> Instructions {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        let found = if has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl") {
            Instructions::Avx512
        } else if has!("avx2") {
            Instructions::Avx2
        } else {
            Instructions::Portable
        };
        found.min(LIMIT.get())
    }
    #[cfg(not(target_arch = "x86_64"))]
    Instructions::Portable
}

/// Lets this thread use no wider instructions than these.
pub(crate) fn limit(instructions: Instructions) {
    LIMIT.set(instructions);
}

#[cfg(test)]
mod tests {
    use super::*;

    kernel! {
        fn sums(a: &[f32], b: &[f32], out: &mut [f32]) -> Instructions {
            for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
                *out = a * 3.0 + b / 7.0;
            }
            available()
        }
    }

    #[test]
    fn each_instruction_set_gives_the_same_bits_and_is_the_one_asked_for() {
        let a: Vec<f32> = (0..101).map(|k| (k as f32).sin()).collect();
        let b: Vec<f32> = (0..101).map(|k| (k as f32).cos()).collect();
        let runs = crate::testing::with_each_instruction_set(|| {
            let mut out = vec![0.0; a.len()];
            (sums(&a, &b, &mut out), out.iter().map(|v| v.to_bits()).collect::<Vec<u32>>())
        });
        assert_eq!(runs[0].0, Instructions::Portable);
        for (asked, (used, bits)) in &runs {
            assert!(asked == used && *bits == runs[0].1.1, "{asked:?}");
        }
    }
}
