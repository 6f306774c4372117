//! What can be tuned from outside. Everything else is a named constant with its reason beside the code.

use super::error::FrontendError;
use serde::{Deserialize, Serialize};

/// Settings of the visual front end. The defaults suit images of about 752 × 480.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FrontendConfig {
    /// Image pyramids.
    pub pyramid: PyramidConfig,
    /// Where features are looked for in a keyframe.
    pub detector: DetectorConfig,
    /// Alignment of a whole frame, which predicts where features are.
    pub image_alignment: ImageAlignmentConfig,
    /// Alignment of single features, which measures.
    pub matching: MatchingConfig,
    /// Motion between two views from rays alone.
    pub two_view: TwoViewConfig,
}

/// Image pyramids.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PyramidConfig {
    /// Levels, each half the size of the one before, 1…8. More find their way through faster motion.
    pub levels: usize,
}

impl Default for PyramidConfig {
    fn default() -> Self {
        Self { levels: 5 }
    }
}

/// Where features are looked for in a keyframe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DetectorConfig {
    /// Side of the cells of which each holds at most one feature, level-0 pixels, 8…256. Smaller gives more features.
    pub cell_px: usize,
    /// Pyramid levels on which corners are looked for, 1…5.
    pub levels: usize,
    /// Difference to the centre that FAST asks of a circle's pixels, grey levels, 2…100. Lower it for dull images.
    pub fast_threshold: u8,
    /// Least structure of a corner: root of the smaller eigenvalue of its mean gradient tensor, grey levels per pixel,
    /// 0.5…50. It bounds the error of the alignment, so raise it for noisy images.
    pub min_corner_strength: f64,
    /// Least gradient of an edgelet, grey levels per pixel, 1…100.
    pub min_edge_strength: f64,
    /// Distance that features keep from the image's border on their own level, pixels, 6…64.
    pub border_px: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self {
            cell_px: 32,
            levels: 3,
            fast_threshold: 10,
            min_corner_strength: 2.5,
            min_edge_strength: 8.0,
            border_px: 8,
        }
    }
}

/// Alignment of a whole frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ImageAlignmentConfig {
    /// Coarsest pyramid level, `finest_level`…7; levels that do not exist are left out. Higher survives faster motion.
    pub coarsest_level: usize,
    /// Finest pyramid level, 0…7. Lower is more exact and slower; features are measured on their own afterwards.
    pub finest_level: usize,
    /// Most steps on one level, 1…50.
    pub max_iterations: usize,
    /// Mean motion of the patches below which a level has settled, pixels of that level, 1e-4…1.
    pub min_step_px: f64,
    /// Residual, in units of the median patch's, at which a patch counts one quarter, 1.5…20.
    pub outlier_ratio: f64,
    /// Fewest patches that must be seen, 6…1000.
    pub min_patches: usize,
}

impl Default for ImageAlignmentConfig {
    fn default() -> Self {
        Self {
            coarsest_level: 4,
            finest_level: 2,
            max_iterations: 10,
            min_step_px: 0.02,
            outlier_ratio: 3.0,
            min_patches: 10,
        }
    }
}

/// Alignment of single features.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MatchingConfig {
    /// Most steps of one alignment, 1…50.
    pub max_iterations: usize,
    /// Step below which it has settled, pixels of its level, 1e-4…0.5.
    pub min_step_px: f64,
    /// Furthest that a feature may be from where it is expected, pixels of its level, 0.5…32.
    pub max_shift_px: f64,
    /// Least correlation of what is accepted, 0…1.
    pub min_ncc: f64,
    /// Least correlation of what differs by no more than image noise, 0…`min_ncc`.
    pub min_noisy_ncc: f64,
    /// Least change of contrast that is accepted; its inverse is the largest, 0.01…1.
    pub min_gain: f64,
    /// Least structure of a patch that is aligned: its summed squared gradients in the weakest direction that matters,
    /// grey levels² per pixel², positive.
    pub min_texture: f64,
    /// Error that a measurement has at least, pixels of its level, 0…2: what the patch model does not know.
    pub sigma_floor_px: f64,
    /// Factor from the variance of the residual to that of the noise that moves a patch, 0.1…10.
    pub variance_factor: f64,
}

impl Default for MatchingConfig {
    fn default() -> Self {
        Self {
            max_iterations: 12,
            min_step_px: 0.015,
            max_shift_px: 8.0,
            min_ncc: 0.8,
            min_noisy_ncc: 0.5,
            min_gain: 0.2,
            min_texture: 100.0,
            sigma_floor_px: 0.1,
            variance_factor: 1.0,
        }
    }
}

/// Motion between two views from rays alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TwoViewConfig {
    /// Angle to the epipolar plane up to which a pair agrees, standard deviations of a ray, 1…10.
    pub threshold_sigmas: f64,
    /// Fewest pairs that must agree, 6…1000.
    pub min_inliers: usize,
    /// Most samples that are drawn, 1…10000.
    pub max_samples: usize,
    /// Probability that one sample was free of wrong pairs, 0.5…0.9999.
    pub confidence: f64,
    /// Least median parallax, standard deviations of a ray, 0…100. Below it a motion cannot be told from a rotation.
    pub min_parallax_sigmas: f64,
}

