//! The bundle adjustment: robust least squares over poses and inverse depths.

use super::{Misfit, Track};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, Matrix6, SMatrix, Vector2, Vector3};
use vidar_core::{LieGroup, Pinhole, Se3, So3};

/// Spread of the given poses, one standard deviation.
pub(crate) struct Spread {
    pub rotation_rad: f64,
    pub translation_m: f64,
}

/// Residual at which a match counts half, by round: first wide, so that all pull, then tight, so that few mislead.
const HALF_WEIGHT_PX: [f64; 8] = [4.0, 3.0, 2.0, 1.5, 1.0, 0.8, 0.8, 0.8];
/// Width up to which the pixels here and above are working pixels; beyond it they grow with the image.
const SPREAD_WIDTH_PX: f64 = 320.0;
/// Spread of a good match, working pixels.
const MATCH_SPREAD_PX: f64 = 0.3;
/// Fewest tracks that are worth adjusting for.
const MIN_TRACKS: usize = 12;

type Jacobian = SMatrix<f64, 2, 6>;

/// One match linearised: residual, and its derivatives by anchor pose, other pose and inverse depth.
struct Row {
    other: usize,
    weight: f64,
    residual: Vector2<f64>,
    by_anchor: Jacobian,
    by_other: Jacobian,
    by_rho: Vector2<f64>,
}

/// The poses that explain `tracks` best, near `given`. The given ones if there are too few tracks or no solution.
pub(crate) fn adjusted(
    given: &[Se3],
    cameras: &[Pinhole],
    tracks: &mut [Track],
    spread: &Spread,
) -> Vec<Se3> {
    let mut poses = given.to_vec();
    if tracks.len() < MIN_TRACKS {
        return poses;
    }
    for half_weight_px in HALF_WEIGHT_PX {
        let Some(step) = step(&poses, given, cameras, tracks, spread, half_weight_px) else {
            return given.to_vec();
        };
        for (i, pose) in poses.iter_mut().enumerate() {
            let turn = Vector3::new(step[6 * i + 3], step[6 * i + 4], step[6 * i + 5]);
            let shift = Vector3::new(step[6 * i], step[6 * i + 1], step[6 * i + 2]);
            *pose = *pose * Se3::new(So3::exp(&turn), shift);
        }
    }
    restore_scale(&mut poses, given, spread);
    if poses.iter().all(Se3::is_finite) { poses } else { given.to_vec() }
}

/// How far the correction moved the matches of each view, and how far they are from where they should be now.
pub(crate) fn misfits(given: &[Se3], poses: &[Se3], cameras: &[Pinhole], tracks: &[Track]) -> Vec<Misfit> {
    let mut shifts: Vec<Vec<f64>> = vec![Vec::new(); poses.len()];
    let mut residuals = shifts.clone();
    for track in tracks {
        let at_anchor = track.ray / track.rho;
        for (other, found) in &track.found {
            let pixel = |poses: &[Se3]| {
                cameras[*other].project(&(poses[*other].inverse() * poses[track.anchor] * at_anchor))
            };
            if let (Some(before), Some(after)) = (pixel(given), pixel(poses)) {
                shifts[track.anchor].push((after - before).norm());
                residuals[track.anchor].push((after - found).norm());
            }
        }
    }
    let median = |mut values: Vec<f64>| {
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).map_or(0.0, |m| *m as f32)
    };
    let misfit = |(shifts, residuals)| Misfit { shift_px: median(shifts), residual_px: median(residuals) };
    shifts.into_iter().zip(residuals).map(misfit).collect()
}

/// Scales the corrected camera centres about their middle to the size of the given ones.
///
/// Matches say nothing about the size of the world, so the given poses alone hold it, and a small error of the
/// intrinsics can trade baseline for rotation at hardly any cost. Where the given centres spread far enough to
/// measure the size, they have the last word.
fn restore_scale(poses: &mut [Se3], given: &[Se3], spread: &Spread) {
    let n = poses.len() as f64;
    let middle = |poses: &[Se3]| poses.iter().map(|p| p.translation).sum::<Vector3<f64>>() / n;
    let (own_middle, given_middle) = (middle(poses), middle(given));
    let (mut cross, mut square) = (0.0, 0.0);
    for (own, given) in poses.iter().zip(given) {
        let (a, b) = (own.translation - own_middle, given.translation - given_middle);
        cross += a.dot(&b);
        square += a.norm_squared();
    }
    // Below, the size of the given path is mostly their own error.
    if square < n * (3.0 * spread.translation_m).powi(2) || !(cross > 0.0) {
        return;
    }
    let scale = cross / square;
    for pose in poses {
        pose.translation = given_middle + (pose.translation - own_middle) * scale;
    }
}

