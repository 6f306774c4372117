//! Runs a kernel with the vector instructions of the processor.

/// Calls a method `#[inline(always)]` inside a function that may use AVX2, where the processor has it.
///
/// Rust never fuses or reorders floating-point operations on its own, so both paths give the same bits.
macro_rules! dispatch {
    ($self:ident . $method:ident ( $($arg:expr),* $(,)? )) => {{
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx2") {
                let call = || $self.$method($($arg),*);
                // SAFETY: the processor has AVX2, as checked on the line above.
                unsafe { $crate::simd::with_avx2(call) }
            } else {
                $self.$method($($arg),*)
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            $self.$method($($arg),*)
        }
    }};
}
pub(crate) use dispatch;

/// Runs `kernel`, compiled into this function with AVX2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(crate) fn with_avx2<R>(kernel: impl FnOnce() -> R) -> R {
    kernel()
}
