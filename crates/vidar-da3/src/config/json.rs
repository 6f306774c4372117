//! `config.json` as it lies beside the weights on the hub.
//!
//! ```json
//! {"model_name": "da3-small", "config": {"net": {"name": "vits", "out_layers": [5, 7, 9, 11], "alt_start": 4, …},
//!                                        "head": {"features": 64, "out_channels": [48, 96, 192, 384], …}, …}}
//! ```
//!
//! For an official name the name is enough. A network of one's own says in `net` what its named vision transformer
//! (`vits`, `vitb`, `vitl`, `vitg`) does not, or all of it: `embed_dim`, `depth`, `num_heads`, `ffn_layer` (`mlp` or
//! `swiglu`), `ffn_hidden`, `position_grid`; in `cam_enc` it may say `num_heads`, `trunk_depth`, `mlp_ratio`.

use super::variant::{CAMERA_ENCODER, POSITION_GRID, named_vit};
use super::{
    BackboneConfig, CameraEncoderConfig, Da3Config, Ffn, HeadConfig, HeadKind, NetConfig, Networks, Variant,
};
use crate::error::Da3Error;
use serde::Deserialize;

/// A description is a few kilobytes; a larger file is something else.
pub const MAX_BYTES: u64 = 1 << 20;

#[derive(Deserialize)]
struct RawFile {
    model_name: Option<String>,
    config: Option<RawModel>,
}

#[derive(Deserialize)]
struct RawModel {
    net: Option<RawNet>,
    head: Option<RawHead>,
    cam_enc: Option<RawCamEnc>,
    cam_dec: Option<RawCamDec>,
    anyview: Option<Box<RawModel>>,
    metric: Option<Box<RawModel>>,
}

#[derive(Deserialize)]
struct RawNet {
    name: Option<String>,
    out_layers: Vec<usize>,
    #[serde(default)]
    alt_start: Start,
    #[serde(default)]
    qknorm_start: Start,
    #[serde(default)]
    rope_start: Start,
    embed_dim: Option<usize>,
    depth: Option<usize>,
    num_heads: Option<usize>,
    ffn_layer: Option<String>,
    ffn_hidden: Option<usize>,
    position_grid: Option<usize>,
}

/// A block number, or −1 for "never".
#[derive(Clone, Copy, Deserialize)]
#[serde(transparent)]
struct Start(i64);

impl Default for Start {
    fn default() -> Self {
        Self(-1)
    }
}

#[derive(Deserialize)]
struct RawHead {
    dim_in: Option<usize>,
    features: usize,
    out_channels: Vec<usize>,
}

#[derive(Deserialize)]
struct RawCamEnc {
    dim_out: Option<usize>,
    num_heads: Option<usize>,
    trunk_depth: Option<usize>,
    mlp_ratio: Option<usize>,
}

#[derive(Deserialize)]
struct RawCamDec {
    dim_in: Option<usize>,
}

/// Reads a description; `place` (a file name) is named in errors.
pub fn parse(text: &str, place: &str) -> Result<Da3Config, Da3Error> {
    if text.len() as u64 > MAX_BYTES {
        return Err(Da3Error::ConfigTooLarge {
            place: place.into(),
            bytes: text.len() as u64,
            max: MAX_BYTES,
        });
    }
    let raw: RawFile = serde_json::from_str(text)
        .map_err(|e| Da3Error::ConfigSyntax { place: place.into(), reason: e.to_string() })?;
    let variant = raw.model_name.as_deref().and_then(Variant::from_name);
    let config = match (raw.config, variant) {
        (None, Some(variant)) => return Ok(variant.config()),
        (None, None) => {
            let found = raw.model_name.unwrap_or_else(|| "nothing".into());
            return Err(bad(place, "model_name", found, "an official name, or a \"config\" with sizes"));
        }
        (Some(config), _) => config,
    };
    let networks = match (config.anyview, config.metric) {
        (Some(any_view), Some(metric)) => Networks::Nested {
            any_view: network(*any_view, &format!("{place}: anyview"))?,
            metric: network(*metric, &format!("{place}: metric"))?,
        },
        (None, None) => Networks::Single(network(RawModel { anyview: None, metric: None, ..config }, place)?),
        _ => return Err(bad(place, "anyview/metric", "one of the two".into(), "both, or neither")),
    };
    let name = raw.model_name.unwrap_or_else(|| "da3-custom".into());
    let parsed = Da3Config { name, variant, networks };
    parsed.validate()?;
    // A file with an official name and other sizes is a network of its own: it is read by its sizes.
    let official = variant.filter(|v| v.config().networks == parsed.networks);
    Ok(Da3Config { variant: official, ..parsed })
}

