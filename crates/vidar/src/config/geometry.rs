//! Settings of the geometry model.

use crate::models::geometry;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The geometry model, and the number of keyframes per prediction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GeometryConfig {
    /// The model: `auto` (stereo, completed by the map and planes), `stereo` (needs poses, no weights), a network of
    /// `vidar model list` (`da3-small`), `custom` (the weights of `model.dir`, which alone mean it), `recorded:DIR`, predictions of
    /// another program in that folder, or `remote:KEY`, the network of the `vidar worker`s under that key.
    pub source: String,
    /// The network that `auto` bends onto measured depth where nothing is measured: one of `vidar model list`, `recorded:DIR`, or
    /// `none`, which interpolates (as good as `da3-nano`, and it costs nothing). `auto` only; `model.dir` comes first.
    pub fill_network: String,
    /// Keyframes that are predicted together, with stereo at least 2. Larger chunks need more memory and are more consistent.
    pub chunk_keyframes: usize,
    /// Keyframes that a chunk shares with the one before it, for the overlap constraint between them. Networks and recordings only;
    /// smaller than the chunk.
    pub overlap_keyframes: usize,
    /// Keyframes on each side that are used as context only. Stereo only.
    pub context_keyframes: usize,
    /// Largest width of the undistorted images (px); wider images are reduced.
    pub max_width_px: usize,
}

impl Default for GeometryConfig {
    fn default() -> Self {
        Self {
            source: geometry::AUTO.into(),
            fill_network: geometry::NO_NETWORK.into(),
            chunk_keyframes: 16,
            overlap_keyframes: 4,
            context_keyframes: 16,
            max_width_px: 640,
        }
    }
}
