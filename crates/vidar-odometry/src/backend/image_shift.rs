//! Images that are shifted by a stabiliser: every frame has a turn of its image against the body, an unknown of the inertial factors on both of its sides.
//!
//! The window's states have the orientation in which their images see the world. A lens that is moved across by `s` focal lengths shows what a camera turned by `s`
//! would, up to the square of the angle from the axis, so only the inertial factors need to know how the body was turned.

use super::Smoother;
use super::own_value::OwnValue;
use super::prior::Part;
use super::system::System;
use super::window::{Frame, LandmarkObservation};
use crate::imu::{NavState, Preintegration, hat};
use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};
use vidar_core::{CameraModel, LieGroup, Se3, So3};

/// Turns between images whose share that is taken back is looked at, rad: smaller ones are noise, larger ones are more than a lens can be shifted.
const LEAST_TURN_RAD: f64 = 0.01;
const MOST_TURN_RAD: f64 = 0.02;

/// By how much an image is turned about the camera's x and y, rad.
pub(crate) type ImageShift = OwnValue<2>;

/// The body's state where the window's is that of the image, and its pose's derivatives by the image's rotation and by the shift.
pub(crate) struct BodyState {
    pub(crate) state: NavState,
    derivatives: Option<Derivatives>,
}

struct Derivatives {
    by_rotation: SMatrix<f64, 6, 3>,
    by_shift: SMatrix<f64, 6, 2>,
}

/// The body's state of a frame whose image is shifted. The camera's place is the same.
pub(crate) fn body_state(image: &NavState, turn: &Vector2<f64>, body_from_camera: &Se3) -> NavState {
    if *turn == Vector2::zeros() {
        return *image;
    }
    let back = So3::exp(&-(body_from_camera.rotation * Vector3::new(turn.x, turn.y, 0.0)));
    let arm = body_from_camera.translation;
    let Se3 { rotation, translation } = image.world_from_body;
    let mut state = *image;
    state.world_from_body = Se3::new(rotation * back, translation + rotation * (arm - back * arm));
    state
}

/// The other way: the image's state of a body's.
pub(crate) fn image_state(body: &NavState, turn: &Vector2<f64>, body_from_camera: &Se3) -> NavState {
    body_state(body, &-turn, body_from_camera)
}

impl BodyState {
    /// Where no image is shifted.
    pub(crate) fn unshifted(image: &NavState) -> Self {
        Self { state: *image, derivatives: None }
    }

    pub(crate) fn new(image: &NavState, turn: &Vector2<f64>, body_from_camera: &Se3) -> Self {
        let axes: SMatrix<f64, 3, 2> = body_from_camera.rotation.matrix().fixed_columns::<2>(0).into_owned();
        let angle = axes * turn;
        let state = body_state(image, turn, body_from_camera);
        let arm = body_from_camera.translation;
        let turned = image.world_from_body.rotation.matrix();
        let moved = arm - So3::exp(&-angle) * arm;
        let mut by_rotation = SMatrix::<f64, 6, 3>::zeros();
        by_rotation.fixed_view_mut::<3, 3>(0, 0).copy_from(&So3::exp(&angle).matrix());
        by_rotation.fixed_view_mut::<3, 3>(3, 0).copy_from(&-(turned * hat(&moved)));
        let slope: Matrix3<f64> = So3::right_jacobian(&-angle);
        let by: SMatrix<f64, 3, 2> = -(slope * axes);
        let mut by_shift = SMatrix::<f64, 6, 2>::zeros();
        by_shift.fixed_view_mut::<3, 2>(0, 0).copy_from(&by);
        by_shift
            .fixed_view_mut::<3, 2>(3, 0)
            .copy_from(&(state.world_from_body.rotation.matrix() * hat(&arm) * by));
        Self { state, derivatives: Some(Derivatives { by_rotation, by_shift }) }
    }

    /// Derivatives by the image's state and by the shift of what has derivatives `by_body` by the body's.
    pub(crate) fn through<const R: usize>(
        &self,
        by_body: &SMatrix<f64, R, 15>,
    ) -> (SMatrix<f64, R, 15>, SMatrix<f64, R, 2>) {
        let Some(Derivatives { by_rotation, by_shift }) = &self.derivatives else {
            return (*by_body, SMatrix::zeros());
        };
        let by_pose: SMatrix<f64, R, 6> = by_body.fixed_columns::<6>(0).into_owned();
        let mut by_image = *by_body;
        by_image.fixed_columns_mut::<3>(0).copy_from(&(by_pose * by_rotation));
        (by_image, by_pose * by_shift)
    }
}

