//! The files of the official Depth Anything 3 program, as it writes them.
//!
//! | Writer | Official format | Differences |
//! |---|---|---|
//! | [`write_npz`], [`write_mini_npz`] | `exports/npz/results.npz`, `exports/mini_npz/results.npz` | none that numpy sees |
//! | [`write_scene_glb`] | `scene.glb` | points are thinned by a fixed seed; cameras are one line set each |
//! | [`write_depth_vis`] | `depth_vis/%04d.jpg` | another JPEG encoder, same quality |
//! | [`write_official_colmap`] | `cameras.bin`, `images.bin`, `points3D.bin`, `rigs.bin`, `frames.bin` | none |
//!
//! These formats keep the official program's conventions, which are not VIDAR's: `extrinsics` are
//! `camera_from_world`, `intrinsics` scale from the image's corner, and unprojection uses the pixel's index as its
//! position. [`read_prediction_npz`] takes files of either program.

mod colmap;
mod npy;
mod npz;
mod numbers;
mod prediction;
mod scene;
mod vis;

pub use colmap::{OriginalImage, write_official_colmap};
pub use npy::{NpyArray, NpyData};
pub use npz::{NpzLimits, Packing, read_npz, write_npz_arrays, write_npz_arrays_with};
pub use prediction::{read_prediction_npz, write_mini_npz, write_npz};
pub use scene::{SceneOptions, SceneSummary, thinned, write_scene_glb};
pub use vis::{depth_colors, spectral, write_depth_vis};

use crate::error::ExportError;
use vidar_core::Image;

/// One view of a prediction, in the official program's conventions.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictedView {
    /// The network's input image; absent in `mini_npz`.
    pub image: Option<Image<[u8; 3]>>,
    /// z-depth.
    pub depth: Image<f32>,
    /// At least 1, higher is more certain; single-view networks have none.
    pub confidence: Option<Image<f32>>,
    /// Rows of `camera_from_world`, 3×4.
    pub extrinsics: Option<[[f32; 4]; 3]>,
    /// Rows of the camera matrix at the depth's size, 3×3.
    pub intrinsics: Option<[[f32; 3]; 3]>,
}

/// A prediction: views of one size.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Prediction {
    /// In the order of the images given.
    pub views: Vec<PredictedView>,
}

impl Prediction {
    /// Columns and rows of the views.
    pub fn size(&self) -> (usize, usize) {
        self.views.first().map_or((0, 0), |v| (v.depth.width(), v.depth.height()))
    }

    /// Refuses views of different sizes, and data that only some views have.
    fn check(&self, format: &'static str) -> Result<(), ExportError> {
        let size = self.size();
        let Some(first) = self.views.first() else {
            return Err(ExportError::unwritable(format, "a prediction", "it has no views"));
        };
        let has = |v: &PredictedView| {
            [v.image.is_some(), v.confidence.is_some(), v.extrinsics.is_some(), v.intrinsics.is_some()]
        };
        for (i, view) in self.views.iter().enumerate() {
            let what = || format!("view {i}");
            let sizes = [
                Some((view.depth.width(), view.depth.height())),
                view.confidence.as_ref().map(|c| (c.width(), c.height())),
                view.image.as_ref().map(|c| (c.width(), c.height())),
            ];
            if let Some(other) = sizes.into_iter().flatten().find(|s| *s != size) {
                let reason = format!("it is {}x{}, view 0 is {}x{}", other.0, other.1, size.0, size.1);
                return Err(ExportError::unwritable(format, what(), reason));
            }
            if has(view) != has(first) {
                let reason =
                    "image, confidence, extrinsics and intrinsics must be present for all views or for none";
                return Err(ExportError::unwritable(format, what(), reason));
            }
        }
        Ok(())
    }

    /// The cameras of all views.
    fn cameras(&self, format: &'static str) -> Result<Vec<numbers::Camera>, ExportError> {
        let camera = |(i, view): (usize, &PredictedView)| {
            let (Some(extrinsics), Some(intrinsics)) = (&view.extrinsics, &view.intrinsics) else {
                let reason = "it has no camera; single-view networks do not predict any";
                return Err(ExportError::unwritable(format, format!("view {i}"), reason));
            };
            numbers::Camera::new(extrinsics, intrinsics).ok_or_else(|| {
                let reason = "its camera is not finite or cannot be inverted";
                ExportError::unwritable(format, format!("view {i}"), reason)
            })
        };
        self.views.iter().enumerate().map(camera).collect()
    }
}

/// Whether a pixel is used as a point: sufficient confidence, and a valid depth. Without confidences every depth counts.
fn is_point(view: &PredictedView, x: usize, y: usize, least: f64) -> bool {
    let depth = view.depth[(x, y)];
    let sure = view.confidence.as_ref().is_none_or(|c| f64::from(c[(x, y)]) >= least);
    sure && depth.is_finite() && depth > 0.0
}

/// Percentiles of all confidences of a prediction; 0 without any.
pub fn confidence_percentile(prediction: &Prediction, percents: &[f64]) -> Vec<f64> {
    let all: Vec<f32> = prediction
        .views
        .iter()
        .filter_map(|v| v.confidence.as_ref())
        .flat_map(|c| c.data())
        .copied()
        .collect();
    let mut sorted: Vec<f64> = all.into_iter().map(f64::from).filter(|c| c.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    percents.iter().map(|p| numbers::percentile(&sorted, *p).unwrap_or(0.0)).collect()
}
