//! A start from nothing: clock offset and rotation of the camera on the body by comparing rotations.
//!
//! The rotation of each pair of images is fitted without translation for a trial focal length. For each clock offset on a
//! grid the gyroscope's rates are compared with those of the images without their means (so the bias does not matter), and
//! the rotation that maps one set to the other is found in closed form (Kabsch 1976; Tsai, Lenz 1989 for hand-eye
//! calibration). Translation disturbs the images' rotations: this is a start to some degrees and some ten milliseconds, and
//! tells the axis permutation.

use super::parameters::Parameters;
use super::path::GyroPath;
use crate::gyro_alignment::{ImageFeatures, common};
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, So3, nearest_rotation};

/// Matches that a pair of images needs.
const MIN_MATCHES: usize = 12;
/// Pairs that a solution needs.
const MIN_PAIRS: usize = 15;
/// Clock offsets that are tried: ± this, in such steps, s.
const SEARCH_SECS: f64 = 0.2;
const STEP_SECS: f64 = 0.01;
/// Starts whose clocks are nearer than this are one, s: a refinement finds the clock from there.
pub(super) const BASIN_SECS: f64 = 0.045;
/// Another clock may be right where it leaves less than this of what the best one leaves. Where a body turns to and fro, clocks 40 ms off leave 1.4 times
/// as much or more; on the way round a room, clocks 200 ms apart 1.06 times.
const NEARLY: f64 = 1.2;

/// A start for the refinement.
#[derive(Clone, Copy, Debug)]
pub(super) struct Start {
    pub parameters: Parameters,
    /// Share of the images' rotation that it leaves unexplained.
    pub unexplained: f64,
    /// Whether another clock leaves less with the same focal length.
    pub is_another_clock: bool,
}

/// Starts with each of `trials` in the order of what they leave unexplained: the best clock offset of every one, and others
/// that leave hardly more. The camera is mounted as `mount` says, else as the rates say. Empty where the body turned too little.
pub(super) fn starts(
    trials: &[Parameters],
    mount: Option<&So3>,
    images: &[ImageFeatures],
    path: &GyroPath,
) -> Vec<Start> {
    let mut found: Vec<Start> = Vec::new();
    for parameters in trials {
        let seen = image_rates(parameters, images);
        if seen.len() < MIN_PAIRS {
            return Vec::new();
        }
        let steps = (2.0 * SEARCH_SECS / STEP_SECS).round() as i32;
        let mut offsets: Vec<Start> = (0..=steps)
            .filter_map(|k| {
                let offset_secs = -SEARCH_SECS + f64::from(k) * STEP_SECS;
                let rates: Vec<(Vector3<f64>, Vector3<f64>)> = seen
                    .iter()
                    .map(|(from, to, seen)| {
                        let turn = path.at(from + offset_secs).rotation.transpose()
                            * path.at(to + offset_secs).rotation;
                        let turn = So3::from_matrix(&turn).unwrap_or(So3::IDENTITY);
                        (turn.log() / (to - from), *seen)
                    })
                    .collect();
                let (unexplained, body_from_camera, bias) = match mount {
                    Some(mount) => explained_by(mount, &rates),
                    None => best_rotation(&rates)?,
                };
                let parameters = Parameters { offset_secs, body_from_camera, bias, ..*parameters };
                Some(Start { parameters, unexplained, is_another_clock: false })
            })
            .collect();
        offsets.sort_by(|a, b| a.unexplained.total_cmp(&b.unexplained));
        let first = found.len();
        for start in offsets {
            let clock = start.parameters.offset_secs;
            let taken = &found[first..];
            let is_good = taken.first().is_none_or(|best| start.unexplained < NEARLY * best.unexplained);
            if is_good && taken.iter().all(|s| (s.parameters.offset_secs - clock).abs() > BASIN_SECS) {
                found.push(Start { is_another_clock: !taken.is_empty(), ..start });
            }
        }
    }
    // Turning nearly about one axis shows a mount with long focal lengths only, with which images seem to turn more about the others: short ones are
    // tried with it, too.
    let focals = trials.iter().map(|trial| trial.focal);
    let missing: Vec<f64> =
        focals.filter(|focal| found.iter().all(|s| s.parameters.focal != *focal)).collect();
    if let Some(best) = found.iter().min_by(|a, b| a.unexplained.total_cmp(&b.unexplained)).copied() {
        found.extend(
            missing
                .into_iter()
                .map(|focal| Start { parameters: Parameters { focal, ..best.parameters }, ..best }),
        );
    }
    // The best of each focal length first: where a hand moves more than it turns, long ones seem to explain more, and with every clock.
    found.sort_by(|a, b| {
        a.is_another_clock.cmp(&b.is_another_clock).then(a.unexplained.total_cmp(&b.unexplained))
    });
    found
}

