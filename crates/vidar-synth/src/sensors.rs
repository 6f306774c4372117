//! What follows from the settings of the device: the camera, its place on the body, the IMU's gains.

use crate::config::SynthConfig;
use crate::device::{Lens, Mount};
use crate::error::SynthError;
use crate::random::{Gaussian, Purpose, stream};
use crate::rig;
use nalgebra::{Matrix3, Vector3};
use vidar_core::camera::{Equidistant, RadTan};
use vidar_core::{CameraModel, LieGroup, Pinhole, Se3, So3};

impl SynthConfig {
    /// The camera that renders the images: `device.lens` at the configured size.
    ///
    /// # Errors
    /// A lens that is no valid camera of this size (distortion that folds the image).
    pub fn camera(&self) -> Result<CameraModel, SynthError> {
        let (Lens::Radtan { focal_px, centre_offset_px, distortion }
        | Lens::Equidistant { focal_px, centre_offset_px, distortion }) = self.device.lens
        else {
            return rig::euroc_camera(self.width, self.height);
        };
        let [dx, dy] = centre_offset_px;
        let (cx, cy) = (0.5 * (self.width as f64 - 1.0) + dx, 0.5 * (self.height as f64 - 1.0) + dy);
        let pinhole = Pinhole::new(focal_px, focal_px, cx, cy, self.width, self.height)?;
        if matches!(self.device.lens, Lens::Equidistant { .. }) {
            return Ok(CameraModel::Equidistant(Equidistant::new(pinhole, distortion)?));
        }
        if distortion == [0.0; 4] {
            return Ok(CameraModel::Pinhole(pinhole));
        }
        Ok(CameraModel::RadTan(RadTan::new(pinhole, distortion)?))
    }

