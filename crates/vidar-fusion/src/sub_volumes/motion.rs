//! Motion of a chunk, from the motion of its keyframes.

use super::{RevisedView, Revision};
use crate::grid::median_depth;
use crate::{FusionConfig, FusionError};
use nalgebra::Vector3;
use vidar_core::{AlignedView, LieGroup, Se3, Sim3, umeyama_sim3};

/// A few points of a keyframe's surface.
#[derive(Clone, Debug)]
pub(super) struct SurfaceProbe {
    world_from_camera: Se3,
    /// In the camera, m: the centre and the corners of the view at its median depth.
    points: [Vector3<f64>; 5],
}

impl SurfaceProbe {
    pub(super) fn new(view: &AlignedView, config: &FusionConfig) -> Self {
        let k = view.intrinsics();
        // A view without depth adds no surface; its motion is measured at one metre.
        let z = median_depth(view, config.max_depth_m as f32).map_or(1.0, f64::from);
        let (right, bottom) = (k.width as f64 - 1.0, k.height as f64 - 1.0);
        let pixels = [[0.5 * right, 0.5 * bottom], [0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]];
        Self { world_from_camera: *view.world_from_camera(), points: pixels.map(|[x, y]| k.ray(x, y) * z) }
    }
}

/// The similarity that best fits the motion of the surface, or the identity if it moved no more than `tolerance_m`; or the one `before`,
/// if that is no farther off, so that a chunk is not moved by less than a voxel again and again.
pub(super) fn fit(
    pairs: &[(&SurfaceProbe, &RevisedView)],
    before: &Sim3,
    tolerance_m: f64,
) -> (Sim3, Revision) {
    let (mut fused, mut now) = (Vec::new(), Vec::new());
    for (probe, view) in pairs {
        for point in &probe.points {
            fused.push(probe.world_from_camera.act(point));
            now.push(view.world_from_camera.act(&(point * view.depth_factor)));
        }
    }
    let largest = |motion: &Sim3| -> f64 {
        fused.iter().zip(&now).map(|(a, b)| (motion.act(a) - b).norm()).fold(0.0, f64::max)
    };
    let moved_m = largest(&Sim3::IDENTITY);
    if moved_m <= tolerance_m {
        return (Sim3::IDENTITY, Revision { moved_m, bent_m: moved_m, stale: false });
    }
    let since = largest(before);
    if since <= tolerance_m {
        return (*before, Revision { moved_m, bent_m: since, stale: true });
    }
    // A view's five points are neither collinear nor coincident, so the similarity exists; should rounding prevent
    // it, the motion of the first view is used.
    let motion = umeyama_sim3(&fused, &now).unwrap_or_else(|_| {
        let of_first = |(probe, view): &(&SurfaceProbe, &RevisedView)| {
            let scaled = Sim3 { scale: view.depth_factor, ..Sim3::from_se3(&view.world_from_camera) };
            scaled * Sim3::from_se3(&probe.world_from_camera.inverse())
        };
        pairs.first().map_or(Sim3::IDENTITY, of_first)
    });
    (motion, Revision { moved_m, bent_m: largest(&motion), stale: true })
}

/// A view moved by a similarity: pose, and depth by the scale.
pub(super) fn moved(view: &AlignedView, b_from_a: &Sim3) -> Result<AlignedView, FusionError> {
    let scale = b_from_a.scale as f32;
    let depth = vidar_core::MetricDepth::new(view.depth().image().map(|z| z * scale));
    let bad = |_| FusionError::BadMove { frame: view.frame_id(), chunk: vidar_core::ChunkId::default() };
    let there = AlignedView::new(
        view.frame_id(),
        view.time(),
        b_from_a.transform_pose(view.world_from_camera()),
        *view.intrinsics(),
        depth,
        view.confidence().clone(),
    )
    .map_err(bad)?;
    match view.color() {
        Some(color) => there.with_color(color.clone()).map_err(bad),
        None => Ok(there),
    }
}
