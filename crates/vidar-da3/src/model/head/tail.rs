//! The last layers of the dense heads: `scratch.output_conv1` and pairs like `scratch.output_conv2.{0,2}`.
//!
//! Enlargement to the image's size, position embedding, 3×3 convolution, ReLU and 1×1 run in one pass over bands of
//! rows: no map of that size is stored but the outputs.

use super::map::Map;
use crate::config::HEAD_LAST;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use vidar_nn::{Conv2d, Corners, GridEmbedding, HeadBranch, HeadInput, LayerNorm, MapSize, head};

/// A 3×3 convolution to 32 channels, for rays a norm, ReLU, and a 1×1 to the numbers wanted.
pub(crate) struct Pair {
    first: Conv2d,
    norm: Option<LayerNorm>,
    last: Conv2d,
    outputs: usize,
}

impl Pair {
    /// Layers `0` and `2`.
    pub fn load(scratch: &Scope, part: &str, inputs: usize, outputs: usize) -> Result<Self, Da3Error> {
        let scope = scratch.at(part);
        Ok(Self {
            first: scope.conv("0", ConvShape::three(inputs, HEAD_LAST))?,
            norm: None,
            last: scope.conv("2", ConvShape::point(HEAD_LAST, outputs))?,
            outputs,
        })
    }

    /// Layers `0` and `5` of the ray branch with the norm between them.
    pub fn load_normed(
        scratch: &Scope,
        part: &str,
        inputs: usize,
        outputs: usize,
        norm: LayerNorm,
    ) -> Result<Self, Da3Error> {
        let scope = scratch.at(part);
        Ok(Self {
            first: scope.conv("0", ConvShape::three(inputs, HEAD_LAST))?,
            norm: Some(norm),
            last: scope.conv("5", ConvShape::point(HEAD_LAST, outputs))?,
            outputs,
        })
    }
}

/// Runs pairs on a map enlarged to `rows` × `columns`, with an embedding where there is one.
pub(crate) fn run_pairs(
    run: &Run<'_>,
    map: &Map,
    (rows, columns): (usize, usize),
    embedding: Option<&GridEmbedding>,
    pairs: &[&Pair],
) -> Vec<Map> {
    let mut outputs: Vec<Map> = pairs.iter().map(|pair| Map::zeros(rows, columns, pair.outputs)).collect();
    let mut branches: Vec<HeadBranch<'_>> = pairs
        .iter()
        .zip(&mut outputs)
        .map(|(pair, out)| HeadBranch {
            conv: &pair.first,
            norm: pair.norm.as_ref(),
            point: &pair.last,
            out: &mut out.data,
        })
        .collect();
    let size = MapSize { rows, cols: columns };
    let input =
        HeadInput { map: map.view(), channels: map.channels, size, corners: Corners::Aligned, embedding };
    head(&run.head, &input, &mut branches);
    outputs
}

/// Shows what goes into the pairs, `head.output_conv2.in`, to whoever looks on; it is not stored otherwise.
pub(crate) fn show_input(
    run: &Run<'_>,
    view: usize,
    map: &Map,
    (rows, columns): (usize, usize),
    embedding: Option<&GridEmbedding>,
) {
    let name = "head.output_conv2.in";
    if run.is_traced(name) {
        let mut full = map.resized(&run.head, rows, columns);
        if let Some(embedding) = embedding {
            full.embed(embedding);
        }
        run.show_map(name, view, full.shape(), &full.data);
    }
}
