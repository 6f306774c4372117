//! Covariances of poses: of the right perturbation δ in `a_from_b · exp(δ)`, carried along and between frames.

use nalgebra::SMatrix;
use vidar_core::{KeyframeId, LieGroup, OdometryKeyframe, PoseCovariance, Se3};

/// `A Σ Aᵀ`: the covariance of `A δ`.
pub(crate) fn transported<const N: usize>(
    adjoint: &SMatrix<f64, N, N>,
    covariance: &SMatrix<f64, N, N>,
) -> SMatrix<f64, N, N> {
    adjoint * covariance * adjoint.transpose()
}

/// The covariance of `b_from_a · exp(δ)` between cameras, from that between bodies:
/// `exp(δ_camera) = camera_from_body · exp(δ_body) · body_from_camera`, so `δ_camera = Ad(camera_from_body) δ_body`.
pub fn covariance_in_camera(in_body: &PoseCovariance, body_from_camera: &Se3) -> PoseCovariance {
    transported(&body_from_camera.inverse().adjoint(), in_body)
}

/// Covariance of the motion between two odometry keyframes that need not be consecutive, of δ in
/// `earlier_from_later · exp(δ)`, in the axes of the later body. Steps are taken as independent:
/// `X₁ exp(δ₁) X₂ exp(δ₂) = X₁ X₂ exp(Ad(X₂⁻¹) δ₁) exp(δ₂)`.
///
/// `keyframe` looks keyframes up. `None` where the chain of [`OdometryKeyframe::previous`] does not lead from `later` to
/// `earlier`.
pub fn chained_covariance<'a>(
    later: &'a OdometryKeyframe,
    earlier: KeyframeId,
    keyframe: impl Fn(KeyframeId) -> Option<&'a OdometryKeyframe>,
) -> Option<PoseCovariance> {
    let mut total = PoseCovariance::zeros();
    let mut at = later;
    while at.id != earlier {
        let (previous, covariance) = at.previous?;
        let at_from_later = at.state.world_from_body.inverse() * later.state.world_from_body;
        total += transported(&at_from_later.inverse().adjoint(), &covariance);
        // Numbers descend along the chain; anything else would never end.
        at = keyframe(previous).filter(|k| k.id < at.id)?;
    }
    Some(total)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix6, Vector3, Vector6};
    use vidar_core::{FrameId, Health, NavState, So3, Timestamp};

    fn keyframe(
        id: u32,
        world_from_body: Se3,
        previous: Option<(KeyframeId, PoseCovariance)>,
    ) -> OdometryKeyframe {
        let state = NavState { world_from_body, ..NavState::at_rest(Timestamp::from_nanos(0)) };
        OdometryKeyframe {
            id: KeyframeId(id),
            frame_id: FrameId(id),
            segment: 0,
            state,
            world_from_camera: world_from_body,
            pose_covariance: PoseCovariance::zeros(),
            previous,
            gravity_in_world: Vector3::new(0.0, 0.0, -9.81),
            scale_std: 0.01,
            health: Health::Ok,
            lens: vidar_core::LensMotion::NONE,
            landmarks: Vec::new(),
        }
    }

    fn step(k: u32) -> Se3 {
        let k = f64::from(k);
        Se3::new(So3::exp(&Vector3::new(0.2, -0.1 * k, 0.3)), Vector3::new(0.4 * k, 0.1, -0.2))
    }

    fn diagonal(k: u32) -> PoseCovariance {
        Matrix6::from_diagonal(&Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)) * (1e-6 * f64::from(k + 1))
    }

    fn chain(count: u32) -> Vec<OdometryKeyframe> {
        let mut pose = Se3::IDENTITY;
        (0..count)
            .map(|k| {
                let previous = k.checked_sub(1).map(|p| (KeyframeId(p), diagonal(k)));
                pose = pose * step(k);
                keyframe(k, pose, previous)
            })
            .collect()
    }

    #[test]
    fn a_chain_of_two_steps_has_the_covariance_of_their_composition() {
        let all = chain(3);
        let by_id = |id: KeyframeId| all.get(id.index());
        let found = chained_covariance(&all[2], KeyframeId(0), by_id).unwrap();
        // exp(δ₁) X₂ = X₂ exp(Ad(X₂⁻¹) δ₁), checked by finite perturbations of each axis.
        let x2 = step(2);
        let moved = |delta: &Vector6<f64>| (x2.inverse() * Se3::exp(delta) * x2).log();
        let jacobian = Matrix6::from_fn(|r, c| {
            let h = 1e-6;
            (moved(&(Vector6::ith(c, h)))[r] - moved(&(Vector6::ith(c, -h)))[r]) / (2.0 * h)
        });
        let expected = jacobian * diagonal(1) * jacobian.transpose() + diagonal(2);
        assert!((found - expected).norm() < 1e-9 * expected.norm(), "{found} {expected}");
        assert_eq!(chained_covariance(&all[1], KeyframeId(1), by_id), Some(PoseCovariance::zeros()));
    }

    #[test]
    fn a_broken_or_circular_chain_has_none() {
        let mut all = chain(4);
        assert!(chained_covariance(&all[2], KeyframeId(9), |id| all.get(id.index())).is_none());
        all[1].previous = Some((KeyframeId(3), diagonal(1)));
        assert!(chained_covariance(&all[3], KeyframeId(0), |id| all.get(id.index())).is_none());
    }

    #[test]
    fn the_covariance_in_the_camera_is_that_of_the_same_motion() {
        let body_from_camera = step(3);
        let in_camera = covariance_in_camera(&diagonal(0), &body_from_camera);
        let back = covariance_in_camera(&in_camera, &body_from_camera.inverse());
        assert!((back - diagonal(0)).norm() < 1e-15);
        assert!((in_camera - diagonal(0)).norm() > 1e-7);
    }
}
