//! Weights in device memory.

use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use half::{bf16, f16};

/// The number format of weights in device memory. Sums are `f32` in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Storage {
    /// 4 bytes a weight.
    #[default]
    F32,
    /// 2 bytes: the upper half of an `f32`.
    Bf16,
    /// 2 bytes: the IEEE half.
    F16,
}

impl Storage {
    /// Bytes of a weight.
    pub fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::Bf16 | Self::F16 => 2,
        }
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
        }
    }
}

/// A matrix `[outputs, inputs]` and its bias, for products `x Wᵀ + b`.
pub struct Matrix {
    pub(crate) words: Buffer,
    pub(crate) bias: Buffer,
    pub(crate) storage: Storage,
    pub(crate) outputs: usize,
    pub(crate) inputs: usize,
}

impl Matrix {
    /// Puts a matrix on the device. `values` are `[outputs, inputs]`, row-major; without a bias there are zeros.
    ///
    /// # Errors
    /// [`GpuError::Shape`] when `inputs` is no multiple of 4; errors of [`Gpu::buffer`].
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn new(
        gpu: &Gpu,
        name: &str,
        values: &[f32],
        bias: Option<&[f32]>,
        [outputs, inputs]: [usize; 2],
        storage: Storage,
    ) -> Result<Self, GpuError> {
        assert_eq!(values.len(), outputs * inputs, "{name}: weight");
        if !inputs.is_multiple_of(4) || inputs == 0 {
            return Err(GpuError::Shape {
                layer: name.to_owned(),
                what: "number of inputs",
                found: inputs,
                expected: "a multiple of 4",
            });
        }
        let words = match storage {
            Storage::F32 => gpu.upload(name, values)?,
            Storage::Bf16 => packed(gpu, name, values, |x| bf16::from_f32(x).to_bits())?,
            Storage::F16 => packed(gpu, name, values, |x| f16::from_f32(x).to_bits())?,
        };
        let bias = match bias {
            Some(bias) => {
                assert_eq!(bias.len(), outputs, "{name}: bias");
                gpu.upload(name, bias)?
            }
            None => gpu.upload(name, &vec![0.0; outputs])?,
        };
        Ok(Self { words, bias, storage, outputs, inputs })
    }

    /// Columns of the output.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Columns of the input.
    pub fn inputs(&self) -> usize {
        self.inputs
    }
}

fn packed(gpu: &Gpu, name: &str, values: &[f32], bits: impl Fn(f32) -> u16) -> Result<Buffer, GpuError> {
    let word = |pair: &[f32]| u32::from(bits(pair[0])) | (u32::from(bits(pair[1])) << 16);
    let words: Vec<u32> = values.chunks_exact(2).map(word).collect();
    let buffer = gpu.buffer(name, words.len())?;
    buffer.write_words(gpu, 0, &words);
    Ok(buffer)
}
