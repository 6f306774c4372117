//! The last layers of the dense heads: `scratch.output_conv1` and pairs like `scratch.output_conv2.{0,2}`.

use super::map::Map;
use super::uv::Uv;
use crate::config::HEAD_LAST;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use vidar_nn::{Conv2d, ConvInput, Epilogue};

/// A 3×3 convolution to 32 channels, ReLU, and a 1×1 to the numbers wanted.
pub(crate) struct Pair {
    first: Conv2d,
    last: Conv2d,
}

impl Pair {
    pub fn load(scratch: &Scope, part: &str, inputs: usize, outputs: usize) -> Result<Self, Da3Error> {
        let scope = scratch.at(part);
        Ok(Self {
            first: scope.conv("0", ConvShape::three(inputs, HEAD_LAST))?,
            last: scope.conv("2", ConvShape::point(HEAD_LAST, outputs))?,
        })
    }

    pub fn run(&self, run: &Run<'_>, x: &Map) -> Map {
        let hidden = x.convolved(&run.head, &self.first, ConvInput::None, Epilogue::Relu);
        hidden.convolved(&run.head, &self.last, ConvInput::None, Epilogue::None)
    }
}

/// `output_conv1` on the fused map, enlarged to the picture's size, with the position embedding where there is one.
pub(crate) fn enlarged(
    run: &Run<'_>,
    view: usize,
    (fused, output_conv1): (&Map, &Conv2d),
    (rows, columns): (usize, usize),
    uv: Option<&Uv>,
) -> Map {
    let narrow = fused.convolved(&run.head, output_conv1, ConvInput::None, Epilogue::None);
    run.show_map("head.output_conv1", view, narrow.shape(), &narrow.data);
    let mut full = narrow.resized(rows, columns);
    if let Some(uv) = uv {
        uv.add_to(&mut full);
    }
    run.show_map("head.output_conv2.in", view, full.shape(), &full.data);
    full
}
