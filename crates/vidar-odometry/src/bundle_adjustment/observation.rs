//! The reprojection factor of the adjustment: a landmark in one image row of a rolling shutter.
//!
//! A landmark is a direction `m` in the world's axes and an inverse distance ρ from a fixed place `A`, the first camera that
//! saw it; it lies along `m + ρ (A − c)` from a camera at `c`, which is well defined at infinity. A state belongs to an instant
//! of the IMU's clock; row `v` of its image was exposed `τ = δ + (v / (h − 1) − ½) t_r` later, where δ is the correction of the
//! clock offset and `t_r` the readout time. Between them the body turns by the gyroscope's rates and moves with the state's
//! velocity and the accelerometer's force (Patron-Perez, Lovegrove, Sibley 2015 do the same with splines).

use super::image_prior::{IMAGE_DIM, ImagePrior, ImageUnknown};
use super::inertial::{GAIN_DIM, ImuGain};
use super::landmark::Landmark;
use crate::backend::tangent_basis;
use crate::imu::{NavState, hat};
use nalgebra::{Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};
use vidar_core::{CameraModel, LensMotion, LieGroup, Se3, So3, camera::Pixel};

/// Unknowns of a state that an observation depends on: rotation, position, velocity.
pub(super) const STATE_DIM: usize = 9;

/// Unknowns of the calibration besides the intrinsics: clock offset, readout, rotation and position of the camera.
pub(super) const TIMING_AND_PLACE: usize = 8;

/// Where rotation and position of the camera begin in them.
pub(super) const ROTATION: usize = 2;
pub(super) const POSITION: usize = 5;

/// What is estimated of the sensors.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct SensorCalibration {
    pub(super) camera: CameraModel,
    pub(super) body_from_camera: Se3,
    /// Correction of the clock offset that the states are stamped with, s.
    pub(super) clock_secs: f64,
    /// From the first to the last row, s.
    pub(super) readout_secs: f64,
    /// Gains of gyroscope and accelerometer.
    pub(super) gain: ImuGain,
}

/// A state with the motion around it.
#[derive(Clone, Copy, Debug)]
pub(super) struct MovingBody {
    pub(super) state: NavState,
    /// Angular rate of the body as the gyroscope shows it, bias not removed, rad/s, and its change, rad/s².
    pub(super) gyro: Vector3<f64>,
    pub(super) gyro_change: Vector3<f64>,
    /// Specific force as the accelerometer shows it, m/s².
    pub(super) force: Vector3<f64>,
    /// Gravity in the world, m/s².
    pub(super) gravity: Vector3<f64>,
    /// How the lens had moved in the state's image (see [`super::image_unknowns`]).
    pub(super) lens: LensMotion,
    /// How much later than its stamp says the state's image was exposed, s: the state is that of the stamp.
    pub(super) delay_secs: f64,
}

impl MovingBody {
    /// Rotation from the instant of the state to `secs` later, and the angular rate then.
    fn turn(&self, secs: f64) -> (So3, Vector3<f64>) {
        let rate = self.gyro - self.state.bias.gyro;
        (So3::exp(&(rate * secs + self.gyro_change * (0.5 * secs * secs))), rate + self.gyro_change * secs)
    }

    /// Acceleration in the world, m/s².
    fn acceleration(&self) -> Vector3<f64> {
        self.state.world_from_body.rotation * (self.force - self.state.bias.accel) + self.gravity
    }

    /// The pose `secs` later.
    pub(super) fn pose_after(&self, secs: f64) -> Se3 {
        let pose = &self.state.world_from_body;
        Se3::new(
            pose.rotation * self.turn(secs).0,
            pose.translation + self.state.velocity * secs + self.acceleration() * (0.5 * secs * secs),
        )
    }

    /// The state `secs` later.
    pub(super) fn state_after(&self, secs: f64) -> NavState {
        NavState {
            world_from_body: self.pose_after(secs),
            velocity: self.state.velocity + self.acceleration() * secs,
            bias: self.state.bias,
        }
    }
}

impl SensorCalibration {
    /// Share of the readout after which row `v` is exposed, counted from the centre row.
    pub(super) fn row_share(&self, row: f64) -> f64 {
        row / (self.camera.height() as f64 - 1.0) - 0.5
    }

    /// How much later than the centre row a row was exposed, s.
    pub(super) fn secs_from_middle(&self, row: f64) -> f64 {
        self.row_share(row) * self.readout_secs
    }

    /// How much later than its state's instant an image's row was exposed, s.
    pub(super) fn row_secs(&self, row: f64) -> f64 {
        self.clock_secs + self.secs_from_middle(row)
    }

