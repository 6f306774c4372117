//! Matrix products with what is done to their sums.

use crate::buffer::Buffer;
use crate::error::GpuError;
use crate::kernel::{Kernel, fill};
use crate::recorder::Recorder;
use crate::weight::{Matrix, Storage};
use std::fmt::Write as _;

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

fn source(form: Form) -> String {
    let TileSizes { rows, columns, inner, own_rows, own_columns } = form.tile.sizes();
    let (gx, gy) = (columns / own_columns, rows / own_rows);
    let (mut zero, mut products, mut stores) = (String::new(), String::new(), String::new());
    for j in 0..own_columns {
        let _ = writeln!(products, "      let w{j} = ws[(tx + {}u) * STRIDE + k];", j * gx);
    }
    for i in 0..own_rows {
        let _ = writeln!(products, "      let x{i} = xs[(ty + {}u) * STRIDE + k];", i * gy);
        for j in 0..own_columns {
            let _ = writeln!(zero, "  var s{i}_{j} = 0.0;");
            let _ = writeln!(
                products,
                "      s{i}_{j} = fma(x{i}.w, w{j}.w, fma(x{i}.z, w{j}.z, fma(x{i}.y, w{j}.y, fma(x{i}.x, w{j}.x, s{i}_{j}))));"
            );
            let row = format!("first_row + ty + {}u", i * gy);
            let _ = match form.output {
                Output::Gated if j % 2 == 0 => writeln!(
                    stores,
                    "  store_gated({row}, first_column + tx + {}u, s{i}_{j}, s{i}_{});",
                    j * gx,
                    j + 1
                ),
                Output::Gated => Ok(()),
                _ => writeln!(stores, "  store({row}, first_column + tx + {}u, s{i}_{j});", j * gx),
            };
        }
    }
    let is_gated = form.output == Output::Gated;
    fill(
        include_str!("../shaders/matmul.wgsl"),
        &[
            ("BM", rows.to_string()),
            ("BN", columns.to_string()),
            ("BK", inner.to_string()),
            ("TM", own_rows.to_string()),
            ("TN", own_columns.to_string()),
            ("GX", gx.to_string()),
            ("GY", gy.to_string()),
            ("XS", (rows * (inner + 1)).to_string()),
            ("WS", (columns * (inner + 1)).to_string()),
            ("THREADS", (gx * gy).to_string()),
            ("WTYPE", if form.storage == Storage::F32 { "vec4<f32>" } else { "vec2<u32>" }.to_owned()),
            ("LOAD_X", load_x(form.input).to_owned()),
            ("LOAD_W", load_w(form.storage).to_owned()),
            ("ERF_NOTE", "Φ by Abramowitz and Stegun 7.1.26: absolute error below 1.5e-7.".to_owned()),
            ("STORE", store(form.output).to_owned()),
            ("STORE_GATED", if is_gated { STORE_GATED } else { "" }.to_owned()),
            ("ZERO", zero),
            ("PRODUCTS", products),
            ("STORES", stores),
        ],
    )
}

/// Where four channels under a tap of a 3×3 kernel lie; zero outside of the map.
macro_rules! three {
    () => {
        "  if k >= p.inner { return vec4<f32>(); }
  let channels = p.in_stride;
  let tap = k / channels;
  let pixel = min(row, p.rows - 1u);
  let r = i32(pixel / p.out_columns * p.step + tap / 3u) - 1;
  let c = i32(pixel % p.out_columns * p.step + tap % 3u) - 1;
  if r < 0 || c < 0 || r >= i32(p.map_rows) || c >= i32(p.map_columns) { return vec4<f32>(); }
  let at = p.in_at + (u32(r) * p.map_columns + u32(c)) * channels + k % channels;
"
    };
}

fn load_x(input: Input) -> &'static str {
    match input {
        Input::Flat => {
            "  if k >= p.inner { return vec4<f32>(); }
  return x[p.in_at + min(row, p.rows - 1u) * p.in_stride + k];"
        }
        Input::Three => concat!(three!(), "  return x[at];"),
        Input::ThreeRelu => concat!(three!(), "  return max(x[at], vec4<f32>());"),
    }
}

fn load_w(storage: Storage) -> &'static str {
    match storage {
        Storage::F32 => "  return w[at];",
        Storage::Bf16 => {
            "  let v = w[at];
  return bitcast<vec4<f32>>(vec4<u32>(v.x << 16u, v.x & 0xffff0000u, v.y << 16u, v.y & 0xffff0000u));"
        }
        Storage::F16 => {
            "  let v = w[at];
  return vec4<f32>(unpack2x16float(v.x), unpack2x16float(v.y));"
        }
    }
}

fn store(output: Output) -> &'static str {
    match output {
        Output::Store | Output::Gated => "  y[p.out_at + row * p.out_stride + column] = v;",
        Output::Gelu => "  y[p.out_at + row * p.out_stride + column] = gelu(v);",
        Output::Relu => "  y[p.out_at + row * p.out_stride + column] = max(v, 0.0);",
        Output::Accumulate => "  y[p.out_at + row * p.out_stride + column] += v;",
        Output::Scaled => "  y[p.out_at + row * p.out_stride + column] += extra[column] * v;",
        Output::Add => {
            "  y[p.out_at + row * p.out_stride + column] = v + extra[p.extra_at + row * p.out_stride + column];"
        }
        Output::Spread => {
            "  let channels = p.out_stride;
  let tap = column / channels;
  let out_row = (row / p.out_columns) * p.step + tap / p.step;
  let out_column = (row % p.out_columns) * p.step + tap % p.step;
  y[p.out_at + (out_row * p.out_columns * p.step + out_column) * channels + column % channels] = v;"
        }
    }
}

const STORE_GATED: &str = "fn store_gated(row: u32, column: u32, gate: f32, value: f32) {
  let place = column / 32u * 16u + column % 16u;
  if row >= p.rows || column + 16u >= p.columns || place >= p.out_stride { return; }
  y[p.out_at + row * p.out_stride + place] = silu(gate + bias[column]) * (value + bias[column + 16u]);
}";

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
