//! Landmarks of the odometry at the pixels of a depth image.

use std::collections::BTreeSet;
use vidar_core::camera::Pixel;
use vidar_core::{
    CameraModel, LandmarkId, LieGroup, OdometryKeyframe, Pinhole, Se3, SparseLandmark, Timestamp,
};

/// A pixel of a pinhole image where the same image at another size shows it (`c' = (c + 0.5)·s − 0.5`); `None` outside.
pub fn pixel_at_size(pixel: &Pixel, from: &Pinhole, to: &Pinhole) -> Option<Pixel> {
    let scaled = |c: f64, from: usize, to: usize| (c + 0.5) * to as f64 / from as f64 - 0.5;
    let pixel = Pixel::new(scaled(pixel.x, from.width, to.width), scaled(pixel.y, from.height, to.height));
    let inside = pixel.x >= 0.0
        && pixel.y >= 0.0
        && pixel.x <= (to.width - 1) as f64
        && pixel.y <= (to.height - 1) as f64;
    inside.then_some(pixel)
}

/// An odometry keyframe as a source of landmarks.
#[derive(Clone, Copy, Debug)]
pub struct LandmarkSource<'a> {
    /// The keyframe; pixels of its landmarks are in the distorted image.
    pub keyframe: &'a OdometryKeyframe,
    /// Its camera's pose in the trajectory in use, m.
    pub world_from_camera: Se3,
    /// When it was taken.
    pub time: Timestamp,
}

/// Carries landmarks from the images of the odometry to depth images.
#[derive(Clone, Copy, Debug)]
pub struct LandmarkTransfer<'a> {
    /// The camera with its distortion.
    pub camera: &'a CameraModel,
    /// The undistorted view that the geometry model gets.
    pub view: &'a Pinhole,
    /// The same view at the size of the predicted depth.
    pub depth: &'a Pinhole,
}

