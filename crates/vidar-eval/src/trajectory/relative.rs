//! Relative pose error (RPE): error of the motion between two poses.

use super::Matched;
use super::report::{RpeReport, RpeStep};
use crate::stats::ErrorStats;
use vidar_core::LieGroup;

/// Relative error over consecutive, non-overlapping steps; `None` when the trajectory is shorter than one step.
///
/// For poses `Q` of the truth and `P` of the estimate, `E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j)` (Sturm et al., IROS 2012,
/// eq. 1); its translation's length and its rotation's angle are the errors.
pub(super) fn rpe(matched: &[Matched<'_>], step: RpeStep) -> Option<RpeReport> {
    let stations = match step {
        RpeStep::Frames { count } => (0..matched.len()).step_by(count.max(1)).collect(),
        RpeStep::Metres { length } => stations_along_path(matched, length),
    };
    let errors: Vec<(f64, f64)> = stations
        .windows(2)
        .map(|w| {
            let (i, j) = (&matched[w[0]], &matched[w[1]]);
            let truth = i.truth.world_from_body.inverse() * j.truth.world_from_body;
            let estimate = i.estimate.world_from_body.inverse() * j.estimate.world_from_body;
            let error = truth.inverse() * estimate;
            (error.translation.norm(), error.rotation.angle_rad().to_degrees())
        })
        .collect();
    let (translation, rotation): (Vec<f64>, Vec<f64>) = errors.into_iter().unzip();
    Some(RpeReport {
        step,
        pairs: translation.len(),
        translation_m: ErrorStats::from_errors(&translation)?,
        rotation_deg: ErrorStats::from_errors(&rotation)?,
    })
}

/// Indices of the poses at which at least `length` metres of estimated path lie behind the one before.
fn stations_along_path(matched: &[Matched<'_>], length: f64) -> Vec<usize> {
    let mut stations = vec![0];
    let mut since = 0.0;
    for (i, w) in matched.windows(2).enumerate() {
        let position = |m: &Matched<'_>| m.estimate.world_from_body.translation;
        since += (position(&w[1]) - position(&w[0])).norm();
        if since >= length {
            stations.push(i + 1);
            since = 0.0;
        }
    }
    stations
}
