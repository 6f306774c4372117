//! The networks on a graphics processor (feature `gpu`): backbone and dense head as operations of `vidar-gpu`.
//!
//! Same keys, same sizes, same results as on the CPU; camera encoder and decoder, poses from rays, preprocessing and
//! alignment stay on the CPU and are shared with it. Weights go to the device once, the backbone's in the precision asked
//! for, the head's in `f32` as the official code has it; activations and sums are `f32`.
//!
//! ```text
//! pixels ─▶ patches ─▶ blocks (a few views at a time; attention over all) ─▶ four stages a view ─▶ head, view by view
//! ```
//!
//! What a run needs is worked out before it starts ([`MemoryPlan`]) and held against what the device binds and what is
//! allowed. A run is submitted in small parts, so that it can be stopped and no part blocks the device for long.

mod backbone;
mod block;
mod head;
mod load;
mod plan;
mod stages;

pub(crate) use plan::device_plan;
pub use plan::{MemoryPlan, memory_plan};

use crate::arithmetic::{Arithmetic, exact_blocks};
use crate::config::{HeadKind, NetConfig};
use crate::error::Da3Error;
use crate::model::backbone::{CameraTokens, Pixels};
use crate::model::{DenseOutput, DeviceLoader, DeviceNet};
use crate::run::{BACKBONE_SHARE, Run};
use crate::weights::{Residency, Scope};
use backbone::Backbone;
use head::Head;
use std::ops::Range;
use vidar_gpu::{Gpu, Recorder, Storage};

pub use vidar_gpu::{Adapter, AdapterKind, GpuError, adapters};

/// An open device and how networks are stored on it.
pub(crate) struct Context {
    gpu: Gpu,
    backbone: Storage,
    head: Storage,
    exact_blocks: Option<usize>,
}

impl Context {
    pub fn new(gpu: &Gpu, arithmetic: Arithmetic) -> Self {
        let Arithmetic { backbone, head, exact_blocks, .. } = arithmetic;
        Self { gpu: gpu.clone(), backbone: storage(backbone), head: storage(head), exact_blocks }
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// How block `i` of `depth` is stored on the device; the patch embedding is as the first block.
    fn of_block(&self, i: usize, depth: usize) -> Storage {
        let is_exact = self.backbone == Storage::Bf16 && i < exact_blocks(self.exact_blocks, depth);
        if is_exact { Storage::F32 } else { self.backbone }
    }
}

fn storage(precision: vidar_nn::Precision) -> Storage {
    match precision {
        vidar_nn::Precision::F32 => Storage::F32,
        vidar_nn::Precision::Bf16 => Storage::Bf16,
        vidar_nn::Precision::F16 => Storage::F16,
    }
}

impl DeviceLoader for Context {
    fn load(
        &self,
        scope: &Scope,
        net: &NetConfig,
        residency: Residency,
    ) -> Result<Box<dyn DeviceNet>, Da3Error> {
        Ok(Box::new(Network {
            backbone: Backbone::load(self, &scope.at("backbone.pretrained"), &net.backbone, residency)?,
            head: Head::load(self, &scope.at("head"), net, residency)?,
            gpu: self.gpu.clone(),
            net: net.clone(),
        }))
    }
}

/// A network's parts on the device.
struct Network {
    gpu: Gpu,
    net: NetConfig,
    backbone: Backbone,
    head: Head,
}

impl DeviceNet for Network {
    fn run(
        &self,
        run: &Run<'_>,
        pixels: &Pixels<'_>,
        tokens: CameraTokens<'_>,
        layers: &[usize],
        (wanted, wants_rays): (Range<usize>, bool),
    ) -> Result<DenseOutput, Da3Error> {
        let wants_rays = wants_rays && self.net.head.kind == HeadKind::DualDpt;
        let size = (pixels.views, pixels.rows, pixels.columns);
        plan::Size::new(&self.net, size, wanted.len(), wants_rays).working().fits(&self.gpu)?;
        let mut recorder = Recorder::new(&self.gpu);
        let grids = self.head.grids(&self.gpu, pixels.rows, pixels.columns)?;
        let mut features = backbone::Features::new(self, pixels, wanted.clone(), &grids)?;
        let reference = self.backbone.run(
            &run.between(0.0, BACKBONE_SHARE),
            &mut recorder,
            pixels,
            tokens,
            layers,
            &mut features,
        )?;
        // Gives the feature buffers back before the head takes its own.
        let (stages, camera_tokens, layers) = features.into_parts();
        let mut scratch = head::Scratch::new(&self.gpu, &self.net, pixels, wants_rays)?;
        let mut views = Vec::with_capacity(wanted.len());
        for (view, stages) in stages.into_iter().enumerate().filter(|(view, _)| wanted.contains(view)) {
            let run = &run.between(BACKBONE_SHARE, 1.0).part(views.len(), wanted.len());
            run.check_cancelled()?;
            let picture = (view, pixels.rows, pixels.columns);
            views.push(self.head.run(
                run,
                &mut recorder,
                picture,
                &stages,
                (&grids, wants_rays),
                &mut scratch,
            )?);
        }
        Ok(DenseOutput { views, camera_tokens, layers, reference })
    }
}

/// Shows a part of a buffer to whoever looks on.
fn show(
    run: &Run<'_>,
    recorder: &mut Recorder,
    (name, view): (&str, usize),
    shape: &[usize],
    (buffer, at): (&vidar_gpu::Buffer, usize),
) -> Result<(), Da3Error> {
    if run.is_traced(name) {
        let values = recorder.read(buffer, at, shape.iter().product())?;
        run.show(name, view, shape, &values);
    }
    Ok(())
}

/// As [`show`], of a map.
fn show_map(
    run: &Run<'_>,
    recorder: &mut Recorder,
    (name, view): (&str, usize),
    shape: vidar_gpu::ops::MapShape,
    buffer: &vidar_gpu::Buffer,
) -> Result<(), Da3Error> {
    if run.is_traced(name) {
        let values = recorder.read(buffer, 0, shape.len())?;
        run.show_map(name, view, [shape.rows, shape.columns, shape.channels], &values);
    }
    Ok(())
}
