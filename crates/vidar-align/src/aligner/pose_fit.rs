//! One chunk onto its pose priors.

use super::report::RejectionReason;
use nalgebra::{Matrix3, Vector3};
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use vidar_core::{LieGroup, Se3, Sim3, So3, umeyama_sim3};
use vidar_solve::statistics::median_upper;

/// A camera in its chunk and in the world of its pose prior.
#[derive(Clone, Copy, Debug)]
pub(super) struct CameraPair {
    pub chunk_from_camera: Se3,
    pub world_from_camera: Se3,
}

/// From this many views on the model's own API uses RANSAC.
const RANSAC_FROM: usize = 10;
const TRIALS: usize = 10;

/// The paper's `UmeyamaScale`, robust as in the model's own API: the similarity from metric centres to predicted ones; from
/// 10 views on by RANSAC over ten random halves. Its inverse is returned, `world_from_chunk`.
///
/// # Errors
/// [`RejectionReason::RankDeficient`].
pub(super) fn robust_umeyama(pairs: &[CameraPair], seed: u64) -> Result<Sim3, RejectionReason> {
    let metric: Vec<Vector3<f64>> = pairs.iter().map(|p| p.world_from_camera.translation).collect();
    let predicted: Vec<Vector3<f64>> = pairs.iter().map(|p| p.chunk_from_camera.translation).collect();
    let all = umeyama_sim3(&metric, &predicted).map_err(|_| RejectionReason::RankDeficient)?;
    if pairs.len() < RANSAC_FROM {
        return Ok(all.inverse());
    }
    // The threshold: the median distance from a moved centre to the nearest predicted one, whichever that is.
    let mut nearest: Vec<f64> = metric
        .iter()
        .map(|m| predicted.iter().map(|p| (all.act(m) - p).norm()).fold(f64::INFINITY, f64::min))
        .collect();
    let threshold = median_upper(&mut nearest).unwrap_or(0.0);
    let inliers = |s: &Sim3| -> Vec<usize> {
        (0..pairs.len()).filter(|&i| (s.act(&metric[i]) - predicted[i]).norm() <= threshold).collect()
    };
    let fit = |of: &[usize]| {
        let (m, p): (Vec<_>, Vec<_>) = of.iter().map(|&i| (metric[i], predicted[i])).unzip();
        umeyama_sim3(&m, &p).ok()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(42 ^ seed.rotate_left(32));
    let mut best: Vec<usize> = Vec::new();
    for _ in 0..TRIALS {
        let mut drawn = sample(&mut rng, pairs.len(), pairs.len().div_ceil(2)).into_vec();
        drawn.sort_unstable();
        let Some(tried) = fit(&drawn) else { continue };
        let agree = inliers(&tried);
        if agree.len() > best.len() {
            best = agree;
        }
    }
    Ok(fit(&best).unwrap_or(all).inverse())
}

/// A chunk's place from rotations and centres together: determined by a single pose prior up to its scale.
#[derive(Clone, Copy, Debug)]
pub(super) struct PoseFit {
    /// The place; its scale is `scale_hint` where the centres do not determine one.
    pub world_from_chunk: Sim3,
    /// σ of ln(scale) from the centres; infinite when they do not determine one.
    pub log_scale_std: f64,
    /// RMS distance of centres, m.
    pub center_rms_m: f64,
    /// RMS angle between rotations, rad.
    pub rotation_rms_rad: f64,
    /// RMS distance of the prior centres from their mean, m.
    pub radius_m: f64,
}

/// `R = proj_SO(3)(Σ R_world R_chunkᵀ)`, outliers left out; scale and translation by linear least squares about it.
///
/// `floor_m` is the least error of a centre, `scale_hint` the metres per unit where the centres do not determine the scale. `None` without pairs.
pub(super) fn fit_about_rotations(pairs: &[CameraPair], scale_hint: f64, floor_m: f64) -> Option<PoseFit> {
    let pairs: Vec<&CameraPair> =
        pairs.iter().filter(|p| p.chunk_from_camera.is_finite() && p.world_from_camera.is_finite()).collect();
    let turn = |p: &CameraPair| p.world_from_camera.rotation * p.chunk_from_camera.rotation.inverse();
    let mut rotation = mean_rotation(pairs.iter().map(|p| turn(p)))?;
    let apart = |r: &So3, p: &CameraPair| (r.inverse() * turn(p)).angle_rad();
    for _ in 0..3 {
        let mut angles: Vec<f64> = pairs.iter().map(|p| apart(&rotation, p)).collect();
        let limit = 3.0 * median_upper(&mut angles)?.max(0.01);
        let kept = pairs.iter().filter(|p| apart(&rotation, p) <= limit);
        rotation = mean_rotation(kept.map(|p| turn(p))).unwrap_or(rotation);
    }
    let n = pairs.len() as f64;
    let mean =
        |of: &dyn Fn(&CameraPair) -> Vector3<f64>| pairs.iter().map(|p| of(p)).sum::<Vector3<f64>>() / n;
    let (chunk_mean, world_mean) =
        (mean(&|p| p.chunk_from_camera.translation), mean(&|p| p.world_from_camera.translation));
    let (mut along, mut chunk_spread, mut world_spread) = (0.0, 0.0, 0.0);
    for p in &pairs {
        let x = rotation.act(&(p.chunk_from_camera.translation - chunk_mean));
        let y = p.world_from_camera.translation - world_mean;
        along += x.dot(&y);
        chunk_spread += x.norm_squared();
        world_spread += y.norm_squared();
    }
    let measured = along / chunk_spread;
    let is_observable = pairs.len() >= 2 && measured.is_finite() && measured > 0.0 && world_spread > 0.0;
    let radius_m = (world_spread / n).sqrt();
    let place = |scale: f64| {
        let turned = Sim3 { rotation, translation: Vector3::zeros(), scale };
        Sim3 { translation: world_mean - turned.act(&chunk_mean), ..turned }
    };
    let rms = |s: &Sim3| {
        let sum: f64 = pairs
            .iter()
            .map(|p| {
                (s.act(&p.chunk_from_camera.translation) - p.world_from_camera.translation).norm_squared()
            })
            .sum();
        (sum / n).sqrt()
    };
    let fitted = place(if is_observable { measured } else { scale_hint });
    let center_rms_m = rms(&fitted);
    // Errors within a chunk are correlated: n centres have the information of one pair a radius apart.
    let log_scale_std = if is_observable { center_rms_m.max(floor_m) / radius_m } else { f64::INFINITY };
    let angles: f64 = pairs.iter().map(|p| apart(&rotation, p).powi(2)).sum();
    let world_from_chunk = if log_scale_std < 1.0 { fitted } else { place(scale_hint) };
    Some(PoseFit {
        center_rms_m: rms(&world_from_chunk),
        world_from_chunk,
        log_scale_std: if log_scale_std < 1.0 { log_scale_std } else { f64::INFINITY },
        rotation_rms_rad: (angles / n).sqrt(),
        radius_m,
    })
}

/// The rotation nearest to the sum of rotations; `None` for none, or when they cancel.
fn mean_rotation(rotations: impl Iterator<Item = So3>) -> Option<So3> {
    let mut count = 0usize;
    let sum = rotations.fold(Matrix3::zeros(), |m, r| {
        count += 1;
        m + r.matrix()
    });
    if count == 0 || !sum.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = sum.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let sign = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v).determinant().signum()));
    So3::from_matrix(&(u * sign * v))
}

/// RMS distance of placed centres from their pose priors, m; NaN without pairs.
pub(super) fn center_rms(world_from_chunk: &Sim3, pairs: &[CameraPair]) -> f64 {
    let sum: f64 = pairs
        .iter()
        .map(|p| {
            let placed = world_from_chunk.act(&p.chunk_from_camera.translation);
            (placed - p.world_from_camera.translation).norm_squared()
        })
        .sum();
    (sum / pairs.len() as f64).sqrt()
}

/// The same place with another scale, the mean of the cameras kept.
pub(super) fn rescaled_about_centers(world_from_chunk: &Sim3, scale: f64, pairs: &[CameraPair]) -> Sim3 {
    let n = pairs.len().max(1) as f64;
    let mean = pairs.iter().map(|p| p.chunk_from_camera.translation).sum::<Vector3<f64>>() / n;
    let kept = world_from_chunk.act(&mean);
    let moved = Sim3 { scale, ..*world_from_chunk };
    Sim3 { translation: world_from_chunk.translation + kept - moved.act(&mean), ..moved }
}
