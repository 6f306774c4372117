//! Binary descriptors of image points: comparisons of grey levels in a patch (BRIEF; Calonder, Lepetit, Strecha, Fua, ECCV 2010), turned so that
//! gravity points down.

use crate::frontend::{Pyramid, sample, to_level};
use nalgebra::{Vector2, Vector3};
use std::sync::LazyLock;
use vidar_core::CameraModel;
use vidar_core::camera::Pixel;
use vidar_solve::pcg64::Pcg64;

const WORDS: usize = 4;
const BITS: usize = 64 * WORDS;

/// Radius of a patch, pixels of the level below the feature's: the halving takes the noise out of single pixels.
const RADIUS_PX: f64 = 8.0;

/// Sine of the angle between a ray and the vertical below which gravity gives no direction in the image.
const MIN_INCLINATION: f64 = 0.2;

/// Grey levels of a patch compared in pairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Descriptor([u64; WORDS]);

/// The pairs of places that are compared: normal about the centre with a fifth of the patch's side (the paper's G II).
static PAIRS: LazyLock<Vec<[Vector2<f64>; 2]>> = LazyLock::new(|| {
    let mut random = Pcg64::seed(0);
    let mut uniform = || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5;
    // The sum of twelve has the variance 1.
    let mut normal = || (0..12).map(|_| uniform()).sum::<f64>();
    let mut place = || {
        let place = 0.4 * RADIUS_PX * Vector2::new(normal(), normal());
        place * (RADIUS_PX / place.norm()).min(1.0)
    };
    (0..BITS).map(|_| [place(), place()]).collect()
});

impl Descriptor {
    /// Of the patch about `pixel` (level 0) at the scale of a level; `down` is where gravity points in the image. `None` where the patch leaves the image.
    pub fn at(pyramid: &Pyramid, pixel: &Pixel, level: usize, down: &Vector2<f64>) -> Option<Self> {
        let level = level + 1;
        if level >= pyramid.level_count() {
            return None;
        }
        let image = pyramid.level(level);
        let centre = to_level(pixel, level);
        let margin = RADIUS_PX + 1.0;
        let is_inside = |at: f64, side: usize| at >= margin && at < side as f64 - 1.0 - margin;
        if !is_inside(centre.x, image.width()) || !is_inside(centre.y, image.height()) {
            return None;
        }
        let gray = |offset: &Vector2<f64>| {
            // The patch's y axis is turned to `down`.
            let x = centre.x + offset.x * down.y + offset.y * down.x;
            let y = centre.y - offset.x * down.x + offset.y * down.y;
            sample(image, x as f32, y as f32)
        };
        let mut words = [0_u64; WORDS];
        for (bit, [one, other]) in PAIRS.iter().enumerate() {
            words[bit / 64] |= u64::from(gray(one) < gray(other)) << (bit % 64);
        }
        Some(Self(words))
    }

    /// Number of comparisons that differ, 0…256.
    pub fn distance(&self, other: &Self) -> u32 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a ^ b).count_ones()).sum()
    }

    /// The comparisons, as bits.
    pub fn words(&self) -> [u64; WORDS] {
        self.0
    }

    /// Of comparisons that are given.
    pub fn from_words(words: [u64; WORDS]) -> Self {
        Self(words)
    }
}

/// The unit direction in the image, at a ray, in which gravity points; the image's own where the ray is nearly vertical.
pub(crate) fn downward(
    camera: &CameraModel,
    ray: &Vector3<f64>,
    gravity_in_camera: &Vector3<f64>,
) -> Vector2<f64> {
    let across = gravity_in_camera - ray * ray.dot(gravity_in_camera);
    let of_camera = Vector2::new(0.0, 1.0);
    if across.norm() < MIN_INCLINATION {
        return of_camera;
    }
    let turned = camera.project_with_jacobian(ray).map(|(_, d_pixel_d_point)| d_pixel_d_point * across);
    turned.and_then(|d| d.try_normalize(1e-9)).unwrap_or(of_camera)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{Image, Pinhole};

    /// Blobs at fixed places of a plane, seen turned by an angle about the point (x, y).
    fn view(x: f64, y: f64, angle: f64) -> Pyramid {
        let mut random = Pcg64::seed(7);
        let mut uniform = || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        let blobs: Vec<(f64, f64, f64)> = (0..400)
            .map(|_| (200.0 * uniform() - 100.0, 200.0 * uniform() - 100.0, 160.0 * uniform() - 80.0))
            .collect();
        let (s, c) = angle.sin_cos();
        let image = Image::from_fn(160, 120, |u, v| {
            let (du, dv) = (u as f64 - x, v as f64 - y);
            let (px, py) = (c * du + s * dv, c * dv - s * du);
            let gray: f64 = blobs
                .iter()
                .map(|(bx, by, a)| a * (-((px - bx).powi(2) + (py - by).powi(2)) / 18.0).exp())
                .sum();
            (128.0 + gray).clamp(0.0, 255.0) as u8
        });
        Pyramid::of(&image, 4)
    }

    #[test]
    fn a_patch_turned_with_gravity_is_the_same_and_another_one_is_not() {
        let upright = view(80.0, 60.0, 0.0);
        let down = Vector2::new(0.0, 1.0);
        let first = Descriptor::at(&upright, &Pixel::new(80.0, 60.0), 0, &down).unwrap();
        for angle in [0.3_f64, 1.2, -2.5] {
            let turned = view(70.0, 55.0, angle);
            // The image is turned by the angle, and so is gravity in it.
            let down = Vector2::new(-angle.sin(), angle.cos());
            let again = Descriptor::at(&turned, &Pixel::new(70.0, 55.0), 0, &down).unwrap();
            assert!(first.distance(&again) < 40, "{angle}: {}", first.distance(&again));
        }
        let elsewhere = Descriptor::at(&upright, &Pixel::new(50.0, 40.0), 0, &down).unwrap();
        assert!(first.distance(&elsewhere) > 80, "{}", first.distance(&elsewhere));
        assert!(Descriptor::at(&upright, &Pixel::new(5.0, 60.0), 0, &down).is_none());
        assert!(Descriptor::at(&upright, &Pixel::new(80.0, 60.0), 3, &down).is_none());
    }

    #[test]
    fn gravity_gives_the_direction_down_except_along_itself() {
        let camera = CameraModel::Pinhole(Pinhole::new(100.0, 100.0, 80.0, 60.0, 160, 120).unwrap());
        let ray = Vector3::new(0.1, 0.0, 1.0).normalize();
        let rolled = Vector3::new(0.6, 0.8, 0.0);
        let down = downward(&camera, &ray, &rolled);
        assert!((down - Vector2::new(0.6, 0.8)).norm() < 0.05, "{down}");
        assert_eq!(
            downward(&camera, &ray, &Vector3::new(0.05, 0.0, 1.0).normalize()),
            Vector2::new(0.0, 1.0)
        );
    }
}
