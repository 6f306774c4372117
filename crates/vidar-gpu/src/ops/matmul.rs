//! Matrix products with what is done to their sums.

mod shader;

use crate::buffer::Buffer;
use crate::error::GpuError;
use crate::kernel::Kernel;
use crate::recorder::Recorder;
use crate::weight::{Matrix, Storage};
use shader::source;

/// What is done with sums before they are stored.
#[derive(Clone, Copy)]
pub enum End<'a> {
    /// Stored as they are.
    Store,
    /// GELU in its exact form.
    Gelu,
    /// max(x, 0).
    Relu,
    /// Added to what the output holds.
    Accumulate,
    /// Added to what the output holds, times a factor per column (LayerScale).
    Scaled(&'a Buffer),
    /// Numbers of the output's layout, from a place on, are added: `out = other + sum`.
    Add(&'a Buffer, usize),
    /// `silu(gate) * value` of pairs of columns that [`gated_order`] has put beside each other.
    Gated,
}

/// Rows of a matrix in a buffer.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    /// Where they are.
    pub buffer: &'a Buffer,
    /// The first number.
    pub at: usize,
    /// Numbers from row to row.
    pub stride: usize,
}

impl<'a> Rows<'a> {
    /// Rows of `width` numbers from the start of a buffer.
    pub fn of(buffer: &'a Buffer, width: usize) -> Self {
        Self { buffer, at: 0, stride: width }
    }

    /// The rows from `row` on.
    #[must_use]
    pub fn from_row(self, row: usize) -> Self {
        Self { at: self.at + row * self.stride, ..self }
    }
}

/// What a kernel does, apart from sizes that are given with each product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Form {
    pub tile: Tile,
    pub input: Input,
    pub storage: Storage,
    pub output: Output,
}

/// Sums per workgroup.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tile {
    /// 64 × 64.
    Small,
    /// 128 × 128.
    Large,
    /// 128 × 32, for convolutions to few channels.
    Narrow,
}

/// Where rows of the left factor come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Input {
    /// They are there.
    Flat,
    /// A row is what a 3×3 kernel sees of a map with a border of zeros.
    Three,
    /// As `Three`, of max(x, 0).
    ThreeRelu,
}

/// What becomes of a sum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    Store,
    Gelu,
    Relu,
    Accumulate,
    Scaled,
    Add,
    Gated,
    /// Stored in a larger map, see [`super::spread`].
    Spread,
}

struct TileSizes {
    rows: usize,
    columns: usize,
    inner: usize,
    own_rows: usize,
    own_columns: usize,
}

impl Tile {
    fn sizes(self) -> TileSizes {
        let (rows, columns, inner, own_rows, own_columns) = match self {
            Self::Small => (64, 64, 4, 4, 4),
            Self::Large => (128, 128, 2, 8, 8),
            Self::Narrow => (128, 32, 4, 8, 2),
        };
        TileSizes { rows, columns, inner, own_rows, own_columns }
    }
}

/// Tiles of 128 × 128 below which small ones keep more of a device busy.
const FEW_TILES: usize = 96;
/// Invocations along the columns of every tile: the distance between a gate and its value.
const ACROSS: usize = 16;

fn tile_for(rows: usize, columns: usize) -> Tile {
    if columns <= 32 {
        Tile::Narrow
    } else if rows.div_ceil(128) * columns.div_ceil(128) >= FEW_TILES {
        Tile::Large
    } else {
        Tile::Small
    }
}

/// The order of the rows of a gated unit's weight: blocks of 16 gates before the 16 values that they gate, the last block
/// filled up with rows that are not there. The first half of `outputs` are the gates.
pub fn gated_order(outputs: usize) -> Vec<Option<usize>> {
    let half = outputs / 2;
    let some = |row: usize, end: usize| (row < end).then_some(row);
    (0..half.next_multiple_of(ACROSS))
        .step_by(ACROSS)
        .flat_map(|first| {
            let gates = (first..first + ACROSS).map(move |row| some(row, half));
            gates.chain((first..first + ACROSS).map(move |row| some(half + row, 2 * half)))
        })
        .collect()
}

impl Matrix {
    /// A gated unit's matrix: the first half of its outputs gates the second ([`End::Gated`]).
    ///
    /// # Errors
    /// As [`Matrix::new`].
    ///
    /// # Panics
    /// When the lengths do not fit or the number of outputs is odd.
    pub fn gated(
        gpu: &crate::Gpu,
        name: &str,
        values: &[f32],
        bias: &[f32],
        [outputs, inputs]: [usize; 2],
        storage: Storage,
    ) -> Result<Self, GpuError> {
        assert!(outputs.is_multiple_of(2) && values.len() == outputs * inputs && bias.len() == outputs);
        let order = gated_order(outputs);
        let mut ordered = vec![0.0; order.len() * inputs];
        let mut ordered_bias = vec![0.0; order.len()];
        for (to, from) in order.iter().enumerate() {
            if let Some(from) = from {
                ordered[to * inputs..][..inputs].copy_from_slice(&values[from * inputs..][..inputs]);
                ordered_bias[to] = bias[*from];
            }
        }
        Self::new(gpu, name, &ordered, Some(&ordered_bias), [order.len(), inputs], storage)
    }
}

