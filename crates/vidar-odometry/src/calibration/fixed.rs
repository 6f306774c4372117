//! Features that move with the camera: those on its carrier, on the lens, or written into the picture.

use super::path::GyroPath;
use crate::gyro_alignment::ImageFeatures;
use nalgebra::Matrix3;
use rustc_hash::FxHashMap;
use vidar_core::LandmarkId;
use vidar_core::camera::Pixel;

/// A feature stays that is never further than this share of the image's width from where it was (a pixel of 640) ...
const FIXED_SHARE: f64 = 1.0 / 640.0;
/// ... while the gyroscope turns by this, rad. About which axis is not known yet; about the optical one the middle of the image stays, too,
/// which costs a few features.
const TURNED_RAD: f64 = 0.07;

/// A feature since the gyroscope last had turned enough, and how often it had stayed and moved until then. Where the clock is not known yet, one
/// of the world can seem to stay once.
struct Course {
    pixel: Pixel,
    /// first_from_body of the gyroscope then.
    rotation: Matrix3<f64>,
    moved_px: f64,
    stayed: u32,
    moved: u32,
}

/// Takes fixed features out of images `width` pixels wide.
pub(super) fn leave_out(images: &mut [ImageFeatures], path: &GyroPath, width: f64) {
    let mut courses: FxHashMap<LandmarkId, Course> = FxHashMap::default();
    for image in images.iter() {
        let rotation = path.at(image.secs).rotation;
        for (id, pixel) in &image.features {
            let begins = || Course { pixel: *pixel, rotation, moved_px: 0.0, stayed: 0, moved: 0 };
            let course = courses.entry(*id).or_insert_with(begins);
            course.moved_px = course.moved_px.max((pixel - course.pixel).norm());
            let cosine = 0.5 * ((course.rotation.transpose() * rotation).trace() - 1.0);
            if cosine.clamp(-1.0, 1.0).acos() > TURNED_RAD {
                let stays = course.moved_px < FIXED_SHARE * width;
                let (stayed, moved) = (course.stayed + u32::from(stays), course.moved + u32::from(!stays));
                *course = Course { stayed, moved, ..begins() };
            }
        }
    }
    courses.retain(|_, course| course.stayed > course.moved);
    for image in images.iter_mut().filter(|_| !courses.is_empty()) {
        image.features.retain(|(id, _)| !courses.contains_key(id));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gyro_alignment::RateSample;
    use nalgebra::Vector3;

    #[test]
    fn what_stays_while_the_gyroscope_turns_is_left_out() {
        let rate = Vector3::new(0.0, 0.3, 0.0);
        let samples: Vec<RateSample> =
            (0..200).map(|k| RateSample { secs: f64::from(k) * 0.005, rate }).collect();
        let path = GyroPath::new(&samples, &Vector3::zeros(), &Vector3::zeros());
        let image = |k: u32| ImageFeatures {
            secs: f64::from(k) * 0.1,
            features: vec![
                (LandmarkId(0), Pixel::new(50.0, 400.0 + 0.3 * f64::from(k % 2))),
                (LandmarkId(1), Pixel::new(200.0 + 15.0 * f64::from(k), 200.0)),
            ],
        };
        let mut short: Vec<ImageFeatures> = (0..3).map(image).collect();
        leave_out(&mut short, &path, 640.0);
        assert!(short.iter().all(|i| i.features.len() == 2), "it had hardly turned");
        let mut images: Vec<ImageFeatures> = (0..9).map(image).collect();
        leave_out(&mut images, &path, 640.0);
        assert!(images.iter().all(|i| i.features.len() == 1 && i.features[0].0 == LandmarkId(1)));
    }
}
