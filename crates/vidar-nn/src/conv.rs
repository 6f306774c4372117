//! Convolutions over NHWC maps, as implicit matrix products.
//!
//! A band of output rows is one chunk: its input rows are copied once with a border of zeros, and the pixels under a
//! kernel row are then consecutive numbers. There is no im2col copy.

use crate::compute::Compute;
use crate::error::NnError;
use crate::kernels::gemm::{Columns, Product, Rows, Run};
use crate::linear::{Epilogue, FlatRows, WeightRows, vector, wrong_shape};
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
    /// Puts a layer together; the border is `padding` zeros on each side.
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
        let bias = self.bias.as_deref();
        if self.kernel == [1, 1] && self.stride == 1 && self.padding == 0 && input == ConvInput::None {
            let rows = FlatRows::new(x.data, h * w, self.inputs, self.outputs);
            let columns = WeightRows { weight: &self.weight, inner: self.inputs };
            Product { rows: &rows, columns: &columns, width: self.outputs, bias, end }.run(c, out);
            return;
        }
        let band_rows = (TASK_PIXELS / ow.max(1)).clamp(1, oh.max(1));
        let padded = w + 2 * self.padding;
        let taps = (0..self.kernel[0]).map(|ky| ky * padded * self.inputs).collect();
        let rows = Bands {
            conv: self,
            x: x.data,
            h,
            w,
            oh,
            ow,
            band_rows,
            padded,
            taps,
            relu: input == ConvInput::Relu,
        };
        let columns = ConvColumns { weight: &self.weight, inputs: self.inputs, kernel: self.kernel };
        Product { rows: &rows, columns: &columns, width: self.outputs, bias, end }.run(c, out);
    }
}

/// An NHWC map of one picture: `[rows, cols, channels]`, row-major.
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

/// Output pixels of one task: enough to hide the repeated border rows, few enough to stay in the second-level cache.
const TASK_PIXELS: usize = 1024;

struct Bands<'a> {
    conv: &'a Conv2d,
    x: &'a [f32],
    h: usize,
    w: usize,
    oh: usize,
    ow: usize,
    band_rows: usize,
    padded: usize,
    taps: Vec<usize>,
    relu: bool,
}

impl Bands<'_> {
    fn band(&self, chunk: usize) -> std::ops::Range<usize> {
        let first = chunk * self.band_rows;
        first..(first + self.band_rows).min(self.oh)
    }
}

impl Rows for Bands<'_> {
    fn chunks(&self) -> usize {
        if self.ow == 0 { 0 } else { self.oh.div_ceil(self.band_rows) }
    }
    fn chunk<'s>(&'s self, chunk: usize, scratch: &'s mut Vec<f32>) -> &'s [f32] {
        let (band, conv) = (self.band(chunk), self.conv);
        let line = self.padded * conv.inputs;
        let needed = (band.len() - 1) * conv.stride + conv.kernel[0];
        scratch.clear();
        scratch.resize(needed * line, 0.0);
        if line == 0 {
            return scratch;
        }
        for (i, to) in scratch.chunks_exact_mut(line).enumerate() {
            let Some(row) =
                (band.start * conv.stride + i).checked_sub(conv.padding).filter(|row| *row < self.h)
            else {
                continue;
            };
            let from = &self.x[row * self.w * conv.inputs..(row + 1) * self.w * conv.inputs];
            let to = &mut to[conv.padding * conv.inputs..][..from.len()];
            if self.relu {
                for (to, from) in to.iter_mut().zip(from) {
                    *to = if *from < 0.0 { 0.0 } else { *from };
                }
            } else {
                to.copy_from_slice(from);
            }
        }
        scratch
    }
    fn runs(&self, chunk: usize, run: &mut dyn FnMut(Run)) {
        let band = self.band(chunk);
        for (i, oy) in band.enumerate() {
            let a = i * self.conv.stride * self.padded * self.conv.inputs;
            run(Run { a, out: oy * self.ow * self.conv.outputs, len: self.ow });
        }
    }
    fn taps(&self) -> &[usize] {
        &self.taps
    }
    fn group(&self) -> usize {
        self.conv.kernel[1] * self.conv.inputs
    }
    fn row_stride(&self) -> usize {
        self.conv.stride * self.conv.inputs
    }
    fn out_stride(&self) -> usize {
        self.conv.outputs
    }
}

/// Columns of B are the kernels of the output channels, in the order [ky][kx][in] of the taps.
struct ConvColumns<'a> {
    weight: &'a Weight,
    inputs: usize,
    kernel: [usize; 2],
}

impl Columns for ConvColumns<'_> {
    fn read(&self, column: usize, out: &mut [f32]) {
        let area = self.kernel[0] * self.kernel[1];
        let mut kernels = vec![0.0; out.len()];
        self.weight.read(column * out.len(), &mut kernels);
        for (i, kernel) in kernels.chunks_exact(area).enumerate() {
            for (tap, value) in kernel.iter().enumerate() {
                out[tap * self.inputs + i] = *value;
            }
        }
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
    /// Puts a layer together.
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
        // One product per row of the kernel: the k pixels that an input pixel gives in an output row are consecutive.
        let bias: Option<Vec<f32>> = self.bias.as_ref().map(|bias| bias.repeat(k));
        for ky in 0..k {
            let rows = SpreadRows { x: x.data, h, w, inputs: self.inputs, k, ky, outputs: self.outputs };
            let columns = SpreadColumns {
                weight: &self.weight,
                inputs: self.inputs,
                outputs: self.outputs,
                kernel: k,
                ky,
            };
            let product = Product {
                rows: &rows,
                columns: &columns,
                width: k * self.outputs,
                bias: bias.as_deref(),
                end: crate::kernels::gemm::End::Store,
            };
            product.run(c, out);
        }
    }
}

struct SpreadRows<'a> {
    x: &'a [f32],
    h: usize,
    w: usize,
    inputs: usize,
    k: usize,
    ky: usize,
    outputs: usize,
}

impl Rows for SpreadRows<'_> {
    fn chunks(&self) -> usize {
        if self.w == 0 { 0 } else { self.h }
    }
    fn chunk<'s>(&'s self, chunk: usize, _scratch: &'s mut Vec<f32>) -> &'s [f32] {
        let line = self.w * self.inputs;
        &self.x[chunk * line..(chunk + 1) * line]
    }
    fn runs(&self, chunk: usize, run: &mut dyn FnMut(Run)) {
        let out = (chunk * self.k + self.ky) * self.w * self.k * self.outputs;
        run(Run { a: 0, out, len: self.w });
    }
    fn taps(&self) -> &[usize] {
        &[0]
    }
    fn group(&self) -> usize {
        self.inputs
    }
    fn row_stride(&self) -> usize {
        self.inputs
    }
    fn out_stride(&self) -> usize {
        self.k * self.outputs
    }
}

/// Column (kx, out channel) of kernel row `ky`.
struct SpreadColumns<'a> {
    weight: &'a Weight,
    inputs: usize,
    outputs: usize,
    kernel: usize,
    ky: usize,
}

impl Columns for SpreadColumns<'_> {
    fn read(&self, column: usize, out: &mut [f32]) {
        let (kx, channel) = (column / self.outputs, column % self.outputs);
        for i in 0..self.inputs {
            let at = ((i * self.outputs + channel) * self.kernel + self.ky) * self.kernel + kx;
            self.weight.read(at, &mut out[i..=i]);
        }
    }
}
