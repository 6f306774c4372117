//! Settings of stereo. Everything else is a named constant with its reason beside the code.

use crate::error::StereoError;
use serde::{Deserialize, Serialize};

/// Settings of the stereo model. The defaults suit a hand-held camera or a drone in rooms and halls.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StereoConfig {
    /// Largest width of the images that are matched, and so of the depth, pixels, 64…4096. Larger images are
    /// area-averaged down; smaller ones are used as they are. Raise for finer depth; time grows with its square.
    pub max_width_px: usize,
    /// Views that each view is matched against, 1…8. More neighbours are more robust to occlusion; time is proportional.
    pub neighbours: usize,
    /// Smallest parallax that makes a neighbour useful, degrees at the typical depth of the scene, 0.05…20.
    pub min_parallax_deg: f64,
    /// Parallax at which a neighbour scores best, degrees, above `min_parallax_deg`, at most 30.
    /// Lower it for cluttered scenes (less occlusion), raise it for open ones (finer depth).
    pub best_parallax_deg: f64,
    /// Nearest depth that is searched, metres, positive.
    pub min_depth_m: f64,
    /// Furthest depth that is searched, metres, above `min_depth_m`.
    pub max_depth_m: f64,
    /// Most depth planes of the sweep, 16…256. Fewer are used where the parallax is small.
    pub max_planes: usize,
    /// Penalty of a step by one plane between adjacent pixels, 1…200; a wrong match costs up to 254.
    pub step_penalty: u16,
    /// Penalty of a depth edge between adjacent pixels of equal brightness, `step_penalty`…1000.
    pub jump_penalty: u16,
    /// Standard deviation of each given pose's rotation, degrees, 0…5. Poses are corrected by the images with this prior;
    /// 0 here or in `pose_std_m` takes them as given.
    pub pose_std_deg: f64,
    /// Standard deviation of the given camera centres, metres, 0…1. Narrower than most are off by: a chunk's size is theirs to
    /// know, not the images'.
    pub pose_std_m: f64,
    /// Noise of the images, grey levels of 255, 0.1…50. Weaker texture is not matched.
    pub noise_gray: f64,
    /// Largest relative difference between the depths of two views that agree, 0.001…0.2.
    pub agreement_ratio: f64,
    /// Depths with less confidence are dropped, 0…1. Fusion weighs the rest, so this can stay low.
    pub min_confidence: f64,
}

impl Default for StereoConfig {
    fn default() -> Self {
        Self {
            max_width_px: 480,
            neighbours: 5,
            min_parallax_deg: 0.5,
            best_parallax_deg: 6.0,
            min_depth_m: 0.3,
            max_depth_m: 20.0,
            max_planes: 128,
            step_penalty: 12,
            jump_penalty: 80,
            pose_std_deg: 0.1,
            pose_std_m: 0.003,
            noise_gray: 1.0,
            agreement_ratio: 0.02,
            min_confidence: 0.2,
        }
    }
}

/// Standard deviations of a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseStd {
    /// Of each component of its rotation, rad.
    pub rotation_rad: f64,
    /// Of each coordinate of its camera centre, m.
    pub translation_m: f64,
}

impl StereoConfig {
    /// What the given poses are taken to be known to; `None` where they are taken as they are.
    pub fn pose_std(&self) -> Option<PoseStd> {
        let (rotation_rad, translation_m) = (self.pose_std_deg.to_radians(), self.pose_std_m);
        (rotation_rad > 0.0 && translation_m > 0.0).then_some(PoseStd { rotation_rad, translation_m })
    }

    /// Checks every field against the range in its description.
    pub fn validate(&self) -> Result<(), StereoError> {
        let check = |key: &'static str, found: f64, low: f64, high: f64| {
            if found >= low && found <= high {
                return Ok(());
            }
            Err(StereoError::BadConfig { key, found, low, high })
        };
        check("max_width_px", self.max_width_px as f64, 64.0, 4096.0)?;
        check("neighbours", self.neighbours as f64, 1.0, 8.0)?;
        check("min_parallax_deg", self.min_parallax_deg, 0.05, 20.0)?;
        check("best_parallax_deg", self.best_parallax_deg, self.min_parallax_deg, 30.0)?;
        check("min_depth_m", self.min_depth_m, 1e-6, 1e6)?;
        check("max_depth_m", self.max_depth_m, self.min_depth_m * 1.1, 1e7)?;
        check("max_planes", self.max_planes as f64, 16.0, 256.0)?;
        check("step_penalty", f64::from(self.step_penalty), 1.0, 200.0)?;
        check("jump_penalty", f64::from(self.jump_penalty), f64::from(self.step_penalty), 1000.0)?;
        check("pose_std_deg", self.pose_std_deg, 0.0, 5.0)?;
        check("pose_std_m", self.pose_std_m, 0.0, 1.0)?;
        check("noise_gray", self.noise_gray, 0.1, 50.0)?;
        check("agreement_ratio", self.agreement_ratio, 0.001, 0.2)?;
        check("min_confidence", self.min_confidence, 0.0, 1.0)
    }
}
