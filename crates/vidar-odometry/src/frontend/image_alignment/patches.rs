//! The patches of sparse image alignment: their constant sums in the reference, their moments in the current image.
//!
//! Everything that Gauss-Newton needs of a patch is a handful of sums, because the Jacobian of all its pixels is the same
//! 2×6 matrix behind the pixel's gradient. Pixels are therefore read once an iteration, whatever gain and weight are.

use super::super::patch::Bilinear;
use super::super::pyramid::{Pyramid, level_scale, to_level};
use nalgebra::{Matrix2, Matrix2x6, Vector2, Vector3};
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;
use vidar_core::{CameraModel, Image, LieGroup, Se3};

/// Side of a patch, pixels.
pub(super) const SIDE: usize = 4;
/// Pixels of a patch.
pub(super) const PIXELS: f64 = (SIDE * SIDE) as f64;
const BORDERED: usize = SIDE + 2;

/// One point with its surroundings.
#[derive(Clone, Debug)]
pub(super) struct Patch {
    /// Which reference it belongs to.
    pub reference: usize,
    pub pixel: Pixel,
    /// The point in its reference's camera, times the inverse distance.
    pub scaled_point: Vector3<f64>,
    pub inverse_distance: f64,
    /// Level-0 pixel in the reference by a perturbation of the anchor, [rotation, translation].
    pub d_pixel_d_anchor: Matrix2x6<f64>,
    /// Whether the reference shows it on the present level.
    pub usable: bool,
    pub intensity: [f32; SIDE * SIDE],
    pub gx: [f32; SIDE * SIDE],
    pub gy: [f32; SIDE * SIDE],
    pub constant: ReferenceSums,
    /// What the current image shows; `None` outside.
    pub seen: Option<Moments>,
    pub weight: f64,
}

/// Sums over the reference patch, T its grey levels and g its gradient by level-0 pixels.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ReferenceSums {
    pub gg: Matrix2<f64>,
    pub gt: Vector2<f64>,
    pub g: Vector2<f64>,
    pub tt: f64,
    pub t: f64,
}

/// Sums over the current patch I with the reference's.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Moments {
    pub gi: Vector2<f64>,
    pub ti: f64,
    pub i: f64,
    pub ii: f64,
}

kernel! {
    fn read_reference(patch: &mut Patch, image: &Image<u8>, corner: &Pixel, level: usize) -> bool {
        patch.read_reference(image, corner, level)
    }
}

kernel! {
    fn moments(patch: &Patch, image: &Image<u8>, corner: &Pixel) -> Option<Moments> {
        patch.moments(image, corner)
    }
}

impl Patch {
    /// `None` where the camera does not hold for the point.
    pub fn new(
        camera: &CameraModel,
        reference: usize,
        anchor_from_reference: &Se3,
        pixel: Pixel,
        bearing: &Vector3<f64>,
        inverse_distance: f64,
    ) -> Option<Self> {
        let (_, d_pixel_d_point) = camera.project_with_jacobian(bearing)?;
        let in_anchor =
            anchor_from_reference.rotation * *bearing + anchor_from_reference.translation * inverse_distance;
        let d_pixel_d_shift = d_pixel_d_point * anchor_from_reference.rotation.inverse().matrix();
        let mut d_pixel_d_anchor = Matrix2x6::zeros();
        // p' = p + θ × p + ρ, all times the inverse distance.
        d_pixel_d_anchor.fixed_columns_mut::<3>(0).copy_from(&(-d_pixel_d_shift * in_anchor.cross_matrix()));
        d_pixel_d_anchor.fixed_columns_mut::<3>(3).copy_from(&(d_pixel_d_shift * inverse_distance));
        Some(Self {
            reference,
            pixel,
            scaled_point: *bearing,
            inverse_distance,
            d_pixel_d_anchor,
            usable: false,
            intensity: [0.0; SIDE * SIDE],
            gx: [0.0; SIDE * SIDE],
            gy: [0.0; SIDE * SIDE],
            constant: ReferenceSums::default(),
            seen: None,
            weight: 1.0,
        })
    }

