//! The dense heads on the device: the DualDPT head of any-view networks and the DPT head with sky of the others; see the
//! CPU's for keys and shapes. They run view by view in the same buffers.

use super::stages::{Fusion, Stages};
use super::{Context, load, show_map};
use crate::config::{HEAD_LAST, HeadConfig, HeadKind, NetConfig, PATCH};
use crate::error::Da3Error;
use crate::model::backbone::Pixels;
use crate::model::head::{DenseView, embedding};
use crate::ray_pose::RayMap;
use crate::run::Run;
use crate::weights::{Residency, Scope, Slot};
use vidar_gpu::ops::{
    Activation, Convolution, End, Grid, MapShape, Norm, PointLayer, convolve, point, resample,
};
use vidar_gpu::{Buffer, Gpu, GpuError, Recorder, Storage};

const EPS: f32 = 1e-5;
/// Numbers of a cell of the ray branch.
pub(super) const RAY_OUTPUTS: usize = 7;

/// The head's layers.
pub(super) struct Head {
    norm: Option<Norm>,
    stages: Stages,
    fusion: Fusion,
    output_conv1: Convolution,
    ends: Vec<Pair>,
    rays: Option<Slot<RayBranch>>,
    config: HeadConfig,
}

/// A 3×3 convolution to 32 channels and a 1×1 to the numbers wanted.
struct Pair {
    first: Convolution,
    last: PointLayer,
    activations: Vec<Activation>,
    /// Name of what goes in and comes out, for those who look on.
    name: &'static str,
}

/// The ray branch's own layers.
struct RayBranch {
    fusion: Fusion,
    convs: Vec<Convolution>,
    pair: Pair,
}

/// The position embeddings of one image size; a DPT head has none.
pub(super) struct Grids {
    stages: Vec<Grid>,
    full: Option<Grid>,
    rays: Option<Grid>,
}

impl Grids {
    /// Of stage `k`.
    pub fn stage(&self, k: usize) -> Option<&Grid> {
        self.stages.get(k)
    }
}

/// Buffers that the views of a run share.
pub(super) struct Scratch {
    resized: Buffer,
    laterals: Vec<Buffer>,
    x: Buffer,
    inner: Buffer,
    fused: Buffer,
    narrow: Buffer,
    full: Buffer,
    last: Buffer,
    answer: Buffer,
}

/// Numbers of the buffers above.
pub(super) struct ScratchSizes {
    pub resized: usize,
    pub laterals: [usize; 4],
    pub fusion: usize,
    pub fused: usize,
    pub narrow: usize,
    pub full: usize,
    pub last: usize,
    pub answer: usize,
}

impl ScratchSizes {
    pub fn new(config: &HeadConfig, rows: usize, columns: usize, wants_rays: bool) -> Self {
        let (ph, pw) = (rows / PATCH, columns / PATCH);
        let (patches, features, pixels) = (ph * pw, config.features, rows * columns);
        let [c0, c1, _, c3] = config.out_channels;
        let halved = ph.div_ceil(2) * pw.div_ceil(2);
        let cells = 64 * patches;
        let rays = |numbers: usize| if wants_rays { cells * numbers } else { 0 };
        Self {
            resized: (16 * patches * c0).max(4 * patches * c1).max(halved * c3),
            laterals: [16 * patches, 4 * patches, patches, halved].map(|n| n * features),
            fusion: 16 * patches * features,
            fused: cells * features,
            narrow: cells * features / 2,
            full: (pixels * features / 2).max(rays(features / 2)),
            last: (pixels * HEAD_LAST).max(rays(HEAD_LAST)),
            answer: (2 * pixels).max(rays(RAY_OUTPUTS)),
        }
    }

    /// All of them.
    pub fn all(&self) -> Vec<(&'static str, usize)> {
        let mut all: Vec<_> = self.laterals.iter().map(|n| ("a lateral map", *n)).collect();
        all.extend([
            ("a resized stage", self.resized),
            ("a fused map", self.fusion),
            ("a fused map", self.fusion),
            ("the fused map", self.fused),
            ("the head's narrow map", self.narrow),
            ("the map at the picture's size", self.full),
            ("the last map of the head", self.last),
            ("the answer of a view", self.answer),
        ]);
        all
    }
}

impl Scratch {
    pub fn new(gpu: &Gpu, net: &NetConfig, pixels: &Pixels<'_>, wants_rays: bool) -> Result<Self, GpuError> {
        let sizes = ScratchSizes::new(&net.head, pixels.rows, pixels.columns, wants_rays);
        let laterals = sizes.laterals.iter().map(|n| gpu.buffer("a lateral map", *n));
        Ok(Self {
            resized: gpu.buffer("a resized stage", sizes.resized)?,
            laterals: laterals.collect::<Result<_, _>>()?,
            x: gpu.buffer("a fused map", sizes.fusion)?,
            inner: gpu.buffer("a fused map", sizes.fusion)?,
            fused: gpu.buffer("the fused map", sizes.fused)?,
            narrow: gpu.buffer("the head's narrow map", sizes.narrow)?,
            full: gpu.buffer("the map at the picture's size", sizes.full)?,
            last: gpu.buffer("the last map of the head", sizes.last)?,
            answer: gpu.buffer("the answer of a view", sizes.answer)?,
        })
    }
}

