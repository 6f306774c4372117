//! How wrong a simulated network is.

use crate::bounds::{ensure, within};
use crate::error::SynthError;
use serde::{Deserialize, Serialize};

/// Errors of a simulated feed-forward any-view network, as Depth Anything 3 makes them.
///
/// The defaults are those of the study that the coupled graph was designed with (per step 0.12° and 1.2 % of the
/// step, 0.15 % of depth scale), and in-frame errors of a small network. [`PredictionErrors::NONE`] is the truth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PredictionErrors {
    /// Standard deviation of ln(metres per chunk unit) from chunk to chunk, 0…3. Pose-free predictions only.
    pub gauge_scale_sigma: f64,
    /// Standard deviation of the chunk frame's rotation from the world, degrees per axis, 0…180. Pose-free only.
    pub gauge_rotation_deg: f64,
    /// Standard deviation of the chunk frame's origin from the world's, m per axis, 0…1000. Pose-free only.
    pub gauge_shift_m: f64,
    /// Random walk of the camera's rotation, degrees per axis and step from view to view, 0…30.
    pub drift_rotation_deg: f64,
    /// Random walk of the camera's place, share of the step's length per axis and step, 0…1.
    pub drift_translation_share: f64,
    /// Random walk of ln(scale) within a chunk, per step, 0…1; it acts on steps and on depth alike.
    pub drift_scale_sigma: f64,
    /// Independent error of each camera's place, m per axis, 0…1.
    pub position_jitter_m: f64,
    /// Independent error of each view's ln(depth), one number per view, 0…1.
    pub frame_scale_sigma: f64,
    /// Standard deviation of ln(focal length), one number per chunk, 0…0.5. Pose-free only.
    pub focal_sigma: f64,
    /// Smooth deformation within a view: standard deviation of ln(depth) over the image, 0…0.5.
    pub deformation_sigma: f64,
    /// Half waves across the image of the deformation's finest part, 1…16.
    pub deformation_order: usize,
    /// Share of the deformation's variance that belongs to the image and is the same in each chunk that sees it, 0…1.
    pub deformation_frame_share: f64,
    /// Correlation of the rest of the deformation between neighbouring views of a chunk, 0…1.
    pub deformation_persistence: f64,
    /// Bleeding at depth edges: standard deviation of the blur, pixels, 0…20. Planes stay planes (inverse depth is
    /// blurred), edges get pixels that float between both sides.
    pub bleeding_px: f64,
    /// Independent noise per pixel: standard deviation of ln(depth), 0…0.5.
    pub noise_sigma: f64,
    /// Share of each view without depth, in blotches, 0…0.9.
    pub hole_share: f64,
    /// What lies further away has no depth (sky), m, 0…10⁶; 0 keeps everything.
    pub sky_beyond_m: f64,
    /// Relative depth error at which the confidence is one half, 0.001…1.
    pub confidence_tolerance: f64,
    /// How badly the confidence predicts the error: standard deviation of ln(perceived error/true error), smooth over the
    /// image, 0…3.
    pub confidence_noise: f64,
    /// Pose-conditioned predictions: standard deviation of ln(scale) about the scale of the poses given, 0…1.
    pub conditioned_scale_sigma: f64,
    /// Pose-conditioned predictions: share of the drift within a chunk that is left, 0…1.
    pub conditioned_drift_share: f64,
    /// Share of chunks whose prediction has nothing to do with the truth, 0…1.
    pub failed_share: f64,
}

impl Default for PredictionErrors {
    fn default() -> Self {
        Self {
            gauge_scale_sigma: 0.3,
            gauge_rotation_deg: 57.3,
            gauge_shift_m: 3.0,
            drift_rotation_deg: 0.12,
            drift_translation_share: 0.012,
            drift_scale_sigma: 0.0015,
            position_jitter_m: 0.004,
            frame_scale_sigma: 0.004,
            focal_sigma: 0.01,
            deformation_sigma: 0.015,
            deformation_order: 3,
            deformation_frame_share: 0.5,
            deformation_persistence: 0.9,
            bleeding_px: 0.8,
            noise_sigma: 0.004,
            hole_share: 0.0,
            sky_beyond_m: 0.0,
            confidence_tolerance: 0.03,
            confidence_noise: 0.5,
            conditioned_scale_sigma: 0.03,
            conditioned_drift_share: 0.3,
            failed_share: 0.0,
        }
    }
}