impl Default for TwoViewConfig {
    fn default() -> Self {
        Self {
            threshold_sigmas: 2.5,
            min_inliers: 12,
            max_samples: 200,
            confidence: 0.995,
            min_parallax_sigmas: 4.0,
        }
    }
}

fn within(
    key: &'static str,
    found: f64,
    low: f64,
    high: f64,
    expected: &'static str,
) -> Result<(), FrontendError> {
    // Written so that NaN is refused.
    if found >= low && found <= high {
        Ok(())
    } else {
        Err(FrontendError::BadConfig { key, expected, found })
    }
}

impl FrontendConfig {
    /// Checks every key against its domain.
    ///
    /// # Errors
    /// Names the first key that is outside.
    pub fn validate(&self) -> Result<(), FrontendError> {
        within("pyramid.levels", self.pyramid.levels as f64, 1.0, 8.0, "1 to 8")?;
        self.detector.validate()?;
        self.image_alignment.validate()?;
        self.matching.validate()?;
        self.two_view.validate()
    }
}

impl TwoViewConfig {
    fn validate(&self) -> Result<(), FrontendError> {
        within("two_view.threshold_sigmas", self.threshold_sigmas, 1.0, 10.0, "1 to 10")?;
        within("two_view.min_inliers", self.min_inliers as f64, 6.0, 1000.0, "6 to 1000")?;
        within("two_view.max_samples", self.max_samples as f64, 1.0, 10_000.0, "1 to 10000")?;
        within("two_view.confidence", self.confidence, 0.5, 0.9999, "0.5 to 0.9999")?;
        within("two_view.min_parallax_sigmas", self.min_parallax_sigmas, 0.0, 100.0, "0 to 100")
    }
}

impl DetectorConfig {
    fn validate(&self) -> Result<(), FrontendError> {
        within("detector.cell_px", self.cell_px as f64, 8.0, 256.0, "8 to 256 px")?;
        within("detector.levels", self.levels as f64, 1.0, 5.0, "1 to 5")?;
        within("detector.fast_threshold", self.fast_threshold.into(), 2.0, 100.0, "2 to 100")?;
        within("detector.min_corner_strength", self.min_corner_strength, 0.5, 50.0, "0.5 to 50")?;
        within("detector.min_edge_strength", self.min_edge_strength, 1.0, 100.0, "1 to 100")?;
        within("detector.border_px", self.border_px as f64, 6.0, 64.0, "6 to 64 px")
    }
}

impl ImageAlignmentConfig {
    fn validate(&self) -> Result<(), FrontendError> {
        within("image_alignment.finest_level", self.finest_level as f64, 0.0, 7.0, "0 to 7")?;
        let (coarsest, finest) = (self.coarsest_level as f64, self.finest_level as f64);
        within("image_alignment.coarsest_level", coarsest, finest, 7.0, "finest_level to 7")?;
        within("image_alignment.max_iterations", self.max_iterations as f64, 1.0, 50.0, "1 to 50")?;
        within("image_alignment.min_step_px", self.min_step_px, 1e-4, 1.0, "1e-4 to 1 px")?;
        within("image_alignment.outlier_ratio", self.outlier_ratio, 1.5, 20.0, "1.5 to 20")?;
        within("image_alignment.min_patches", self.min_patches as f64, 6.0, 1000.0, "6 to 1000")
    }
}

impl MatchingConfig {
    fn validate(&self) -> Result<(), FrontendError> {
        within("matching.max_iterations", self.max_iterations as f64, 1.0, 50.0, "1 to 50")?;
        within("matching.min_step_px", self.min_step_px, 1e-4, 0.5, "1e-4 to 0.5 px")?;
        within("matching.max_shift_px", self.max_shift_px, 0.5, 32.0, "0.5 to 32 px")?;
        within("matching.min_ncc", self.min_ncc, 0.0, 1.0, "0 to 1")?;
        within("matching.min_noisy_ncc", self.min_noisy_ncc, 0.0, self.min_ncc, "0 to min_ncc")?;
        within("matching.min_gain", self.min_gain, 0.01, 1.0, "0.01 to 1")?;
        within("matching.min_texture", self.min_texture, 1e-3, 1e6, "1e-3 to 1e6")?;
        within("matching.sigma_floor_px", self.sigma_floor_px, 0.0, 2.0, "0 to 2 px")?;
        within("matching.variance_factor", self.variance_factor, 0.1, 10.0, "0.1 to 10")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_valid_and_a_bad_key_is_named() {
        FrontendConfig::default().validate().unwrap();
        type Corrupt = fn(&mut FrontendConfig);
        let cases: [(&str, Corrupt); 5] = [
            ("pyramid.levels", |c| c.pyramid.levels = 0),
            ("detector.fast_threshold", |c| c.detector.fast_threshold = 0),
            ("image_alignment.coarsest_level", |c| c.image_alignment.coarsest_level = 1),
            ("matching.min_ncc", |c| c.matching.min_ncc = f64::NAN),
            ("two_view.confidence", |c| c.two_view.confidence = 1.0),
        ];
        for (name, corrupt) in cases {
            let mut config = FrontendConfig::default();
            corrupt(&mut config);
            match config.validate() {
                Err(FrontendError::BadConfig { key, .. }) => assert_eq!(key, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