impl Head {
    pub fn load(
        context: &Context,
        scope: &Scope,
        net: &NetConfig,
        residency: Residency,
    ) -> Result<Self, Da3Error> {
        let (gpu, storage, config) = (context.gpu(), context.head, &net.head);
        let (inputs, features) = (net.backbone.feature_dim(), config.features);
        let scratch = scope.at("scratch");
        let pair = |part: &'static str, activations: &[Activation]| {
            Pair::load(gpu, &scratch, part, features / 2, activations, storage)
        };
        let is_dual = config.kind == HeadKind::DualDpt;
        let ends = if is_dual {
            vec![pair("output_conv2", &[Activation::Exp, Activation::OnePlusExp])?]
        } else {
            vec![pair("output_conv2", &[Activation::Exp])?, pair("sky_output_conv2", &[Activation::Relu])?]
        };
        let rays = if is_dual {
            let (gpu, scratch) = (gpu.clone(), scratch.clone());
            Some(Slot::new(residency, move || RayBranch::load(&gpu, &scratch, features, storage))?)
        } else {
            None
        };
        Ok(Self {
            norm: if is_dual { Some(load::norm(gpu, scope, "norm", inputs, EPS)?) } else { None },
            stages: Stages::load(gpu, scope, inputs, config, storage)?,
            fusion: Fusion::load(gpu, &scratch, "", features, storage)?,
            output_conv1: load::conv(
                gpu,
                &scratch,
                "output_conv1",
                [features, features / 2, 3],
                (1, storage),
            )?,
            ends,
            rays,
            config: config.clone(),
        })
    }

    /// The norm before the projections.
    pub fn norm(&self) -> Option<&Norm> {
        self.norm.as_ref()
    }

    /// The projections.
    pub fn stages(&self) -> &Stages {
        &self.stages
    }

    /// Embeddings for images of `rows` × `columns` pixels.
    pub fn grids(&self, gpu: &Gpu, rows: usize, columns: usize) -> Result<Grids, Da3Error> {
        if self.config.kind == HeadKind::DptSky {
            return Ok(Grids { stages: Vec::new(), full: None, rays: None });
        }
        let (ph, pw, aspect) = (rows / PATCH, columns / PATCH, columns as f64 / rows as f64);
        let grid = |rows: usize, columns: usize, channels: usize| {
            let tables = embedding(rows, columns, channels, aspect);
            Grid::new(gpu, &tables.by_col, &tables.by_row, MapShape { rows, columns, channels })
        };
        let narrow = self.config.features / 2;
        Ok(Grids {
            stages: self.config.out_channels.iter().map(|c| grid(ph, pw, *c)).collect::<Result<_, _>>()?,
            full: Some(grid(rows, columns, narrow)?),
            rays: Some(grid(8 * ph, 8 * pw, narrow)?),
        })
    }

    /// Depth and confidence (or sky) of a view from its four stages, and rays where `scratch` has room for them and they
    /// are asked for.
    pub fn run(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        (view, rows, columns): (usize, usize, usize),
        stages: &[Buffer],
        (grids, wants_rays): (&Grids, bool),
        scratch: &mut Scratch,
    ) -> Result<DenseView, Da3Error> {
        let size = (rows / PATCH, columns / PATCH);
        let mut laterals = Vec::with_capacity(4);
        for (k, (stage, out)) in stages.iter().zip(scratch.laterals.drain(..)).enumerate() {
            let room = (&scratch.resized, &out);
            let shape = self.stages.lateral(run, recorder, (view, k), (stage, size), room)?;
            laterals.push((out, shape));
        }
        run.check_cancelled()?;
        let room = (&scratch.x, &scratch.inner, &scratch.fused);
        let shape = self.fusion.run(run, recorder, view, &laterals, room)?;
        let shape = convolve(
            recorder,
            (&scratch.fused, shape),
            &self.output_conv1,
            &scratch.narrow,
            false,
            End::Store,
        )?;
        show_map(run, recorder, ("head.output_conv1", view), shape, &scratch.narrow)?;
        let full = resample(
            recorder,
            (&scratch.narrow, shape),
            (rows, columns),
            grids.full.as_ref(),
            &scratch.full,
        )?;
        show_map(run, recorder, ("head.output_conv2.in", view), full, &scratch.full)?;
        let mut at = 0;
        for pair in &self.ends {
            pair.run(run, recorder, view, (&scratch.full, full), scratch, at)?;
            at += full.pixels() * pair.activations.len();
        }
        let mut depth = recorder.read(&scratch.answer, 0, at)?;
        let confidence = depth.split_off(full.pixels());
        let rays = match self.rays.as_ref().filter(|_| wants_rays) {
            Some(branch) => {
                run.check_cancelled()?;
                Some(branch.get()?.run(run, recorder, view, &laterals, (grids, scratch))?)
            }
            None => None,
        };
        scratch.laterals = laterals.into_iter().map(|(buffer, _)| buffer).collect();
        Ok(DenseView { depth, confidence, rays })
    }
}

