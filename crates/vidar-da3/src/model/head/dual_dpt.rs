//! The DualDPT head of any-view networks, `head` (DA3, dual DPT): depth with confidence, and rays on demand.
//!
//! Features are normed (`norm`), projected, embedded, resized and fused; `output_conv1` and `output_conv2` give two
//! numbers a pixel: depth `exp(l₀)` and confidence `1 + exp(l₁)`. The ray branch has its own fusion chain `_aux` on the
//! same maps, five plain 3×3 convolutions `output_conv1_aux.3.{0..4}`, an embedding, and `output_conv2_aux.3`: 3×3 to 32
//! channels, layer norm (stored under level 0, where all levels share it), ReLU, 1×1 to seven: direction, origin, and
//! confidence `1 + exp`. It stays at 8ph × 8pw, and is more than half of the head's work: it runs only when asked for.

use super::fusion::Fusion;
use super::map::Map;
use super::stages::Stages;
use super::tail::{Pair, run_pairs, show_input};
use super::uv::embedding;
use crate::config::{HEAD_LAST, HeadConfig, PATCH};
use crate::error::Da3Error;
use crate::ray_pose::RayMap;
use crate::run::Run;
use crate::weights::{ConvShape, Residency, Scope, Slot};
use std::sync::{Arc, Mutex, PoisonError};
use vidar_nn::{Conv2d, ConvInput, Epilogue, GridEmbedding, LayerNorm, activation};

const EPS: f32 = 1e-5;

/// The head's layers.
pub(crate) struct DualDpt {
    norm: LayerNorm,
    stages: Stages,
    fusion: Fusion,
    output_conv1: Conv2d,
    output_conv2: Pair,
    rays: Slot<RayBranch>,
    config: HeadConfig,
    /// Embeddings of the image size seen last.
    embeddings: Mutex<Option<OfSize>>,
}

/// Rows and columns of images, and the embeddings at that size.
type OfSize = ((usize, usize), Arc<Embeddings>);

/// The position embeddings of one image size.
pub(crate) struct Embeddings {
    stages: Vec<GridEmbedding>,
    full: GridEmbedding,
    rays: GridEmbedding,
}

/// Depth and what comes with it, of one view.
pub(crate) struct DenseView {
    /// `[H, W]`.
    pub depth: Vec<f32>,
    /// `[H, W]`, at least 1.
    pub confidence: Vec<f32>,
    /// If they were asked for.
    pub rays: Option<RayMap>,
}

/// The ray branch's own layers.
struct RayBranch {
    fusion: Fusion,
    convs: Vec<Conv2d>,
    pair: Pair,
}

impl DualDpt {
    pub fn load(
        scope: &Scope,
        inputs: usize,
        config: &HeadConfig,
        residency: Residency,
    ) -> Result<Self, Da3Error> {
        let (scratch, features) = (scope.at("scratch"), config.features);
        let branch = scratch.clone();
        Ok(Self {
            norm: scope.norm("norm", inputs, EPS)?,
            stages: Stages::load(scope, inputs, config)?,
            fusion: Fusion::load(&scratch, "", features)?,
            output_conv1: scratch.conv("output_conv1", ConvShape::three(features, features / 2))?,
            output_conv2: Pair::load(&scratch, "output_conv2", features / 2, 2)?,
            rays: Slot::new(residency, move || RayBranch::load(&branch, features))?,
            config: config.clone(),
            embeddings: Mutex::new(None),
        })
    }

    /// Embeddings for images of `rows` × `columns` pixels.
    pub fn embeddings(&self, rows: usize, columns: usize) -> Arc<Embeddings> {
        let mut kept = self.embeddings.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((size, embeddings)) = kept.as_ref()
            && *size == (rows, columns)
        {
            return Arc::clone(embeddings);
        }
        let (ph, pw, aspect) = (rows / PATCH, columns / PATCH, columns as f64 / rows as f64);
        let narrow = self.config.features / 2;
        let embeddings = Arc::new(Embeddings {
            stages: self.config.out_channels.iter().map(|c| embedding(ph, pw, *c, aspect)).collect(),
            full: embedding(rows, columns, narrow, aspect),
            rays: embedding(8 * ph, 8 * pw, narrow, aspect),
        });
        *kept = Some(((rows, columns), Arc::clone(&embeddings)));
        embeddings
    }

