//! The head's stages and fusion on the device; see the CPU's for keys and shapes.

use super::load;
use super::show_map;
use crate::config::HeadConfig;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::Scope;
use vidar_gpu::ops::{Convolution, End, MapShape, Spread, add, convolve, resample, spread};
use vidar_gpu::{Buffer, Gpu, Recorder, Storage};

/// `projects.K`, `resize_layers.K`, `scratch.layer{K+1}_rn`.
pub(super) struct Stages {
    projects: Vec<Convolution>,
    spread_4: Spread,
    spread_2: Spread,
    halve: Convolution,
    layer_rn: Vec<Convolution>,
    channels: [usize; 4],
}

impl Stages {
    pub fn load(
        gpu: &Gpu,
        scope: &Scope,
        inputs: usize,
        config: &HeadConfig,
        storage: Storage,
    ) -> Result<Self, Da3Error> {
        let channels = config.out_channels;
        let scratch = scope.at("scratch");
        let project = |k: usize| {
            load::conv(gpu, scope, &format!("projects.{k}"), [inputs, channels[k], 1], (1, storage))
        };
        let layer = |k: usize| {
            let part = format!("layer{}_rn", k + 1);
            load::conv_unbiased(gpu, &scratch, &part, [channels[k], config.features], storage)
        };
        let halve = [channels[3], channels[3], 3];
        Ok(Self {
            projects: (0..4).map(project).collect::<Result<_, _>>()?,
            spread_4: load::spread(gpu, scope, "resize_layers.0", [channels[0], 4], storage)?,
            spread_2: load::spread(gpu, scope, "resize_layers.1", [channels[1], 2], storage)?,
            halve: load::conv(gpu, scope, "resize_layers.3", halve, (2, storage))?,
            layer_rn: (0..4).map(layer).collect::<Result<_, _>>()?,
            channels,
        })
    }

    /// Channels of stage `k`.
    pub fn channels(&self, k: usize) -> usize {
        self.channels[k]
    }

    /// Stage `k`'s projection of a view's patches, `[ph·pw, C]`.
    pub fn project(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        (view, k): (usize, usize),
        (patches, size): (&Buffer, (usize, usize)),
        out: &Buffer,
    ) -> Result<(), Da3Error> {
        let conv = &self.projects[k];
        let shape = MapShape { rows: size.0, columns: size.1, channels: conv.inputs() };
        let shape = convolve(recorder, (patches, shape), conv, out, false, End::Store)?;
        show_map(run, recorder, (&format!("head.projects.{k}"), view), shape, out)
    }

    /// Lateral map `k` of F channels from the (embedded) projection; `resized` is room for the map in between.
    pub fn lateral(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        (view, k): (usize, usize),
        (projected, size): (&Buffer, (usize, usize)),
        (resized, out): (&Buffer, &Buffer),
    ) -> Result<MapShape, Da3Error> {
        let from = MapShape { rows: size.0, columns: size.1, channels: self.channels[k] };
        let (map, shape) = match k {
            0 => (resized, spread(recorder, (projected, from), &self.spread_4, resized)?),
            1 => (resized, spread(recorder, (projected, from), &self.spread_2, resized)?),
            3 => (resized, convolve(recorder, (projected, from), &self.halve, resized, false, End::Store)?),
            _ => (projected, from),
        };
        show_map(run, recorder, (&format!("head.resize_layers.{k}"), view), shape, map)?;
        let shape = convolve(recorder, (map, shape), &self.layer_rn[k], out, false, End::Store)?;
        show_map(run, recorder, (&format!("head.layer{}_rn", k + 1), view), shape, out)?;
        Ok(shape)
    }
}

/// `resConfUnitI.{conv1,conv2}`.
struct ResidualUnit {
    conv1: Convolution,
    conv2: Convolution,
}

impl ResidualUnit {
    fn load(gpu: &Gpu, scope: &Scope, features: usize, storage: Storage) -> Result<Self, Da3Error> {
        let conv = |part| load::conv(gpu, scope, part, [features, features, 3], (1, storage));
        Ok(Self { conv1: conv("conv1")?, conv2: conv("conv2")? })
    }

    /// `to += conv2(relu(conv1(relu of)))`.
    fn add(
        &self,
        recorder: &mut Recorder,
        (of, shape): (&Buffer, MapShape),
        inner: &Buffer,
        to: &Buffer,
    ) -> Result<(), Da3Error> {
        convolve(recorder, (of, shape), &self.conv1, inner, true, End::Relu)?;
        convolve(recorder, (inner, shape), &self.conv2, to, false, End::Accumulate)?;
        Ok(())
    }
}

/// One of the four blocks; the coarsest has no unit for a lateral map.
struct FusionBlock {
    lateral: Option<ResidualUnit>,
    own: ResidualUnit,
    out_conv: Convolution,
}

/// The four blocks `scratch.refinenet{1..4}`, coarsest last.
pub(super) struct Fusion {
    blocks: Vec<FusionBlock>,
    suffix: &'static str,
}

impl Fusion {
    /// The chain whose keys end in `suffix`.
    pub fn load(
        gpu: &Gpu,
        scratch: &Scope,
        suffix: &'static str,
        features: usize,
        storage: Storage,
    ) -> Result<Self, Da3Error> {
        let one = |level: usize| -> Result<FusionBlock, Da3Error> {
            let scope = scratch.at(&format!("refinenet{level}{suffix}"));
            let unit = |part: &str| ResidualUnit::load(gpu, &scope.at(part), features, storage);
            Ok(FusionBlock {
                lateral: if level == 4 { None } else { Some(unit("resConfUnit1")?) },
                own: unit("resConfUnit2")?,
                out_conv: load::conv(gpu, &scope, "out_conv", [features, features, 1], (1, storage))?,
            })
        };
        Ok(Self { blocks: (1..=4).map(one).collect::<Result<_, _>>()?, suffix })
    }

    /// Writes the fused map at twice the size of the finest lateral to `fused`; `x` and `inner` are room for a map of the
    /// finest lateral's size.
    pub fn run(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        view: usize,
        laterals: &[(Buffer, MapShape)],
        (x, inner, fused): (&Buffer, &Buffer, &Buffer),
    ) -> Result<MapShape, Da3Error> {
        let (coarsest, shape) = &laterals[3];
        let mut shape = *shape;
        recorder.copy((coarsest, 0), (x, 0), shape.len());
        for level in (0..4).rev() {
            run.check_cancelled()?;
            let block = &self.blocks[level];
            if let Some(unit) = &block.lateral {
                let (lateral, _) = &laterals[level];
                add(recorder, (lateral, 0), (x, 0), shape.len())?;
                unit.add(recorder, (lateral, shape), inner, x)?;
            }
            block.own.add(recorder, (x, shape), inner, x)?;
            // Both are linear and the enlargement's weights sum to one: `out_conv` runs first, on a quarter of the pixels.
            convolve(recorder, (x, shape), &block.out_conv, inner, false, End::Store)?;
            let (to, rows, columns) = match level {
                0 => (fused, 2 * shape.rows, 2 * shape.columns),
                _ => (x, laterals[level - 1].1.rows, laterals[level - 1].1.columns),
            };
            shape = resample(recorder, (inner, shape), (rows, columns), None, to)?;
            let name = format!("head.refinenet{}{}", level + 1, self.suffix);
            show_map(run, recorder, (&name, view), shape, to)?;
            recorder.submit()?;
        }
        Ok(shape)
    }
}
