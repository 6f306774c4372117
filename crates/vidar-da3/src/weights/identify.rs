//! Checks of a checkpoint against the network it should hold, and detection of the network from its keys.

use super::inventory::{self, Parameter, parameters};
use crate::config::{Da3Config, Variant};
use crate::error::Da3Error;
use std::collections::BTreeSet;
use vidar_nn::Checkpoint;

/// Most problems listed in an error; the others are counted.
const MAX_LISTED: usize = 20;

/// Checks every key of a checkpoint: missing keys, wrong shapes, keys of another network.
///
/// Keys that inference never reads may be absent; those of the Gaussian head may be present.
pub fn verify(checkpoint: &Checkpoint, config: &Da3Config) -> Result<(), Da3Error> {
    let expected = parameters(config);
    let known: BTreeSet<&str> = expected.iter().map(|p| p.name.as_str()).collect();
    let mut problems: Vec<String> = expected.iter().filter_map(|p| problem(checkpoint, p)).collect();
    problems.extend(
        checkpoint
            .names()
            .filter(|name| !known.contains(name) && !inventory::is_ignored(name))
            .filter(|name| {
                !inventory::stored_name(name).is_some_and(|stored| known.contains(stored.as_str()))
            })
            .map(|name| format!("  {name}: not a tensor of this network")),
    );
    if problems.is_empty() {
        return Ok(());
    }
    let hidden = problems.len().saturating_sub(MAX_LISTED);
    problems.truncate(MAX_LISTED);
    if hidden > 0 {
        problems.push(format!("  and {hidden} more"));
    }
    Err(Da3Error::ForeignCheckpoint {
        origin: checkpoint.origin().to_owned(),
        model: config.name.clone(),
        problems,
    })
}

fn problem(checkpoint: &Checkpoint, parameter: &Parameter) -> Option<String> {
    let Parameter { name, shape, is_read } = parameter;
    match checkpoint.tensor(name) {
        Err(_) if !is_read => None,
        Err(_) => Some(format!("  {name}: missing, expected shape {shape:?}")),
        Ok(tensor) if tensor.shape != shape => {
            Some(format!("  {name}: shape {:?}, expected {shape:?}", tensor.shape))
        }
        Ok(_) => None,
    }
}

/// The official network whose keys a checkpoint has, for checkpoints without `config.json`.
///
/// Nested models are recognised by their prefix, any-view networks by their camera token, the size by the width of the
/// class token. The metric and the monocular network have the same keys and shapes; metric is assumed.
pub fn detect(checkpoint: &Checkpoint) -> Result<Variant, Da3Error> {
    if checkpoint.names().any(|name| name.starts_with("model.da3.")) {
        return Ok(Variant::NestedGiantLarge);
    }
    let unknown =
        |reason: String| Da3Error::UnknownNetwork { origin: checkpoint.origin().to_owned(), reason };
    let token = checkpoint
        .tensor("model.backbone.pretrained.cls_token")
        .map_err(|_| unknown("no model.backbone.pretrained.cls_token".into()))?;
    let dim = token.shape.last().copied().unwrap_or(0);
    let is_any_view = checkpoint.contains("model.backbone.pretrained.camera_token");
    match (is_any_view, dim) {
        (true, 384) => Ok(Variant::Small),
        (true, 768) => Ok(Variant::Base),
        (true, 1024) => Ok(Variant::Large),
        (true, 1536) => Ok(Variant::Giant),
        (false, 1024) => Ok(Variant::MetricLarge),
        _ => {
            let kind = if is_any_view { "any-view" } else { "single-view" };
            Err(unknown(format!("a {kind} network of width {dim}; a config.json can describe it")))
        }
    }
}
