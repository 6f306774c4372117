//! The official variants (DA3, table of models): sizes, names, licences.

use super::{BackboneConfig, CameraEncoderConfig, Da3Config, Ffn, HeadConfig, HeadKind, NetConfig, Networks};

/// An official model of the family. Retrained files (`-1.1`) share the architecture of the originals.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Variant {
    /// DA3-SMALL, Apache-2.0.
    Small,
    /// DA3-BASE, Apache-2.0.
    Base,
    /// DA3-LARGE and DA3-LARGE-1.1, CC-BY-NC-4.0.
    Large,
    /// DA3-GIANT and DA3-GIANT-1.1, CC-BY-NC-4.0.
    Giant,
    /// DA3METRIC-LARGE, Apache-2.0: depth of one view, canonical, and sky.
    MetricLarge,
    /// DA3MONO-LARGE, Apache-2.0: relative depth of one view, and sky.
    MonoLarge,
    /// DA3NESTED-GIANT-LARGE and -1.1, CC-BY-NC-4.0: giant scaled to metres by metric-large.
    NestedGiantLarge,
}

impl Variant {
    /// All of them, smallest first.
    pub const ALL: [Self; 7] = [
        Self::Small,
        Self::Base,
        Self::Large,
        Self::Giant,
        Self::MetricLarge,
        Self::MonoLarge,
        Self::NestedGiantLarge,
    ];

    /// `model_name` in `config.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Small => "da3-small",
            Self::Base => "da3-base",
            Self::Large => "da3-large",
            Self::Giant => "da3-giant",
            Self::MetricLarge => "da3metric-large",
            Self::MonoLarge => "da3mono-large",
            Self::NestedGiantLarge => "da3nested-giant-large",
        }
    }

    /// The variant of a `model_name`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|v| v.name() == name)
    }

    /// SPDX licence of the official weights, as their cards state it.
    pub fn licence(self) -> &'static str {
        match self {
            Self::Small | Self::Base | Self::MetricLarge | Self::MonoLarge => "Apache-2.0",
            Self::Large | Self::Giant | Self::NestedGiantLarge => "CC-BY-NC-4.0",
        }
    }

    /// Sizes of the variant's networks.
    pub fn config(self) -> Da3Config {
        let networks = match self {
            Self::Small => Networks::Single(any_view(vit("vits"), 4, [5, 7, 9, 11], 64, [48, 96, 192, 384])),
            Self::Base => Networks::Single(any_view(vit("vitb"), 4, [5, 7, 9, 11], 128, [96, 192, 384, 768])),
            Self::Large => Networks::Single(any_view(vit("vitl"), 8, [11, 15, 19, 23], 256, WIDE)),
            Self::Giant => Networks::Single(giant()),
            Self::MetricLarge | Self::MonoLarge => Networks::Single(metric()),
            Self::NestedGiantLarge => Networks::Nested { any_view: giant(), metric: metric() },
        };
        Da3Config { name: self.name().into(), variant: Some(self), networks }
    }
}

const WIDE: [usize; 4] = [256, 512, 1024, 1024];

/// Width, blocks, heads and feed-forward part of a named vision transformer.
pub(super) type Vit = (usize, usize, usize, Ffn);

/// The vision transformers that the official configurations name.
pub(super) fn named_vit(name: &str) -> Option<Vit> {
    match name {
        "vits" => Some((384, 12, 6, Ffn::Mlp { hidden: 1536 })),
        "vitb" => Some((768, 12, 12, Ffn::Mlp { hidden: 3072 })),
        "vitl" => Some((1024, 24, 16, Ffn::Mlp { hidden: 4096 })),
        "vitg" => Some((1536, 40, 24, Ffn::SwiGlu { hidden: 4096 })),
        _ => None,
    }
}

/// As [`named_vit`]; the names below are written in this file only.
fn vit(name: &str) -> Vit {
    named_vit(name).unwrap_or((384, 12, 6, Ffn::Mlp { hidden: 1536 }))
}

/// The trained grid of 518 pixels.
pub(super) const POSITION_GRID: usize = 37;

/// Defaults of the official camera encoder.
pub(super) const CAMERA_ENCODER: CameraEncoderConfig =
    CameraEncoderConfig { heads: 16, depth: 4, mlp_ratio: 4 };

fn any_view(
    (dim, depth, heads, ffn): Vit,
    from: usize,
    out_layers: [usize; 4],
    features: usize,
    out_channels: [usize; 4],
) -> NetConfig {
    NetConfig {
        backbone: BackboneConfig {
            dim,
            depth,
            heads,
            ffn,
            out_layers,
            alternate_from: Some(from),
            qk_norm_from: Some(from),
            rope_from: Some(from),
            position_grid: POSITION_GRID,
        },
        head: HeadConfig { kind: HeadKind::DualDpt, features, out_channels },
        camera_encoder: Some(CAMERA_ENCODER),
        camera_decoder: true,
    }
}

fn giant() -> NetConfig {
    any_view(vit("vitg"), 13, [19, 27, 33, 39], 256, WIDE)
}

fn metric() -> NetConfig {
    let (dim, depth, heads, ffn) = vit("vitl");
    NetConfig {
        backbone: BackboneConfig {
            dim,
            depth,
            heads,
            ffn,
            out_layers: [4, 11, 17, 23],
            alternate_from: None,
            qk_norm_from: None,
            rope_from: None,
            position_grid: POSITION_GRID,
        },
        head: HeadConfig { kind: HeadKind::DptSky, features: 256, out_channels: WIDE },
        camera_encoder: None,
        camera_decoder: false,
    }
}
