//! The bundle adjustment: robust least squares over poses and inverse depths.

use super::Track;
use crate::config::PoseStd;
use crate::prepare::PoseCorrection;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix2x3, Matrix3, Matrix6, SMatrix, Vector2, Vector3};
use vidar_core::{LieGroup, Pinhole, Se3, So3};

/// Residual at which a match has half its weight, by iteration: first wide, so that all matches take part, then narrow,
/// so that outliers have little influence.
const HALF_WEIGHT_PX: [f64; 8] = [4.0, 3.0, 2.0, 1.5, 1.0, 0.8, 0.8, 0.8];
/// Image width up to which these values are in working pixels; for wider images they scale with the width.
const REFERENCE_WIDTH_PX: f64 = 320.0;
/// Standard deviation of a correct match, working pixels.
const MATCH_STD_PX: f64 = 0.3;
/// Fewest tracks for an adjustment.
const MIN_TRACKS: usize = 12;

type Jacobian = SMatrix<f64, 2, 6>;

/// One match linearised: residual, and its derivatives by host pose, other pose and inverse depth.
struct Row {
    other: usize,
    weight: f64,
    residual: Vector2<f64>,
    by_host: Jacobian,
    by_other: Jacobian,
    by_rho: Vector2<f64>,
}

/// The maximum a posteriori poses given `tracks`, with the prior `given`, and what they are known to; `given` itself if there are too few
/// tracks or no solution.
pub(crate) fn adjusted(
    given: &[Se3],
    cameras: &[Pinhole],
    tracks: &mut [Track],
    prior: &PoseStd,
) -> Vec<(Se3, PoseStd)> {
    let as_given = || given.iter().map(|pose| (*pose, *prior)).collect();
    if tracks.len() < MIN_TRACKS {
        return as_given();
    }
    let mut poses = given.to_vec();
    let mut system = None;
    for half_weight_px in HALF_WEIGHT_PX {
        let Some((step, solved)) = step(&poses, given, cameras, tracks, prior, half_weight_px) else {
            return as_given();
        };
        system = Some(solved);
        for (i, pose) in poses.iter_mut().enumerate() {
            let turn = Vector3::new(step[6 * i + 3], step[6 * i + 4], step[6 * i + 5]);
            let shift = Vector3::new(step[6 * i], step[6 * i + 1], step[6 * i + 2]);
            *pose = *pose * Se3::new(So3::exp(&turn), shift);
        }
    }
    restore_scale(&mut poses, given, prior);
    match system {
        Some(system) if poses.iter().all(Se3::is_finite) => {
            let covariance = system.inverse();
            let of_axes =
                |first: usize| (0..3).map(|k| covariance[(first + k, first + k)]).sum::<f64>() / 3.0;
            let std = |i: usize| PoseStd {
                rotation_rad: of_axes(6 * i + 3).sqrt(),
                translation_m: of_axes(6 * i).sqrt(),
            };
            poses.into_iter().enumerate().map(|(i, pose)| (pose, std(i))).collect()
        }
        _ => as_given(),
    }
}

/// Median shift of each view's matches by the correction, and median residual after it.
pub(crate) fn corrections(
    given: &[Se3],
    poses: &[Se3],
    cameras: &[Pinhole],
    tracks: &[Track],
) -> Vec<PoseCorrection> {
    let mut shifts: Vec<Vec<f64>> = vec![Vec::new(); poses.len()];
    let mut residuals = shifts.clone();
    for track in tracks {
        let in_host = track.ray / track.rho;
        for (other, observed) in &track.observations {
            let pixel = |poses: &[Se3]| {
                cameras[*other].project(&(poses[*other].inverse() * poses[track.host] * in_host))
            };
            if let (Some(before), Some(after)) = (pixel(given), pixel(poses)) {
                shifts[track.host].push((after - before).norm());
                residuals[track.host].push((after - observed).norm());
            }
        }
    }
    let median = |mut values: Vec<f64>| {
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).map_or(0.0, |m| *m as f32)
    };
    let correction =
        |(shifts, residuals)| PoseCorrection { shift_px: median(shifts), residual_px: median(residuals) };
    shifts.into_iter().zip(residuals).map(correction).collect()
}

