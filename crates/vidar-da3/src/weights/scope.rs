//! A prefix of checkpoint keys from which layers are built: `scope.at("attn").linear("qkv", …)`.

use crate::error::Da3Error;
use std::sync::Arc;
use vidar_nn::{Conv2d, ConvTranspose2d, LayerNorm, Linear, Weight, WeightSource};

/// A prefix of keys and the source they are looked up in.
#[derive(Clone)]
pub(crate) struct Scope {
    source: Arc<dyn WeightSource>,
    path: String,
}

impl Scope {
    pub fn new(source: Arc<dyn WeightSource>, root: &str) -> Self {
        Self { source, path: root.into() }
    }

    /// The scope `self.part`.
    pub fn at(&self, part: &str) -> Self {
        Self { source: Arc::clone(&self.source), path: format!("{}.{part}", self.path) }
    }

    /// The tensor of a key below this scope.
    pub fn weight(&self, leaf: &str, shape: &[usize]) -> Result<Weight, Da3Error> {
        Ok(self.source.weight(&format!("{}.{leaf}", self.path), shape)?)
    }

    /// A vector, decoded.
    pub fn vector(&self, leaf: &str, length: usize) -> Result<Vec<f32>, Da3Error> {
        Ok(self.weight(leaf, &[length])?.to_f32())
    }

    pub fn linear(&self, part: &str, inputs: usize, outputs: usize) -> Result<Linear, Da3Error> {
        let layer = self.at(part);
        let bias = layer.weight("bias", &[outputs])?;
        Ok(Linear::new(layer.weight("weight", &[outputs, inputs])?, Some(bias))?)
    }

    pub fn norm(&self, part: &str, channels: usize, eps: f32) -> Result<LayerNorm, Da3Error> {
        let layer = self.at(part);
        let weight = layer.weight("weight", &[channels])?;
        Ok(LayerNorm::new(weight, layer.weight("bias", &[channels])?, eps)?)
    }

    /// A square convolution with a bias.
    pub fn conv(&self, part: &str, shape: ConvShape) -> Result<Conv2d, Da3Error> {
        let layer = self.at(part);
        let ConvShape { inputs, outputs, side, stride, padding } = shape;
        let bias = layer.weight("bias", &[outputs])?;
        let weight = layer.weight("weight", &[outputs, inputs, side, side])?;
        Ok(Conv2d::new(weight, Some(bias), stride, padding)?)
    }

    /// A 3×3 convolution with padding 1 and no bias.
    pub fn conv3_unbiased(&self, part: &str, inputs: usize, outputs: usize) -> Result<Conv2d, Da3Error> {
        let weight = self.at(part).weight("weight", &[outputs, inputs, 3, 3])?;
        Ok(Conv2d::new(weight, None, 1, 1)?)
    }

    /// A transposed convolution with stride equal to its kernel size and as many output as input channels.
    pub fn conv_transpose(
        &self,
        part: &str,
        channels: usize,
        side: usize,
    ) -> Result<ConvTranspose2d, Da3Error> {
        let layer = self.at(part);
        let weight = layer.weight("weight", &[channels, channels, side, side])?;
        Ok(ConvTranspose2d::new(weight, Some(layer.weight("bias", &[channels])?))?)
    }
}

/// Sizes of a square convolution.
#[derive(Clone, Copy)]
pub(crate) struct ConvShape {
    pub inputs: usize,
    pub outputs: usize,
    pub side: usize,
    pub stride: usize,
    pub padding: usize,
}

impl ConvShape {
    /// 1×1.
    pub fn point(inputs: usize, outputs: usize) -> Self {
        Self { inputs, outputs, side: 1, stride: 1, padding: 0 }
    }

    /// 3×3 with padding 1.
    pub fn three(inputs: usize, outputs: usize) -> Self {
        Self { inputs, outputs, side: 3, stride: 1, padding: 1 }
    }
}
