//! The fusion chain, `scratch.refinenet{1..4}` and its twin `_aux` for rays.
//!
//! A residual unit is `x + conv2(relu(conv1(relu x)))`. A fusion block adds the unit of the lateral map, passes its own
//! unit, enlarges to the next lateral's size with aligned corners, and mixes channels with the 1×1 `out_conv`. Both of
//! the last two are linear and the weights of the enlargement sum to one, so `out_conv` runs *before* it, on a quarter
//! of the pixels.

use super::map::Map;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use vidar_nn::{Compute, Conv2d, ConvInput, Epilogue};

/// `resConfUnitI.{conv1,conv2}`.
struct ResidualUnit {
    conv1: Conv2d,
    conv2: Conv2d,
}

impl ResidualUnit {
    fn load(scope: &Scope, features: usize) -> Result<Self, Da3Error> {
        let shape = ConvShape::three(features, features);
        Ok(Self { conv1: scope.conv("conv1", shape)?, conv2: scope.conv("conv2", shape)? })
    }

    /// `to += conv2(relu(conv1(relu of)))`.
    fn add(&self, c: &Compute, of: &Map, to: &mut [f32]) {
        let inner = of.convolved(c, &self.conv1, ConvInput::Relu, Epilogue::Relu);
        let end = Epilogue::Accumulate { gamma: None };
        self.conv2.apply(c, inner.view(), to, ConvInput::None, end);
    }

    /// `x += conv2(relu(conv1(relu x)))`.
    fn add_in_place(&self, c: &Compute, x: &mut Map) {
        let inner = x.convolved(c, &self.conv1, ConvInput::Relu, Epilogue::Relu);
        let end = Epilogue::Accumulate { gamma: None };
        self.conv2.apply(c, inner.view(), &mut x.data, ConvInput::None, end);
    }
}

/// One of the four blocks; the coarsest has no unit for a lateral map.
struct FusionBlock {
    lateral: Option<ResidualUnit>,
    own: ResidualUnit,
    out_conv: Conv2d,
}

/// The four blocks, coarsest last.
pub(crate) struct Fusion {
    blocks: Vec<FusionBlock>,
    suffix: &'static str,
}

impl Fusion {
    /// The chain whose keys end in `suffix`: nothing for depth, `_aux` for rays.
    pub fn load(scratch: &Scope, suffix: &'static str, features: usize) -> Result<Self, Da3Error> {
        let one = |level: usize| -> Result<FusionBlock, Da3Error> {
            let scope = scratch.at(&format!("refinenet{level}{suffix}"));
            let lateral =
                (level != 4).then(|| ResidualUnit::load(&scope.at("resConfUnit1"), features)).transpose()?;
            Ok(FusionBlock {
                lateral,
                own: ResidualUnit::load(&scope.at("resConfUnit2"), features)?,
                out_conv: scope.conv("out_conv", ConvShape::point(features, features))?,
            })
        };
        Ok(Self { blocks: (1..=4).map(one).collect::<Result<_, _>>()?, suffix })
    }

    /// The fused map at twice the size of the finest lateral (8ph × 8pw).
    pub fn run(&self, run: &Run<'_>, view: usize, laterals: &[Map]) -> Result<Map, Da3Error> {
        let c = &run.head;
        let mut x = laterals[3].clone();
        for level in (0..4).rev() {
            run.check_cancelled()?;
            let block = &self.blocks[level];
            if let Some(unit) = &block.lateral {
                x.data.iter_mut().zip(&laterals[level].data).for_each(|(x, l)| *x += l);
                unit.add(c, &laterals[level], &mut x.data);
            }
            block.own.add_in_place(c, &mut x);
            let mixed = x.convolved(c, &block.out_conv, ConvInput::None, Epilogue::None);
            let (rows, columns) = match level {
                0 => (2 * laterals[0].rows, 2 * laterals[0].columns),
                _ => (laterals[level - 1].rows, laterals[level - 1].columns),
            };
            x = mixed.resized(c, rows, columns);
            let name = format!("head.refinenet{}{}", level + 1, self.suffix);
            run.show_map(&name, view, x.shape(), &x.data);
        }
        Ok(x)
    }
}
