//! Which network a checkpoint holds: sizes, layers, heads.
//!
//! The official sizes are [`Variant`]s; anything else is described by the `config.json` beside the weights (see
//! [`json`]), so that a network of other widths or depths of the same family runs without a change of code.

pub mod json;
mod variant;

pub use variant::Variant;

use crate::error::Da3Error;

/// Side of a patch, pixels. Every network of the family uses it.
pub const PATCH: usize = 14;

/// A whole model: one network, or the nested pair.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Da3Config {
    /// Name as in `config.json` (`da3-small`), or one's own.
    pub name: String,
    /// Which official variant it is, if it is one.
    pub variant: Option<Variant>,
    /// The networks.
    pub networks: Networks,
}

/// The networks of a model and where their keys begin. There is one of these a model: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Networks {
    /// One network; keys begin with `model.`.
    Single(NetConfig),
    /// An any-view network (`model.da3.`) scaled by a metric one (`model.da3_metric.`).
    Nested {
        /// The any-view network.
        any_view: NetConfig,
        /// The metric network with its sky head.
        metric: NetConfig,
    },
}

/// One network: backbone, head and, for any-view networks, the camera parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetConfig {
    /// Sizes of `backbone.pretrained`.
    pub backbone: BackboneConfig,
    /// Sizes of `head`.
    pub head: HeadConfig,
    /// Sizes of `cam_enc`, if there is one.
    pub camera_encoder: Option<CameraEncoderConfig>,
    /// Whether there is a `cam_dec`.
    pub camera_decoder: bool,
}

/// Sizes of the vision transformer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BackboneConfig {
    /// Width of a token, channels.
    pub dim: usize,
    /// Blocks.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// The feed-forward part of a block.
    pub ffn: Ffn,
    /// The blocks after which features are taken, ascending.
    pub out_layers: [usize; 4],
    /// From this block on odd blocks look across views; `None` for networks of one view.
    pub alternate_from: Option<usize>,
    /// From this block on queries and keys are normalised.
    pub qk_norm_from: Option<usize>,
    /// From this block on queries and keys are rotated by position.
    pub rope_from: Option<usize>,
    /// Rows and columns of the trained position grid.
    pub position_grid: usize,
}

/// The feed-forward part of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ffn {
    /// `fc2(gelu(fc1(x)))`.
    Mlp {
        /// Inner width.
        hidden: usize,
    },
    /// `w3(silu(a)·b)` with `a ‖ b = w12(x)`.
    SwiGlu {
        /// Inner width (half the output of `w12`).
        hidden: usize,
    },
}

/// Which dense head a network has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeadKind {
    /// Depth with confidence, and rays on demand.
    DualDpt,
    /// Depth and sky.
    DptSky,
}

/// Sizes of the dense head.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HeadConfig {
    /// Which head.
    pub kind: HeadKind,
    /// Channels of the fused maps (F).
    pub features: usize,
    /// Channels of the four stages after projection.
    pub out_channels: [usize; 4],
}

/// Sizes of the camera encoder; its width is the backbone's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraEncoderConfig {
    /// Attention heads.
    pub heads: usize,
    /// Blocks of the trunk.
    pub depth: usize,
    /// Inner width of a block's MLP over its width.
    pub mlp_ratio: usize,
}

/// Inner width of the last head convolutions, fixed by the architecture.
pub(crate) const HEAD_LAST: usize = 32;

impl BackboneConfig {
    /// Whether block `i` looks across views.
    pub fn is_global(&self, i: usize) -> bool {
        self.alternate_from.is_some_and(|from| i >= from) && i % 2 == 1
    }

    /// Whether block `i` normalises queries and keys.
    pub fn has_qk_norm(&self, i: usize) -> bool {
        self.qk_norm_from.is_some_and(|from| i >= from)
    }

    /// Whether block `i` rotates queries and keys.
    pub fn has_rope(&self, i: usize) -> bool {
        self.rope_from.is_some_and(|from| i >= from)
    }

    /// Channels of a feature: local and global half for any-view networks.
    pub fn feature_dim(&self) -> usize {
        if self.alternate_from.is_some() { 2 * self.dim } else { self.dim }
    }

    /// Channels of one attention head.
    pub fn head_dim(&self) -> usize {
        self.dim / self.heads
    }
}

/// Bounds that keep a hostile description from asking for absurd amounts of memory.
const MAX_DIM: usize = 8192;
const MAX_DEPTH: usize = 128;
const MAX_FEATURES: usize = 4096;

impl NetConfig {
    /// Whether the network takes several views at once.
    pub fn is_any_view(&self) -> bool {
        self.backbone.alternate_from.is_some()
    }

