//! How to compute: the kernel set and the precision of matrix products.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::NnError;
use crate::isa::Isa;

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
        if isa.is_available() {
            return Ok(Self { isa, precision });
        }
        let names: Vec<&str> = Isa::available().into_iter().map(Isa::name).collect();
        Err(NnError::IsaUnavailable { asked: isa.name(), available: names.join(", ") })
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