    /// Reads the reference's patch on `level`.
    pub fn prepare(&mut self, reference: &Pyramid, level: usize) {
        let image = reference.level(level);
        let corner = to_level(&self.pixel, level).add_scalar(-0.5 * (BORDERED as f64 - 1.0));
        self.usable = read_reference(self, image, &corner, level);
    }

    #[inline(always)]
    fn read_reference(&mut self, image: &Image<u8>, corner: &Pixel, level: usize) -> bool {
        let Some(at) = Bilinear::for_patch(image, corner.x, corner.y, BORDERED) else { return false };
        let mut rows = [[0.0_f32; BORDERED]; BORDERED];
        for (j, row) in rows.iter_mut().enumerate() {
            *row = at.row(image, j);
        }
        // Gradients per pixel of level 0.
        let half = (0.5 / level_scale(level)) as f32;
        for j in 0..SIDE {
            for i in 0..SIDE {
                let k = j * SIDE + i;
                self.intensity[k] = rows[j + 1][i + 1];
                self.gx[k] = half * (rows[j + 1][i + 2] - rows[j + 1][i]);
                self.gy[k] = half * (rows[j + 2][i + 1] - rows[j][i + 1]);
            }
        }
        let ones = [1.0_f32; SIDE * SIDE];
        let xy = dot(&self.gx, &self.gy);
        self.constant = ReferenceSums {
            gg: Matrix2::new(dot(&self.gx, &self.gx), xy, xy, dot(&self.gy, &self.gy)),
            gt: Vector2::new(dot(&self.gx, &self.intensity), dot(&self.gy, &self.intensity)),
            g: Vector2::new(dot(&self.gx, &ones), dot(&self.gy, &ones)),
            tt: dot(&self.intensity, &self.intensity),
            t: dot(&self.intensity, &ones),
        };
        true
    }

    /// Reads the current image on `level` where `current_from_reference` puts the point.
    pub fn look(
        &mut self,
        camera: &CameraModel,
        current: &Image<u8>,
        level: usize,
        current_from_reference: &Se3,
    ) {
        self.seen = None;
        if !self.usable {
            return;
        }
        let point = current_from_reference.rotation * self.scaled_point
            + current_from_reference.translation * self.inverse_distance;
        let Some(pixel) = camera.project(&point) else { return };
        let corner = to_level(&pixel, level).add_scalar(-0.5 * (SIDE as f64 - 1.0));
        self.seen = moments(self, current, &corner);
    }

    #[inline(always)]
    fn moments(&self, image: &Image<u8>, corner: &Pixel) -> Option<Moments> {
        let at = Bilinear::for_patch(image, corner.x, corner.y, SIDE)?;
        let mut current = [0.0_f32; SIDE * SIDE];
        for row in 0..SIDE {
            let values: [f32; SIDE] = at.row(image, row);
            current[row * SIDE..(row + 1) * SIDE].copy_from_slice(&values);
        }
        Some(Moments {
            gi: Vector2::new(dot(&self.gx, &current), dot(&self.gy, &current)),
            ti: dot(&self.intensity, &current),
            i: dot(&[1.0; SIDE * SIDE], &current),
            ii: dot(&current, &current),
        })
    }

    /// Sum of squared residuals `I − a·T − b`, when seen.
    pub fn squared_residual(&self, gain: f64, offset: f64) -> Option<f64> {
        let (m, c) = (self.seen.as_ref()?, &self.constant);
        let sum = m.ii - 2.0 * (gain * m.ti + offset * m.i)
            + gain * gain * c.tt
            + 2.0 * gain * offset * c.t
            + PIXELS * offset * offset;
        Some(sum.max(0.0))
    }
}

/// Products are exact enough in f32 (24 bits of 16-bit products); lanes are added in a fixed order.
#[inline(always)]
fn dot(a: &[f32; SIDE * SIDE], b: &[f32; SIDE * SIDE]) -> f64 {
    let mut lanes = [0.0_f32; 8];
    for k in 0..8 {
        lanes[k] = a[k] * b[k] + a[k + 8] * b[k + 8];
    }
    f64::from(super::super::patch::sum8(&lanes))
}
