//! The size at which images are followed. Large images are halved until they are at most [`MAX_WIDTH`] wide: a patch then sees as much of
//! the scene as in a small image, and time and memory per image do not depend on the sensor. What goes out is in the pixels that came in.

use crate::bundle_adjustment::Adjusted;
use crate::frontend::Pyramid;
use crate::tracking::TrackRecord;
use vidar_core::camera::{CameraError, Pixel};
use vidar_core::{CameraModel, FrameImage, SparseLandmark};

/// Widest image that is followed as it is, pixels: EuRoC's 752 are, 1280 become 640, 1920 and 3840 become 960.
const MAX_WIDTH: usize = 1000;

/// Entries of [`crate::bundle_adjustment::AdjustedCalibration::sigmas`] before those of the intrinsics, and the intrinsics that are in pixels.
const BEFORE_INTRINSICS: usize = 8;
const INTRINSICS_IN_PX: usize = 4;

/// Conversion between the pixels of the caller and those that are worked with.
#[derive(Debug)]
pub(super) struct WorkingSize {
    /// The caller's size.
    width: usize,
    height: usize,
    halvings: usize,
    buffers: Option<Pyramid>,
}

impl WorkingSize {
    /// For images of `given`, with the camera of the images that are worked with.
    pub fn of(given: &CameraModel) -> (Self, CameraModel) {
        let (width, height) = (given.width(), given.height());
        let wanted = Pyramid::level_for(width, height, MAX_WIDTH);
        let halved = scaled(given, 1.0 / f64::from(1_u32 << wanted), width >> wanted, height >> wanted);
        // A camera that has no half, of one row say, is worked with as it is.
        let (halvings, working) = halved.map_or_else(|_| (0, given.clone()), |camera| (wanted, camera));
        (Self { width, height, halvings, buffers: None }, working)
    }

    /// The same conversion, with buffers of its own.
    pub fn another(&self) -> Self {
        Self { buffers: None, ..*self }
    }

    /// The caller's columns and rows.
    pub fn given(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Pixels of the caller per working pixel.
    pub fn factor(&self) -> f64 {
        f64::from(1_u32 << self.halvings)
    }

    /// An image of the caller as it is worked with.
    pub fn image(&mut self, given: FrameImage) -> FrameImage {
        if self.halvings == 0 {
            return given;
        }
        let buffers =
            self.buffers.get_or_insert_with(|| Pyramid::new(self.width, self.height, self.halvings + 1));
        match buffers.rebuild(&given) {
            Ok(()) => FrameImage::Gray8(buffers.level(self.halvings).clone()),
            // Its size was checked when it came.
            Err(_) => given,
        }
    }

    fn pixel(&self, working: Pixel) -> Pixel {
        working.map(|c| (c + 0.5) * self.factor() - 0.5)
    }

    /// Landmarks in the caller's pixels.
    pub fn restore_landmarks(&self, landmarks: &mut [SparseLandmark]) {
        landmarks.iter_mut().for_each(|l| l.pixel = self.pixel(l.pixel));
    }

    /// A track in the caller's pixels.
    pub fn restore_track(&self, track: TrackRecord) -> TrackRecord {
        let residual = track.residual.map(|r| r * self.factor());
        TrackRecord { pixel: self.pixel(track.pixel), residual, ..track }
    }

    /// An adjustment in the caller's pixels.
    ///
    /// # Errors
    /// A camera that cannot have that size.
    pub fn restore_adjusted(&self, mut adjusted: Adjusted) -> Result<Adjusted, CameraError> {
        let calibration = &mut adjusted.calibration;
        calibration.camera = scaled(&calibration.camera, self.factor(), self.width, self.height)?;
        let intrinsics = calibration.sigmas.iter_mut().skip(BEFORE_INTRINSICS).take(INTRINSICS_IN_PX);
        intrinsics.for_each(|sigma| *sigma *= self.factor());
        adjusted.keyframes.iter_mut().for_each(|k| self.restore_landmarks(&mut k.landmarks));
        Ok(adjusted)
    }
}

/// The camera of images whose pixels are `1 / factor` times as large: `c' = (c + ½)·factor − ½`.
fn scaled(
    camera: &CameraModel,
    factor: f64,
    width: usize,
    height: usize,
) -> Result<CameraModel, CameraError> {
    let mut parameters = camera.parameters();
    parameters.iter_mut().take(2).for_each(|f| *f *= factor);
    parameters.iter_mut().skip(2).take(2).for_each(|c| *c = (*c + 0.5) * factor - 0.5);
    camera.with_parameters_and_size(&parameters, width, height)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::Image;
    use vidar_core::camera::{Pinhole, RadTan};

    #[test]
    fn a_large_camera_is_halved_and_its_pixels_come_back() {
        let pinhole = Pinhole::new(910.0, 905.0, 640.3, 361.7, 1281, 721).unwrap();
        let given = CameraModel::RadTan(RadTan::new(pinhole, [-0.1, 0.02, 1e-3, -1e-3]).unwrap());
        let (size, working) = WorkingSize::of(&given);
        assert_eq!((working.width(), working.height(), size.factor()), (640, 360, 2.0));
        let point = Vector3::new(0.3, -0.2, 1.4);
        let seen = size.pixel(working.project(&point).unwrap());
        assert!((seen - given.project(&point).unwrap()).norm() < 1e-9, "{seen}");
        assert_eq!(scaled(&working, 2.0, 1281, 721).unwrap(), given);
    }

    #[test]
    fn an_image_too_flat_for_more_halvings_fits_the_camera_that_it_is_given_to() {
        let flat = CameraModel::Pinhole(Pinhole::new(900.0, 900.0, 2000.0, 25.0, 4000, 50).unwrap());
        let (mut size, working) = WorkingSize::of(&flat);
        let image = size.image(FrameImage::Gray8(Image::filled(4000, 50, 7)));
        assert_eq!((working.width(), working.height(), size.factor()), (2000, 25, 2.0));
        assert_eq!((image.width(), image.height()), (2000, 25));
    }

    #[test]
    fn an_image_is_the_mean_of_its_pixels_and_a_small_one_stays() {
        let camera = |w, h| CameraModel::Pinhole(Pinhole::new(900.0, 900.0, 600.0, 300.0, w, h).unwrap());
        let image = FrameImage::Gray8(Image::from_fn(1200, 600, |x, y| ((x / 2 + y / 2) % 200) as u8));
        let (mut size, _) = WorkingSize::of(&camera(1200, 600));
        let FrameImage::Gray8(half) = size.image(image) else { panic!("grey stays grey") };
        assert_eq!((half.width(), half.height()), (600, 300));
        assert_eq!(half, Image::from_fn(600, 300, |x, y| ((x + y) % 200) as u8));
        let (mut size, _) = WorkingSize::of(&camera(752, 480));
        let small = FrameImage::Gray8(Image::filled(752, 480, 7));
        assert_eq!((size.factor(), size.image(small.clone())), (1.0, small));
    }
}