fn network(raw: RawModel, place: &str) -> Result<NetConfig, Da3Error> {
    let missing = |field: &str| bad(place, field, "nothing".into(), "a section with sizes");
    let net = raw.net.ok_or_else(|| missing("net"))?;
    let head = raw.head.ok_or_else(|| missing("head"))?;
    let backbone = backbone(&net, place)?;
    let any_view = backbone.alternate_from.is_some();
    if head.dim_in.is_some_and(|d| d != backbone.feature_dim()) {
        let expected = format!("{}, the width of the backbone's features", backbone.feature_dim());
        return Err(bad(place, "head.dim_in", format!("{:?}", head.dim_in), &expected));
    }
    let camera_encoder = raw.cam_enc.map(|c| camera_encoder(&c, &backbone, place)).transpose()?;
    if raw.cam_dec.as_ref().is_some_and(|c| c.dim_in.is_some_and(|d| d != backbone.feature_dim())) {
        let expected = format!("{}, the width of the backbone's features", backbone.feature_dim());
        return Err(bad(place, "cam_dec.dim_in", "another width".into(), &expected));
    }
    Ok(NetConfig {
        head: HeadConfig {
            kind: if any_view { HeadKind::DualDpt } else { HeadKind::DptSky },
            features: head.features,
            out_channels: four(&head.out_channels, "head.out_channels", place)?,
        },
        backbone,
        camera_encoder,
        camera_decoder: raw.cam_dec.is_some(),
    })
}

fn backbone(net: &RawNet, place: &str) -> Result<BackboneConfig, Da3Error> {
    let named = net.name.as_deref().and_then(named_vit);
    let known = |own: Option<usize>, of_name: Option<usize>, field: &str| {
        own.or(of_name).ok_or_else(|| {
            let name = net.name.clone().unwrap_or_else(|| "no name".into());
            bad(
                place,
                field,
                format!("nothing (net.name is {name})"),
                "a size, or one of vits, vitb, vitl, vitg",
            )
        })
    };
    let dim = known(net.embed_dim, named.map(|n| n.0), "net.embed_dim")?;
    let depth = known(net.depth, named.map(|n| n.1), "net.depth")?;
    let heads = known(net.num_heads, named.map(|n| n.2), "net.num_heads")?;
    let ffn = match (net.ffn_layer.as_deref(), net.ffn_hidden, named.map(|n| n.3)) {
        (None, None, Some(ffn)) if named.is_some_and(|n| n.0 == dim) => ffn,
        (None | Some("mlp"), hidden, _) => Ffn::Mlp { hidden: hidden.unwrap_or(dim.saturating_mul(4)) },
        (Some("swiglu" | "swiglufused"), Some(hidden), _) => Ffn::SwiGlu { hidden },
        (Some("swiglu" | "swiglufused"), None, _) => {
            // Two thirds of four widths, rounded up to eights: as many weights as the MLP.
            Ffn::SwiGlu { hidden: (dim.saturating_mul(8) / 3).div_ceil(8).saturating_mul(8) }
        }
        (Some(other), _, _) => {
            return Err(bad(place, "net.ffn_layer", other.into(), "mlp or swiglu"));
        }
    };
    Ok(BackboneConfig {
        dim,
        depth,
        heads,
        ffn,
        out_layers: four(&net.out_layers, "net.out_layers", place)?,
        alternate_from: start(net.alt_start),
        qk_norm_from: start(net.qknorm_start),
        rope_from: start(net.rope_start),
        position_grid: net.position_grid.unwrap_or(POSITION_GRID),
    })
}

fn camera_encoder(
    raw: &RawCamEnc,
    backbone: &BackboneConfig,
    place: &str,
) -> Result<CameraEncoderConfig, Da3Error> {
    if raw.dim_out.is_some_and(|d| d != backbone.dim) {
        let expected = format!("{}, the backbone's width", backbone.dim);
        return Err(bad(place, "cam_enc.dim_out", format!("{:?}", raw.dim_out), &expected));
    }
    Ok(CameraEncoderConfig {
        heads: raw.num_heads.unwrap_or(CAMERA_ENCODER.heads),
        depth: raw.trunk_depth.unwrap_or(CAMERA_ENCODER.depth),
        mlp_ratio: raw.mlp_ratio.unwrap_or(CAMERA_ENCODER.mlp_ratio),
    })
}

fn start(raw: Start) -> Option<usize> {
    usize::try_from(raw.0).ok()
}

fn four(list: &[usize], field: &str, place: &str) -> Result<[usize; 4], Da3Error> {
    list.try_into().map_err(|_| bad(place, field, format!("{} entries", list.len()), "four entries"))
}

fn bad(place: &str, field: &str, found: String, expected: &str) -> Da3Error {
    Da3Error::BadConfig { place: place.into(), field: field.into(), found, expected: expected.into() }
}

#[cfg(test)]
mod tests;
