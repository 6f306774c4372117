//! The DPT head of the metric and monocular networks, `head` (DA3, teacher and metric models): depth and sky.
//!
//! As the main branch of the DualDPT head, without norm and embeddings; on the enlarged map stand two pairs of layers,
//! `output_conv2` for depth `exp(l)` and `sky_output_conv2` for sky `max(l, 0)`.

use super::fusion::Fusion;
use super::map::Map;
use super::stages::Stages;
use super::tail::{Pair, run_pairs, show_input};
use crate::config::HeadConfig;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use vidar_nn::{Conv2d, ConvInput, Epilogue, activation};

/// The head's layers.
pub(crate) struct Dpt {
    stages: Stages,
    fusion: Fusion,
    output_conv1: Conv2d,
    output_conv2: Pair,
    sky_output_conv2: Pair,
}

impl Dpt {
    pub fn load(scope: &Scope, inputs: usize, config: &HeadConfig) -> Result<Self, Da3Error> {
        let (scratch, features) = (scope.at("scratch"), config.features);
        Ok(Self {
            stages: Stages::load(scope, inputs, config)?,
            fusion: Fusion::load(&scratch, "", features)?,
            output_conv1: scratch.conv("output_conv1", ConvShape::three(features, features / 2))?,
            output_conv2: Pair::load(&scratch, "output_conv2", features / 2, 1)?,
            sky_output_conv2: Pair::load(&scratch, "sky_output_conv2", features / 2, 1)?,
        })
    }

    /// Stage `k` of a view from its feature, `[patches, D]`.
    pub fn project(
        &self,
        run: &Run<'_>,
        (view, k): (usize, usize),
        feature: &[f32],
        size: (usize, usize),
    ) -> Map {
        self.stages.project(run, view, k, feature, size)
    }

    /// Depth (sky not yet filled) and sky of a view from its four stages, `[H, W]` each.
    pub fn run(
        &self,
        run: &Run<'_>,
        view: usize,
        stages: Vec<Map>,
        size: (usize, usize),
    ) -> Result<(Vec<f32>, Vec<f32>), Da3Error> {
        let laterals = self.stages.laterals(run, view, stages);
        run.check_cancelled()?;
        let fused = self.fusion.run(run, view, &laterals)?;
        drop(laterals);
        let narrow = fused.convolved(&run.head, &self.output_conv1, ConvInput::None, Epilogue::None);
        drop(fused);
        run.show_map("head.output_conv1", view, narrow.shape(), &narrow.data);
        show_input(run, view, &narrow, size, None);
        run.check_cancelled()?;
        let pairs = [&self.output_conv2, &self.sky_output_conv2];
        let mut logits = run_pairs(run, &narrow, size, None, &pairs);
        let (depth, sky) = (logits.swap_remove(0), logits.swap_remove(0));
        run.show_map("head.output_conv2.logits", view, depth.shape(), &depth.data);
        run.show_map("head.sky_output_conv2.logits", view, sky.shape(), &sky.data);
        let (mut depth, mut sky) = (depth.data, sky.data);
        activation::exp(&run.head, &mut depth);
        activation::relu(&run.head, &mut sky);
        Ok((depth, sky))
    }
}
