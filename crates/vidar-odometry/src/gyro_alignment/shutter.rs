//! Rolling shutter: when each image row was exposed, and where a pixel would be had the whole image been exposed at the
//! time of its centre row.
//!
//! Row `v` of an image of height `h` with readout time `t_r` is exposed at `t + (v / (h − 1) − ½) t_r`, where `t` is the
//! time of the centre row. Between a row's time and `t` the camera turns with the gyroscope's rate ω and moves with the
//! velocity `v_c`. A point seen along the unit ray `b` at inverse distance ρ lies, at time `t`, along
//! `exp(−Δ ω − ½ Δ² α) b + ρ Δ v_c`, where `Δ` is the row's time less `t` and the rotation vector is in camera axes.

use nalgebra::Vector3;
use vidar_core::camera::Pixel;
use vidar_core::{CameraModel, LieGroup, So3};

/// Motion of the camera while one image was read out. `readout_secs` of zero is a global shutter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct RollingShutter {
    /// Time from the first to the last row, s.
    pub readout_secs: f64,
    /// Angular rate of the camera at the centre row's time, in camera axes, rad/s.
    pub rate: Vector3<f64>,
    /// Its derivative by time, rad/s².
    pub acceleration: Vector3<f64>,
    /// Velocity of the camera in camera axes, m/s; zero where it is not known.
    pub velocity: Vector3<f64>,
}

impl RollingShutter {
    /// Time of a row less the time of the centre row, s.
    fn row_secs(&self, camera: &CameraModel, row: f64) -> f64 {
        (row / (camera.height() as f64 - 1.0) - 0.5) * self.readout_secs
    }

    /// The pixel as a global shutter at the centre row's time would show it. `inverse_distance` of the point, 1/m.
    pub fn remove_motion(&self, camera: &CameraModel, pixel: &Pixel, inverse_distance: f64) -> Pixel {
        if self.readout_secs == 0.0 {
            return *pixel;
        }
        let secs = self.row_secs(camera, pixel.y);
        let Some(ray) = camera.unproject(pixel) else { return *pixel };
        let moved = self.turn(secs) * ray + self.velocity * (secs * inverse_distance);
        camera.project(&moved).unwrap_or(*pixel)
    }

    /// Where the rolling shutter shows what a global shutter would show at `pixel`: the inverse of
    /// [`RollingShutter::remove_motion`], by fixed-point iteration (each round shrinks the error by the image motion within
    /// the readout over the image height, about a tenth for a lively hand).
    pub fn add_motion(&self, camera: &CameraModel, pixel: &Pixel, inverse_distance: f64) -> Pixel {
        if self.readout_secs == 0.0 {
            return *pixel;
        }
        let mut rolled = *pixel;
        for _ in 0..5 {
            rolled += pixel - self.remove_motion(camera, &rolled, inverse_distance);
        }
        rolled
    }

    /// Rotation camera-at-the-centre-row from camera-at-the-row.
    fn turn(&self, secs: f64) -> So3 {
        So3::exp(&(self.rate * secs + self.acceleration * (0.5 * secs * secs)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;
    use vidar_core::Pinhole;

    fn camera() -> CameraModel {
        CameraModel::Pinhole(Pinhole::new(500.0, 500.0, 319.5, 239.5, 640, 480).unwrap())
    }

    fn lively() -> RollingShutter {
        RollingShutter {
            readout_secs: 0.03,
            rate: Vector3::new(1.0, -2.0, 0.5),
            acceleration: Vector3::new(10.0, 5.0, -8.0),
            velocity: Vector3::new(0.4, -0.2, 0.3),
        }
    }

    #[test]
    fn a_pixel_survives_the_way_to_the_global_shutter_and_back() {
        let (camera, shutter) = (camera(), lively());
        for pixel in [Vector2::new(30.0, 20.0), Vector2::new(600.0, 460.0), Vector2::new(320.0, 240.0)] {
            let global = shutter.remove_motion(&camera, &pixel, 0.5);
            let back = shutter.add_motion(&camera, &global, 0.5);
            assert!((back - pixel).norm() < 2e-3, "{pixel} came back as {back}");
        }
    }

    #[test]
    fn a_row_is_corrected_by_the_motion_between_its_time_and_the_centre_row() {
        let (camera, shutter) = (camera(), lively());
        // A point fixed in the world, camera frame of the centre row.
        let point = Vector3::new(0.4, -0.7, 2.0);
        // Exposure time of the row that shows it, found by iteration on the true motion.
        let mut secs = 0.0;
        let mut pixel = Vector2::zeros();
        for _ in 0..50 {
            let turn = So3::exp(&(shutter.rate * secs + shutter.acceleration * (0.5 * secs * secs)));
            pixel = camera.project(&(turn.inverse() * (point - shutter.velocity * secs))).unwrap();
            secs = (pixel.y / 479.0 - 0.5) * shutter.readout_secs;
        }
        let global = shutter.remove_motion(&camera, &pixel, 1.0 / point.norm());
        let expected = camera.project(&point).unwrap();
        assert!((global - expected).norm() < 0.05, "{global} instead of {expected}");
        assert!((pixel - expected).norm() > 5.0, "the motion must matter");
    }

    #[test]
    fn a_global_shutter_changes_nothing() {
        let (camera, shutter) = (camera(), RollingShutter { readout_secs: 0.0, ..lively() });
        let pixel = Vector2::new(12.25, 400.5);
        assert_eq!(shutter.remove_motion(&camera, &pixel, 1.0), pixel);
        assert_eq!(shutter.add_motion(&camera, &pixel, 1.0), pixel);
    }
}
