//! How to compute: the kernel set and the precision of matrix products.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::NnError;

/// How matrix products are computed. Inputs, outputs, accumulators and everything that is no matrix product are `f32`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Factors in `f32`.
    #[default]
    F32,
    /// Factors rounded to bf16 where the processor multiplies bf16; elsewhere `f32`, which is then as fast.
    Bf16,
    /// Weights rounded to f16, activations and arithmetic in `f32`.
    F16,
}

impl Precision {
    /// All precisions, most exact first.
    pub const ALL: [Self; 3] = [Self::F32, Self::F16, Self::Bf16];

    /// The word used in configuration and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = NnError;
    fn from_str(word: &str) -> Result<Self, NnError> {
        Self::ALL.into_iter().find(|p| p.name() == word).ok_or_else(|| NnError::UnknownName {
            what: "precision",
            found: word.to_owned(),
            expected: "f32, f16, bf16",
        })
    }
}

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
        Self::ALL.into_iter().filter(|isa| crate::kernels::is_available(*isa)).collect()
    }

    /// The fastest kernel set of this machine.
    pub fn detect() -> Self {
        let by_speed = [Self::Avx512, Self::Avx2, Self::Neon];
        by_speed.into_iter().find(|isa| crate::kernels::is_available(*isa)).unwrap_or(Self::Portable)
    }
}

impl Isa {
    /// The kernel sets that this process has run since the last call; tests check with it that a chosen set is used
    /// throughout. Recorded in builds with debug assertions only; otherwise empty.
    #[doc(hidden)]
    pub fn take_used() -> Vec<Self> {
        crate::kernels::take_used()
    }

    /// Whether the kernel set multiplies bf16 on this machine; where it does not, bf16 is computed in `f32`.
    pub fn multiplies_bf16(self) -> bool {
        crate::kernels::multiplies_bf16(self)
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

/// Where and how to compute; cheap to copy and given to every operation.
///
/// Operations use the rayon pool they are called in and give the same bits for any number of threads. The kernel set is
/// known to run here: it can only be built through [`Compute::new`] and [`Compute::with_isa`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compute {
    isa: Isa,
    precision: Precision,
}

impl Default for Compute {
    /// The best kernel set of this machine, in `f32`.
    fn default() -> Self {
        Self::new(Precision::F32)
    }
}

impl Compute {
    /// The best kernel set of this machine at the given precision.
    pub fn new(precision: Precision) -> Self {
        Self { isa: Isa::detect(), precision }
    }

    /// A chosen kernel set.
    ///
    /// # Errors
    /// [`NnError::IsaUnavailable`] when it does not run on this machine.
    pub fn with_isa(isa: Isa, precision: Precision) -> Result<Self, NnError> {
        if crate::kernels::is_available(isa) {
            return Ok(Self { isa, precision });
        }
        let names: Vec<&str> = Isa::available().into_iter().map(Isa::name).collect();
        Err(NnError::IsaUnavailable { asked: isa, available: names.join(", ") })
    }

    /// The same kernel set at another precision (the heads of DA3 may be more exact than its backbone).
    #[must_use]
    pub const fn at(self, precision: Precision) -> Self {
        Self { isa: self.isa, precision }
    }

    /// The kernel set.
    pub const fn isa(&self) -> Isa {
        self.isa
    }

    /// The precision of matrix products.
    pub const fn precision(&self) -> Precision {
        self.precision
    }
}
