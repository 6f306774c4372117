//! Layer norm over rows.

use super::groups;
use super::matmul::Rows;
use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::Kernel;
use crate::recorder::Recorder;

/// A layer norm's factors and offsets.
pub struct Norm {
    weight: Buffer,
    bias: Buffer,
    eps: f32,
}

impl Norm {
    /// Puts a norm on the device.
    ///
    /// # Errors
    /// [`GpuError::Shape`] when the width is no multiple of 4; errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths differ.
    pub fn new(gpu: &Gpu, name: &str, weight: &[f32], bias: &[f32], eps: f32) -> Result<Self, GpuError> {
        assert_eq!(weight.len(), bias.len(), "{name}: norm");
        if !weight.len().is_multiple_of(4) || weight.is_empty() {
            let (layer, found) = (name.to_owned(), weight.len());
            return Err(GpuError::Shape {
                layer,
                what: "width of a norm",
                found,
                expected: "a multiple of 4",
            });
        }
        Ok(Self { weight: gpu.upload(name, weight)?, bias: gpu.upload(name, bias)?, eps })
    }

    /// Length of a row.
    pub fn width(&self) -> usize {
        self.weight.len()
    }

    pub(crate) fn parts(&self) -> (&Buffer, &Buffer, f32) {
        (&self.weight, &self.bias, self.eps)
    }
}

/// Normalises `rows` rows of one buffer into another.
///
/// # Errors
/// When the device refuses the kernel.
///
/// # Panics
/// When ranges do not fit or begin at no multiple of 4.
pub fn layer_norm(
    recorder: &mut Recorder,
    norm: &Norm,
    x: Rows<'_>,
    rows: usize,
    out: Rows<'_>,
) -> Result<(), GpuError> {
    let width = norm.width();
    for part in [x, out] {
        assert!(part.at.is_multiple_of(4) && part.stride.is_multiple_of(4), "rows of a norm");
        assert!(
            rows == 0 || part.at + (rows - 1) * part.stride + width <= part.buffer.len(),
            "rows of a norm"
        );
    }
    let four = |n: usize| (n / 4) as u32;
    let words = [
        rows as u32,
        four(width),
        four(x.at),
        four(x.stride),
        four(out.at),
        four(out.stride),
        norm.eps.to_bits(),
    ];
    let reads = [x.buffer, &norm.weight, &norm.bias];
    recorder.dispatch(&kernel(), &reads, out.buffer, &words, groups(rows, 8))
}

fn kernel() -> Kernel {
    Kernel::new("norm".into(), 3, || include_str!("../shaders/norm.wgsl").to_owned())
}

pub(crate) fn every_kernel() -> Vec<Kernel> {
    vec![kernel()]
}
