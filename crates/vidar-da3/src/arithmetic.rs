//! Number formats of a model.
//!
//! bf16 keeps eight bits, so every rounded factor is off by up to 0.4 %. The effect on depth depends on the layer: errors of
//! the patch embedding and of the first blocks grow through all later ones, errors of the dense head reach the output
//! directly, and errors of the later blocks average out. A bf16 backbone therefore keeps its patch embedding and its first
//! third of blocks (of forty: half, attention included) in `f32`, and its heads too (the official code also excludes the head
//! from `autocast`). The residual stream, norms, softmax and all sums are `f32` in every
//! precision. Depth is then within two hundredths of its standard deviation at every pixel of every reference,
//! where bf16 throughout (as the official code has its backbone) reaches four to eight; a third of the local
//! blocks' products cost twice the time of the others.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use vidar_nn::{Compute, Isa, NnError};

/// Precision of a model's matrix products.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// `bf16` where the processor multiplies it, `f32` elsewhere: the fastest that keeps depth within two hundredths of
    /// its standard deviation. [`Arithmetic`] reports which of the two is used.
    #[default]
    Auto,
    /// Everything in `f32`: the reference.
    F32,
    /// Backbone in bf16 but for its leading blocks, heads in `f32`. A processor that does not multiply bf16 computes it in
    /// `f32`, which is then as fast.
    Bf16,
    /// Weights rounded to f16, arithmetic in `f32`.
    F16,
}

impl Precision {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Auto, Self::F32, Self::Bf16, Self::F16];

    /// The word used in configuration and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
        }
    }

    /// The format in which a kernel set computes it.
    fn on(self, isa: Isa) -> vidar_nn::Precision {
        match self {
            Self::Auto | Self::Bf16 if isa.multiplies_bf16() => vidar_nn::Precision::Bf16,
            Self::Auto | Self::Bf16 | Self::F32 => vidar_nn::Precision::F32,
            Self::F16 => vidar_nn::Precision::F16,
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
            expected: "auto, f32, bf16, f16",
        })
    }
}

/// Kernels and precisions of an open model: the requested precision, resolved for this machine. Its text stands in manifests
/// and reports: `bf16 (patch embedding, leading blocks and heads f32) on avx512`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Arithmetic {
    /// The kernels.
    pub isa: Isa,
    /// Matrix products of the backbone.
    pub backbone: vidar_nn::Precision,
    /// Matrix products of the dense heads.
    pub head: vidar_nn::Precision,
    /// Leading blocks in `f32` under a bf16 backbone; `None` is the first third, or all but the last twenty where those are
    /// more.
    pub exact_blocks: Option<usize>,
    /// Whether backbone and heads are on a graphics processor, where this is how weights are stored: sums and activations
    /// are `f32` there.
    pub on_device: bool,
}

impl Arithmetic {
    /// Resolves the requested precisions for a kernel set.
    pub(crate) fn resolve(
        precision: Precision,
        head: Option<Precision>,
        isa: Isa,
        exact_blocks: Option<usize>,
    ) -> Self {
        let backbone = precision.on(isa);
        let own = if backbone == vidar_nn::Precision::Bf16 { Precision::F32 } else { precision };
        Self { isa, backbone, head: head.unwrap_or(own).on(isa), exact_blocks, on_device: false }
    }

    /// As [`Arithmetic::resolve`], for a graphics processor, which has all formats.
    pub(crate) fn on_device(
        precision: Precision,
        head: Option<Precision>,
        isa: Isa,
        exact_blocks: Option<usize>,
    ) -> Self {
        let stored = |precision| match precision {
            Precision::Auto | Precision::Bf16 => vidar_nn::Precision::Bf16,
            Precision::F32 => vidar_nn::Precision::F32,
            Precision::F16 => vidar_nn::Precision::F16,
        };
        let head = head.map_or(vidar_nn::Precision::F32, stored);
        Self { isa, backbone: stored(precision), head, exact_blocks, on_device: true }
    }

    /// Whether everything has the accuracy of `f32`.
    pub(crate) fn is_exact(&self) -> bool {
        is_exact(self.backbone) && is_exact(self.head)
    }

    /// Whether the largest error of depth is bounded, not only its mean square: heads and leading blocks are exact.
    pub(crate) fn bounds_largest_error(&self) -> bool {
        let is_rounded_late = self.backbone == vidar_nn::Precision::Bf16 && self.exact_blocks.is_none();
        is_exact(self.head) && (is_exact(self.backbone) || is_rounded_late)
    }
}

fn is_exact(precision: vidar_nn::Precision) -> bool {
    precision == vidar_nn::Precision::F32
}

