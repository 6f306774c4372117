//! Convolutions over NHWC maps, as implicit matrix products.
//!
//! A band of output rows is one chunk: its input rows are copied once with a border of zeros, and the pixels under a
//! kernel row are then consecutive numbers. There is no im2col copy.

use crate::compute::Compute;
use crate::error::NnError;
use crate::kernels::pack::Columns;
use crate::kernels::product::{End, OutLayout, Product};
use crate::kernels::scratch::{self, Role};
use crate::kernels::source::{Bands, Fill, Source};
use crate::linear::{Epilogue, vector, wrong_shape};
use crate::weight::Weight;

/// What is done with a convolution's input before it is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ConvInput {
    /// Used as it is.
    #[default]
    None,
    /// max(x, 0) of it is used.
    Relu,
}

/// A convolution with weight `[out, in, kh, kw]` over a map `[rows, cols, in]`.
#[derive(Debug, Clone)]
pub struct Conv2d {
    weight: Weight,
    bias: Option<Vec<f32>>,
    outputs: usize,
    inputs: usize,
    kernel: [usize; 2],
    stride: usize,
    padding: usize,
}

impl Conv2d {
    /// Constructs a layer; the border is `padding` zeros on each side.
    ///
    /// # Errors
    /// [`NnError::WeightShape`] and, for a stride of zero or an empty kernel, [`NnError::Setting`].
    pub fn new(weight: Weight, bias: Option<Weight>, stride: usize, padding: usize) -> Result<Self, NnError> {
        let &[outputs, inputs, kh, kw] = weight.shape() else {
            return Err(wrong_shape("convolution", &weight, "[out, in, kh, kw]"));
        };
        if stride == 0 || kh == 0 || kw == 0 {
            let what = format!("stride {stride}, kernel {kh}x{kw}; each must be at least 1");
            return Err(NnError::Setting { layer: "convolution", what });
        }
        let bias = vector("convolution", bias, outputs)?;
        Ok(Self { weight, bias, outputs, inputs, kernel: [kh, kw], stride, padding })
    }

    /// Channels of the input.
    pub fn in_channels(&self) -> usize {
        self.inputs
    }

    /// Channels of the output.
    pub fn out_channels(&self) -> usize {
        self.outputs
    }

    /// Rows and columns of the output for a map of `h` rows and `w` columns; zero where the kernel does not fit.
    pub fn output_size(&self, h: usize, w: usize) -> (usize, usize) {
        let side = |n: usize, k: usize| {
            (n + 2 * self.padding).checked_sub(k).map_or(0, |room| room / self.stride + 1)
        };
        (side(h, self.kernel[0]), side(w, self.kernel[1]))
    }

    /// Convolves `x` (`[h, w, in]`) into `out` (`[oh, ow, out]`, see [`Conv2d::output_size`]).
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn apply(
        &self,
        c: &Compute,
        x: MapRef<'_>,
        out: &mut [f32],
        input: ConvInput,
        epilogue: Epilogue<'_>,
    ) {
        let (h, w) = (x.rows, x.cols);
        let (oh, ow) = self.output_size(h, w);
        assert_eq!(x.data.len(), h * w * self.inputs, "input of a convolution");
        assert_eq!(out.len(), oh * ow * self.outputs, "output of a convolution");
        let end = epilogue.checked(self.outputs, out.len());
        let source =
            if self.kernel == [1, 1] && self.stride == 1 && self.padding == 0 && input == ConvInput::None {
                Source::Flat { x: x.data, rows: h * w, inner: self.inputs }
            } else {
                let fill = match input {
                    ConvInput::None => Fill::Copy(x.data),
                    ConvInput::Relu => Fill::Relu(x.data),
                };
                Source::Bands(self.bands(fill, h, w))
            };
        let layout = OutLayout::dense(oh * ow, self.outputs);
        Product { source, columns: self, width: self.outputs, bias: self.bias.as_deref(), end, layout }
            .run(c, out);
    }

    /// Whether it is a 1×1 convolution, a linear map of each pixel.
    pub(crate) fn is_pointwise(&self) -> bool {
        self.kernel == [1, 1] && self.stride == 1 && self.padding == 0
    }

    /// Whether the output has the input's rows and columns.
    pub(crate) fn keeps_size(&self) -> bool {
        self.stride == 1 && self.kernel.iter().all(|k| *k == 2 * self.padding + 1)
    }

    pub(crate) fn weight(&self) -> &Weight {
        &self.weight
    }

    pub(crate) fn bias(&self) -> Option<&[f32]> {
        self.bias.as_deref()
    }

    pub(crate) fn bands<'a>(&self, fill: Fill<'a>, rows: usize, cols: usize) -> Bands<'a> {
        let (out_rows, out_cols) = self.output_size(rows, cols);
        Bands {
            fill,
            rows,
            cols,
            channels: self.inputs,
            kernel: self.kernel,
            stride: self.stride,
            padding: self.padding,
            out_rows,
            out_cols,
        }
    }
}