    /// Unknowns.
    pub(super) fn dim(&self) -> usize {
        TIMING_AND_PLACE + self.camera.parameters().len() + GAIN_DIM
    }

    /// The calibration moved by a step of all its unknowns; `None` where the camera would not be valid.
    pub(super) fn plus(&self, step: &[f64]) -> Option<Self> {
        let three = |at: usize| Vector3::from_column_slice(&step[at..at + 3]);
        let place = &self.body_from_camera;
        let parameters: Vec<f64> =
            self.camera.parameters().iter().zip(&step[TIMING_AND_PLACE..]).map(|(p, d)| p + d).collect();
        Some(Self {
            camera: self.camera.with_parameters(&parameters).ok()?,
            body_from_camera: Se3::new(place.rotation * So3::exp(&three(2)), place.translation + three(5)),
            clock_secs: self.clock_secs + step[0],
            readout_secs: self.readout_secs + step[1],
            gain: self.gain.plus(&step[step.len() - GAIN_DIM..]),
        })
    }

    /// The step with `other.plus(step) = self`.
    pub(super) fn minus(&self, other: &Self) -> Vec<f64> {
        let turn = other.body_from_camera.rotation.inverse() * self.body_from_camera.rotation;
        let place = self.body_from_camera.translation - other.body_from_camera.translation;
        let mut step = vec![self.clock_secs - other.clock_secs, self.readout_secs - other.readout_secs];
        step.extend(turn.log().iter().chain(place.iter()));
        step.extend(self.camera.parameters().iter().zip(other.camera.parameters()).map(|(a, b)| a - b));
        step.extend(self.gain.values().iter().zip(other.gain.values()).map(|(a, b)| a - b));
        step
    }
}

/// Derivatives of a pixel.
#[derive(Clone, Debug)]
pub(super) struct Linearised {
    pub(super) pixel: Pixel,
    pub(super) by_state: SMatrix<f64, 2, STATE_DIM>,
    pub(super) by_landmark: Matrix2x3<f64>,
    /// Clock, readout, rotation, position, intrinsics. The gains have no part in it: within a row's time they turn by less than
    /// 0.1 mrad.
    pub(super) by_calibration: Vec<Vector2<f64>>,
}

impl Linearised {
    /// Derivatives by the image's own unknowns, a column each; zero beyond them.
    pub(super) fn by_image(
        &self,
        body: &MovingBody,
        calibration: &SensorCalibration,
        prior: &ImagePrior,
        measured: &Pixel,
    ) -> SMatrix<f64, 2, IMAGE_DIM> {
        let focal = calibration.camera.focal_lengths();
        let secs = calibration.secs_from_middle(measured.y);
        let mut by_image = SMatrix::<f64, 2, IMAGE_DIM>::zeros();
        for (at, unknown) in prior.unknowns().enumerate() {
            let by_one = match unknown {
                ImageUnknown::LogFocal => {
                    let shift = body.lens.shift_px(&calibration.camera, secs);
                    self.pixel - shift - calibration.camera.principal_point()
                }
                ImageUnknown::ShiftX => Vector2::new(focal.x, 0.0),
                ImageUnknown::ShiftY => Vector2::new(0.0, focal.y),
                ImageUnknown::ShiftRateX => Vector2::new(secs * focal.x, 0.0),
                ImageUnknown::ShiftRateY => Vector2::new(0.0, secs * focal.y),
                ImageUnknown::Delay => self.by_calibration[0],
            };
            by_image.set_column(at, &by_one);
        }
        by_image
    }
}

/// Pose of the camera while the row of `measured` is exposed.
pub(super) fn camera_pose(body: &MovingBody, calibration: &SensorCalibration, measured: &Pixel) -> Se3 {
    body.pose_after(calibration.row_secs(measured.y) + body.delay_secs) * calibration.body_from_camera
}

/// Where the landmark lies in the image, in the row of `measured`.
pub(super) fn project(
    body: &MovingBody,
    landmark: &Landmark,
    calibration: &SensorCalibration,
    measured: &Pixel,
) -> Option<Pixel> {
    let camera = camera_pose(body, calibration, measured);
    let ray = camera.rotation.inverse().act(&from_camera(landmark, &camera.translation));
    let pixel = calibration.camera.project(&ray)?;
    Some(body.lens.shown(&calibration.camera, &pixel, calibration.secs_from_middle(measured.y)))
}

/// Direction from a camera at `place` to the landmark, world axes, scaled by the inverse distance from its origin.
pub(super) fn from_camera(landmark: &Landmark, place: &Vector3<f64>) -> Vector3<f64> {
    landmark.direction + (landmark.origin - place) * landmark.inverse_distance
}