    /// Refuses sizes that no network of the family can have; `place` is named in the error.
    pub fn validate(&self, place: &str) -> Result<(), Da3Error> {
        self.validate_backbone(place)?;
        let head = &self.head;
        let even = |field, value: usize| {
            check(value.is_multiple_of(2), place, field, value, "an even number of channels")
        };
        within(place, "head.features", head.features, 2..=MAX_FEATURES)?;
        even("head.features", head.features)?;
        for &channels in &head.out_channels {
            within(place, "head.out_channels", channels, 4..=MAX_FEATURES)?;
        }
        if head.kind == HeadKind::DualDpt {
            check(
                (head.features / 2).is_multiple_of(4),
                place,
                "head.features",
                head.features,
                "a multiple of 8",
            )?;
            for &channels in &head.out_channels {
                check(channels.is_multiple_of(4), place, "head.out_channels", channels, "a multiple of 4")?;
            }
        }
        if let Some(encoder) = &self.camera_encoder {
            within(place, "cam_enc.num_heads", encoder.heads, 1..=MAX_DIM)?;
            within(place, "cam_enc.trunk_depth", encoder.depth, 0..=MAX_DEPTH)?;
            within(place, "cam_enc.mlp_ratio", encoder.mlp_ratio, 1..=16)?;
            let fits = self.backbone.dim.is_multiple_of(encoder.heads);
            check(fits, place, "cam_enc.num_heads", encoder.heads, "a divisor of the width")?;
            check(
                self.backbone.dim.is_multiple_of(2),
                place,
                "net.embed_dim",
                self.backbone.dim,
                "an even width",
            )?;
        }
        let consistent = self.is_any_view() == (head.kind == HeadKind::DualDpt);
        if !consistent || (!self.is_any_view() && (self.camera_encoder.is_some() || self.camera_decoder)) {
            return Err(Da3Error::BadConfig {
                place: place.into(),
                field: "head".into(),
                found: format!("{:?} with alternation from {:?}", head.kind, self.backbone.alternate_from),
                expected: "DualDPT and cameras with an any-view backbone, DPT with a single-view one".into(),
            });
        }
        Ok(())
    }

    fn validate_backbone(&self, place: &str) -> Result<(), Da3Error> {
        let b = &self.backbone;
        within(place, "net.embed_dim", b.dim, 8..=MAX_DIM)?;
        within(place, "net.depth", b.depth, 1..=MAX_DEPTH)?;
        within(place, "net.num_heads", b.heads, 1..=MAX_DIM)?;
        within(place, "net.position_grid", b.position_grid, 1..=256)?;
        check(b.dim.is_multiple_of(b.heads), place, "net.num_heads", b.heads, "a divisor of the width")?;
        let hidden = match b.ffn {
            Ffn::Mlp { hidden } | Ffn::SwiGlu { hidden } => hidden,
        };
        within(place, "net.ffn_hidden", hidden, 1..=8 * MAX_DIM)?;
        if b.rope_from.is_some() {
            let quarter = b.head_dim().is_multiple_of(4);
            check(quarter, place, "net.num_heads", b.heads, "heads whose width is a multiple of 4")?;
        }
        let ascending = b.out_layers.windows(2).all(|w| w[0] < w[1]) && b.out_layers[3] < b.depth;
        if !ascending {
            return Err(Da3Error::BadConfig {
                place: place.into(),
                field: "net.out_layers".into(),
                found: format!("{:?}", b.out_layers),
                expected: format!("four ascending blocks below {}", b.depth),
            });
        }
        if let Some(from) = b.alternate_from {
            // The reference view is chosen one block before, so the first block cannot alternate.
            within(place, "net.alt_start", from, 1..=b.depth - 1)?;
        }
        Ok(())
    }
}

impl Da3Config {
    /// Refuses sizes that no network of the family can have.
    pub fn validate(&self) -> Result<(), Da3Error> {
        match &self.networks {
            Networks::Single(net) => net.validate(&self.name),
            Networks::Nested { any_view, metric } => {
                any_view.validate(&format!("{}.anyview", self.name))?;
                metric.validate(&format!("{}.metric", self.name))?;
                if !any_view.is_any_view() || metric.is_any_view() || !any_view.camera_decoder {
                    return Err(Da3Error::BadConfig {
                        place: self.name.clone(),
                        field: "anyview/metric".into(),
                        found: "another combination".into(),
                        expected: "an any-view network with a camera decoder, and a metric network".into(),
                    });
                }
                Ok(())
            }
        }
    }

    /// The network that sees all views: the only one, or the any-view one of a nested model.
    pub fn main(&self) -> &NetConfig {
        match &self.networks {
            Networks::Single(net) => net,
            Networks::Nested { any_view, .. } => any_view,
        }
    }
}

fn check(ok: bool, place: &str, field: &str, found: usize, expected: &str) -> Result<(), Da3Error> {
    if ok {
        return Ok(());
    }
    Err(Da3Error::BadConfig {
        place: place.into(),
        field: field.into(),
        found: found.to_string(),
        expected: expected.into(),
    })
}

fn within(
    place: &str,
    field: &str,
    found: usize,
    range: std::ops::RangeInclusive<usize>,
) -> Result<(), Da3Error> {
    let expected = format!("{} to {}", range.start(), range.end());
    check(range.contains(&found), place, field, found, &expected)
}
