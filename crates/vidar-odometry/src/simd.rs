//! Running a kernel with the vector instructions that the machine has.

/// Evaluates an expression of `#[inline(always)]` calls with AVX2 where the processor has it.
///
/// Rust never fuses or reorders floating-point operations on its own, so both paths give the same bits.
macro_rules! dispatch {
    ($kernel:expr) => {{
        #[cfg(target_arch = "x86_64")]
        {
            if $crate::simd::has_avx2() {
                // SAFETY: the processor has AVX2, as checked on the line above.
                unsafe { $crate::simd::with_avx2(|| $kernel) }
            } else {
                $kernel
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            $kernel
        }
    }};
}
pub(crate) use dispatch;

/// Whether the wide path may be taken; tests switch it off to compare bits.
#[cfg(target_arch = "x86_64")]
#[inline]
pub(crate) fn has_avx2() -> bool {
    #[cfg(test)]
    if NARROW.with(std::cell::Cell::get) {
        return false;
    }
    std::arch::is_x86_feature_detected!("avx2")
}

#[cfg(test)]
thread_local! {
    static NARROW: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// Runs `work` on this thread without the wide path.
#[cfg(test)]
pub(crate) fn narrow<R>(work: impl FnOnce() -> R) -> R {
    NARROW.with(|n| n.set(true));
    let result = work();
    NARROW.with(|n| n.set(false));
    result
}

/// Runs `kernel`, compiled into this function with AVX2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(crate) fn with_avx2<R>(kernel: impl FnOnce() -> R) -> R {
    kernel()
}