/// Per pair of neighbouring images: both stamps, and the rate of the camera in its own axes.
fn image_rates(camera: &Parameters, images: &[ImageFeatures]) -> Vec<(f64, f64, Vector3<f64>)> {
    let rate = |pair: &[ImageFeatures]| {
        let [before, now] = pair else { return None };
        let secs = now.secs - before.secs;
        let matches: Vec<(Vector3<f64>, Vector3<f64>)> = common(before, now)
            .iter()
            .map(|[a, b]| (camera.direction(&before.features[*a].1), camera.direction(&now.features[*b].1)))
            .collect();
        if matches.len() < MIN_MATCHES || secs > 0.3 {
            return None;
        }
        Some((before.secs, now.secs, rotation_between(&matches)? / secs))
    };
    images.windows(2).filter_map(rate).collect()
}

/// The share of the second rates that a rotation onto the first leaves unexplained, the rotation, and the difference of the means.
fn explained_by(rotation: &So3, rates: &[(Vector3<f64>, Vector3<f64>)]) -> (f64, So3, Vector3<f64>) {
    let n = rates.len() as f64;
    let (a, b) = rates.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), r| (a + r.0, b + r.1));
    let (mean_a, mean_b) = (a / n, rotation.act(&b) / n);
    let (mut left, mut energy) = (0.0, 0.0);
    for (felt, seen) in rates {
        let (felt, seen) = (felt - mean_a, rotation.act(seen) - mean_b);
        left += (felt - seen).norm_squared();
        energy += felt.norm_squared() + seen.norm_squared();
    }
    (left / energy.max(1e-12), *rotation, mean_a - mean_b)
}

/// Rotation that maps the second rates of the pairs onto the first, means removed, the share of the second that it
/// leaves unexplained, and the difference of the means. `None` where the rates span less than a plane.
fn best_rotation(rates: &[(Vector3<f64>, Vector3<f64>)]) -> Option<(f64, So3, Vector3<f64>)> {
    let n = rates.len() as f64;
    let (a, b) = rates.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), r| (a + r.0, b + r.1));
    let (mean_a, mean_b) = (a / n, b / n);
    let mut rotation = Matrix3::<f64>::identity();
    let mut weight_scale2 = f64::INFINITY;
    let mut unexplained = 1.0;
    // Pairs that the first rotation leaves far off (translation, wrong matches) lose weight.
    for _ in 0..4 {
        let (mut cross, mut left, mut energy, mut weights) = (Matrix3::zeros(), 0.0, 0.0, 0.0);
        for (felt, seen) in rates {
            let (felt, seen) = (felt - mean_a, seen - mean_b);
            let r2 = (felt - rotation * seen).norm_squared();
            let weight = if weight_scale2.is_finite() { 1.0 / (1.0 + r2 / weight_scale2) } else { 1.0 };
            cross += felt * seen.transpose() * weight;
            energy += 0.5 * (seen.norm_squared() + felt.norm_squared()) * weight;
            left += weight * r2;
            weights += weight;
        }
        let nearest = nearest_rotation(&cross)?;
        if !(nearest.singular_values[1] > 0.02 * nearest.singular_values[0] && weights > 0.0) {
            return None;
        }
        rotation = nearest.rotation;
        unexplained = 1.0 - (rotation * cross.transpose()).trace() / energy;
        weight_scale2 = if weight_scale2.is_finite() { (left / weights).max(1e-6) } else { energy / weights };
    }
    Some((unexplained, So3::from_matrix(&rotation)?, mean_a - rotation * mean_b))
}

