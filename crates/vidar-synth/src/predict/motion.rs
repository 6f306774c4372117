//! Where a simulated network believes that its cameras stood.

use super::{PredictionErrors, TrueView};
use crate::random::{Gaussian, Purpose, stream};
use nalgebra::{Vector3, Vector6};
use rand::Rng;
use vidar_core::{LieGroup, Se3, Sim3, So3, umeyama_se3, umeyama_sim3};

/// Injected poses whose centres lie closer together than this (RMS, m) give the network no scale.
const MIN_SPREAD_M: f64 = 0.1;

/// What a chunk's prediction is off by, apart from its pixels.
pub(super) struct ChunkMotion {
    /// Per view, pose in the chunk's frame and units.
    pub chunk_from_camera: Vec<Se3>,
    /// Per view, ln of chunk units per metre of depth.
    pub log_depth_scale: Vec<f64>,
    /// Factor on the focal length.
    pub focal: f64,
    /// Whether the prediction has nothing to do with the truth.
    pub failed: bool,
}

/// Draws a chunk's motion; `prior` are the poses that were injected.
pub(super) fn believed(
    chunk: u32,
    views: &[TrueView],
    prior: Option<&[Se3]>,
    errors: &PredictionErrors,
    seed: u64,
) -> ChunkMotion {
    let mut random = Gaussian::new(stream(seed, Purpose::Chunk(chunk)));
    // Drawn in a fixed order and always, so that one error's size does not change the others' numbers.
    let failed = random.uniform() < errors.failed_share;
    let world_from_chunk = gauge(errors, &mut random);
    let focal = (errors.focal_sigma * random.next()).exp();
    let conditioned_scale = errors.conditioned_scale_sigma * random.next();
    let truth: Vec<Se3> = views.iter().map(|v| v.world_from_camera).collect();
    match prior {
        None => {
            let (cameras, scales) = drifted(&truth, errors, 1.0, &mut random);
            let chunk_from_world = world_from_chunk.inverse();
            let mut motion = ChunkMotion {
                chunk_from_camera: cameras.iter().map(|c| chunk_from_world.transform_pose(c)).collect(),
                log_depth_scale: scales.iter().map(|s| s + chunk_from_world.scale.ln()).collect(),
                focal,
                failed,
            };
            if failed {
                motion.chunk_from_camera = wandering(views.len(), &mut random);
            }
            motion
        }
        Some(prior) => {
            let (mut cameras, scales) = drifted(prior, errors, errors.conditioned_drift_share, &mut random);
            let first = prior.first().map_or(Vector3::zeros(), |p| p.translation);
            for camera in &mut cameras {
                camera.translation = first + (camera.translation - first) * conditioned_scale.exp();
            }
            let scale = injected_scale(&truth, prior).ln() + conditioned_scale;
            ChunkMotion {
                chunk_from_camera: cameras,
                log_depth_scale: scales.iter().map(|s| s + scale).collect(),
                focal: 1.0,
                failed,
            }
        }
    }
}

/// The chunk's frame: a random similarity `world_from_chunk`.
fn gauge<R: Rng>(errors: &PredictionErrors, random: &mut Gaussian<R>) -> Sim3 {
    let scale = (errors.gauge_scale_sigma * random.next()).exp();
    let rotation = So3::exp(&(random.vector() * errors.gauge_rotation_deg.to_radians()));
    Sim3 { rotation, translation: random.vector() * errors.gauge_shift_m, scale }
}

/// The poses with a random walk of rotation, place and scale, right on average; and each view's ln(depth scale).
fn drifted<R: Rng>(
    poses: &[Se3],
    errors: &PredictionErrors,
    share: f64,
    random: &mut Gaussian<R>,
) -> (Vec<Se3>, Vec<f64>) {
    let Some(first) = poses.first() else { return (Vec::new(), Vec::new()) };
    let mut cameras = vec![*first];
    let mut scales = vec![0.0];
    let mut scale: f64 = 0.0;
    for pair in poses.windows(2) {
        let step = pair[0].inverse() * pair[1];
        scale += share * errors.drift_scale_sigma * random.next();
        let turn = random.vector() * (share * errors.drift_rotation_deg.to_radians());
        let slip = random.vector() * (share * errors.drift_translation_share * step.translation.norm());
        let believed = Se3::new(step.rotation * So3::exp(&turn), step.translation * scale.exp() + slip);
        cameras.push(cameras[cameras.len() - 1] * believed);
        scales.push(scale);
    }
    let walks = share > 0.0
        && (errors.drift_rotation_deg > 0.0
            || errors.drift_translation_share > 0.0
            || errors.drift_scale_sigma > 0.0);
    if !walks {
        // The very poses, without the rounding of a chain.
        cameras.copy_from_slice(poses);
    }
    for camera in &mut cameras {
        camera.translation += random.vector() * (share * errors.position_jitter_m);
    }
    if walks {
        let places = |cameras: &[Se3]| cameras.iter().map(|c| c.translation).collect::<Vec<_>>();
        // Without a spread (standing still, two views) the chunk stays tied to its first camera.
        let back = umeyama_se3(&places(&cameras), &places(poses)).unwrap_or(Se3::IDENTITY);
        cameras = cameras.iter().map(|c| back * *c).collect();
    }
    let mean = scales.iter().sum::<f64>() / scales.len() as f64;
    let scales = scales.iter().map(|s| s - mean + share * errors.frame_scale_sigma * random.next()).collect();
    (cameras, scales)
}

/// Scale of the injected poses: their lengths per true length.
fn injected_scale(truth: &[Se3], prior: &[Se3]) -> f64 {
    let places = |poses: &[Se3]| poses.iter().map(|p| p.translation).collect::<Vec<_>>();
    let (truth, prior) = (places(truth), places(prior));
    let middle = truth.iter().sum::<Vector3<f64>>() / truth.len().max(1) as f64;
    let spread = truth.iter().map(|p| (p - middle).norm_squared()).sum::<f64>() / truth.len().max(1) as f64;
    if spread.sqrt() < MIN_SPREAD_M {
        return 1.0;
    }
    umeyama_sim3(&truth, &prior).map_or(1.0, |s| s.scale)
}

/// Poses of a prediction that failed: a walk that has nothing to do with the truth.
fn wandering<R: Rng>(n: usize, random: &mut Gaussian<R>) -> Vec<Se3> {
    let mut camera = Se3::IDENTITY;
    let step = |random: &mut Gaussian<R>| {
        let (turn, shift) = (random.vector() * 0.2, random.vector() * 0.3);
        let tangent: Vector6<f64> = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
        Se3::exp(&tangent)
    };
    (0..n)
        .map(|_| {
            camera = camera * step(random);
            camera
        })
        .collect()
}
