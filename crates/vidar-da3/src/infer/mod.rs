//! Inference: images in, a [`Prediction`] out, as the official public interface returns it.
//!
//! ```text
//! images ─▶ preprocess ─▶ normalise ─┐
//! cameras ──▶ first camera = world ────┴▶ network ─▶ (nested: metres) ─▶ align with the given cameras ─▶ prediction
//! ```

mod forward;
mod prediction;

pub use forward::NetOutput;
pub use prediction::{FeatureMaps, Prediction};

use crate::align::align_cameras;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::model::backbone::{Pixels, ReferenceStrategy};
use crate::pose::{self, NetCameras};
use crate::preprocess::{self, Batch, PreprocessConfig, denormalise, normalise_into};
use crate::run::Hooks;
use nalgebra::{Matrix3, Matrix4};
use std::ops::Range;
use vidar_core::Image;

/// What the network sees.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// The images.
    pub images: &'a [Image<[u8; 3]>],
    /// Known camera poses in a metric world, one per image. They need `intrinsics`.
    pub camera_from_world: Option<&'a [Matrix4<f64>]>,
    /// Known intrinsics in pixels of the images, origin at the *edge* of the top-left pixel
    /// ([`pose::to_edge`]). Without poses they are not used.
    pub intrinsics: Option<&'a [Matrix3<f64>]>,
}

impl<'a> Inputs<'a> {
    /// Images alone.
    pub fn images(images: &'a [Image<[u8; 3]>]) -> Self {
        Self { images, camera_from_world: None, intrinsics: None }
    }

    /// Images with known cameras.
    pub fn posed(
        images: &'a [Image<[u8; 3]>],
        camera_from_world: &'a [Matrix4<f64>],
        intrinsics: &'a [Matrix3<f64>],
    ) -> Self {
        Self { images, camera_from_world: Some(camera_from_world), intrinsics: Some(intrinsics) }
    }
}

/// How to infer. The defaults are the official ones.
#[derive(Clone, Debug, PartialEq)]
pub struct InferOptions {
    /// Size of the network's input.
    pub preprocess: PreprocessConfig,
    /// How the reference view is chosen when no poses are given.
    pub reference: ReferenceStrategy,
    /// Cameras from the ray branch instead of the camera decoder.
    pub use_ray_pose: bool,
    /// Also answer the rays themselves.
    pub wants_rays: bool,
    /// With given cameras: divide depth by the scale between given and predicted ones and answer the given poses. If
    /// not, answer the given poses moved into the predicted frame, and depth as predicted.
    pub align_to_given: bool,
    /// Backbone layers whose tokens are wanted.
    pub feature_layers: Vec<usize>,
    /// Views whose depth is needed (indices); the others are context. `None` is all. Networks of single views and
    /// nested ones work out all.
    pub wanted: Option<Range<usize>>,
    /// Behave as the official code does where this library does better: stop at one or two given views and at given
    /// cameras on a line, return images that lose a grey level, leave feature maps in the order of computation.
    pub compat: bool,
}

impl Default for InferOptions {
    fn default() -> Self {
        Self {
            preprocess: PreprocessConfig::default(),
            reference: ReferenceStrategy::default(),
            use_ray_pose: false,
            wants_rays: false,
            align_to_given: true,
            feature_layers: Vec::new(),
            wanted: None,
            compat: false,
        }
    }
}

/// Most views of one run: the tokens of more do not fit any machine.
const MAX_VIEWS: usize = 4096;

impl Da3 {
    /// Infers with all defaults but `options`.
    pub fn infer(&self, inputs: &Inputs<'_>, options: &InferOptions) -> Result<Prediction, Da3Error> {
        self.infer_with(inputs, options, &Hooks::default())
    }