/// Scales the corrected camera centres about their centroid to the extent of the given ones.
///
/// Matches do not determine the scale; only the prior does, and with a small error of the intrinsics a change of
/// baseline and rotation costs hardly anything. Where the extent of the given centres is well above their standard
/// deviation, the scale is taken from them.
fn restore_scale(poses: &mut [Se3], given: &[Se3], prior: &PoseStd) {
    let n = poses.len() as f64;
    let centroid = |poses: &[Se3]| poses.iter().map(|p| p.translation).sum::<Vector3<f64>>() / n;
    let (own_centroid, given_centroid) = (centroid(poses), centroid(given));
    let (mut cross, mut square) = (0.0, 0.0);
    for (own, given) in poses.iter().zip(given) {
        let (a, b) = (own.translation - own_centroid, given.translation - given_centroid);
        cross += a.dot(&b);
        square += a.norm_squared();
    }
    // Below, the extent of the given path is mostly their error.
    if square < n * (3.0 * prior.translation_m).powi(2) || !(cross > 0.0) {
        return;
    }
    let scale = cross / square;
    for pose in poses {
        pose.translation = given_centroid + (pose.translation - own_centroid) * scale;
    }
}

/// One Gauss-Newton step: updates the inverse depths and returns the poses' (shift, turn) in their own frames, with the factor of their
/// information matrix.
fn step(
    poses: &[Se3],
    given: &[Se3],
    cameras: &[Pinhole],
    tracks: &mut [Track],
    prior: &PoseStd,
    half_weight_px: f64,
) -> Option<(DVector<f64>, Cholesky<f64, Dyn>)> {
    let n = 6 * poses.len();
    let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (i, (pose, given)) in poses.iter().zip(given).enumerate() {
        let (wt, wr) = (prior.translation_m.powi(-2), prior.rotation_rad.powi(-2));
        let moved = given.inverse() * *pose;
        let turned = moved.rotation.log();
        for k in 0..3 {
            h[(6 * i + k, 6 * i + k)] += wt;
            h[(6 * i + 3 + k, 6 * i + 3 + k)] += wr;
            g[6 * i + k] += wt * moved.translation[k];
            g[6 * i + 3 + k] += wr * turned[k];
        }
    }
    // Stored for the back-substitution of inverse depths.
    let mut eliminated = Vec::with_capacity(tracks.len());
    for track in tracks.iter() {
        let rows: Vec<Row> =
            track.observations.iter().filter_map(|m| row(poses, cameras, track, m, half_weight_px)).collect();
        // The inverse depth is a scalar, damped so that two rays without parallax do not make it singular.
        let mut h_rho = 1e-9;
        let mut g_rho = 0.0;
        let mut cross: Vec<(usize, SMatrix<f64, 6, 1>)> = Vec::with_capacity(rows.len() + 1);
        cross.push((track.host, SMatrix::zeros()));
        for r in &rows {
            h_rho += r.weight * r.by_rho.norm_squared();
            g_rho += r.weight * r.by_rho.dot(&r.residual);
            cross[0].1 += r.by_host.transpose() * r.by_rho * r.weight;
            cross.push((r.other, r.by_other.transpose() * r.by_rho * r.weight));
            add(&mut h, track.host, track.host, &(r.by_host.transpose() * r.by_host * r.weight));
            add(&mut h, r.other, r.other, &(r.by_other.transpose() * r.by_other * r.weight));
            let mixed = r.by_host.transpose() * r.by_other * r.weight;
            add(&mut h, track.host, r.other, &mixed);
            add(&mut h, r.other, track.host, &mixed.transpose());
            for (view, by) in [(track.host, &r.by_host), (r.other, &r.by_other)] {
                let gradient = by.transpose() * r.residual * r.weight;
                g.rows_mut(6 * view, 6).zip_apply(&gradient, |a, b| *a += b);
            }
        }
        for (i, a) in &cross {
            g.rows_mut(6 * i, 6).zip_apply(a, |t, b| *t -= b * g_rho / h_rho);
            for (j, b) in &cross {
                add(&mut h, *i, *j, &(a * b.transpose() * (-1.0 / h_rho)));
            }
        }
        eliminated.push((h_rho, g_rho, cross));
    }
    let factor = h.cholesky()?;
    let step = -factor.solve(&g);
    for (track, (h_rho, g_rho, cross)) in tracks.iter_mut().zip(&eliminated) {
        let moved: f64 = cross.iter().map(|(i, c)| c.dot(&step.rows(6 * i, 6))).sum();
        let change = -(g_rho + moved) / h_rho;
        // At most by half in one round, so that it stays in front of the camera.
        track.rho += change.clamp(-0.5 * track.rho, track.rho);
    }
    Some((step, factor))
}

fn add(h: &mut DMatrix<f64>, i: usize, j: usize, block: &Matrix6<f64>) {
    h.fixed_view_mut::<6, 6>(6 * i, 6 * j).zip_apply(block, |a, b| *a += b);
}

