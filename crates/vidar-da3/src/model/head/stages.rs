//! From the four features to four maps of F channels: `projects.K`, `resize_layers.K`, `scratch.layer{K+1}_rn`.
//!
//! Feature k, `[patches, C]`, is projected to `out_channels[k]`; stage 0 is upsampled by four and stage 1 by
//! two with transposed convolutions, stage 2 keeps its size, stage 3 is halved (rounding up); a 3×3 convolution without bias
//! brings each to F channels. Sizes: 4ph × 4pw,
//! 2ph × 2pw, ph × pw, ⌈ph/2⌉ × ⌈pw/2⌉.

use super::map::Map;
use crate::config::HeadConfig;
use crate::error::Da3Error;
use crate::run::Run;
use crate::weights::{ConvShape, Scope};
use vidar_nn::{Conv2d, ConvInput, ConvTranspose2d, Epilogue};

/// The layers up to the fusion.
pub(crate) struct Stages {
    projects: Vec<Conv2d>,
    spread_4: ConvTranspose2d,
    spread_2: ConvTranspose2d,
    halve: Conv2d,
    layer_rn: Vec<Conv2d>,
}

impl Stages {
    pub fn load(scope: &Scope, inputs: usize, config: &HeadConfig) -> Result<Self, Da3Error> {
        let channels = config.out_channels;
        let projects =
            (0..4).map(|k| scope.conv(&format!("projects.{k}"), ConvShape::point(inputs, channels[k])));
        let scratch = scope.at("scratch");
        let layer_rn = (0..4)
            .map(|k| scratch.conv3_unbiased(&format!("layer{}_rn", k + 1), channels[k], config.features));
        let halve = ConvShape { stride: 2, ..ConvShape::three(channels[3], channels[3]) };
        Ok(Self {
            projects: projects.collect::<Result<_, _>>()?,
            spread_4: scope.conv_transpose("resize_layers.0", channels[0], 4)?,
            spread_2: scope.conv_transpose("resize_layers.1", channels[1], 2)?,
            halve: scope.conv("resize_layers.3", halve)?,
            layer_rn: layer_rn.collect::<Result<_, _>>()?,
        })
    }

    /// Stage `k`'s projection of a view's patches, `[ph·pw, C]`.
    pub fn project(
        &self,
        run: &Run<'_>,
        view: usize,
        k: usize,
        patches: &[f32],
        size: (usize, usize),
    ) -> Map {
        let conv = &self.projects[k];
        let mut map = Map::zeros(size.0, size.1, conv.out_channels());
        let input = vidar_nn::MapRef::new(patches, size.0, size.1);
        conv.apply(&run.head, input, &mut map.data, ConvInput::None, Epilogue::None);
        run.show_map(&format!("head.projects.{k}"), view, map.shape(), &map.data);
        map
    }

    /// The four maps of F channels from the (embedded) projections.
    pub fn laterals(&self, run: &Run<'_>, view: usize, projected: Vec<Map>) -> Vec<Map> {
        let one = |(k, map): (usize, Map)| {
            let resized = self.resized(run, k, map);
            run.show_map(&format!("head.resize_layers.{k}"), view, resized.shape(), &resized.data);
            let lateral = resized.convolved(&run.head, &self.layer_rn[k], ConvInput::None, Epilogue::None);
            run.show_map(&format!("head.layer{}_rn", k + 1), view, lateral.shape(), &lateral.data);
            lateral
        };
        projected.into_iter().enumerate().map(one).collect()
    }

    fn resized(&self, run: &Run<'_>, k: usize, map: Map) -> Map {
        let spread = match k {
            0 => &self.spread_4,
            1 => &self.spread_2,
            3 => return map.convolved(&run.head, &self.halve, ConvInput::None, Epilogue::None),
            _ => return map,
        };
        let (rows, columns) = spread.output_size(map.rows, map.columns);
        let mut out = Map::zeros(rows, columns, spread.out_channels());
        spread.apply(&run.head, map.view(), &mut out.data);
        out
    }
}