impl PredictionErrors {
    /// The truth: no error of any kind, the world's own frame, full confidence.
    pub const NONE: Self = Self {
        gauge_scale_sigma: 0.0,
        gauge_rotation_deg: 0.0,
        gauge_shift_m: 0.0,
        drift_rotation_deg: 0.0,
        drift_translation_share: 0.0,
        drift_scale_sigma: 0.0,
        position_jitter_m: 0.0,
        frame_scale_sigma: 0.0,
        focal_sigma: 0.0,
        deformation_sigma: 0.0,
        deformation_order: 1,
        deformation_frame_share: 0.0,
        deformation_persistence: 0.0,
        bleeding_px: 0.0,
        noise_sigma: 0.0,
        hole_share: 0.0,
        sky_beyond_m: 0.0,
        confidence_tolerance: 0.03,
        confidence_noise: 0.0,
        conditioned_scale_sigma: 0.0,
        conditioned_drift_share: 0.0,
        failed_share: 0.0,
    };

    /// Checks every key against its domain.
    pub fn validate(&self) -> Result<(), SynthError> {
        within("errors.gauge_scale_sigma", self.gauge_scale_sigma, 0.0, 3.0, "0 to 3")?;
        within("errors.gauge_rotation_deg", self.gauge_rotation_deg, 0.0, 180.0, "0 to 180°")?;
        within("errors.gauge_shift_m", self.gauge_shift_m, 0.0, 1000.0, "0 to 1000 m")?;
        within("errors.drift_rotation_deg", self.drift_rotation_deg, 0.0, 30.0, "0 to 30°")?;
        within("errors.drift_translation_share", self.drift_translation_share, 0.0, 1.0, "0 to 1")?;
        within("errors.drift_scale_sigma", self.drift_scale_sigma, 0.0, 1.0, "0 to 1")?;
        within("errors.position_jitter_m", self.position_jitter_m, 0.0, 1.0, "0 to 1 m")?;
        within("errors.frame_scale_sigma", self.frame_scale_sigma, 0.0, 1.0, "0 to 1")?;
        within("errors.focal_sigma", self.focal_sigma, 0.0, 0.5, "0 to 0.5")?;
        within("errors.deformation_sigma", self.deformation_sigma, 0.0, 0.5, "0 to 0.5")?;
        let order = self.deformation_order;
        ensure((1..=16).contains(&order), "errors.deformation_order", "1 to 16", order)?;
        within("errors.deformation_frame_share", self.deformation_frame_share, 0.0, 1.0, "0 to 1")?;
        within("errors.deformation_persistence", self.deformation_persistence, 0.0, 1.0, "0 to 1")?;
        within("errors.bleeding_px", self.bleeding_px, 0.0, 20.0, "0 to 20 pixels")?;
        within("errors.noise_sigma", self.noise_sigma, 0.0, 0.5, "0 to 0.5")?;
        within("errors.hole_share", self.hole_share, 0.0, 0.9, "0 to 0.9")?;
        within("errors.sky_beyond_m", self.sky_beyond_m, 0.0, 1e6, "0 to 10⁶ m")?;
        within("errors.confidence_tolerance", self.confidence_tolerance, 0.001, 1.0, "0.001 to 1")?;
        within("errors.confidence_noise", self.confidence_noise, 0.0, 3.0, "0 to 3")?;
        within("errors.conditioned_scale_sigma", self.conditioned_scale_sigma, 0.0, 1.0, "0 to 1")?;
        within("errors.conditioned_drift_share", self.conditioned_drift_share, 0.0, 1.0, "0 to 1")?;
        within("errors.failed_share", self.failed_share, 0.0, 1.0, "0 to 1")
    }
}