/// One Gauss-Newton step: updates the inverse depths and returns the poses' (shift, turn) in their own frames.
fn step(
    poses: &[Se3],
    given: &[Se3],
    cameras: &[Pinhole],
    tracks: &mut [Track],
    spread: &Spread,
    half_weight_px: f64,
) -> Option<DVector<f64>> {
    let n = 6 * poses.len();
    let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (i, (pose, given)) in poses.iter().zip(given).enumerate() {
        let (wt, wr) = (spread.translation_m.powi(-2), spread.rotation_rad.powi(-2));
        let moved = given.inverse() * *pose;
        let turned = moved.rotation.log();
        for k in 0..3 {
            h[(6 * i + k, 6 * i + k)] += wt;
            h[(6 * i + 3 + k, 6 * i + 3 + k)] += wr;
            g[6 * i + k] += wt * moved.translation[k];
            g[6 * i + 3 + k] += wr * turned[k];
        }
    }
    // What elimination of a track's inverse depth needs again once the poses are known.
    let mut eliminated = Vec::with_capacity(tracks.len());
    for track in tracks.iter() {
        let rows: Vec<Row> =
            track.found.iter().filter_map(|m| row(poses, cameras, track, m, half_weight_px)).collect();
        // A scalar of the inverse depth, with a weak hold so that two rays without parallax do not make it singular.
        let mut h_rho = 1e-9;
        let mut g_rho = 0.0;
        let mut cross: Vec<(usize, SMatrix<f64, 6, 1>)> = Vec::with_capacity(rows.len() + 1);
        cross.push((track.anchor, SMatrix::zeros()));
        for r in &rows {
            h_rho += r.weight * r.by_rho.norm_squared();
            g_rho += r.weight * r.by_rho.dot(&r.residual);
            cross[0].1 += r.by_anchor.transpose() * r.by_rho * r.weight;
            cross.push((r.other, r.by_other.transpose() * r.by_rho * r.weight));
            add(&mut h, track.anchor, track.anchor, &(r.by_anchor.transpose() * r.by_anchor * r.weight));
            add(&mut h, r.other, r.other, &(r.by_other.transpose() * r.by_other * r.weight));
            let mixed = r.by_anchor.transpose() * r.by_other * r.weight;
            add(&mut h, track.anchor, r.other, &mixed);
            add(&mut h, r.other, track.anchor, &mixed.transpose());
            for (view, by) in [(track.anchor, &r.by_anchor), (r.other, &r.by_other)] {
                let pull = by.transpose() * r.residual * r.weight;
                g.rows_mut(6 * view, 6).zip_apply(&pull, |a, b| *a += b);
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
    let step = -h.cholesky()?.solve(&g);
    for (track, (h_rho, g_rho, cross)) in tracks.iter_mut().zip(&eliminated) {
        let moved: f64 = cross.iter().map(|(i, c)| c.dot(&step.rows(6 * i, 6))).sum();
        let change = -(g_rho + moved) / h_rho;
        // At most by half in one round, so that it stays in front of the camera.
        track.rho += change.clamp(-0.5 * track.rho, track.rho);
    }
    Some(step)
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
    let other_from_anchor = poses[*other].inverse() * poses[track.anchor];
    let at_anchor = track.ray / track.rho;
    let p = other_from_anchor * at_anchor;
    let k = &cameras[*other];
    let residual = k.project(&p)? - pixel;
    let z = p.z;
    let by_point = Matrix2x3::new(k.fx / z, 0.0, -k.fx * p.x / (z * z), 0.0, k.fy / z, -k.fy * p.y / (z * z));
    let rotation = by_point * other_from_anchor.rotation.matrix();
    let mut by_anchor = Jacobian::zeros();
    by_anchor.fixed_view_mut::<2, 3>(0, 0).copy_from(&rotation);
    by_anchor.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-rotation * skew(&at_anchor)));
    let mut by_other = Jacobian::zeros();
    by_other.fixed_view_mut::<2, 3>(0, 0).copy_from(&-by_point);
    by_other.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_point * skew(&p)));
    let by_rho = rotation * track.ray * (-1.0 / (track.rho * track.rho));
    // Errors of lens and shutter grow with the image, so larger images are not trusted to finer angles.
    let size = (k.width as f64 / SPREAD_WIDTH_PX).max(1.0);
    let weight = 1.0 / (1.0 + residual.norm_squared() / (half_weight_px * size).powi(2));
    let weight = weight / (MATCH_SPREAD_PX * size).powi(2);
    Some(Row { other: *other, weight, residual, by_anchor, by_other, by_rho })
}

fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}