/// Columns of B are the kernels of the output channels, in the order [ky][kx][in] of the taps.
impl Columns for Conv2d {
    fn read(&self, column: usize, out: &mut [f32]) {
        let area = self.kernel[0] * self.kernel[1];
        if area == 1 {
            return self.weight.read(column * out.len(), out);
        }
        let mut scratch = scratch::borrow(Role::Kernels);
        let kernels = &mut scratch.floats(out.len())[..out.len()];
        self.weight.read(column * kernels.len(), kernels);
        for (i, kernel) in kernels.chunks_exact(area).enumerate() {
            for (tap, value) in kernel.iter().enumerate() {
                out[tap * self.inputs + i] = *value;
            }
        }
    }
}

/// An NHWC map of one image: `[rows, cols, channels]`, row-major.
#[derive(Debug, Clone, Copy)]
pub struct MapRef<'a> {
    /// The numbers.
    pub data: &'a [f32],
    /// Rows of pixels.
    pub rows: usize,
    /// Pixels of a row.
    pub cols: usize,
}

impl<'a> MapRef<'a> {
    /// A map of `rows` × `cols` pixels.
    pub const fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        Self { data, rows, cols }
    }
}

/// A transposed convolution whose stride equals its kernel, with weight `[in, out, k, k]`: every input pixel becomes a
/// k×k block of output pixels.
#[derive(Debug, Clone)]
pub struct ConvTranspose2d {
    weight: Weight,
    bias: Option<Vec<f32>>,
    inputs: usize,
    outputs: usize,
    kernel: usize,
}

impl ConvTranspose2d {
    /// Constructs a layer.
    ///
    /// # Errors
    /// [`NnError::WeightShape`] when the kernel is not square or the shapes do not fit.
    pub fn new(weight: Weight, bias: Option<Weight>) -> Result<Self, NnError> {
        let &[inputs, outputs, kernel, kw] = weight.shape() else {
            return Err(wrong_shape("transposed convolution", &weight, "[in, out, k, k]"));
        };
        if kernel != kw || kernel == 0 {
            return Err(wrong_shape("transposed convolution", &weight, "[in, out, k, k] with k >= 1"));
        }
        let bias = vector("transposed convolution", bias, outputs)?;
        Ok(Self { weight, bias, inputs, outputs, kernel })
    }

    /// Channels of the output.
    pub fn out_channels(&self) -> usize {
        self.outputs
    }

    /// Rows and columns of the output.
    pub fn output_size(&self, h: usize, w: usize) -> (usize, usize) {
        (h * self.kernel, w * self.kernel)
    }

    /// Spreads `x` (`[h, w, in]`) into `out` (`[h k, w k, out]`).
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn apply(&self, c: &Compute, x: MapRef<'_>, out: &mut [f32]) {
        let (h, w) = (x.rows, x.cols);
        let k = self.kernel;
        assert_eq!(x.data.len(), h * w * self.inputs, "input of a transposed convolution");
        assert_eq!(out.len(), h * w * k * k * self.outputs, "output of a transposed convolution");
        if self.inputs == 0 || out.is_empty() {
            let bias = self.bias.as_deref().unwrap_or(&[]);
            out.chunks_exact_mut(bias.len().max(1)).for_each(|out| out.copy_from_slice(bias));
            return;
        }
        // One product per row of the kernel: the k pixels that an input pixel gives in an output row are consecutive.
        // The weight is small and in an unhandy order, so it is put in order once: [ky][kx][out][in].
        let mut ordered = vec![0.0; self.weight.len()];
        let mut row = vec![0.0; self.outputs * k * k];
        for i in 0..self.inputs {
            self.weight.read(i * row.len(), &mut row);
            for (o, block) in row.chunks_exact(k * k).enumerate() {
                for (tap, value) in block.iter().enumerate() {
                    ordered[(tap * self.outputs + o) * self.inputs + i] = *value;
                }
            }
        }
        let bias: Option<Vec<f32>> = self.bias.as_ref().map(|bias| bias.repeat(k));
        let width = k * self.outputs;
        for (ky, kernel_row) in ordered.chunks_exact(width * self.inputs).enumerate() {
            let line = w * width;
            let product = Product {
                source: Source::Flat { x: x.data, rows: h * w, inner: self.inputs },
                columns: &DenseColumns { values: kernel_row, inner: self.inputs },
                width,
                bias: bias.as_deref(),
                end: End::Store,
                layout: OutLayout { line: w, line_stride: k * line, row_stride: width, offset: ky * line },
            };
            product.run(c, out);
        }
    }
}

struct DenseColumns<'a> {
    values: &'a [f32],
    inner: usize,
}

impl Columns for DenseColumns<'_> {
    fn read(&self, column: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.values[column * self.inner..(column + 1) * self.inner]);
    }
}