    /// Stage `k` of a view from its feature, `[patches, 2D]`, which is normed in place.
    pub fn project(
        &self,
        run: &Run<'_>,
        (view, k): (usize, usize),
        feature: &mut [f32],
        size: (usize, usize),
        embeddings: &Embeddings,
    ) -> Map {
        self.norm.apply_in_place(&run.head, feature);
        let mut map = self.stages.project(run, view, k, feature, size);
        map.embed(&embeddings.stages[k]);
        map
    }

    /// Depth, confidence and rays of a view from its four stages.
    pub fn run(
        &self,
        run: &Run<'_>,
        view: usize,
        stages: Vec<Map>,
        (rows, columns): (usize, usize),
        (embeddings, wants_rays): (&Embeddings, bool),
    ) -> Result<DenseView, Da3Error> {
        let laterals = self.stages.laterals(run, view, stages);
        run.check_cancelled()?;
        let fused = self.fusion.run(run, view, &laterals)?;
        let narrow = fused.convolved(&run.head, &self.output_conv1, ConvInput::None, Epilogue::None);
        drop(fused);
        run.show_map("head.output_conv1", view, narrow.shape(), &narrow.data);
        show_input(run, view, &narrow, (rows, columns), Some(&embeddings.full));
        run.check_cancelled()?;
        let pairs = [&self.output_conv2];
        let logits = run_pairs(run, &narrow, (rows, columns), Some(&embeddings.full), &pairs).swap_remove(0);
        drop(narrow);
        run.show_map("head.output_conv2.logits", view, logits.shape(), &logits.data);
        let mut depth: Vec<f32> = logits.data.iter().step_by(2).copied().collect();
        let mut confidence: Vec<f32> = logits.data.iter().skip(1).step_by(2).copied().collect();
        activation::exp(&run.head, &mut depth);
        activation::exp(&run.head, &mut confidence);
        confidence.iter_mut().for_each(|c| *c += 1.0);
        let rays = if wants_rays {
            run.check_cancelled()?;
            Some(self.rays.get()?.run(run, view, &laterals, &embeddings.rays)?)
        } else {
            None
        };
        Ok(DenseView { depth, confidence, rays })
    }
}

impl RayBranch {
    fn load(scratch: &Scope, features: usize) -> Result<Self, Da3Error> {
        let half = features / 2;
        let conv = |i: usize| {
            let shape = if i.is_multiple_of(2) { (features, half) } else { (half, features) };
            scratch.conv(&format!("output_conv1_aux.3.{i}"), ConvShape::three(shape.0, shape.1))
        };
        Ok(Self {
            fusion: Fusion::load(scratch, "_aux", features)?,
            convs: (0..5).map(conv).collect::<Result<_, _>>()?,
            pair: Pair::load_normed(
                scratch,
                "output_conv2_aux.3",
                half,
                7,
                scratch.norm("output_conv2_aux.0.2", HEAD_LAST, EPS)?,
            )?,
        })
    }

    fn run(
        &self,
        run: &Run<'_>,
        view: usize,
        laterals: &[Map],
        embedding: &GridEmbedding,
    ) -> Result<RayMap, Da3Error> {
        let c = &run.head;
        let mut x = self.fusion.run(run, view, laterals)?;
        for conv in &self.convs {
            run.check_cancelled()?;
            x = x.convolved(c, conv, ConvInput::None, Epilogue::None);
        }
        run.show_map("head.output_conv1_aux.3", view, x.shape(), &x.data);
        let size = (x.rows, x.columns);
        let logits = run_pairs(run, &x, size, Some(embedding), &[&self.pair]).swap_remove(0);
        run.show_map("head.output_conv2_aux.3.logits", view, logits.shape(), &logits.data);
        let cells = logits.data.chunks_exact(7);
        let rays = cells.clone().map(|l| [l[0], l[1], l[2], l[3], l[4], l[5]]).collect();
        let mut confidence: Vec<f32> = cells.map(|l| l[6]).collect();
        activation::exp(c, &mut confidence);
        confidence.iter_mut().for_each(|c| *c += 1.0);
        Ok(RayMap { rows: logits.rows, columns: logits.columns, rays, confidence })
    }
}