fn row(
    poses: &[Se3],
    cameras: &[Pinhole],
    track: &Track,
    (other, pixel): &(usize, Vector2<f64>),
    half_weight_px: f64,
) -> Option<Row> {
    let other_from_host = poses[*other].inverse() * poses[track.host];
    let in_host = track.ray / track.rho;
    let p = other_from_host * in_host;
    let k = &cameras[*other];
    let residual = k.project(&p)? - pixel;
    let z = p.z;
    let by_point = Matrix2x3::new(k.fx / z, 0.0, -k.fx * p.x / (z * z), 0.0, k.fy / z, -k.fy * p.y / (z * z));
    let rotation = by_point * other_from_host.rotation.matrix();
    let mut by_host = Jacobian::zeros();
    by_host.fixed_view_mut::<2, 3>(0, 0).copy_from(&rotation);
    by_host.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-rotation * skew(&in_host)));
    let mut by_other = Jacobian::zeros();
    by_other.fixed_view_mut::<2, 3>(0, 0).copy_from(&-by_point);
    by_other.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_point * skew(&p)));
    let by_rho = rotation * track.ray * (-1.0 / (track.rho * track.rho));
    // Errors of lens and shutter grow with the image, so larger images are not more accurate in angle.
    let size = (k.width as f64 / REFERENCE_WIDTH_PX).max(1.0);
    let weight = 1.0 / (1.0 + residual.norm_squared() / (half_weight_px * size).powi(2));
    let weight = weight / (MATCH_STD_PX * size).powi(2);
    Some(Row { other: *other, weight, residual, by_host, by_other, by_rho })
}

fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::random::SplitMix64;

    /// Errors of corrected poses over their stated standard deviations, mean squares of (rotation, translation), and the mean ratio of the
    /// stated ones to the prior's.
    fn normalised_errors(prior: &PoseStd, seeds: std::ops::Range<u64>) -> ([f64; 2], [f64; 2]) {
        let camera = Pinhole::new(250.0, 250.0, 159.5, 119.5, 320, 240).expect("valid");
        let (mut squares, mut ratios, mut count) = ([0.0; 2], [0.0; 2], 0.0);
        for seed in seeds {
            let mut random = SplitMix64::new(seed);
            let truth: Vec<Se3> = (0..8)
                .map(|i| {
                    let turn = So3::exp(&(random.normal3() * 0.05));
                    Se3::new(
                        turn,
                        Vector3::new(0.1 * f64::from(i), 0.05 * random.normal(), 0.05 * random.normal()),
                    )
                })
                .collect();
            let mut tracks = Vec::new();
            for host in 0..truth.len() {
                for _ in 0..40 {
                    let (x, y) = (320.0 * random.uniform(), 240.0 * random.uniform());
                    let (ray, rho) = (camera.ray(x, y), 1.0 / (1.5 + 2.0 * random.uniform()));
                    let in_world = truth[host].act(&(ray / rho));
                    let others = (0..truth.len()).filter(|o| *o != host && o.abs_diff(host) <= 3);
                    let seen = others.filter_map(|o| {
                        let pixel = camera
                            .project(&(truth[o].inverse() * Se3::from_translation(in_world)).translation)?;
                        let noise = Vector2::new(random.normal(), random.normal()) * MATCH_STD_PX;
                        Some((o, pixel + noise))
                    });
                    tracks.push(Track { host, ray, rho: 1.03 * rho, observations: seen.collect() });
                }
            }
            let given: Vec<Se3> = truth
                .iter()
                .map(|pose| {
                    let turn = So3::exp(&(random.normal3() * prior.rotation_rad));
                    *pose * Se3::new(turn, random.normal3() * prior.translation_m)
                })
                .collect();
            let cameras = vec![camera; truth.len()];
            for ((pose, std), truth) in adjusted(&given, &cameras, &mut tracks, prior).iter().zip(&truth) {
                let error = truth.inverse() * *pose;
                squares[0] += (error.rotation.log() / std.rotation_rad).norm_squared();
                squares[1] += (error.translation / std.translation_m).norm_squared();
                ratios[0] += std.rotation_rad / prior.rotation_rad;
                ratios[1] += std.translation_m / prior.translation_m;
                count += 1.0;
            }
        }
        (squares.map(|s| s / (3.0 * count)), ratios.map(|r| r / count))
    }

    #[test]
    fn corrected_poses_are_as_far_off_as_is_stated() {
        for (rotation_deg, translation_m) in [(0.1f64, 0.01), (0.05, 0.003), (1.0, 0.03)] {
            let prior = PoseStd { rotation_rad: rotation_deg.to_radians(), translation_m };
            let (squares, ratios) = normalised_errors(&prior, 0..30);
            println!("{rotation_deg} deg, {translation_m} m: {squares:?}, of the prior {ratios:?}");
            assert!(squares.iter().all(|s| (0.6..1.5).contains(s)), "{squares:?}");
            assert!(ratios.iter().all(|r| *r < 0.95), "the images tell nothing: {ratios:?}");
        }
    }
}
