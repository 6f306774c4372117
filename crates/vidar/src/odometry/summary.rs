//! What `vidar odometry` says: its figures as JSON and as lines.

use super::{OdometryOutcome, adjusted, files};
use serde_json::{Value, json};
use vidar_core::Trajectory;
use vidar_eval::TrajectoryReport;

impl OdometryOutcome {
    /// Length of the best trajectory's path, m: after the adjustment, where there is one. Live poses that scatter are longer.
    fn path_m(&self) -> Option<f64> {
        self.final_trajectory.as_ref().or(self.trajectory.as_ref()).map(Trajectory::path_length_m)
    }

    /// Counts and scores as JSON.
    pub fn result_json(&self) -> Value {
        let tracked = &self.tracked;
        let with_state = tracked.frames.iter().filter(|f| f.output.tracking().is_some()).count();
        let mut health = std::collections::BTreeMap::<&str, usize>::new();
        for frame in &tracked.frames {
            *health.entry(files::word(&frame.output)).or_default() += 1;
        }
        json!({
            "verdict": self.verdict,
            "is_metric": self.scale.is_metric,
            "scale": self.scale,
            "quality": tracked.quality.json(),
            "images": tracked.frames.len(),
            "images_with_state": with_state,
            "first_state_secs": tracked.first_state_secs(),
            "keyframes": tracked.keyframes.len(),
            "path_m": self.path_m(),
            "health": health,
            "lost": tracked.lost,
            "apart": tracked.apart(),
            "images_out_of_order": tracked.counts.images_out_of_order,
            "images_repeated": tracked.counts.images_repeated,
            "imu_samples_rejected": tracked.counts.imu_samples_rejected,
            "imu_gaps": tracked.counts.imu_gaps,
            "milliseconds_per_image": files::milliseconds(tracked),
            "carrier_share": tracked.carrier_share,
            "map": tracked.map,
            "trajectory": self.report,
            "final": tracked.adjusted.as_ref().map(|adjusted| json!({
                "images": adjusted.images.len(),
                "scale_std": adjusted.scale_std,
                "adjustment": adjusted.report,
                "calibration": adjusted::calibration_json(adjusted),
                "imu": adjusted::imu_json(adjusted),
                "trajectory": self.final_report,
            })),
        })
    }

    /// What was made and how far to trust it.
    pub fn summary_lines(&self) -> Vec<(&'static str, String)> {
        let tracked = &self.tracked;
        let unit = if self.scale.is_metric { "m" } else { "units (lengths are not metres)" };
        let mut lines = vec![
            ("verdict", self.verdict.line()),
            ("tracked", tracked.quality.words()),
            ("scale", self.scale.words.clone()),
            ("keyframes", tracked.keyframes.len().to_string()),
        ];
        if let Some(path_m) = self.path_m() {
            lines.push(("path", format!("{path_m:.2} {unit}")));
        }
        if let Some(secs) = tracked.first_state_secs() {
            lines.push(("first state", format!("{secs:.2} s after the first image")));
        }
        let metres = |e: Option<vidar_eval::ErrorStats>| e.map_or("-".into(), |e| format!("{:.4} m", e.rmse));
        let mut both =
            |label, of: &dyn Fn(&TrajectoryReport) -> String| match (&self.final_report, &self.report) {
                (Some(adjusted), Some(live)) => {
                    lines.push((label, format!("{} (live {})", of(adjusted), of(live))));
                }
                (Some(only), None) | (None, Some(only)) => lines.push((label, of(only))),
                (None, None) => {}
            };
        both("ATE SE(3)", &|r| metres(r.ate_se3_m));
        both("ATE Sim(3)", &|r| metres(r.ate_sim3_m));
        both("|ln s|", &|r| r.scale_error.map_or("-".into(), |s| format!("{s:.4}")));
        for span in &tracked.lost {
            let at = vidar_core::Timestamp::from_nanos(span.from_ns);
            lines.push(("lost", format!("at {at} s: {}", span.reason)));
        }
        lines.push(("folder", self.folder.display().to_string()));
        lines
    }
}
