//! One chunk onto its anchors.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use thiserror::Error;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    AlignedView, ChunkId, ChunkView, FrameId, FrameImage, GeometryError, GeometryPrediction, Image, LieGroup,
    Se3, Sim3, umeyama_sim3,
};

/// What decides how a chunk is placed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AlignConfig {
    /// Largest RMS distance (m) between placed and anchored camera centres at which a chunk is still trusted.
    /// Raise it for fast vehicles with a coarse trajectory; lower it indoors.
    pub max_center_rms_m: f64,
}

impl Default for AlignConfig {
    fn default() -> Self {
        Self { max_center_rms_m: 0.5 }
    }
}

impl AlignConfig {
    /// Checks the ranges.
    pub fn validate(&self) -> Result<(), AlignError> {
        if self.max_center_rms_m.is_finite() && self.max_center_rms_m > 0.0 {
            return Ok(());
        }
        Err(AlignError::BadConfig { key: "max_center_rms_m", found: self.max_center_rms_m })
    }
}

/// A metric pose of one of the chunk's cameras.
#[derive(Clone, Copy, Debug)]
pub struct Anchor {
    /// Which frame.
    pub frame_id: FrameId,
    /// Its pose, metres.
    pub world_from_camera: Se3,
}

/// What the evidence says of a placement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The prediction was made in the anchors' own frame; nothing was fitted.
    PriorWorld,
    /// A similarity was fitted and agrees with the anchors.
    Fitted,
    /// The cameras do not fix a similarity (on a line, or too few): identity, as the paper's guard has it.
    RankDeficient,
    /// The fit exists but leaves the anchors further off than the configuration allows.
    Inconsistent,
    /// The chunk stands where its neighbours put it; its own cameras have no anchor, or one that is not believed.
    Chained,
    /// The prediction contradicts its neighbour and its anchors, or holds no number: left out.
    Garbage,
    /// Neither anchor nor neighbour says where it is: left out.
    Unplaced,
}

impl Verdict {
    /// Whether the chunk may enter the map.
    pub fn is_usable(self) -> bool {
        matches!(self, Self::PriorWorld | Self::Fitted | Self::Chained)
    }

    /// In words, for messages.
    pub fn words(self) -> &'static str {
        match self {
            Self::PriorWorld => "predicted in the anchors' own frame",
            Self::Fitted => "fitted to its anchors",
            Self::RankDeficient => "its cameras stand on a line or are too few to fix a place",
            Self::Inconsistent => "its cameras do not fit their anchors",
            Self::Chained => "placed by its neighbours",
            Self::Garbage => "it contradicts its neighbour and its anchors, or holds no number",
            Self::Unplaced => "neither anchor nor neighbour says where it is",
        }
    }
}

/// A placement together with its evidence.
#[derive(Clone, Copy, Debug)]
pub struct ChunkAlignment {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// Maps chunk coordinates and units to metres in the world.
    pub world_from_chunk: Sim3,
    /// Camera centres used.
    pub matched: usize,
    /// RMS distance of placed and anchored camera centres, metres.
    pub center_rms_m: f64,
    /// The judgement.
    pub verdict: Verdict,
}

