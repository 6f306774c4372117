//! Binary descriptors of image points: comparisons of grey levels in a patch (BRIEF; Calonder, Lepetit, Strecha, Fua, ECCV 2010), turned so that
//! gravity points down.

use crate::frontend::{Pyramid, sample, to_level};
use nalgebra::{Vector2, Vector3};
use std::sync::LazyLock;
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;
use vidar_core::{CameraModel, Image};
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

/// Pairs that are compared at a time.
const LANES: usize = 8;

/// Places of some pairs about the centre, one coordinate after another: x and y of the first, x and y of the second of each pair.
type Places = [[f64; LANES]; 4];

/// The pairs of places that are compared: normal about the centre with a fifth of the patch's side (the paper's G II).
static PAIRS: LazyLock<Vec<Places>> = LazyLock::new(|| {
    let mut random = Pcg64::seed(0);
    let mut uniform = || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5;
    // The sum of twelve has the variance 1.
    let mut normal = || (0..12).map(|_| uniform()).sum::<f64>();
    let mut place = || {
        let place = 0.4 * RADIUS_PX * Vector2::new(normal(), normal());
        place * (RADIUS_PX / place.norm()).min(1.0)
    };
    let mut pairs = vec![[[0.0; LANES]; 4]; BITS / LANES];
    for bit in 0..BITS {
        let (one, other) = (place(), place());
        for (k, value) in [one.x, one.y, other.x, other.y].into_iter().enumerate() {
            pairs[bit / LANES][k][bit % LANES] = value;
        }
    }
    pairs
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
        let pairs: &[Places] = &PAIRS;
        Some(Self(comparisons(image, &centre, down, pairs)))
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

kernel! {
    fn comparisons(image: &Image<u8>, centre: &Pixel, down: &Vector2<f64>, pairs: &[Places]) -> [u64; WORDS] {
        compare_pairs(image, centre, down, pairs)
    }
}

/// For each pair whether the first place is darker, one bit after another.
#[inline(always)]
fn compare_pairs(image: &Image<u8>, centre: &Pixel, down: &Vector2<f64>, pairs: &[Places]) -> [u64; WORDS] {
    let mut words = [0_u64; WORDS];
    for (group, [one_x, one_y, other_x, other_y]) in pairs.iter().enumerate() {
        let one = turned_samples(image, centre, down, one_x, one_y);
        let other = turned_samples(image, centre, down, other_x, other_y);
        for lane in 0..LANES {
            let bit = group * LANES + lane;
            words[bit / 64] |= u64::from(one[lane] < other[lane]) << (bit % 64);
        }
    }
    words
}

/// Grey levels at places about the centre, the patch's y axis turned to `down`.
#[inline(always)]
fn turned_samples(
    image: &Image<u8>,
    centre: &Pixel,
    down: &Vector2<f64>,
    x: &[f64; LANES],
    y: &[f64; LANES],
) -> [f32; LANES] {
    let (mut turned_x, mut turned_y) = ([0.0; LANES], [0.0; LANES]);
    for k in 0..LANES {
        turned_x[k] = (centre.x + x[k] * down.y + y[k] * down.x) as f32;
        turned_y[k] = (centre.y - x[k] * down.x + y[k] * down.y) as f32;
    }
    sample(image, &turned_x, &turned_y)
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
    use vidar_core::Pinhole;

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
