//! Layers put on the device from their place in the key tree.

use crate::error::Da3Error;
use crate::weights::Scope;
use vidar_gpu::ops::{Convolution, Norm, PointLayer, Spread};
use vidar_gpu::{Buffer, Gpu, Matrix, Storage};

/// A linear layer.
pub(super) fn matrix(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [inputs, outputs]: [usize; 2],
    storage: Storage,
) -> Result<Matrix, Da3Error> {
    let layer = scope.at(part);
    let (weight, bias) = (layer.weight("weight", &[outputs, inputs])?, layer.vector("bias", outputs)?);
    Ok(Matrix::new(gpu, weight.name(), &weight.to_f32(), Some(&bias), [outputs, inputs], storage)?)
}

/// The first layer of a gated unit.
pub(super) fn gated(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [inputs, outputs]: [usize; 2],
    storage: Storage,
) -> Result<Matrix, Da3Error> {
    let layer = scope.at(part);
    let (weight, bias) = (layer.weight("weight", &[outputs, inputs])?, layer.vector("bias", outputs)?);
    Ok(Matrix::gated(gpu, weight.name(), &weight.to_f32(), &bias, [outputs, inputs], storage)?)
}

/// A vector.
pub(super) fn vector(gpu: &Gpu, scope: &Scope, leaf: &str, length: usize) -> Result<Buffer, Da3Error> {
    Ok(gpu.upload(leaf, &scope.vector(leaf, length)?)?)
}

/// A layer norm.
pub(super) fn norm(gpu: &Gpu, scope: &Scope, part: &str, width: usize, eps: f32) -> Result<Norm, Da3Error> {
    let layer = scope.at(part);
    let weight = layer.weight("weight", &[width])?;
    Ok(Norm::new(gpu, weight.name(), &weight.to_f32(), &layer.vector("bias", width)?, eps)?)
}

/// Inputs, outputs and side of a square convolution.
pub(super) type Sizes = [usize; 3];

/// A convolution with a bias.
pub(super) fn conv(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    sizes: Sizes,
    (stride, storage): (usize, Storage),
) -> Result<Convolution, Da3Error> {
    let bias = scope.at(part).vector("bias", sizes[1])?;
    convolution(gpu, scope, part, sizes, Some(&bias), (stride, storage))
}

/// A 3×3 convolution without a bias.
pub(super) fn conv_unbiased(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [inputs, outputs]: [usize; 2],
    storage: Storage,
) -> Result<Convolution, Da3Error> {
    convolution(gpu, scope, part, [inputs, outputs, 3], None, (1, storage))
}

fn convolution(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [inputs, outputs, side]: Sizes,
    bias: Option<&[f32]>,
    rest: (usize, Storage),
) -> Result<Convolution, Da3Error> {
    let weight = scope.at(part).weight("weight", &[outputs, inputs, side, side])?;
    Ok(Convolution::new(gpu, weight.name(), &weight.to_f32(), bias, [outputs, inputs, side], rest)?)
}

/// A transposed convolution whose stride is its side, as many channels out as in.
pub(super) fn spread(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [channels, side]: [usize; 2],
    storage: Storage,
) -> Result<Spread, Da3Error> {
    let layer = scope.at(part);
    let weight = layer.weight("weight", &[channels, channels, side, side])?;
    let bias = layer.vector("bias", channels)?;
    Ok(Spread::new(gpu, weight.name(), &weight.to_f32(), &bias, [channels, channels, side], storage)?)
}

/// The last layer of a head.
pub(super) fn last(
    gpu: &Gpu,
    scope: &Scope,
    part: &str,
    [inputs, outputs]: [usize; 2],
    norm: Option<Norm>,
) -> Result<PointLayer, Da3Error> {
    let layer = scope.at(part);
    let weight = layer.weight("weight", &[outputs, inputs, 1, 1])?;
    Ok(PointLayer::new(gpu, weight.name(), &weight.to_f32(), &layer.vector("bias", outputs)?, norm)?)
}