/// Why a chunk cannot be placed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AlignError {
    /// A configuration value is out of range.
    #[error("align.{key} must be finite and positive, found {found}")]
    BadConfig {
        /// Which key.
        key: &'static str,
        /// The value.
        found: f64,
    },
    /// A configuration value is outside of its range.
    #[error("align.{key} must be between {least} and {most}, found {found}")]
    OutOfRange {
        /// Which key.
        key: &'static str,
        /// The value.
        found: f64,
        /// Smallest value allowed.
        least: f64,
        /// Largest value allowed.
        most: f64,
    },
    /// A loop names a chunk that was never given.
    #[error("chunk {chunk} was never given")]
    UnknownChunk {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// A chunk was pushed twice.
    #[error("chunk {chunk} was given before")]
    RepeatedChunk {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// No camera of the chunk has an anchor.
    #[error("chunk {chunk}: none of its {views} views has a metric pose")]
    NoAnchor {
        /// Which chunk.
        chunk: ChunkId,
        /// Views in the prediction.
        views: usize,
    },
    /// The prediction holds something that cannot become a metric view.
    #[error("chunk {chunk}: {source}")]
    Geometry {
        /// Which chunk.
        chunk: ChunkId,
        /// What is wrong.
        source: GeometryError,
    },
}

/// Finds the similarity that takes the chunk's camera centres onto their anchors.
pub fn place_chunk(
    prediction: &GeometryPrediction,
    anchors: &[Anchor],
    config: &AlignConfig,
) -> Result<ChunkAlignment, AlignError> {
    config.validate()?;
    let (in_chunk, in_world) = matched_centers(prediction, anchors);
    if in_chunk.is_empty() {
        return Err(AlignError::NoAnchor { chunk: prediction.chunk_id, views: prediction.views.len() });
    }
    let (world_from_chunk, fitted) = match prediction.frame {
        ChunkFrame::PriorWorld => (Sim3::IDENTITY, Verdict::PriorWorld),
        ChunkFrame::ModelNative => match umeyama_sim3(&in_chunk, &in_world) {
            Ok(similarity) => (similarity, Verdict::Fitted),
            Err(_) => (Sim3::IDENTITY, Verdict::RankDeficient),
        },
    };
    let center_rms_m = rms(&world_from_chunk, &in_chunk, &in_world);
    let within = center_rms_m <= config.max_center_rms_m;
    let verdict = if fitted.is_usable() && !within { Verdict::Inconsistent } else { fitted };
    Ok(ChunkAlignment {
        chunk_id: prediction.chunk_id,
        world_from_chunk,
        matched: in_chunk.len(),
        center_rms_m,
        verdict,
    })
}

/// The prediction's views in metres and in the world, coloured from the images they were made of.
pub fn aligned_views(
    prediction: GeometryPrediction,
    alignment: &ChunkAlignment,
    views: &[ChunkView],
) -> Result<Vec<AlignedView>, AlignError> {
    let chunk = prediction.chunk_id;
    let geometry = |source| AlignError::Geometry { chunk, source };
    let mut aligned = Vec::with_capacity(prediction.views.len());
    for view in prediction.views {
        let image = views.iter().find(|v| v.frame_id == view.frame_id);
        let depth = view.depth.to_metric(alignment.world_from_chunk.scale).map_err(geometry)?;
        let world_from_camera = alignment.world_from_chunk.transform_pose(&view.chunk_from_camera);
        let time = image.map_or_else(Default::default, |v| v.time);
        let metric =
            AlignedView::new(view.frame_id, time, world_from_camera, view.intrinsics, depth, view.confidence)
                .map_err(geometry)?;
        aligned.push(colored(metric, image).map_err(geometry)?);
    }
    Ok(aligned)
}

/// The same view with the colours of its image, if there is one.
pub(crate) fn colored(view: AlignedView, image: Option<&ChunkView>) -> Result<AlignedView, GeometryError> {
    let Some(image) = image else { return Ok(view) };
    let color = color_at_size(&image.image, view.intrinsics().width, view.intrinsics().height);
    view.with_color(color)
}

/// The image's colours at the depth's size: bilinear, pixel centres kept (`c' = (c + 0.5)·s − 0.5`).
pub fn color_at_size(image: &FrameImage, width: usize, height: usize) -> Image<[u8; 3]> {
    let color = image.to_rgb8();
    let (w, h) = (color.width(), color.height());
    if (w, h) == (width, height) || w == 0 || h == 0 {
        return color;
    }
    let (sx, sy) = (w as f32 / width as f32, h as f32 / height as f32);
    let source = |c: usize, s: f32, n: usize| ((c as f32 + 0.5) * s - 0.5).clamp(0.0, (n - 1) as f32);
    Image::from_fn(width, height, |x, y| {
        let (fx, fy) = (source(x, sx, w), source(y, sy, h));
        let (x0, y0) = (fx as usize, fy as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (ax, ay) = (fx - x0 as f32, fy - y0 as f32);
        std::array::from_fn(|c| {
            let at = |x: usize, y: usize| f32::from(color[(x, y)][c]);
            let top = at(x0, y0) + ax * (at(x1, y0) - at(x0, y0));
            let bottom = at(x0, y1) + ax * (at(x1, y1) - at(x0, y1));
            (top + ay * (bottom - top)).round() as u8
        })
    })
}

fn matched_centers(
    prediction: &GeometryPrediction,
    anchors: &[Anchor],
) -> (Vec<Vector3<f64>>, Vec<Vector3<f64>>) {
    prediction
        .views
        .iter()
        .filter_map(|view| {
            let anchor = anchors.iter().find(|a| a.frame_id == view.frame_id)?;
            Some((view.chunk_from_camera.translation, anchor.world_from_camera.translation))
        })
        .unzip()
}

fn rms(world_from_chunk: &Sim3, in_chunk: &[Vector3<f64>], in_world: &[Vector3<f64>]) -> f64 {
    let sum: f64 =
        in_chunk.iter().zip(in_world).map(|(c, w)| (world_from_chunk.act(c) - w).norm_squared()).sum();
    (sum / in_chunk.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests;
