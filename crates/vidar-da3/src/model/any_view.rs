//! An any-view network: backbone, camera encoder and decoder, DualDPT head.

use super::backbone::{Backbone, CameraTokens, Feature, FeatureSink, Pixels, ReferenceStrategy};
use super::cam_dec::CameraDecoder;
use super::cam_enc::CameraEncoder;
use super::device::{DenseOutput, DeviceLoader, DeviceNet};
use super::head::{DenseView, DualDpt, Embeddings, Map};
use crate::config::NetConfig;
use crate::error::Da3Error;
use crate::pose::{self, NetCameras};
use crate::run::{BACKBONE_SHARE, Run};
use crate::weights::{Residency, Scope, Slot};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// The network's parts.
pub(crate) struct AnyView {
    cam_enc: Option<Slot<CameraEncoder>>,
    cam_dec: Option<Slot<CameraDecoder>>,
    parts: Parts,
}

/// Where backbone and head are. There is one of these a network: its size does not matter.
#[allow(clippy::large_enum_variant)]
enum Parts {
    Here(Host),
    OnDevice(Box<dyn DeviceNet>),
}

/// Backbone and head on the CPU.
struct Host {
    config: NetConfig,
    backbone: Backbone,
    head: DualDpt,
}

/// What is asked of the network besides depth.
pub(crate) struct Request<'a> {
    /// Cameras that are known: normalised `camera_from_world` and intrinsics of the pixels.
    pub cameras: Option<NetCameras<'a>>,
    pub strategy: ReferenceStrategy,
    pub wants_rays: bool,
    /// Layers whose tokens are wanted.
    pub layers: &'a [usize],
    /// Views whose depth is wanted.
    pub wanted: Range<usize>,
}

/// What the network says.
pub(crate) struct Answer {
    /// Of the wanted views.
    pub views: Vec<DenseView>,
    /// Pose encodings of the camera decoder, if there is one.
    pub codes: Option<Vec<[f64; 9]>>,
    /// By layer and view: normalised patch tokens.
    pub layers: BTreeMap<usize, Vec<Vec<f32>>>,
    /// The reference view.
    pub reference: usize,
}

impl AnyView {
    pub fn load(
        scope: &Scope,
        config: &NetConfig,
        residency: Residency,
        device: Option<&dyn DeviceLoader>,
    ) -> Result<Self, Da3Error> {
        let (dim, width) = (config.backbone.dim, config.backbone.feature_dim());
        let cam_enc = config.camera_encoder.map(|encoder| {
            let scope = scope.at("cam_enc");
            Slot::new(residency, move || CameraEncoder::load(&scope, &encoder, dim))
        });
        let cam_dec = config.camera_decoder.then(|| {
            let scope = scope.at("cam_dec");
            Slot::new(residency, move || CameraDecoder::load(&scope, width))
        });
        let parts = match device {
            Some(device) => Parts::OnDevice(device.load(scope, config, residency)?),
            None => Parts::Here(Host {
                backbone: Backbone::load(&scope.at("backbone.pretrained"), &config.backbone, residency)?,
                head: DualDpt::load(&scope.at("head"), width, &config.head, residency)?,
                config: config.clone(),
            }),
        };
        Ok(Self { cam_enc: cam_enc.transpose()?, cam_dec: cam_dec.transpose()?, parts })
    }

    pub fn run(&self, run: &Run<'_>, pixels: &Pixels<'_>, request: &Request<'_>) -> Result<Answer, Da3Error> {
        let given = request.cameras.map(|cameras| self.encode(run, pixels, cameras)).transpose()?;
        let tokens = match &given {
            Some(tokens) => CameraTokens::Given(tokens),
            None => CameraTokens::Trained(request.strategy),
        };
        let wanted = (request.wanted.clone(), request.wants_rays);
        let DenseOutput { views, camera_tokens, layers, reference } = match &self.parts {
            Parts::Here(host) => host.run(run, pixels, tokens, request.layers, wanted)?,
            Parts::OnDevice(device) => device.run(run, pixels, tokens, request.layers, wanted)?,
        };
        let codes = match &self.cam_dec {
            Some(decoder) => Some(decoder.get()?.run(run, &camera_tokens)),
            None => None,
        };
        Ok(Answer { views, codes, layers, reference })
    }

