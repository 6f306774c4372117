//! Convolutions as products whose left factor is read from the map as it lies.

use super::matmul::{End, Form, Input, Output, Params, Tile, product_into, run};
use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::recorder::Recorder;
use crate::weight::{Matrix, Storage};

/// Rows, columns and channels of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapShape {
    /// Rows of pixels.
    pub rows: usize,
    /// Pixels of a row.
    pub columns: usize,
    /// Channels of a pixel.
    pub channels: usize,
}

impl MapShape {
    /// Pixels.
    pub fn pixels(self) -> usize {
        self.rows * self.columns
    }

    /// Numbers.
    #[allow(clippy::len_without_is_empty)] // a size, no container
    pub fn len(self) -> usize {
        self.pixels() * self.channels
    }
}

/// A convolution with a kernel of 1×1, or of 3×3 with a border of one.
pub struct Convolution {
    matrix: Matrix,
    side: usize,
    stride: usize,
    inputs: usize,
}

impl Convolution {
    /// Puts a convolution on the device; `values` are `[outputs, inputs, side, side]`.
    ///
    /// # Errors
    /// [`GpuError::Shape`] for another side or an input width that is no multiple of 4; errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(
        gpu: &Gpu,
        name: &str,
        values: &[f32],
        bias: Option<&[f32]>,
        [outputs, inputs, side]: [usize; 3],
        (stride, storage): (usize, Storage),
    ) -> Result<Self, GpuError> {
        let area = side * side;
        assert_eq!(values.len(), outputs * inputs * area, "{name}: weight");
        if side != 3 && !(side == 1 && stride == 1) {
            let layer = name.to_owned();
            return Err(GpuError::Shape {
                layer,
                what: "side of the kernel",
                found: side,
                expected: "1 or 3",
            });
        }
        if !inputs.is_multiple_of(4) {
            let (layer, expected) = (name.to_owned(), "a multiple of 4");
            return Err(GpuError::Shape { layer, what: "number of inputs", found: inputs, expected });
        }
        // From [in][tap] to [tap][in].
        let mut ordered = vec![0.0; values.len()];
        for (to, from) in ordered.chunks_exact_mut(inputs * area).zip(values.chunks_exact(inputs * area)) {
            for (i, taps) in from.chunks_exact(area).enumerate() {
                for (tap, value) in taps.iter().enumerate() {
                    to[tap * inputs + i] = *value;
                }
            }
        }
        let matrix = Matrix::new(gpu, name, &ordered, bias, [outputs, inputs * area], storage)?;
        Ok(Self { matrix, side, stride, inputs })
    }

    /// The output's shape for a map of some rows and columns.
    pub fn output(&self, rows: usize, columns: usize) -> MapShape {
        let side = |n: usize| if self.side == 1 { n } else { (n + 2 - self.side) / self.stride + 1 };
        MapShape { rows: side(rows), columns: side(columns), channels: self.matrix.outputs }
    }

    /// Channels of the input.
    pub fn inputs(&self) -> usize {
        self.inputs
    }
}

/// Convolves a map, of max(x, 0) when `relu` is set. `end` is one of `Store`, `Relu`, `Accumulate`.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When sizes do not fit or `end` is another.
pub fn convolve(
    recorder: &mut Recorder,
    (x, shape): (&Buffer, MapShape),
    layer: &Convolution,
    out: &Buffer,
    relu: bool,
    end: End<'_>,
) -> Result<MapShape, GpuError> {
    assert_eq!(shape.channels, layer.inputs, "channels of a convolution");
    let to = layer.output(shape.rows, shape.columns);
    assert!(shape.len() <= x.len() && to.len() <= out.len(), "maps of a convolution: {shape:?} to {to:?}");
    let matrix = &layer.matrix;
    if layer.side == 1 {
        assert!(!relu, "a 1x1 convolution reads its input as it is");
        product_into(recorder, x, shape.pixels(), matrix, out, end)?;
        return Ok(to);
    }
    let output = match end {
        End::Store => Output::Store,
        End::Relu => Output::Relu,
        End::Accumulate => Output::Accumulate,
        _ => unreachable!("a convolution stores, cuts off or accumulates"),
    };
    let input = if relu { Input::ThreeRelu } else { Input::Three };
    let tile = match to.channels {
        0..=32 => Tile::Narrow,
        33..=64 => Tile::Small,
        _ if to.pixels() >= 64 * 128 => Tile::Large,
        _ => Tile::Small,
    };
    let params = Params {
        in_stride: shape.channels / 4,
        out_stride: to.channels,
        map_rows: shape.rows,
        map_columns: shape.columns,
        out_columns: to.columns,
        step: layer.stride,
        ..Params::of(to.pixels(), matrix)
    };
    let form = Form { tile, input, storage: matrix.storage, output };
    run(recorder, form, x, matrix, &matrix.bias, out, &params)?;
    Ok(to)
}

/// A transposed convolution whose stride is its side: every pixel becomes a block of pixels.
pub struct Spread {
    matrix: Matrix,
    side: usize,
    outputs: usize,
}

impl Spread {
    /// Puts a layer on the device; `values` are `[inputs, outputs, side, side]`.
    ///
    /// # Errors
    /// As [`Matrix::new`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(
        gpu: &Gpu,
        name: &str,
        values: &[f32],
        bias: &[f32],
        [inputs, outputs, side]: [usize; 3],
        storage: Storage,
    ) -> Result<Self, GpuError> {
        let area = side * side;
        assert!(values.len() == inputs * outputs * area && bias.len() == outputs, "{name}: weight");
        let mut ordered = vec![0.0; values.len()];
        for (i, from) in values.chunks_exact(outputs * area).enumerate() {
            for (o, taps) in from.chunks_exact(area).enumerate() {
                for (tap, value) in taps.iter().enumerate() {
                    ordered[(tap * outputs + o) * inputs + i] = *value;
                }
            }
        }
        let bias = bias.repeat(area);
        let matrix = Matrix::new(gpu, name, &ordered, Some(&bias), [area * outputs, inputs], storage)?;
        Ok(Self { matrix, side, outputs })
    }

    /// The output's shape for a map of some rows and columns.
    pub fn output(&self, rows: usize, columns: usize) -> MapShape {
        MapShape { rows: rows * self.side, columns: columns * self.side, channels: self.outputs }
    }
}

/// Spreads a map.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When sizes do not fit.
pub fn spread(
    recorder: &mut Recorder,
    (x, shape): (&Buffer, MapShape),
    layer: &Spread,
    out: &Buffer,
) -> Result<MapShape, GpuError> {
    let matrix = &layer.matrix;
    assert_eq!(shape.channels, matrix.inputs, "channels of a transposed convolution");
    let to = layer.output(shape.rows, shape.columns);
    assert!(shape.len() <= x.len() && to.len() <= out.len(), "maps of a transposed convolution");
    let params = Params {
        in_stride: shape.channels / 4,
        out_stride: layer.outputs,
        out_columns: shape.columns,
        step: layer.side,
        ..Params::of(shape.pixels(), matrix)
    };
    let form =
        Form { tile: Tile::Small, input: Input::Flat, storage: matrix.storage, output: Output::Spread };
    run(recorder, form, x, matrix, &matrix.bias, out, &params)?;
    Ok(to)
}
