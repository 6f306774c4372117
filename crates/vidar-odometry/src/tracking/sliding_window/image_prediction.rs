//! The pose without an IMU, from the images alone.

use super::SlidingWindowOdometry;
use crate::frontend::{AlignmentPoint, AlignmentReference, MotionPrediction};
use crate::imu::NavState;
use crate::tracking::HostImage;
use std::sync::Arc;
use vidar_core::{LieGroup, Se3};

/// Standard deviation of a motion that is only guessed, rad, and as a share of the scene's distance.
const GUESS_SIGMA_RAD: f64 = 0.1;

impl SlidingWindowOdometry {
    /// The pose without an IMU: the last motion goes on, and the last image's patches correct it.
    pub(super) fn predict_by_image(&mut self, host: &Arc<HostImage>, last: &NavState) -> NavState {
        let body_from_camera = *self.smoother.body_from_camera();
        let last_from_before = self.before_last.map_or(Se3::IDENTITY, |b| b.inverse() * last.world_from_body);
        let mut predicted = NavState { world_from_body: last.world_from_body * last_from_before, ..*last };
        let Some(reference) = self.last_host.clone() else { return predicted };
        let world_from_last = last.world_from_body * body_from_camera;
        let last_from_world = world_from_last.inverse();
        let points: Vec<AlignmentPoint> = self
            .tracker
            .tracks
            .iter()
            .filter(|t| t.is_landmark && t.last_frame == self.last)
            .filter_map(|t| {
                let distance = last_from_world.act(&self.smoother.landmark(t.id)?.in_world).norm();
                let bearing = self.camera.unproject(&t.last_pixel)?;
                Some(AlignmentPoint { pixel: t.last_pixel, bearing, inverse_distance: 1.0 / distance })
            })
            .collect();
        let motion = (predicted.world_from_body * body_from_camera).inverse() * world_from_last;
        let loose = [GUESS_SIGMA_RAD, GUESS_SIGMA_RAD, GUESS_SIGMA_RAD];
        let far = GUESS_SIGMA_RAD / self.typical_inverse;
        let sigmas = nalgebra::Vector6::new(loose[0], loose[1], loose[2], far, far, far);
        let prediction = MotionPrediction {
            current_from_anchor: motion,
            information: nalgebra::Matrix6::from_diagonal(&sigmas.map(|s| 1.0 / (s * s))),
        };
        let references = [AlignmentReference {
            pyramid: &reference.pyramid,
            anchor_from_reference: Se3::IDENTITY,
            points: &points,
        }];
        let found = self.aligner.align(&self.camera, &references, &host.pyramid, &prediction);
        if found.converged {
            let world_from_camera = world_from_last * found.current_from_anchor.inverse();
            predicted.world_from_body = world_from_camera * body_from_camera.inverse();
        }
        predicted
    }
}
