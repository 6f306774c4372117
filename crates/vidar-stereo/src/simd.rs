//! Running a kernel with the vector instructions of the processor.
//!
//! Kernels are plain loops over rows, marked `#[inline(always)]` and compiled once for each instruction set. Rust never
//! fuses or reorders floating-point operations on its own, so all of them give the same bits.

/// Instruction sets that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "only the portable one is reached there"))]
pub(crate) enum Instructions {
    /// What the program was built for.
    Portable,
    Avx2,
    Avx512,
}

/// Evaluates an expression of `#[inline(always)]` calls with the widest instructions that the processor has.
macro_rules! dispatch {
    ($kernel:expr) => {{
        #[cfg(target_arch = "x86_64")]
        match $crate::simd::available() {
            // SAFETY: `available` found the instructions on this processor.
            $crate::simd::Instructions::Avx512 => unsafe { $crate::simd::with_avx512(|| $kernel) },
            // SAFETY: as above.
            $crate::simd::Instructions::Avx2 => unsafe { $crate::simd::with_avx2(|| $kernel) },
            $crate::simd::Instructions::Portable => $kernel,
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            $kernel
        }
    }};
}
pub(crate) use dispatch;

/// Defines a function whose body is compiled for each instruction set. [`dispatch`] leaves it to the compiler whether a large kernel is
/// compiled into the function that has the instructions; where it is not, it gets those of the portable one (the matching costs did).
macro_rules! for_each_instruction_set {
    ($(#[$meta:meta])* fn $name:ident($($arg:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        fn $name($($arg: $type),*) {
            #[inline(always)]
            fn kernel($($arg: $type),*) $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
            fn avx512($($arg: $type),*) { kernel($($arg),*) }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($arg: $type),*) { kernel($($arg),*) }
            #[cfg(target_arch = "x86_64")]
            match $crate::simd::available() {
                // SAFETY: `available` found the instructions on this processor.
                $crate::simd::Instructions::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                $crate::simd::Instructions::Avx2 => unsafe { avx2($($arg),*) },
                $crate::simd::Instructions::Portable => kernel($($arg),*),
            }
            #[cfg(not(target_arch = "x86_64"))]
            kernel($($arg),*);
        }
    };
}
pub(crate) use for_each_instruction_set;

/// The widest instructions of this processor; tests may ask for less.
#[cfg(target_arch = "x86_64")]
pub(crate) fn available() -> Instructions {
    use std::arch::is_x86_feature_detected as has;
    let found = if has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl") {
        Instructions::Avx512
    } else if has!("avx2") {
        Instructions::Avx2
    } else {
        Instructions::Portable
    };
    #[cfg(test)]
    let found = found.min(tests::limit());
    found
}

/// Runs `kernel`, compiled into this function with AVX-512.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2")]
pub(crate) fn with_avx512<R>(kernel: impl FnOnce() -> R) -> R {
    kernel()
}

/// Runs `kernel`, compiled into this function with AVX2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(crate) fn with_avx2<R>(kernel: impl FnOnce() -> R) -> R {
    kernel()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::Instructions;
    use std::cell::Cell;

    thread_local! {
        static LIMIT: Cell<Instructions> = const { Cell::new(Instructions::Avx512) };
    }

    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "one path only"))]
    pub(crate) fn limit() -> Instructions {
        LIMIT.with(Cell::get)
    }

    /// Results of `work` on one thread, with each instruction set that this processor has, the portable one first.
    pub(crate) fn with_each<R: Send>(work: impl Fn() -> R + Sync) -> Vec<(Instructions, R)> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
        let mut results = Vec::new();
        for limit in [Instructions::Portable, Instructions::Avx2, Instructions::Avx512] {
            let run = || {
                LIMIT.with(|l| l.set(limit));
                #[cfg(target_arch = "x86_64")]
                if super::available() != limit {
                    return None;
                }
                Some(work())
            };
            results.extend(pool.install(run).map(|r| (limit, r)));
        }
        results
    }
}
