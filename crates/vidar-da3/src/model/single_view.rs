//! A network of single views: backbone and DPT head with sky (the metric and the monocular one).

use super::backbone::{Backbone, CameraTokens, Feature, FeatureSink, Pixels, ReferenceStrategy};
use super::device::{DenseOutput, DeviceLoader, DeviceNet};
use super::head::{DenseView, Dpt, Map};
use crate::config::NetConfig;
use crate::error::Da3Error;
use crate::run::{BACKBONE_SHARE, Run};
use crate::sky;
use crate::weights::{Residency, Scope};
use std::collections::BTreeMap;

/// The network's parts.
pub(crate) struct SingleView {
    parts: Parts,
}

/// Where they are. There is one of these a network: its size does not matter.
#[allow(clippy::large_enum_variant)]
enum Parts {
    Here(Host),
    OnDevice(Box<dyn DeviceNet>),
}

/// Backbone and head on the CPU.
struct Host {
    config: NetConfig,
    backbone: Backbone,
    head: Dpt,
}

/// What the network says; all views one after the other.
pub(crate) struct SingleViewOutput {
    /// `[views, H, W]`, sky filled.
    pub depth: Vec<f32>,
    /// `[views, H, W]`.
    pub sky: Vec<f32>,
    /// By layer and view: normalised patch tokens.
    pub layers: BTreeMap<usize, Vec<Vec<f32>>>,
}

impl SingleView {
    pub fn load(
        scope: &Scope,
        config: &NetConfig,
        residency: Residency,
        device: Option<&dyn DeviceLoader>,
    ) -> Result<Self, Da3Error> {
        let parts = match device {
            Some(device) => Parts::OnDevice(device.load(scope, config, residency)?),
            None => Parts::Here(Host {
                backbone: Backbone::load(&scope.at("backbone.pretrained"), &config.backbone, residency)?,
                head: Dpt::load(&scope.at("head"), config.backbone.feature_dim(), &config.head)?,
                config: config.clone(),
            }),
        };
        Ok(Self { parts })
    }

    pub fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        layers: &[usize],
    ) -> Result<SingleViewOutput, Da3Error> {
        let tokens = CameraTokens::Trained(ReferenceStrategy::First);
        let dense = match &self.parts {
            Parts::Here(host) => host.run(run, pixels, tokens, layers)?,
            Parts::OnDevice(device) => device.run(run, pixels, tokens, layers, (0..pixels.views, false))?,
        };
        let area = pixels.rows * pixels.columns;
        let (mut depth, mut sky) =
            (Vec::with_capacity(pixels.views * area), Vec::with_capacity(pixels.views * area));
        for (view, answer) in dense.views.into_iter().enumerate() {
            run.show("head.depth_before_sky", view, &[pixels.rows, pixels.columns], &answer.depth);
            depth.extend(answer.depth);
            sky.extend(answer.confidence);
        }
        sky::fill(&mut depth, &sky);
        Ok(SingleViewOutput { depth, sky, layers: dense.layers })
    }
}

impl Host {
    /// Sky stands where any-view networks have confidence.
    fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        tokens: CameraTokens<'_>,
        layers: &[usize],
    ) -> Result<DenseOutput, Da3Error> {
        let mut features = Features {
            net: self,
            size: pixels.patches(),
            stages: (0..pixels.views).map(|_| Vec::with_capacity(4)).collect(),
            layers: BTreeMap::new(),
        };
        let reference =
            self.backbone.run(&run.between(0.0, BACKBONE_SHARE), pixels, tokens, layers, &mut features)?;
        let mut views = Vec::with_capacity(pixels.views);
        for (view, stages) in features.stages.into_iter().enumerate() {
            let run = &run.between(BACKBONE_SHARE, 1.0).part(view, pixels.views);
            run.check_cancelled()?;
            let (depth, sky) = self.head.run(run, view, stages, (pixels.rows, pixels.columns))?;
            views.push(DenseView { depth, confidence: sky, rays: None });
        }
        Ok(DenseOutput { views, camera_tokens: Vec::new(), layers: features.layers, reference })
    }
}

/// Takes features as the backbone yields them and keeps only their projections.
struct Features<'a> {
    net: &'a Host,
    size: (usize, usize),
    stages: Vec<Vec<Map>>,
    layers: BTreeMap<usize, Vec<Vec<f32>>>,
}

impl FeatureSink for Features<'_> {
    fn take(&mut self, run: &Run<'_>, feature: Feature<'_>) -> Result<(), Da3Error> {
        let Feature { stage, view, global, .. } = feature;
        let dim = self.net.config.backbone.dim;
        run.show(&format!("camtok{stage}"), view, &[dim], &global[..dim]);
        let mut normed = global[dim..].to_vec();
        self.net.backbone.norm().apply_in_place(&run.head, &mut normed);
        run.show(&format!("feat{stage}"), view, &[normed.len() / dim, dim], &normed);
        self.stages[view].push(self.net.head.project(run, (view, stage), &normed, self.size));
        Ok(())
    }

    fn take_extra(&mut self, layer: usize, view: usize, patches: Vec<f32>) {
        let views = self.stages.len();
        self.layers.entry(layer).or_insert_with(|| vec![Vec::new(); views])[view] = patches;
    }
}