/// `out = end(x Wᵀ + b)` over `rows` rows.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When ranges do not fit.
pub fn product(
    recorder: &mut Recorder,
    x: Rows<'_>,
    rows: usize,
    weight: &Matrix,
    out: Rows<'_>,
    end: End<'_>,
) -> Result<(), GpuError> {
    let output = match end {
        End::Store => Output::Store,
        End::Gelu => Output::Gelu,
        End::Relu => Output::Relu,
        End::Accumulate => Output::Accumulate,
        End::Scaled(_) => Output::Scaled,
        End::Add(..) => Output::Add,
        End::Gated => Output::Gated,
    };
    let columns = if output == Output::Gated { out.stride.min(weight.outputs / 2) } else { weight.outputs };
    assert!(
        x.at.is_multiple_of(4) && x.stride.is_multiple_of(4),
        "rows of a product begin at multiples of 4"
    );
    check_rows(x, rows, weight.inputs);
    check_rows(out, rows, columns);
    let form =
        Form { tile: tile_for(rows, weight.outputs), input: Input::Flat, storage: weight.storage, output };
    let (extra, extra_at) = match end {
        End::Scaled(gamma) => (gamma, 0),
        End::Add(other, at) => (other, at),
        _ => (&weight.bias, 0),
    };
    let params = Params {
        in_at: x.at / 4,
        in_stride: x.stride / 4,
        out_at: out.at,
        out_stride: out.stride,
        extra_at,
        ..Params::of(rows, weight)
    };
    run(recorder, form, x.buffer, weight, extra, out.buffer, &params)
}

/// As [`product`] from the start of one buffer to the start of another, rows dense.
///
/// # Errors
/// As [`product`].
///
/// # Panics
/// As [`product`].
pub fn product_into(
    recorder: &mut Recorder,
    x: &Buffer,
    rows: usize,
    weight: &Matrix,
    out: &Buffer,
    end: End<'_>,
) -> Result<(), GpuError> {
    product(recorder, Rows::of(x, weight.inputs), rows, weight, Rows::of(out, weight.outputs), end)
}

fn check_rows(rows: Rows<'_>, count: usize, width: usize) {
    let end = rows.at + count.saturating_sub(1) * rows.stride + width;
    assert!(count == 0 || end <= rows.buffer.len(), "{count} rows of {width} at {}", rows.at);
}

/// Sizes of one product, in the shader's order.
#[derive(Default)]
pub(crate) struct Params {
    pub rows: usize,
    pub columns: usize,
    pub inner: usize,
    pub in_at: usize,
    pub in_stride: usize,
    pub out_at: usize,
    pub out_stride: usize,
    pub map_rows: usize,
    pub map_columns: usize,
    pub out_columns: usize,
    pub step: usize,
    pub extra_at: usize,
}

impl Params {
    pub fn of(rows: usize, weight: &Matrix) -> Self {
        let inner = weight.inputs / 4;
        Self { rows, columns: weight.outputs, inner, ..Self::default() }
    }

    fn words(&self) -> [u32; 12] {
        [
            self.rows,
            self.columns,
            self.inner,
            self.in_at,
            self.in_stride,
            self.out_at,
            self.out_stride,
            self.map_rows,
            self.map_columns,
            self.out_columns,
            self.step,
            self.extra_at,
        ]
        .map(|n| n as u32)
    }
}

/// Records a product of any form.
pub(crate) fn run(
    recorder: &mut Recorder,
    form: Form,
    x: &Buffer,
    weight: &Matrix,
    extra: &Buffer,
    out: &Buffer,
    params: &Params,
) -> Result<(), GpuError> {
    const FOLD: usize = 32768; // as in the shader
    let sizes = form.tile.sizes();
    let (across, down) = (params.columns.div_ceil(sizes.columns), params.rows.div_ceil(sizes.rows));
    let groups = [across as u32, down.min(FOLD) as u32, down.div_ceil(FOLD) as u32];
    let reads = [x, &weight.words, &weight.bias, extra];
    recorder.dispatch(&kernel(form), &reads, out, &params.words(), groups)
}

fn kernel(form: Form) -> Kernel {
    let Form { tile, input, storage, output } = form;
    let name = format!("product {tile:?} {input:?} {} {output:?}", storage.name());
    Kernel::new(name, 4, move || source(form))
}

/// Every form in use.
pub(crate) fn every_kernel() -> Vec<Kernel> {
    let mut all = Vec::new();
    for tile in [Tile::Small, Tile::Large, Tile::Narrow] {
        for storage in [Storage::F32, Storage::Bf16, Storage::F16] {
            for output in [
                Output::Store,
                Output::Gelu,
                Output::Relu,
                Output::Accumulate,
                Output::Scaled,
                Output::Add,
                Output::Gated,
                Output::Spread,
            ] {
                all.push(Form { tile, input: Input::Flat, storage, output });
            }
            for input in [Input::Three, Input::ThreeRelu] {
                for output in [Output::Store, Output::Relu, Output::Accumulate] {
                    all.push(Form { tile, input, storage, output });
                }
            }
        }
    }
    all.into_iter().map(kernel).collect()
}