    fn encode(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        cameras: NetCameras<'_>,
    ) -> Result<Vec<f32>, Da3Error> {
        let Some(encoder) = &self.cam_enc else {
            let reason = "this network has no camera encoder".into();
            return Err(Da3Error::BadInput { what: "given cameras", reason });
        };
        let codes: Vec<[f64; 9]> = cameras
            .camera_from_world
            .iter()
            .zip(cameras.intrinsics)
            .map(|(pose, k)| pose::encode(pose, k, pixels.columns, pixels.rows))
            .collect();
        Ok(encoder.get()?.run(run, &codes))
    }
}

impl Host {
    fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        tokens: CameraTokens<'_>,
        layers: &[usize],
        (wanted, wants_rays): (Range<usize>, bool),
    ) -> Result<DenseOutput, Da3Error> {
        let mut features = Features::new(self, pixels, wanted.clone());
        let reference =
            self.backbone.run(&run.between(0.0, BACKBONE_SHARE), pixels, tokens, layers, &mut features)?;
        let Features { embeddings, stages, camera_tokens, layers, .. } = features;
        let size = (pixels.rows, pixels.columns);
        let mut views = Vec::with_capacity(wanted.len());
        for (view, stages) in stages.into_iter().enumerate().filter(|(view, _)| wanted.contains(view)) {
            let run = &run.between(BACKBONE_SHARE, 1.0).part(views.len(), wanted.len());
            run.check_cancelled()?;
            views.push(self.head.run(run, view, stages, size, (&embeddings, wants_rays))?);
        }
        Ok(DenseOutput { views, camera_tokens, layers, reference })
    }
}

/// Takes features as the backbone yields them and keeps only their projections.
struct Features<'a> {
    net: &'a Host,
    size: (usize, usize),
    wanted: Range<usize>,
    embeddings: Arc<Embeddings>,
    /// By view, then by stage.
    stages: Vec<Vec<Map>>,
    /// Of the last stage, `[views, 2D]`.
    camera_tokens: Vec<f32>,
    layers: BTreeMap<usize, Vec<Vec<f32>>>,
    joined: Vec<f32>,
}

impl<'a> Features<'a> {
    fn new(net: &'a Host, pixels: &Pixels<'_>, wanted: Range<usize>) -> Self {
        Self {
            net,
            size: pixels.patches(),
            wanted,
            embeddings: net.head.embeddings(pixels.rows, pixels.columns),
            stages: (0..pixels.views).map(|_| Vec::with_capacity(4)).collect(),
            camera_tokens: vec![0.0; pixels.views * net.config.backbone.feature_dim()],
            layers: BTreeMap::new(),
            joined: Vec::new(),
        }
    }
}

impl FeatureSink for Features<'_> {
    /// The local half stays as it is, the global half is normed; the camera token is neither.
    fn take(&mut self, run: &Run<'_>, feature: Feature<'_>) -> Result<(), Da3Error> {
        let Feature { stage, view, local, global } = feature;
        let (dim, width) = (self.net.config.backbone.dim, self.net.config.backbone.feature_dim());
        let camera_token = &mut self.camera_tokens[view * width..(view + 1) * width];
        camera_token[..dim].copy_from_slice(&local[..dim]);
        camera_token[dim..].copy_from_slice(&global[..dim]);
        run.show(&format!("camtok{stage}"), view, &[width], camera_token);
        if !self.wanted.contains(&view) {
            return Ok(());
        }
        let mut normed = global[dim..].to_vec();
        self.net.backbone.norm().apply_in_place(&run.head, &mut normed);
        self.joined.clear();
        for (local, global) in local[dim..].chunks_exact(dim).zip(normed.chunks_exact(dim)) {
            self.joined.extend_from_slice(local);
            self.joined.extend_from_slice(global);
        }
        run.show(&format!("feat{stage}"), view, &[self.joined.len() / width, width], &self.joined);
        let place = (view, stage);
        let map = self.net.head.project(run, place, &mut self.joined, self.size, &self.embeddings);
        self.stages[view].push(map);
        Ok(())
    }

    fn take_extra(&mut self, layer: usize, view: usize, patches: Vec<f32>) {
        let views = self.stages.len();
        self.layers.entry(layer).or_insert_with(|| vec![Vec::new(); views])[view] = patches;
    }
}
