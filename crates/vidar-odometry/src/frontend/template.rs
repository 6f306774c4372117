//! What a keyframe's feature should look like in another frame.
//!
//! The surface is taken to be a plane across the viewing ray at the feature's distance. Its map into the current image is
//! linearised to a 2×2 matrix: `A = J_cur · R · B · (J_key · B)⁻¹`, with B two tangents of the ray, J the cameras'
//! projection Jacobians at the point and R the relative rotation. No finite differences, and no need of a pinhole.

use super::feature::{Feature, FeatureKind};
use super::patch::sample;
use super::pyramid::{Pyramid, level_scale, to_level};
use nalgebra::{Matrix2, Matrix3x2, Vector2, Vector3};
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;
use vidar_core::{CameraModel, Se3, So3};

/// Side of the patch that is aligned, pixels.
pub(crate) const SIDE: usize = 8;
/// Side with the border that central differences need.
const BORDERED: usize = SIDE + 2;

/// Where a feature is expected and how its surroundings are deformed on the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Warp {
    /// Expected position in the current image, level-0 pixels.
    pub pixel: Pixel,
    /// Derivative of the current pixel by the keyframe's pixel, both of level 0.
    pub d_current_d_keyframe: Matrix2<f64>,
}

impl Warp {
    /// The warp of `feature` at `inverse_distance` (1/m along the ray; 0 is infinitely far).
    ///
    /// `None` when the point is behind the current camera, outside its model, or the map degenerates.
    pub fn new(
        camera: &CameraModel,
        feature: &Feature,
        inverse_distance: f64,
        current_from_keyframe: &Se3,
    ) -> Option<Self> {
        let in_keyframe = feature.bearing;
        // Everything is scaled by the inverse distance, so that infinity needs no case of its own.
        let in_current = current_from_keyframe.rotation * in_keyframe
            + current_from_keyframe.translation * inverse_distance;
        let (_, j_key) = camera.project_with_jacobian(&in_keyframe)?;
        let (pixel, j_current) = camera.project_with_jacobian(&in_current)?;
        let tangents = tangents(&in_keyframe);
        let key_pixels = (j_key * tangents).try_inverse()?;
        let rotated = current_from_keyframe.rotation.matrix() * tangents;
        let d_current_d_keyframe = j_current * rotated * key_pixels;
        let determinant = d_current_d_keyframe.determinant();
        // A mirrored or collapsed patch cannot be matched; a fourfold change of size is past any level.
        (determinant > 1.0 / 64.0 && determinant < 64.0).then_some(Self { pixel, d_current_d_keyframe })
    }

    /// The warp of a feature when the camera only turned, which is right for what is far away.
    pub fn rotated(camera: &CameraModel, feature: &Feature, current_from_keyframe: &So3) -> Option<Self> {
        Self::new(camera, feature, 0.0, &Se3::new(*current_from_keyframe, Vector3::zeros()))
    }

    /// A warp that only shifts.
    pub fn shift(pixel: Pixel) -> Self {
        Self { pixel, d_current_d_keyframe: Matrix2::identity() }
    }

    /// The level of the current image on which the keyframe's patch of `level` has its own resolution.
    ///
    /// Forster 2014: the smallest level on which the patch covers at most three times its pixels.
    pub fn search_level(&self, level: u8, level_count: usize) -> usize {
        let mut area = self.d_current_d_keyframe.determinant() * level_scale(level.into()).powi(2);
        let mut found = 0;
        while area > 3.0 && found + 1 < level_count {
            area *= 0.25;
            found += 1;
        }
        found
    }
}

/// Two unit vectors across a unit vector and across each other.
pub(crate) fn tangents(direction: &Vector3<f64>) -> Matrix3x2<f64> {
    let other = if direction.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
    let first = direction.cross(&other).normalize();
    Matrix3x2::from_columns(&[first, direction.cross(&first)])
}

/// A feature's surroundings as the current frame should show them, ready for inverse-compositional alignment.
///
/// Intensities have zero mean; gradients are made orthogonal to the constant and to the intensities, so that offset and
/// gain drop out of the alignment (variable projection).
#[derive(Clone, Debug)]
pub struct Template {
    /// Level of the current image to align on.
    pub(crate) level: usize,
    /// Expected position, level-0 pixels.
    pub(crate) pixel: Pixel,
    /// Zero-mean grey levels, row by row.
    pub(crate) intensity: [f32; SIDE * SIDE],
    /// Gradient along x, projected.
    pub(crate) gx: [f32; SIDE * SIDE],
    /// Gradient along y, projected.
    pub(crate) gy: [f32; SIDE * SIDE],
    /// Sum of squared zero-mean grey levels.
    pub(crate) energy: f64,
    /// `Σ g gᵀ` of the projected gradients.
    pub(crate) hessian: Matrix2<f64>,
    /// Share of clipped pixels.
    pub(crate) saturated_share: f64,
    /// Direction across the edge in the current image, when the feature is an edgelet.
    pub(crate) normal: Option<Vector2<f64>>,
}

