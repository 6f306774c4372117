//! Timing in processor seconds of one thread, and the peak rate of a core.

use std::hint::black_box;
use vidar_nn::{Compute, Isa, Precision};

/// Nanoseconds that this thread has run.
pub fn cpu_ns() -> f64 {
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").expect("Linux");
    stat.split_whitespace().next().and_then(|word| word.parse().ok()).expect("nanoseconds first")
}

/// Best and median nanoseconds of a run. The clock ticks every few milliseconds, so runs are timed in batches.
pub fn time(mut work: impl FnMut()) -> (f64, f64) {
    let start = cpu_ns();
    let mut batch = 0;
    while cpu_ns() - start < 50e6 {
        work();
        batch += 1;
    }
    let mut runs: Vec<f64> = (0..11)
        .map(|_| {
            let before = cpu_ns();
            (0..batch).for_each(|_| work());
            (cpu_ns() - before) / f64::from(batch)
        })
        .collect();
    runs.sort_by(f64::total_cmp);
    (runs[0], runs[runs.len() / 2])
}

/// Steps of one measurement of the peak.
const STEPS: usize = 100_000;

/// GFLOP per second of one core that does nothing but multiply and add in registers, as `c` does it; `None` where there is
/// no loop for its kernels.
pub fn peak(c: &Compute) -> Option<f64> {
    let is_bf16 = c.precision() == Precision::Bf16 && c.isa().multiplies_bf16();
    let (work, flops): (fn(), usize) = match (c.isa(), is_bf16) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY (of all three): the kernel set was found to run here.
        (Isa::Avx512, true) => (|| unsafe { x86::dots_of_16() }, 24 * 64),
        #[cfg(target_arch = "x86_64")]
        (Isa::Avx512, false) => (|| unsafe { x86::sums_of_16() }, 24 * 32),
        #[cfg(target_arch = "x86_64")]
        (Isa::Avx2, _) => (|| unsafe { x86::sums_of_8() }, 12 * 16),
        #[cfg(target_arch = "aarch64")]
        // SAFETY: as above.
        (Isa::Neon, _) => (|| unsafe { neon::sums_of_4() }, 24 * 8),
        _ => return None,
    };
    Some((flops * STEPS) as f64 / time(|| black_box(work)()).0)
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{STEPS, black_box};
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx512f")]
    pub fn sums_of_16() {
        let (x, y) = black_box((_mm512_set1_ps(0.999), _mm512_set1_ps(1e-3)));
        let mut sums = [y; 24];
        for _ in 0..STEPS {
            sums.iter_mut().for_each(|s| *s = _mm512_fmadd_ps(*s, x, y));
        }
        black_box(sums);
    }

    #[target_feature(enable = "avx512f,avx512bf16")]
    pub fn dots_of_16() {
        let x = black_box(_mm512_cvtne2ps_pbh(_mm512_set1_ps(0.01), _mm512_set1_ps(0.02)));
        let mut sums = [_mm512_set1_ps(0.0); 24];
        for _ in 0..STEPS {
            sums.iter_mut().for_each(|s| *s = _mm512_dpbf16_ps(*s, x, x));
        }
        black_box(sums);
    }

    #[target_feature(enable = "avx2,fma")]
    pub fn sums_of_8() {
        let (x, y) = black_box((_mm256_set1_ps(0.999), _mm256_set1_ps(1e-3)));
        let mut sums = [y; 12];
        for _ in 0..STEPS {
            sums.iter_mut().for_each(|s| *s = _mm256_fmadd_ps(*s, x, y));
        }
        black_box(sums);
    }
}

#[cfg(target_arch = "aarch64")]
mod neon {
    use super::{STEPS, black_box};
    use std::arch::aarch64::*;

    #[target_feature(enable = "neon")]
    pub fn sums_of_4() {
        let (x, y) = black_box((vdupq_n_f32(0.999), vdupq_n_f32(1e-3)));
        let mut sums = [y; 24];
        for _ in 0..STEPS {
            sums.iter_mut().for_each(|s| *s = vfmaq_f32(y, *s, x));
        }
        black_box(sums);
    }
}
