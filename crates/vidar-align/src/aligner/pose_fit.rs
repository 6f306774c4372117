//! One chunk onto its pose priors.

use super::report::RejectionReason;
use crate::landmark_scale::LogScale;
use nalgebra::Vector3;
use vidar_core::{LieGroup, Se3, Sim3, So3};
use vidar_solve::statistics::median_upper;
use vidar_solve::{mean_rotation, robust_similarity};

/// A camera in its chunk and in the world of its pose prior.
#[derive(Clone, Copy, Debug)]
pub(super) struct CameraPair {
    pub chunk_from_camera: Se3,
    pub world_from_camera: Se3,
}

/// The paper's `UmeyamaScale`: the inverse of the robust similarity from metric centres to predicted ones.
///
/// # Errors
/// [`RejectionReason::RankDeficient`].
pub(super) fn world_from_chunk(pairs: &[CameraPair]) -> Result<Sim3, RejectionReason> {
    let metric: Vec<Vector3<f64>> = pairs.iter().map(|p| p.world_from_camera.translation).collect();
    let predicted: Vec<Vector3<f64>> = pairs.iter().map(|p| p.chunk_from_camera.translation).collect();
    let fit = robust_similarity(&metric, &predicted).map_err(|_| RejectionReason::RankDeficient)?;
    Ok(fit.target_from_source.inverse())
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

/// The same place with the scale from centres and landmarks together, by inverse variance.
pub(super) fn with_landmark_scale(
    fit: PoseFit,
    landmarks: Option<LogScale>,
    pairs: &[CameraPair],
) -> PoseFit {
    let Some(landmarks) = landmarks else { return fit };
    let information = [fit.log_scale_std.powi(-2), landmarks.std.powi(-2)];
    let sum = information[0] + information[1];
    let log = (information[0] * fit.world_from_chunk.scale.ln() + information[1] * landmarks.log_scale) / sum;
    let world_from_chunk = rescaled_about_centers(&fit.world_from_chunk, log.exp(), pairs);
    let center_rms_m = center_rms(&world_from_chunk, pairs);
    PoseFit {
        world_from_chunk,
        center_rms_m,
        log_scale_std: sum.powf(-0.5).hypot(landmarks.shared_std),
        ..fit
    }
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