    /// Infers, with somebody who may stop it or look on.
    pub fn infer_with(
        &self,
        inputs: &Inputs<'_>,
        options: &InferOptions,
        hooks: &Hooks<'_>,
    ) -> Result<Prediction, Da3Error> {
        check_inputs(inputs, options)?;
        let images: Vec<&Image<[u8; 3]>> = inputs.images.iter().collect();
        let batch = preprocess::process(&images, inputs.intrinsics, &options.preprocess)?;
        let (width, height, views) = (batch.width(), batch.height(), batch.images.len());
        let mut data = vec![0.0; 3 * views * width * height];
        for (image, planes) in batch.images.iter().zip(data.chunks_exact_mut(3 * width * height)) {
            normalise_into(image, planes);
        }
        let pixels = Pixels::new(&data, views, height, width)?;
        let moved = inputs.camera_from_world.map(pose::normalise_world);
        let cameras = match (&moved, &batch.intrinsics) {
            (Some(poses), Some(intrinsics)) => Some(NetCameras { camera_from_world: poses, intrinsics }),
            _ => None,
        };
        let output = self.forward(&pixels, cameras, options, hooks)?;
        let batch = if options.compat { as_official(batch, &data) } else { batch };
        self.finish(inputs, options, batch, output)
    }

    /// The steps after the network: alignment with given cameras.
    fn finish(
        &self,
        inputs: &Inputs<'_>,
        options: &InferOptions,
        batch: Batch,
        mut output: NetOutput,
    ) -> Result<Prediction, Da3Error> {
        let mut alignment = None;
        if let (Some(given), Some(predicted)) = (inputs.camera_from_world, &output.camera_from_world) {
            let found = align_cameras(predicted, given, options.compat)?;
            if options.align_to_given {
                output.depth.iter_mut().for_each(|d| *d = (f64::from(*d) / found.scale) as f32);
                output.camera_from_world = Some(given.to_vec());
            } else {
                output.camera_from_world = Some(given.iter().map(|g| found.to_predicted(g)).collect());
            }
            output.intrinsics.clone_from(&batch.intrinsics);
            alignment = Some(found);
        }
        Prediction::assemble(self, batch, output, alignment)
    }
}

fn check_inputs(inputs: &Inputs<'_>, options: &InferOptions) -> Result<(), Da3Error> {
    let views = inputs.images.len();
    if !(1..=MAX_VIEWS).contains(&views) {
        return Err(Da3Error::ViewCount { found: views, expected: format!("1 to {MAX_VIEWS}") });
    }
    if let Some(poses) = inputs.camera_from_world {
        if poses.len() != views {
            let reason = format!("{} for {views} images", poses.len());
            return Err(Da3Error::BadInput { what: "camera_from_world", reason });
        }
        if inputs.intrinsics.is_none() {
            let reason = "given cameras need intrinsics".into();
            return Err(Da3Error::BadInput { what: "intrinsics", reason });
        }
        if let Some(view) = poses.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
            return Err(Da3Error::BadView { view, reason: "its pose is not finite".into() });
        }
    }
    let is_bad = |k: &Matrix3<f64>| !(k[(0, 0)] > 0.0 && k[(1, 1)] > 0.0 && k.iter().all(|v| v.is_finite()));
    if let Some(view) = inputs.intrinsics.and_then(|all| all.iter().position(is_bad)) {
        let reason = "its focal lengths must be positive and its intrinsics finite".into();
        return Err(Da3Error::BadView { view, reason });
    }
    if let Some(wanted) = options.wanted.as_ref().filter(|w| w.end > views || w.is_empty()) {
        let reason = format!("views {}..{} of {views}", wanted.start, wanted.end);
        return Err(Da3Error::BadInput { what: "wanted", reason });
    }
    Ok(())
}

fn as_official(batch: Batch, data: &[f32]) -> Batch {
    let (width, height) = (batch.width(), batch.height());
    let images = data.chunks_exact(3 * width * height).map(|planes| denormalise(planes, width, height));
    Batch { images: images.collect(), ..batch }
}
