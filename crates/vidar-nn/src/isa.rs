//! Kernel sets, and which of them this machine has.

use crate::error::NnError;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicU8, Ordering};

/// One bit per kernel set that has run.
static USED: AtomicU8 = AtomicU8::new(0);

/// A set of kernels. [`Isa::detect`] gives the best one here; the others can be forced for tests and comparisons.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Isa {
    /// Plain Rust that the compiler vectorises for the baseline of the target.
    Portable,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 (F, BW, DQ, VL); bf16 products where the processor also has AVX-512-BF16.
    Avx512,
    /// 64-bit ARM.
    Neon,
}

impl Isa {
    /// All kernel sets, whether they run here or not.
    pub const ALL: [Self; 4] = [Self::Portable, Self::Avx2, Self::Avx512, Self::Neon];

    /// The word used in configuration and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Neon => "neon",
        }
    }

    /// The kernel sets that run on this machine; never empty.
    pub fn available() -> Vec<Self> {
        Self::ALL.into_iter().filter(|isa| isa.is_available()).collect()
    }

    /// The fastest kernel set of this machine.
    pub fn detect() -> Self {
        let by_speed = [Self::Avx512, Self::Avx2, Self::Neon];
        by_speed.into_iter().find(|isa| isa.is_available()).unwrap_or(Self::Portable)
    }
}

impl Isa {
    /// The kernel sets that this process has run since the last call; tests check with it that a chosen set is used
    /// throughout. Recorded in builds with debug assertions only; otherwise empty.
    #[doc(hidden)]
    pub fn take_used() -> Vec<Self> {
        let used = USED.swap(0, Ordering::Relaxed);
        Self::ALL.into_iter().filter(|isa| used >> *isa as u8 & 1 == 1).collect()
    }

    /// Whether the kernel set multiplies bf16 on this machine; where it does not, bf16 is computed in `f32`.
    pub fn multiplies_bf16(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => is_x86_feature_detected!("avx512bf16"),
            _ => false,
        }
    }

    /// Whether the kernel set runs on this machine.
    pub(crate) fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("fma")
            }
            #[cfg(target_arch = "aarch64")]
            Self::Neon => std::arch::is_aarch64_feature_detected!("neon"),
            _ => false,
        }
    }

    /// Records that the kernel set is run, in builds with debug assertions.
    #[inline(always)]
    pub(crate) fn record(self) {
        if cfg!(debug_assertions) {
            USED.fetch_or(1 << self as u8, Ordering::Relaxed);
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Isa {
    type Err = NnError;
    fn from_str(word: &str) -> Result<Self, NnError> {
        Self::ALL.into_iter().find(|isa| isa.name() == word).ok_or_else(|| NnError::UnknownName {
            what: "kernel set",
            found: word.to_owned(),
            expected: "portable, avx2, avx512, neon",
        })
    }
}