/// Where a camera that is turned by `turn` shows what a lens that is shifted as much shows at `seen`: the same but for the square of the angle from the axis.
pub(crate) fn seen_by_turned(
    camera: &CameraModel,
    seen: &Vector2<f64>,
    turn: &Vector2<f64>,
) -> Option<Vector2<f64>> {
    let lens = camera.intrinsics();
    let unshifted = seen - Vector2::new(-lens.fx * turn.y, lens.fy * turn.x);
    camera.project(&(So3::exp(&-Vector3::new(turn.x, turn.y, 0.0)) * camera.unproject(&unshifted)?))
}

impl Smoother {
    /// Takes all observations as cameras would make them that are turned as the images are shifted, by the present shifts; how far the farthest moved, px.
    pub(crate) fn turn_shifted_pixels(&mut self) -> f64 {
        if !self.shifts_images() {
            return 0.0;
        }
        let mut farthest = 0.0_f64;
        let (frames, camera) = (&self.frames, &self.camera);
        let mut turn = |s: &mut LandmarkObservation| {
            let turn = &frames[s.frame].image_shift.now;
            let pixel = seen_by_turned(camera, &s.seen, turn).unwrap_or(s.seen);
            farthest = farthest.max((pixel - s.pixel).norm());
            s.pixel = pixel;
        };
        for landmark in self.landmarks.iter_mut().filter(|l| l.alive) {
            turn(&mut landmark.host);
            landmark.observations.iter_mut().for_each(&mut turn);
        }
        farthest
    }

    /// Whether every image has a shift of its own.
    pub(crate) fn shifts_images(&self) -> bool {
        self.config.image_shift_sigma().is_some()
    }

    /// The body's state of a frame at the present states.
    pub(crate) fn body_state_of(&self, frame: &Frame) -> NavState {
        body_state(&frame.state, &frame.image_shift.now, &self.calibration.body_from_camera)
    }

    /// The state that IMU measurements since the newest frame lead to, of an image that is shifted as the stabiliser goes on.
    pub(crate) fn predict(&self, preintegration: &Preintegration) -> NavState {
        let Some(newest) = self.frames.last() else { return NavState::REST };
        let camera = &self.calibration.body_from_camera;
        let body = preintegration.predict(&self.body_state_of(newest));
        image_state(&body, &self.next_image_shift(Some(preintegration)), camera)
    }

    /// The shift that the next image has if the stabiliser goes on as in the window.
    pub(crate) fn next_image_shift(&self, preintegration: Option<&Preintegration>) -> Vector2<f64> {
        let last = self.frames.last().map_or_else(Vector2::zeros, |f| f.image_shift.now);
        let (Some(sigma), Some(preintegration)) = (self.config.image_shift_sigma(), preintegration) else {
            return last;
        };
        let next = last - self.camera_turn(preintegration) * self.stabilised_share();
        next.cap_magnitude(2.0 * sigma)
    }

    /// How far the camera turned about its x and y, rad.
    fn camera_turn(&self, preintegration: &Preintegration) -> Vector2<f64> {
        let turn = preintegration.rotation(preintegration.bias()).log();
        (self.calibration.body_from_camera.rotation.inverse() * turn).xy()
    }

    /// Share of the camera's turns that the stabiliser takes back, 0…1: the slope of the shifts over the turns between the window's images. 0 where images are not shifted.
    pub(crate) fn stabilised_share(&self) -> f64 {
        if !self.shifts_images() {
            return 0.0;
        }
        // About so much of a turn has to be seen before its share says anything.
        let mut sums = (0.0, LEAST_TURN_RAD * LEAST_TURN_RAD);
        for pair in self.frames.windows(2) {
            let Some(factor) = &pair[1].imu_factor else { continue };
            let turned = self.camera_turn(&factor.preintegration);
            if turned.norm() > MOST_TURN_RAD {
                continue;
            }
            sums.0 -= turned.dot(&(pair[1].image_shift.now - pair[0].image_shift.now));
            sums.1 += turned.norm_squared();
        }
        (sums.0 / sums.1).clamp(0.0, 1.0)
    }

    /// That a frame's image is hardly shifted.
    pub(crate) fn add_image_shift(&self, system: &mut System, k: usize) -> f64 {
        let Some(sigma) = self.config.image_shift_sigma() else { return 0.0 };
        let at = system.offset(Part::ImageShift(k));
        let turn = self.frames[k].image_shift.now;
        for c in 0..2 {
            system.h[(at + c) * system.n + at + c] += 1.0 / (sigma * sigma);
            system.gradient[at + c] += turn[c] / (sigma * sigma);
        }
        0.5 * turn.norm_squared() / (sigma * sigma)
    }
}