/// [`project`] with its derivatives. The gyroscope bias' share of the motion within a row's time is left out: a correction of
/// 0.01 rad/s turns by 0.1 mrad in 10 ms, a twentieth of a pixel.
pub(super) fn linearise(
    body: &MovingBody,
    landmark: &Landmark,
    calibration: &SensorCalibration,
    measured: &Pixel,
) -> Option<Linearised> {
    let secs = calibration.row_secs(measured.y) + body.delay_secs;
    let (turn, rate) = body.turn(secs);
    let pose = body.pose_after(secs);
    let camera = pose * calibration.body_from_camera;
    let rho = landmark.inverse_distance;
    let camera_from_world: Matrix3<f64> = camera.rotation.matrix().transpose();
    let camera_from_body: Matrix3<f64> = calibration.body_from_camera.rotation.matrix().transpose();
    let ray = camera_from_world * from_camera(landmark, &camera.translation);
    let (pixel, mut parameters) = calibration.camera.project_with_parameter_jacobian(&ray)?;
    let (_, by_ray) = calibration.camera.project_with_jacobian(&ray)?;
    let row_secs = calibration.secs_from_middle(measured.y);
    let (pixel, factor) = (body.lens.shown(&calibration.camera, &pixel, row_secs), body.lens.log_focal.exp());
    let by_ray = by_ray * factor;
    parameters *= factor;
    for axis in 0..2 {
        // The principal point is the centre of the magnification, too; a shift counts in focal lengths.
        parameters[(axis, 2 + axis)] += 1.0 - factor;
        parameters[(axis, axis)] += body.lens.shift[axis] + row_secs * body.lens.shift_rate[axis];
    }

    // The landmark seen from the body's place while the row is exposed, in the axes of the state's body.
    let from_body =
        body.state.world_from_body.rotation.inverse().act(&from_camera(landmark, &pose.translation));
    let later_from_body = turn.inverse().act(&from_body);
    let by_rotation = camera_from_body * turn.matrix().transpose() * hat(&from_body);
    let by_position = camera_from_world * -rho;
    let by_instant = camera_from_body * later_from_body.cross(&rate)
        + by_position * (body.state.velocity + body.acceleration() * secs);

    let mut by_state = SMatrix::<f64, 2, STATE_DIM>::zeros();
    by_state.fixed_view_mut::<2, 3>(0, 0).copy_from(&(by_ray * by_rotation));
    by_state.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_ray * by_position));
    by_state.fixed_view_mut::<2, 3>(0, 6).copy_from(&(by_ray * by_position * secs));

    let mut by_landmark = Matrix2x3::zeros();
    let basis = tangent_basis(&landmark.direction);
    by_landmark.fixed_view_mut::<2, 2>(0, 0).copy_from(&(by_ray * camera_from_world * basis));
    let to_origin = camera_from_world * (landmark.origin - camera.translation);
    by_landmark.fixed_view_mut::<2, 1>(0, 2).copy_from(&(by_ray * to_origin));

    let by_instant = by_ray * by_instant;
    let by_camera_rotation = by_ray * hat(&ray);
    let by_camera_position = by_ray * camera_from_body * -rho;
    let mut by_calibration = Vec::with_capacity(calibration.dim());
    by_calibration.push(by_instant);
    let by_row = by_instant + calibration.camera.focal_lengths().component_mul(&body.lens.shift_rate);
    by_calibration.push(by_row * calibration.row_share(measured.y));
    by_calibration.extend(by_camera_rotation.column_iter().map(|c| c.into_owned()));
    by_calibration.extend(by_camera_position.column_iter().map(|c| c.into_owned()));
    by_calibration.extend(parameters.column_iter().map(|c| c.into_owned()));
    Some(Linearised { pixel, by_state, by_landmark, by_calibration })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::imu::{Bias, Vector15};
    use vidar_core::{CameraModel, Pinhole, camera::RadTan};

    pub(in crate::bundle_adjustment) fn example() -> (MovingBody, Landmark, SensorCalibration, Pixel) {
        let state = NavState {
            world_from_body: Se3::new(So3::exp(&Vector3::new(0.3, -0.5, 0.9)), Vector3::new(1.0, -0.4, 0.7)),
            velocity: Vector3::new(0.5, -0.3, 0.2),
            bias: Bias { gyro: Vector3::new(0.01, -0.02, 0.005), accel: Vector3::new(0.1, 0.05, -0.08) },
        };
        let body = MovingBody {
            state,
            gyro: Vector3::new(0.8, -1.1, 0.4),
            gyro_change: Vector3::new(3.0, 5.0, -4.0),
            force: Vector3::new(0.5, 9.6, -1.0),
            gravity: Vector3::new(0.0, 0.0, -9.81),
            lens: LensMotion {
                log_focal: 0.01,
                shift: Vector2::new(0.012, -0.006),
                shift_rate: Vector2::new(-0.2, 0.3),
            },
            delay_secs: 0.004,
        };
        let pinhole = Pinhole::new(420.0, 424.0, 317.0, 243.0, 640, 480).unwrap();
        let calibration = SensorCalibration {
            camera: CameraModel::RadTan(RadTan::new(pinhole, [-0.2, 0.05, 1e-3, -5e-4]).unwrap()),
            body_from_camera: Se3::new(
                So3::exp(&Vector3::new(1.2, 0.1, -0.3)),
                Vector3::new(0.05, -0.02, 0.03),
            ),
            clock_secs: 0.003,
            readout_secs: 0.025,
            gain: ImuGain::default(),
        };
        let measured = Pixel::new(400.0, 100.0);
        let camera = camera_pose(&body, &calibration, &measured);
        let row_secs = calibration.secs_from_middle(measured.y);
        let seen = body.lens.calibrated(&calibration.camera, &Pixel::new(410.0, 120.0), row_secs);
        let bearing = calibration.camera.unproject(&seen).unwrap();
        // Counted from somewhere else than this camera.
        let origin = camera.translation + Vector3::new(0.3, 0.2, -0.1);
        let point = camera.act(&(bearing * 2.5));
        let ray = point - origin;
        let landmark = Landmark { direction: ray.normalize(), inverse_distance: 1.0 / ray.norm(), origin };
        (body, landmark, calibration, measured)
    }

    fn perturbed(calibration: &SensorCalibration, index: usize, by: f64) -> SensorCalibration {
        let mut step = vec![0.0; calibration.dim()];
        step[index] = by;
        let moved = calibration.plus(&step).unwrap();
        let back = moved.minus(calibration);
        assert!(back.iter().zip(&step).all(|(a, b)| (a - b).abs() < 1e-9), "{back:?}");
        moved
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let (body, landmark, calibration, measured) = example();
        let at = linearise(&body, &landmark, &calibration, &measured).unwrap();
        assert!((at.pixel - Pixel::new(410.0, 120.0)).norm() < 1e-9, "{}", at.pixel);
        // Within a row's time the rates turn by a milliradian at most, which the derivative by the instant leaves out.
        let check = |name: &str, plus: Option<Pixel>, minus: Option<Pixel>, h: f64, found: Vector2<f64>| {
            let wanted = (plus.unwrap() - minus.unwrap()) / (2.0 * h);
            let error = (wanted - found).norm() / wanted.norm().max(1.0);
            assert!(error < 2e-4, "{name}: {found} instead of {wanted}, {error:.1e} off");
        };
        let h = 1e-6;
        for k in 0..STATE_DIM {
            let moved = |by: f64| {
                let mut step = Vector15::zeros();
                step[k] = by;
                MovingBody { state: body.state.plus(&step), ..body }
            };
            // The acceleration turns with the state; its share within a row's time is left out.
            let plus = project(&moved(h), &landmark, &calibration, &measured);
            let minus = project(&moved(-h), &landmark, &calibration, &measured);
            let wanted = (plus.unwrap() - minus.unwrap()) / (2.0 * h);
            let found = at.by_state.column(k).into_owned();
            assert!(
                (wanted - found).norm() < 2e-4 * wanted.norm().max(1.0),
                "state {k}: {found} not {wanted}"
            );
        }
        for k in 0..3 {
            let step = Vector3::ith(k, h);
            let plus = project(&body, &landmark.plus(&step), &calibration, &measured);
            let minus = project(&body, &landmark.plus(&-step), &calibration, &measured);
            check("landmark", plus, minus, h, at.by_landmark.column(k).into_owned());
        }
        let prior = ImagePrior { focal: Some(1.0), shift: Some(1.0), delay: Some(1.0) };
        let by_image = at.by_image(&body, &calibration, &prior, &measured);
        for (k, unknown) in prior.unknowns().enumerate() {
            let moved = |by: f64| {
                let mut body = body;
                unknown.add(&mut body, by);
                project(&body, &landmark, &calibration, &measured)
            };
            check(&format!("{unknown:?}"), moved(h), moved(-h), h, by_image.column(k).into_owned());
        }
        for k in 0..calibration.dim() - GAIN_DIM {
            let plus = project(&body, &landmark, &perturbed(&calibration, k, h), &measured);
            let minus = project(&body, &landmark, &perturbed(&calibration, k, -h), &measured);
            check(&format!("calibration {k}"), plus, minus, h, at.by_calibration[k]);
        }
    }
}
