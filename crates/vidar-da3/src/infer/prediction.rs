//! The result of inference.

use super::NetOutput;
use crate::align::CameraAlignment;
use crate::config::PATCH;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::preprocess::Batch;
use crate::ray_pose::RayMap;
use nalgebra::{Matrix3, Matrix4};
use std::collections::BTreeMap;
use std::ops::Range;
use vidar_core::Image;

/// From this on a pixel is sky in the answer (the threshold for filling is lower).
const IS_SKY: f32 = 0.5;

/// Depth, and what the network says besides, of every wanted view, at the processed size.
#[derive(Clone, Debug)]
pub struct Prediction {
    /// The processed images of all views.
    pub images: Vec<Image<[u8; 3]>>,
    /// Which views the maps below are of.
    pub wanted: Range<usize>,
    /// z-depth: metres if `is_metric` or aligned with given cameras, else the network's own unit.
    pub depth: Vec<Image<f32>>,
    /// At least 1, without an upper bound; only comparisons mean something. `None` for networks of single views.
    pub confidence: Option<Vec<Image<f32>>>,
    /// Which pixels are sky; networks of single views only.
    pub sky: Option<Vec<Image<bool>>>,
    /// Poses of all views: predicted, or the given ones (see [`super::InferOptions::align_to_given`]).
    pub camera_from_world: Option<Vec<Matrix4<f64>>>,
    /// Intrinsics of all views in processed pixels, origin at the edge of the top-left pixel.
    pub intrinsics: Option<Vec<Matrix3<f64>>>,
    /// Whether the network itself predicts metres (nested models).
    pub is_metric: bool,
    /// Metres per unit that a nested model multiplied by.
    pub scale_factor: Option<f64>,
    /// How given cameras were aligned with predicted ones, and what the scale rests on.
    pub alignment: Option<CameraAlignment>,
    /// Rays, if asked for.
    pub rays: Option<Vec<RayMap>>,
    /// Tokens of the layers asked for, by layer.
    pub features: BTreeMap<usize, FeatureMaps>,
    /// The view in whose camera frame predicted poses are.
    pub reference_view: usize,
    /// Whether images of different sizes were cut to the smallest.
    pub was_cropped: bool,
}

/// Normalised patch tokens of all views after one layer.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureMaps {
    /// Rows of patches.
    pub rows: usize,
    /// Columns of patches.
    pub columns: usize,
    /// Channels.
    pub channels: usize,
    /// By view: `[rows, columns, channels]`.
    pub views: Vec<Vec<f32>>,
}

impl Prediction {
    pub(super) fn assemble(
        model: &Da3,
        batch: Batch,
        output: NetOutput,
        alignment: Option<CameraAlignment>,
    ) -> Result<Self, Da3Error> {
        let (width, height) = (batch.width(), batch.height());
        let (rows, columns) = (height / PATCH, width / PATCH);
        let channels = model.config.main().backbone.dim;
        let features = output
            .layers
            .into_iter()
            .map(|(layer, views)| (layer, FeatureMaps { rows, columns, channels, views }))
            .collect();
        let sky = output.sky.map(|sky| images(&sky, width, height, |s| *s >= IS_SKY));
        Ok(Self {
            wanted: output.wanted,
            depth: images(&output.depth, width, height, |d| *d),
            confidence: output.confidence.map(|c| images(&c, width, height, |c| *c)),
            sky,
            camera_from_world: output.camera_from_world,
            intrinsics: output.intrinsics,
            is_metric: output.scale_factor.is_some(),
            scale_factor: output.scale_factor,
            alignment,
            rays: output.rays,
            features,
            reference_view: output.reference,
            was_cropped: batch.was_cropped,
            images: batch.images,
        })
    }

    /// Columns of every map.
    pub fn width(&self) -> usize {
        self.images.first().map_or(0, Image::width)
    }

    /// Rows of every map.
    pub fn height(&self) -> usize {
        self.images.first().map_or(0, Image::height)
    }
}

fn images<T: Clone>(values: &[f32], width: usize, height: usize, to: impl Fn(&f32) -> T) -> Vec<Image<T>> {
    values
        .chunks_exact(width * height)
        .map(|view| Image::from_fn(width, height, |x, y| to(&view[y * width + x])))
        .collect()
}