impl Pair {
    fn load(
        gpu: &Gpu,
        scratch: &Scope,
        part: &'static str,
        inputs: usize,
        activations: &[Activation],
        storage: Storage,
    ) -> Result<Self, Da3Error> {
        let scope = scratch.at(part);
        Ok(Self {
            first: load::conv(gpu, &scope, "0", [inputs, HEAD_LAST, 3], (1, storage))?,
            last: load::last(gpu, &scope, "2", [HEAD_LAST, activations.len()], None)?,
            activations: activations.to_vec(),
            name: part,
        })
    }

    /// Writes the channels, one plane after the other, from `at` on.
    fn run(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        view: usize,
        (map, shape): (&Buffer, MapShape),
        scratch: &Scratch,
        at: usize,
    ) -> Result<(), Da3Error> {
        let pixels = shape.pixels();
        convolve(recorder, (map, shape), &self.first, &scratch.last, false, End::Store)?;
        let name = format!("head.{}.logits", self.name);
        if run.is_traced(&name) {
            let plain = vec![Activation::None; self.activations.len()];
            point(recorder, (&scratch.last, pixels), &self.last, &plain, (&scratch.answer, at))?;
            let planes = recorder.read(&scratch.answer, at, pixels * plain.len())?;
            let interleaved: Vec<f32> =
                (0..pixels).flat_map(|i| planes.iter().skip(i).step_by(pixels).copied()).collect();
            run.show_map(&name, view, [shape.rows, shape.columns, plain.len()], &interleaved);
        }
        point(recorder, (&scratch.last, pixels), &self.last, &self.activations, (&scratch.answer, at))?;
        Ok(())
    }
}

impl RayBranch {
    fn load(gpu: &Gpu, scratch: &Scope, features: usize, storage: Storage) -> Result<Self, Da3Error> {
        let half = features / 2;
        let conv = |i: usize| {
            let sizes = if i.is_multiple_of(2) { [features, half, 3] } else { [half, features, 3] };
            load::conv(gpu, scratch, &format!("output_conv1_aux.3.{i}"), sizes, (1, storage))
        };
        let scope = scratch.at("output_conv2_aux.3");
        let norm = load::norm(gpu, scratch, "output_conv2_aux.0.2", HEAD_LAST, EPS)?;
        let mut activations = vec![Activation::None; RAY_OUTPUTS];
        activations[RAY_OUTPUTS - 1] = Activation::OnePlusExp;
        Ok(Self {
            fusion: Fusion::load(gpu, scratch, "_aux", features, storage)?,
            convs: (0..5).map(conv).collect::<Result<_, _>>()?,
            pair: Pair {
                first: load::conv(gpu, &scope, "0", [half, HEAD_LAST, 3], (1, storage))?,
                last: load::last(gpu, &scope, "5", [HEAD_LAST, RAY_OUTPUTS], Some(norm))?,
                activations,
                name: "output_conv2_aux.3",
            },
        })
    }

    fn run(
        &self,
        run: &Run<'_>,
        recorder: &mut Recorder,
        view: usize,
        laterals: &[(Buffer, MapShape)],
        (grids, scratch): (&Grids, &Scratch),
    ) -> Result<RayMap, Da3Error> {
        let room = (&scratch.x, &scratch.inner, &scratch.fused);
        let mut shape = self.fusion.run(run, recorder, view, laterals, room)?;
        let (mut from, mut to) = (&scratch.fused, &scratch.narrow);
        for conv in &self.convs {
            run.check_cancelled()?;
            shape = convolve(recorder, (from, shape), conv, to, false, End::Store)?;
            std::mem::swap(&mut from, &mut to);
        }
        show_map(run, recorder, ("head.output_conv1_aux.3", view), shape, from)?;
        let size = (shape.rows, shape.columns);
        let shape = resample(recorder, (from, shape), size, grids.rays.as_ref(), &scratch.full)?;
        self.pair.run(run, recorder, view, (&scratch.full, shape), scratch, 0)?;
        let planes = recorder.read(&scratch.answer, 0, shape.pixels() * RAY_OUTPUTS)?;
        let plane = |o: usize| &planes[o * shape.pixels()..(o + 1) * shape.pixels()];
        let cell = |i: usize| [0, 1, 2, 3, 4, 5].map(|o| plane(o)[i]);
        Ok(RayMap {
            rows: shape.rows,
            columns: shape.columns,
            rays: (0..shape.pixels()).map(cell).collect(),
            confidence: plane(RAY_OUTPUTS - 1).to_vec(),
        })
    }
}