impl fmt::Display for Arithmetic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { backbone, head, exact_blocks, .. } = self;
        let place = if self.on_device { "gpu" } else { self.isa.name() };
        if *backbone != vidar_nn::Precision::Bf16 {
            write!(f, "{backbone}")?;
            return if head == backbone {
                write!(f, " on {place}")
            } else {
                write!(f, " (heads {head}) on {place}")
            };
        }
        let leading = match exact_blocks {
            None => "patch embedding, leading blocks".to_owned(),
            Some(0) => String::new(),
            Some(1) => "patch embedding, first block".to_owned(),
            Some(n) => format!("patch embedding, first {n} blocks"),
        };
        match (leading.as_str(), *head) {
            ("", vidar_nn::Precision::Bf16) => write!(f, "bf16 on {place}"),
            ("", head) => write!(f, "bf16 (heads {head}) on {place}"),
            (leading, vidar_nn::Precision::F32) => write!(f, "bf16 ({leading} and heads f32) on {place}"),
            (leading, head) => write!(f, "bf16 ({leading} f32; heads {head}) on {place}"),
        }
    }
}

/// Most consecutive blocks in bf16: their errors add up. With 27 of 40 rounded, depth was off by up to 0.022
/// of its deviation on GIANT's references and 0.019 on NESTED's; with 20, by 0.017 and 0.020 with attention in bf16 everywhere,
/// by 0.007 and 0.005 with the exact blocks' attention exact too.
const MOST_ROUNDED: usize = 20;

/// Whether a backbone is so deep that bf16 attention in its exact blocks would affect depth.
pub(crate) fn is_deep(depth: usize) -> bool {
    depth / 3 < depth.saturating_sub(MOST_ROUNDED)
}

/// Leading blocks of a backbone of `depth` blocks that are computed in `f32`, and whether the patch embedding is.
pub(crate) fn exact_blocks(asked: Option<usize>, depth: usize) -> usize {
    asked.unwrap_or((depth / 3).max(depth.saturating_sub(MOST_ROUNDED))).min(depth)
}

/// Kernels and precision of the exact part of a backbone.
pub(crate) fn exact(backbone: Compute) -> Compute {
    match backbone.precision() {
        vidar_nn::Precision::Bf16 => backbone.at(vidar_nn::Precision::F32),
        _ => backbone,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_description_names_what_is_computed_and_not_what_was_asked_for() {
        let on_cpu = |p, head, isa, n| Arithmetic::resolve(p, head, isa, n).to_string();
        assert_eq!(on_cpu(Precision::Auto, None, Isa::Portable, None), "f32 on portable");
        assert_eq!(on_cpu(Precision::Bf16, None, Isa::Avx2, None), "f32 on avx2");
        assert_eq!(on_cpu(Precision::F16, None, Isa::Avx2, None), "f16 on avx2");
        assert_eq!(on_cpu(Precision::F16, Some(Precision::F32), Isa::Avx2, None), "f16 (heads f32) on avx2");
        let with_bf16 = "bf16 (patch embedding, leading blocks and heads f32) on avx512";
        let expected = if Isa::Avx512.multiplies_bf16() { with_bf16 } else { "f32 on avx512" };
        assert_eq!(on_cpu(Precision::Auto, None, Isa::Avx512, None), expected);
        // A graphics processor has every format, so these descriptions do not depend on the machine.
        let on_gpu = |p, head, n| Arithmetic::on_device(p, head, Isa::Portable, n).to_string();
        let exact_ends = "bf16 (patch embedding, leading blocks and heads f32) on gpu";
        assert_eq!(on_gpu(Precision::Auto, None, None), exact_ends);
        assert_eq!(on_gpu(Precision::Bf16, Some(Precision::Bf16), Some(0)), "bf16 on gpu");
        assert_eq!(
            on_gpu(Precision::Bf16, Some(Precision::Bf16), Some(2)),
            "bf16 (patch embedding, first 2 blocks f32; heads bf16) on gpu"
        );
        for precision in Precision::ALL {
            assert_eq!(precision.name().parse::<Precision>().ok(), Some(precision));
        }
        assert!("double".parse::<Precision>().is_err());
    }

    #[test]
    fn the_first_third_is_exact_or_all_but_twenty_by_default() {
        assert_eq!([12, 24, 40].map(is_deep), [false, false, true]);
        assert_eq!([12, 24, 40, 2].map(|depth| exact_blocks(None, depth)), [4, 8, 20, 0]);
        assert_eq!((exact_blocks(Some(0), 12), exact_blocks(Some(99), 12)), (0, 12));
    }
}