/// Rotation vector `before_from_now` that explains most of the motion of unit rays (before, now): Gauss-Newton with
/// Cauchy weights.
fn rotation_between(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Vector3<f64>> {
    let mut rotation = So3::IDENTITY;
    let mut scale2 = f64::INFINITY;
    for _ in 0..5 {
        let (mut h, mut g, mut sum, mut weights) = (Matrix3::<f64>::zeros(), Vector3::zeros(), 0.0, 0.0);
        for (before, now) in pairs {
            let turned = rotation * *now;
            // before ≈ turned + δ × turned.
            let residual = before - turned;
            let r2 = residual.norm_squared();
            let weight = if scale2.is_finite() { 1.0 / (1.0 + r2 / scale2) } else { 1.0 };
            h += (Matrix3::identity() - turned * turned.transpose()) * weight;
            g += turned.cross(&residual) * weight;
            sum += weight * r2;
            weights += weight;
        }
        rotation = So3::exp(&(h.try_inverse()? * g)) * rotation;
        scale2 = (sum / weights).max(1e-8);
    }
    let turn = rotation.log();
    turn.iter().all(|x| x.is_finite()).then_some(turn)
}

#[cfg(test)]
mod tests {
    use super::super::lens::LensModel;
    use super::*;
    use crate::gyro_alignment::RateSample;
    use crate::simulate::Handheld;
    use vidar_core::Timestamp;

    fn starts_of(truth: &Handheld) -> Vec<Start> {
        let recording = truth.record();
        let secs = |t: Timestamp| (t - recording.images[0].0).as_secs_f64();
        let samples: Vec<RateSample> =
            recording.samples.iter().map(|s| RateSample { secs: secs(s.time), rate: s.gyro.0 }).collect();
        let image = |(stamp, features): &(Timestamp, Vec<_>)| ImageFeatures {
            secs: secs(*stamp),
            features: features.clone(),
        };
        let images: Vec<ImageFeatures> = recording.images.iter().map(image).collect();
        let path = GyroPath::new(&samples, &Vector3::zeros(), &Vector3::zeros());
        let trials = Parameters::trials(LensModel::RadTan, (640.0, 480.0), 0.015);
        starts(&trials, None, &images, &path)
    }

    /// A lively hand shows its clock; one that is moved more than turned does not, and no clock is passed over.
    #[test]
    fn clocks_that_explain_hardly_less_are_starts_too() {
        let calm = |seed| Handheld { pixel_noise: 0.3, outliers: 0.0, secs: 10.0, ..Handheld::draw(seed) };
        for seed in [3, 8] {
            let clocks = |starts: &[Start]| {
                let best = starts[0].parameters.focal;
                starts.iter().filter(|s| s.parameters.focal == best).count()
            };
            let lively = starts_of(&Handheld { turning: 1.2, moving: 0.05, ..calm(seed) });
            assert_eq!(clocks(&lively), 1, "{seed}");
            let swept = starts_of(&Handheld { turning: 0.05, moving: 1.0, ..calm(seed) });
            assert!(clocks(&swept) > 3, "{seed}: {}", clocks(&swept));
            let is_apart = |a: &Start, b: &Start| {
                a.parameters.focal != b.parameters.focal
                    || (a.parameters.offset_secs - b.parameters.offset_secs).abs() > BASIN_SECS
            };
            assert!((1..swept.len()).all(|k| swept[..k].iter().all(|s| is_apart(s, &swept[k]))), "{seed}");
        }
    }

    /// Turning nearly about one axis shows the mount with some focal lengths only; all are tried.
    #[test]
    fn every_focal_length_is_a_start_where_some_show_the_mount() {
        let mut partly = 0;
        for seed in 0..8 {
            let motion = Handheld { main_axis: (1, 0.1), turning: 0.3, moving: 0.3, ..Handheld::draw(seed) };
            let starts = starts_of(&motion);
            let best: Vec<&Start> = starts.iter().filter(|s| !s.is_another_clock).collect();
            assert!(best.is_empty() || best.len() == LensModel::RadTan.trial_focals().len(), "{seed}");
            let own = best.iter().filter(|s| s.unexplained != best[0].unexplained).count();
            partly += usize::from(own + 1 < best.len());
        }
        assert!(partly > 0, "no seed tries it");
    }
}
