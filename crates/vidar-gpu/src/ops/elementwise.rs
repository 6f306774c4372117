//! Operations on single numbers, patches and pixels.

use super::groups;
use super::matmul::Rows;
use super::norm::Norm;
use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::{Kernel, fill};
use crate::recorder::Recorder;

/// `y[out_at..] += x[in_at..]` over `count` numbers.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When a range does not fit.
pub fn add(
    recorder: &mut Recorder,
    (x, in_at): (&Buffer, usize),
    (y, out_at): (&Buffer, usize),
    count: usize,
) -> Result<(), GpuError> {
    assert!(in_at + count <= x.len() && out_at + count <= y.len(), "{count} numbers to add");
    let words = [count, in_at, out_at].map(|n| n as u32);
    recorder.dispatch(&add_kernel(), &[x], y, &words, groups(count, 256))
}

/// Copies `rows` rows of `width` numbers.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When a range does not fit.
pub fn copy_rows(
    recorder: &mut Recorder,
    x: Rows<'_>,
    (rows, width): (usize, usize),
    out: Rows<'_>,
) -> Result<(), GpuError> {
    for part in [x, out] {
        let end = part.at + rows.saturating_sub(1) * part.stride + width;
        assert!(rows == 0 || end <= part.buffer.len(), "{rows} rows of {width} to be copied");
    }
    let words = [rows * width, width, x.at, x.stride, out.at, out.stride].map(|n| n as u32);
    recorder.dispatch(&copy_kernel(), &[x.buffer], out.buffer, &words, groups(rows * width, 256))
}

/// Writes the patches of an image of three planes, `[3, rows, columns]` from `in_at` on, as rows
/// `[rows/side · columns/side, 3 · side²]`.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When a range does not fit or the sides are no multiples.
pub fn patchify(
    recorder: &mut Recorder,
    (x, in_at): (&Buffer, usize),
    [rows, columns, side]: [usize; 3],
    out: &Buffer,
) -> Result<(), GpuError> {
    let count = 3 * rows * columns;
    assert!(
        rows.is_multiple_of(side) && columns.is_multiple_of(side),
        "patches of {side} in {columns}x{rows}"
    );
    assert!(in_at + count <= x.len() && count <= out.len(), "pixels of a picture");
    let words = [count, in_at, rows, columns, side].map(|n| n as u32);
    recorder.dispatch(&patchify_kernel(), &[x], out, &words, groups(count, 256))
}

/// What becomes of a channel at the end of a head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// It stays.
    None,
    /// `exp x`.
    Exp,
    /// `1 + exp x`.
    OnePlusExp,
    /// `max(x, 0)`.
    Relu,
}

/// Channels that a [`PointLayer`] reads.
const POINT_INPUTS: usize = 32;
/// Most channels that it gives.
const POINT_OUTPUTS: usize = 8;

/// A 1×1 layer from 32 channels to a few, behind a norm where there is one, and max(x, 0).
pub struct PointLayer {
    weight: Buffer,
    bias: Buffer,
    norm: Option<Norm>,
    outputs: usize,
}

impl PointLayer {
    /// Puts a layer on the device; `values` are `[outputs, 32]`.
    ///
    /// # Errors
    /// [`GpuError::Shape`] for another width; errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(
        gpu: &Gpu,
        name: &str,
        values: &[f32],
        bias: &[f32],
        norm: Option<Norm>,
    ) -> Result<Self, GpuError> {
        let outputs = bias.len();
        assert_eq!(values.len(), outputs * POINT_INPUTS, "{name}: weight");
        assert!(norm.as_ref().is_none_or(|n| n.width() == POINT_INPUTS), "{name}: norm");
        if outputs > POINT_OUTPUTS {
            let (layer, found) = (name.to_owned(), outputs);
            return Err(GpuError::Shape { layer, what: "number of outputs", found, expected: "at most 8" });
        }
        Ok(Self { weight: gpu.upload(name, values)?, bias: gpu.upload(name, bias)?, norm, outputs })
    }

    /// Channels given.
    pub fn outputs(&self) -> usize {
        self.outputs
    }
}

/// Takes `pixels` pixels of 32 channels through a layer; channels are planes of the output from `out_at` on.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When a range does not fit or the number of activations is another.
pub fn point(
    recorder: &mut Recorder,
    (x, pixels): (&Buffer, usize),
    layer: &PointLayer,
    activations: &[Activation],
    (out, out_at): (&Buffer, usize),
) -> Result<(), GpuError> {
    assert_eq!(activations.len(), layer.outputs, "activations");
    assert!(
        pixels * POINT_INPUTS <= x.len() && out_at + pixels * layer.outputs <= out.len(),
        "pixels of a head"
    );
    let code = |a: &Activation| match a {
        Activation::None => 0u32,
        Activation::Exp => 1,
        Activation::OnePlusExp => 2,
        Activation::Relu => 3,
    };
    let codes = activations.iter().enumerate().fold(0, |all, (o, a)| all | (code(a) << (4 * o)));
    let (weight, bias, eps) = match &layer.norm {
        Some(norm) => norm.parts(),
        None => (&layer.weight, &layer.weight, 0.0),
    };
    let words = [pixels as u32, layer.outputs as u32, out_at as u32, codes, eps.to_bits()];
    let reads = [x, weight, bias, &layer.weight, &layer.bias];
    recorder.dispatch(&point_kernel(layer.norm.is_some()), &reads, out, &words, groups(pixels, 64))
}

fn add_kernel() -> Kernel {
    Kernel::new("add".into(), 1, || include_str!("../shaders/add.wgsl").to_owned())
}

fn copy_kernel() -> Kernel {
    Kernel::new("copy rows".into(), 1, || include_str!("../shaders/copy_rows.wgsl").to_owned())
}

fn patchify_kernel() -> Kernel {
    Kernel::new("patchify".into(), 1, || include_str!("../shaders/patchify.wgsl").to_owned())
}

const POINT_NORM: &str = "  let mean = (sum.x + sum.y + sum.z + sum.w) / 32.0;
  var square = vec4<f32>();
  for (var c = 0u; c < 8u; c++) {
    v[c] -= mean;
    square = fma(v[c], v[c], square);
  }
  let scale = 1.0 / sqrt((square.x + square.y + square.z + square.w) / 32.0 + p.eps);
  for (var c = 0u; c < 8u; c++) {
    v[c] = fma(v[c] * scale, norm_weight[c], norm_bias[c]);
  }";

fn point_kernel(has_norm: bool) -> Kernel {
    Kernel::new(format!("point norm {has_norm}"), 5, move || {
        let norm = if has_norm { POINT_NORM } else { "" };
        fill(include_str!("../shaders/point.wgsl"), &[("NORM", norm.to_owned())])
    })
}

pub(crate) fn every_kernel() -> Vec<Kernel> {
    vec![add_kernel(), copy_kernel(), patchify_kernel(), point_kernel(true), point_kernel(false)]
}