impl LandmarkTransfer<'_> {
    /// Landmarks of a keyframe at the pixels of its own depth image; those outside the undistorted view are left out.
    pub fn undistorted(&self, landmarks: &[SparseLandmark]) -> Vec<SparseLandmark> {
        let carried = |l: &SparseLandmark| {
            let in_view = self.view.project(&self.camera.unproject(&l.pixel)?)?;
            Some(SparseLandmark { pixel: pixel_at_size(&in_view, self.view, self.depth)?, ..*l })
        };
        landmarks.iter().filter_map(carried).collect()
    }

    /// Landmarks of a frame taken between two odometry keyframes: those that both keyframes observe, projected from the one
    /// nearer in time. Both must be of one segment; landmarks behind the camera or outside its view are left out.
    pub fn between(
        &self,
        time: Timestamp,
        world_from_camera: &Se3,
        before: &LandmarkSource<'_>,
        after: &LandmarkSource<'_>,
    ) -> Vec<SparseLandmark> {
        if before.keyframe.segment != after.keyframe.segment {
            return Vec::new();
        }
        let is_before_nearer = time.since(before.time) <= after.time.since(time);
        let (near, far) = if is_before_nearer { (before, after) } else { (after, before) };
        let in_both: BTreeSet<LandmarkId> = far.keyframe.landmarks.iter().map(|l| l.id).collect();
        let camera_from_near = world_from_camera.inverse() * near.world_from_camera;
        let shared = near.keyframe.landmarks.iter().filter(|l| in_both.contains(&l.id));
        shared.filter_map(|l| self.projected(l, &camera_from_near)).collect()
    }

    fn projected(&self, l: &SparseLandmark, camera_from_near: &Se3) -> Option<SparseLandmark> {
        let ray = self.camera.unproject(&l.pixel).filter(|ray| ray.z > 0.0)?;
        let in_camera = camera_from_near.act(&(ray / (ray.z * l.inverse_depth)));
        let pixel = pixel_at_size(&self.view.project(&in_camera)?, self.view, self.depth)?;
        let inverse_depth = 1.0 / in_camera.z;
        // The relative error of the depth is kept.
        let inverse_depth_std = l.inverse_depth_std / l.inverse_depth * inverse_depth;
        Some(SparseLandmark { pixel, inverse_depth, inverse_depth_std, ..*l })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::{FrameId, Health, KeyframeId, NavState, PoseCovariance};

    fn view() -> Pinhole {
        Pinhole::new(100.0, 100.0, 99.5, 49.5, 200, 100).unwrap()
    }

    fn half() -> Pinhole {
        Pinhole::new(50.0, 50.0, 49.5, 24.5, 100, 50).unwrap()
    }

    fn keyframe(x: f64, points: &[(u32, Vector3<f64>)]) -> OdometryKeyframe {
        let world_from_camera = Se3::from_translation(Vector3::x() * x);
        let landmarks = points
            .iter()
            .map(|(id, point)| {
                let in_camera = world_from_camera.inverse().act(point);
                SparseLandmark {
                    id: LandmarkId(*id),
                    pixel: view().project(&in_camera).unwrap(),
                    inverse_depth: 1.0 / in_camera.z,
                    inverse_depth_std: 0.02 / in_camera.z,
                }
            })
            .collect();
        OdometryKeyframe {
            id: KeyframeId(0),
            frame_id: FrameId(0),
            segment: 0,
            state: NavState::at_rest(Timestamp::from_nanos(0)),
            world_from_camera,
            pose_covariance: PoseCovariance::zeros(),
            previous: None,
            gravity_in_world: Vector3::new(0.0, 0.0, -9.81),
            scale_std: 0.01,
            health: Health::Ok,
            lens: vidar_core::LensMotion::NONE,
            landmarks,
        }
    }

    #[test]
    fn a_frame_between_two_keyframes_gets_the_landmarks_that_both_observe() {
        let points = [(1, Vector3::new(0.2, 0.1, 2.0)), (2, Vector3::new(-0.3, 0.0, 4.0)), (3, Vector3::z())];
        let (a, b) = (keyframe(0.0, &points), keyframe(0.2, &points[..2]));
        let at = Timestamp::from_nanos;
        let source = |keyframe, time| LandmarkSource {
            keyframe,
            world_from_camera: OdometryKeyframe::clone(keyframe).world_from_camera,
            time: at(time),
        };
        let camera = CameraModel::Pinhole(view());
        let (view, depth) = (view(), half());
        let transfer = LandmarkTransfer { camera: &camera, view: &view, depth: &depth };
        let pose = Se3::from_translation(Vector3::new(0.05, 0.0, 0.5));
        let found = transfer.between(at(3), &pose, &source(&a, 0), &source(&b, 10));
        assert_eq!(found.iter().map(|l| l.id.0).collect::<Vec<_>>(), [1, 2]);
        for (l, (_, point)) in found.iter().zip(&points) {
            let in_camera = pose.inverse().act(point);
            let expected = half().project(&in_camera).unwrap();
            assert!((l.pixel - expected).norm() < 1e-9, "{l:?} {expected}");
            assert!((l.inverse_depth * in_camera.z - 1.0).abs() < 1e-12);
            assert!((l.inverse_depth_std / l.inverse_depth - 0.02).abs() < 1e-12);
        }
        let mut other_segment = b.clone();
        other_segment.segment = 1;
        assert!(transfer.between(at(3), &pose, &source(&a, 0), &source(&other_segment, 10)).is_empty());
    }

    #[test]
    fn landmarks_of_a_keyframe_move_to_the_size_of_its_depth_and_leave_with_the_image() {
        let camera = CameraModel::Pinhole(view());
        let (view, depth) = (view(), half());
        let transfer = LandmarkTransfer { camera: &camera, view: &view, depth: &depth };
        let at = |x: f64, y: f64| SparseLandmark {
            id: LandmarkId(7),
            pixel: Pixel::new(x, y),
            inverse_depth: 0.5,
            inverse_depth_std: 0.01,
        };
        // Pixel centres: (40 + 0.5) / 2 − 0.5 = 19.75, and (0 + 0.5) / 2 − 0.5 < 0 is outside.
        let found = transfer.undistorted(&[at(40.0, 20.0), at(0.0, 20.0)]);
        assert_eq!(found.len(), 1);
        assert!((found[0].pixel - Pixel::new(19.75, 9.75)).norm() < 1e-9, "{:?}", found[0].pixel);
        assert_eq!(found[0].inverse_depth, 0.5);
    }
}
