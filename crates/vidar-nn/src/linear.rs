//! Linear layers: `y = x Wᵀ + b`.

use crate::compute::Compute;
use crate::error::NnError;
use crate::kernels::pack::Columns;
use crate::kernels::product::{End, OutLayout, Product};
use crate::kernels::source::Source;
use crate::weight::Weight;

/// What is done with a layer's sums before they are stored.
#[derive(Debug, Clone, Copy, Default)]
pub enum Epilogue<'a> {
    /// Stored as they are.
    #[default]
    None,
    /// GELU in its exact form, x Φ(x).
    Gelu,
    /// max(x, 0).
    Relu,
    /// Added to what the output holds, after a factor per column (LayerScale) where there is one: `out += gamma * y`.
    Accumulate {
        /// The factors, one per output channel.
        gamma: Option<&'a [f32]>,
    },
    /// Another buffer of the output's layout is added: `out = other + y`.
    Add(&'a [f32]),
}

impl<'a> Epilogue<'a> {
    /// Checks the lengths and gives the kernels' form.
    pub(crate) fn checked(self, channels: usize, outputs: usize) -> End<'a> {
        match self {
            Self::None => End::Store,
            Self::Gelu => End::Gelu,
            Self::Relu => End::Relu,
            Self::Accumulate { gamma } => {
                if let Some(gamma) = gamma {
                    assert_eq!(gamma.len(), channels, "gamma has one factor per output channel");
                }
                End::Accumulate(gamma)
            }
            Self::Add(other) => {
                assert_eq!(other.len(), outputs, "the added buffer has the output's layout");
                End::Add(other)
            }
        }
    }
}

/// A linear layer with weight `[out, in]` and an optional bias `[out]`.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: Weight,
    bias: Option<Vec<f32>>,
    inputs: usize,
    outputs: usize,
}

impl Linear {
    /// Constructs a layer; the weight is not copied.
    ///
    /// # Errors
    /// [`NnError::WeightShape`] when the shapes do not fit.
    pub fn new(weight: Weight, bias: Option<Weight>) -> Result<Self, NnError> {
        let &[outputs, inputs] = weight.shape() else {
            return Err(wrong_shape("linear layer", &weight, "[out, in]"));
        };
        let bias = vector("linear layer", bias, outputs)?;
        Ok(Self { weight, bias, inputs, outputs })
    }

    /// Columns of the input.
    pub fn in_features(&self) -> usize {
        self.inputs
    }

    /// Columns of the output.
    pub fn out_features(&self) -> usize {
        self.outputs
    }

    /// `out = epilogue(x Wᵀ + b)`: `x` is `[rows, in]`, `out` is `[rows, out]`, both row-major.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn apply(&self, c: &Compute, x: &[f32], rows: usize, out: &mut [f32], epilogue: Epilogue<'_>) {
        assert_eq!(out.len(), rows * self.outputs, "output of a linear layer");
        let end = epilogue.checked(self.outputs, out.len());
        self.product(self.flat(x, rows), rows, self.outputs, end).run(c, out);
    }

    /// The gated unit of SwiGLU: the first half of the layer's outputs gates the second, `out = silu(gate) * value`;
    /// `out` is `[rows, out_features / 2]`.
    ///
    /// # Panics
    /// When a slice has another length, or the number of outputs is odd.
    pub fn apply_swiglu(&self, c: &Compute, x: &[f32], rows: usize, out: &mut [f32]) {
        assert_eq!(self.outputs % 2, 0, "a gated unit has an even number of outputs");
        assert_eq!(out.len(), rows * self.outputs / 2, "output of a gated unit");
        self.product(self.flat(x, rows), rows, self.outputs / 2, End::SwiGlu).run(c, out);
    }

    fn flat<'a>(&self, x: &'a [f32], rows: usize) -> Source<'a> {
        assert_eq!(x.len(), rows * self.inputs, "input of a linear layer");
        Source::Flat { x, rows, inner: self.inputs }
    }

    fn product<'a>(&'a self, source: Source<'a>, rows: usize, width: usize, end: End<'a>) -> Product<'a> {
        let layout = OutLayout::dense(rows, width);
        Product { source, columns: self, width: self.outputs, bias: self.bias.as_deref(), end, layout }
    }
}

/// Columns of B are rows of the weight.
impl Columns for Linear {
    fn read(&self, column: usize, out: &mut [f32]) {
        self.weight.read(column * self.inputs, out);
    }
}

/// A bias or norm vector of the expected length, decoded.
pub(crate) fn vector(
    layer: &'static str,
    weight: Option<Weight>,
    len: usize,
) -> Result<Option<Vec<f32>>, NnError> {
    let Some(weight) = weight else { return Ok(None) };
    if weight.shape() != [len] {
        return Err(wrong_shape(layer, &weight, &format!("[{len}]")));
    }
    Ok(Some(weight.to_f32()))
}

pub(crate) fn wrong_shape(layer: &'static str, weight: &Weight, expected: &str) -> NnError {
    NnError::WeightShape {
        layer,
        name: weight.name().to_owned(),
        found: weight.shape().to_vec(),
        expected: expected.to_owned(),
    }
}