    /// Pose of the camera in the body (IMU) frame: `device.mount`.
    pub fn body_from_camera(&self) -> Se3 {
        let mut random = Gaussian::new(stream(self.seed, Purpose::Mount));
        let misaligned = |axes: Matrix3<f64>, turn: Vector3<f64>, lever_m: Vector3<f64>| {
            let axes = So3::from_matrix(&axes).unwrap_or(So3::IDENTITY);
            Se3::new(axes * So3::exp(&(turn * MISALIGNMENT_RAD)), lever_m)
        };
        match self.device.mount {
            Mount::Euroc => rig::euroc_body_from_camera(),
            Mount::TumVi => rig::tum_vi_body_from_camera(),
            Mount::Phone => {
                // Landscape: the body's x is up, y is left, z points at the user; the camera looks along −z.
                let axes = Matrix3::new(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
                let lever_m = Vector3::new(0.02, 0.055, -0.004) + random.vector() * 0.005;
                misaligned(axes, random.vector(), lever_m)
            }
            Mount::AnyAxes => {
                let axes = axis_permutation((random.uniform() * 24.0) as usize);
                let lever_m = Vector3::from_fn(|_, _| 0.1 * random.uniform() - 0.05);
                misaligned(axes, random.vector(), lever_m)
            }
        }
    }

    /// True scale factors of gyroscope and accelerometer per axis: a measurement is motion times this, plus bias and noise.
    pub fn imu_scale(&self) -> [Vector3<f64>; 2] {
        let mut random = Gaussian::new(stream(self.seed, Purpose::ImuScale));
        let mut draw = || Vector3::repeat(1.0) + random.vector() * self.device.imu_scale_sigma;
        [draw(), draw()]
    }

    /// The camera that a partial calibration states.
    pub(crate) fn partial_camera(&self, camera: &CameraModel) -> Result<CameraModel, SynthError> {
        let focal_px = self.stated_focal_px(camera.intrinsics().fx);
        let [cx, cy] = [self.width, self.height].map(|size| 0.5 * (size as f64 - 1.0));
        Ok(CameraModel::Pinhole(Pinhole::new(focal_px, focal_px, cx, cy, self.width, self.height)?))
    }

    /// The focal length that a partial calibration states, px: the true one with an error of 1.5 % (σ), at most 3 %.
    pub(crate) fn stated_focal_px(&self, true_focal_px: f64) -> f64 {
        let mut random = Gaussian::new(stream(self.seed, Purpose::StatedFocal));
        true_focal_px * (1.0 + (0.015 * random.next()).clamp(-0.03, 0.03))
    }
}

/// Standard deviation of a consumer device's camera orientation per axis, rad: 1.5°.
const MISALIGNMENT_RAD: f64 = 0.026;

/// Right-handed axis permutation `index` (0…23); columns are the camera's axes in the body.
fn axis_permutation(index: usize) -> Matrix3<f64> {
    let (x, sign_x) = (index % 3, if (index / 3).is_multiple_of(2) { 1.0 } else { -1.0 });
    let turn = index / 6 % 4;
    let mut first = Vector3::zeros();
    first[x] = sign_x;
    let mut second = Vector3::zeros();
    second[(x + 1 + turn % 2) % 3] = if turn < 2 { 1.0 } else { -1.0 };
    Matrix3::from_columns(&[first, second, first.cross(&second)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceConfig;

    #[test]
    fn the_24_axis_permutations_are_right_handed_and_distinct() {
        for i in 0..24 {
            assert!((axis_permutation(i).determinant() - 1.0).abs() < 1e-12, "{i}");
            for j in 0..i {
                assert_ne!(axis_permutation(i), axis_permutation(j), "{i} and {j}");
            }
        }
    }

    #[test]
    fn a_phone_held_in_landscape_sees_upright_images() {
        let config = SynthConfig {
            device: DeviceConfig { mount: Mount::Phone, ..Default::default() },
            ..Default::default()
        };
        let mount = config.body_from_camera();
        // The image's down (camera y) is the body's −x; 5° is more than 3 σ of the misalignment.
        let down = mount.rotation * Vector3::y();
        assert!(down.dot(&-Vector3::x()) > 5_f64.to_radians().cos(), "{down:?}");
        assert!((0.03..0.09).contains(&mount.translation.norm()));
        let other = SynthConfig { seed: 2, ..config.clone() };
        assert_ne!(other.body_from_camera(), mount);
        assert_eq!(config.body_from_camera(), mount);
    }

    #[test]
    fn a_fisheye_sees_by_the_angle() {
        let lens = Lens::Equidistant { focal_px: 300.0, centre_offset_px: [0.0; 2], distortion: [0.0; 4] };
        let device = DeviceConfig { lens, ..Default::default() };
        let config = SynthConfig { width: 641, height: 481, device, ..Default::default() };
        let seen = config.camera().unwrap().project(&Vector3::new(1.0, 0.0, 1.0)).unwrap();
        assert!((seen.x - 320.0 - 300.0 * std::f64::consts::FRAC_PI_4).abs() < 1e-9, "{seen:?}");
        assert_eq!(config.resized(1282, 962).camera().unwrap().intrinsics().fx, 600.0);
    }

    #[test]
    fn a_lens_of_given_focal_length_projects_with_it() {
        let lens = Lens::Radtan {
            focal_px: 487.0,
            centre_offset_px: [3.0, -2.0],
            distortion: [0.08, -0.1, 0.0, 0.0],
        };
        let device = DeviceConfig { lens, ..Default::default() };
        let config = SynthConfig { width: 640, height: 480, device, ..Default::default() };
        let camera = config.camera().unwrap();
        let k = camera.intrinsics();
        assert_eq!([k.fx, k.fy, k.cx, k.cy], [487.0, 487.0, 322.5, 237.5]);
        assert!(matches!(camera, CameraModel::RadTan(_)));
        let stated = config.stated_focal_px(487.0);
        assert!((stated / 487.0 - 1.0).abs() <= 0.03 && stated != 487.0);
    }
}