impl Template {
    /// Nothing yet; a buffer for [`Template::fill`].
    pub fn empty() -> Self {
        Self {
            level: 0,
            pixel: Pixel::zeros(),
            intensity: [0.0; SIDE * SIDE],
            gx: [0.0; SIDE * SIDE],
            gy: [0.0; SIDE * SIDE],
            energy: 0.0,
            hessian: Matrix2::zeros(),
            saturated_share: 0.0,
            normal: None,
        }
    }

    /// Samples `keyframe` around `feature` as `warp` shows it.
    ///
    /// Returns whether the patch lies inside the keyframe and has texture; otherwise the template must not be used.
    #[must_use]
    pub fn fill(&mut self, keyframe: &Pyramid, feature: &Feature, warp: &Warp) -> bool {
        self.level = warp.search_level(feature.level, keyframe.level_count());
        self.pixel = warp.pixel;
        self.normal = match feature.kind {
            FeatureKind::Corner => None,
            // Normals map with the transposed inverse of what maps positions.
            FeatureKind::Edgelet { normal } => warp
                .d_current_d_keyframe
                .try_inverse()
                .and_then(|inverse| (inverse.transpose() * normal).try_normalize(1e-9)),
        };
        if self.normal.is_none() && feature.is_edgelet() {
            return false;
        }
        let Some(key_from_current) = warp.d_current_d_keyframe.try_inverse() else { return false };
        // Sampled from the level of the keyframe where a step of one pixel stays about one pixel.
        let step = level_scale(self.level) * key_from_current.determinant().abs().sqrt();
        let source = (step.log2().round().max(0.0) as usize).min(keyframe.level_count() - 1);
        let centre = to_level(&feature.pixel, source);
        let steps = key_from_current * (level_scale(self.level) / level_scale(source));
        sample_from(self, keyframe, source, &centre, &steps) && self.prepare()
    }

    #[inline(always)]
    fn sample_from(
        &mut self,
        keyframe: &Pyramid,
        source: usize,
        centre: &Pixel,
        steps: &Matrix2<f64>,
    ) -> bool {
        let image = keyframe.level(source);
        let half = 0.5 * (BORDERED as f64 - 1.0);
        let reach = steps.abs() * Vector2::repeat(half);
        let inside = centre.x - reach.x >= 0.0
            && centre.y - reach.y >= 0.0
            && centre.x + reach.x < image.width() as f64 - 1.0
            && centre.y + reach.y < image.height() as f64 - 1.0;
        if !inside {
            return false;
        }
        let corner = centre - steps * Vector2::repeat(half);
        let (cx, cy) = (corner.x as f32, corner.y as f32);
        let [xx, yx, xy, yy] = [steps.m11 as f32, steps.m21 as f32, steps.m12 as f32, steps.m22 as f32];
        let (max_x, max_y) = ((image.width() - 2) as f32, (image.height() - 2) as f32);
        let mut patch = [[0.0_f32; BORDERED]; BORDERED];
        for (j, row) in patch.iter_mut().enumerate() {
            let (rx, ry) = (cx + j as f32 * xy, cy + j as f32 * yy);
            let (mut x, mut y) = ([0.0; BORDERED], [0.0; BORDERED]);
            for i in 0..BORDERED {
                // Rounding to f32 may step over the border that was checked in f64.
                x[i] = (rx + i as f32 * xx).clamp(0.0, max_x);
                y[i] = (ry + i as f32 * yx).clamp(0.0, max_y);
            }
            *row = sample(image, &x, &y);
        }
        for j in 0..SIDE {
            for i in 0..SIDE {
                let at = j * SIDE + i;
                self.intensity[at] = patch[j + 1][i + 1];
                self.gx[at] = 0.5 * (patch[j + 1][i + 2] - patch[j + 1][i]);
                self.gy[at] = 0.5 * (patch[j + 2][i + 1] - patch[j][i + 1]);
            }
        }
        true
    }

    /// Removes mean and gain from intensities and gradients; whether enough texture is left.
    fn prepare(&mut self) -> bool {
        let n = (SIDE * SIDE) as f32;
        let clipped = self.intensity.iter().filter(|v| **v > 254.5).count();
        self.saturated_share = clipped as f64 / f64::from(n);
        for channel in [&mut self.intensity, &mut self.gx, &mut self.gy] {
            let mean = channel.iter().sum::<f32>() / n;
            channel.iter_mut().for_each(|v| *v -= mean);
        }
        self.energy = dot(&self.intensity, &self.intensity);
        if self.energy < MIN_ENERGY {
            return false;
        }
        for channel in [&mut self.gx, &mut self.gy] {
            let share = (dot(channel, &self.intensity) / self.energy) as f32;
            channel.iter_mut().zip(&self.intensity).for_each(|(g, i)| *g -= share * i);
        }
        let xy = dot(&self.gx, &self.gy);
        self.hessian = Matrix2::new(dot(&self.gx, &self.gx), xy, xy, dot(&self.gy, &self.gy));
        true
    }
}

