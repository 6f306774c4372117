//! Checks of the whole configuration.

use super::{Config, PlaceRecognitionConfig};
use crate::error::Error;
use crate::models::geometry;

impl Config {
    /// Checks every range; the message names the key.
    pub fn validate(&self) -> Result<(), Error> {
        let bad = |reason: String| Err(Error::BadValue { reason });
        let positive = |key: &str, value: f64| match value.is_finite() && value > 0.0 {
            true => Ok(()),
            false => bad(format!("{key} must be finite and positive, found {value}")),
        };
        if self.coupling.place_recognition == PlaceRecognitionConfig::Salad
            && self.coupling.salad_checkpoint.is_empty()
        {
            return bad("coupling.place_recognition = \"salad\" needs coupling.salad_checkpoint".into());
        }
        for (key, value) in [
            ("input.start_secs", self.input.start_secs),
            ("input.end_secs", self.input.end_secs),
            ("output.live_map_wait_secs", self.output.live_map_wait_secs),
        ] {
            if !(value.is_finite() && value >= 0.0) {
                return bad(format!("{key} must be finite and not negative, found {value}"));
            }
        }
        for (key, found) in [
            ("imu_scale_std", self.input.imu_scale_std),
            ("calibration_scale_std", self.input.calibration_scale_std),
        ] {
            if !(0.0..=1.0).contains(&found) {
                return bad(format!("input.{key} must be 0 to 1, found {found}"));
            }
        }
        let budget = &self.budget;
        if !(budget.seconds.is_finite() && budget.seconds >= 0.0) {
            return bad(format!("budget.seconds must be finite and not negative, found {}", budget.seconds));
        }
        if budget.realtime && budget.seconds > 0.0 {
            return bad("budget.realtime and budget.seconds are two limits: leave one of them out".into());
        }
        if !(0.01..=1000.0).contains(&budget.speed) {
            return bad(format!("budget.speed must be 0.01 to 1000, found {}", budget.speed));
        }
        for (key, value) in
            [("timeout_secs", self.link.timeout_secs), ("patience_secs", self.link.patience_secs)]
        {
            if !(0.1..=86_400.0).contains(&value) {
                return bad(format!("link.{key} must be 0.1 to 86400, found {value}"));
            }
        }
        for (key, value) in
            [("input.stride", self.input.stride), ("geometry.chunk_keyframes", self.geometry.chunk_keyframes)]
        {
            if value == 0 {
                return bad(format!("{key} must be at least 1"));
            }
        }
        positive("input.max_pose_gap_secs", self.input.max_pose_gap_secs)?;
        positive("keyframes.min_translation_m", self.keyframes.min_translation_m)?;
        positive("keyframes.unposed_interval_secs", self.keyframes.unposed_interval_secs)?;
        positive("keyframes.min_rotation_deg", self.keyframes.min_rotation_deg)?;
        positive("output.depth_units_per_metre", self.output.depth_units_per_metre)?;
        let (chunk, overlap) = (self.geometry.chunk_keyframes, self.geometry.overlap_keyframes);
        let overlaps = !geometry::source(self).is_ok_and(|s| s.is_by_stereo());
        if !overlaps && chunk < 2 {
            // A chunk of one keyframe has no pair to estimate depth from but those of its context, and is lost.
            return bad("geometry.chunk_keyframes must be at least 2 with stereo, found 1".into());
        }
        if overlaps && overlap >= chunk {
            return bad(format!(
                "geometry.overlap_keyframes must be smaller than geometry.chunk_keyframes ({chunk}), found {overlap}"
            ));
        }
        if !(32..=8192).contains(&self.geometry.max_width_px) {
            return bad(format!(
                "geometry.max_width_px must be 32 to 8192, found {}",
                self.geometry.max_width_px
            ));
        }
        if !self.model.dir.is_empty() && ![geometry::AUTO, geometry::CUSTOM].contains(&&*self.geometry.source)
        {
            let (dir, source) = (&self.model.dir, &self.geometry.source);
            return bad(format!(
                "model.dir names weights ({dir:?}), but geometry.source is {source:?}: leave one of them out"
            ));
        }
        if geometry::chosen(self).is_err() {
            let known = crate::models::names();
            let (source, network) = (&self.geometry.source, &self.geometry.fill_network);
            if source == geometry::AUTO {
                return bad(format!(
                    "geometry.fill_network must be \"none\", \"recorded:DIR\" or one of {known}, found {network:?}"
                ));
            }
            let found = source;
            return bad(format!(
                "geometry.source must be \"auto\", \"stereo\", \"recorded:DIR\", \"remote:KEY\", \"custom\" with model.dir, or one of {known}, found {found:?}"
            ));
        }
        let stage = |result: Result<(), String>| result.map_err(|reason| Error::BadValue { reason });
        stage(self.model.network.validate().map_err(|e| e.to_string()))?;
        stage(self.odometry.validate().map_err(|e| e.to_string()))?;
        stage(self.stereo.validate().map_err(|e| e.to_string()))?;
        stage(self.align.validate().map_err(|e| e.to_string()))?;
        stage(self.fusion.validate().map_err(|e| e.to_string()))?;
        stage(self.eval.trajectory.validate().map_err(|e| e.to_string()))?;
        stage(self.eval.surface.validate().map_err(|e| e.to_string()))
    }
}