kernel! {
    fn sample_from(
        template: &mut Template,
        keyframe: &Pyramid,
        source: usize,
        centre: &Pixel,
        steps: &Matrix2<f64>,
    ) -> bool {
        template.sample_from(keyframe, source, centre, steps)
    }
}

/// Least sum of squares of a patch that has texture: a contrast of one grey level, below any camera's noise.
const MIN_ENERGY: f64 = (SIDE * SIDE) as f64;

fn dot(a: &[f32; SIDE * SIDE], b: &[f32; SIDE * SIDE]) -> f64 {
    let mut lanes = [0.0_f32; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for i in 0..8 {
            lanes[i] += x[i] * y[i];
        }
    }
    f64::from(super::patch::sum8(&lanes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::LieGroup;
    use vidar_core::random::SplitMix64;
    use vidar_core::testing::check_jacobian;

    #[test]
    fn the_warp_is_the_derivative_of_the_map_through_the_plane() {
        let mut random = SplitMix64::new(4);
        for camera in CameraModel::examples() {
            let centre = Pixel::new(camera.intrinsics().cx + 60.0, camera.intrinsics().cy - 40.0);
            let Some(feature) = Feature::new(&camera, centre, 0, FeatureKind::Corner) else { continue };
            for inverse_distance in [0.0, 0.1, 0.6] {
                let current_from_keyframe =
                    Se3::new(So3::exp(&(random.normal3() * 0.1)), random.normal3() * 0.1);
                let warp = Warp::new(&camera, &feature, inverse_distance, &current_from_keyframe).unwrap();
                let through = |key: &Pixel| -> Vector2<f64> {
                    let ray = camera.unproject(key).unwrap();
                    // On the plane across the bearing, at the bearing's distance (scaled, so that infinity works).
                    let scaled = ray / ray.dot(&feature.bearing);
                    let turned = current_from_keyframe.rotation * scaled;
                    camera.project(&(turned + current_from_keyframe.translation * inverse_distance)).unwrap()
                };
                assert!((through(&centre) - warp.pixel).norm() < 1e-9);
                // The cameras' own inverses are exact to 1e-10 or so, which differences enlarge.
                check_jacobian("warp", &warp.d_current_d_keyframe, through, &centre, 1e-6).unwrap();
            }
        }
    }

    #[test]
    fn a_patch_that_grows_is_looked_for_on_a_coarser_level() {
        let warp =
            |scale: f64| Warp { pixel: Pixel::zeros(), d_current_d_keyframe: Matrix2::identity() * scale };
        assert_eq!(warp(1.0).search_level(0, 5), 0);
        assert_eq!(warp(2.0).search_level(0, 5), 1);
        assert_eq!(warp(1.0).search_level(2, 5), 2);
        assert_eq!(warp(0.6).search_level(2, 5), 1);
        assert_eq!(warp(8.0).search_level(2, 3), 2);
    }

    #[test]
    fn what_is_behind_or_collapses_has_no_warp() {
        let camera = CameraModel::examples().remove(0);
        let centre = Pixel::new(camera.intrinsics().cx, camera.intrinsics().cy);
        let feature = Feature::new(&camera, centre, 0, FeatureKind::Corner).unwrap();
        let back = Se3::from_translation(Vector3::new(0.0, 0.0, -3.0));
        assert!(Warp::new(&camera, &feature, 1.0, &back).is_none());
        let far_away = Se3::from_translation(Vector3::new(0.0, 0.0, 50.0));
        assert!(Warp::new(&camera, &feature, 1.0, &far_away).is_none());
    }

    #[test]
    fn gradients_are_orthogonal_to_the_constant_and_to_the_intensities() {
        let image = vidar_core::Image::from_fn(64, 64, |x, y| ((x * x + 3 * y * x + 7 * y) % 200) as u8);
        let pyramid = Pyramid::of(&image, 2);
        let feature = Feature {
            pixel: Pixel::new(30.0, 31.0),
            global_pixel: Pixel::new(30.0, 31.0),
            bearing: Vector3::z(),
            level: 0,
            kind: FeatureKind::Corner,
        };
        let mut template = Template::empty();
        assert!(template.fill(&pyramid, &feature, &Warp::shift(feature.pixel)));
        for gradient in [&template.gx, &template.gy] {
            assert!(gradient.iter().sum::<f32>().abs() < 0.1);
            assert!(dot(gradient, &template.intensity).abs() < 1e-3 * template.energy);
        }
    }
}
