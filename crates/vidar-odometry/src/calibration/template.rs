//! A patch of one level of an image pyramid, found in another image by inverse compositional Lucas-Kanade, free of offset and gain.

use nalgebra::{Matrix2, Vector2};
use vidar_core::Image;
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;

/// Half side of a patch, pixels of its level.
const HALF: usize = 6;
const SIDE: usize = 2 * HALF + 1;
/// A row of a patch, the pixels on both sides of it, and nothing.
const LANES: usize = 16;
/// Steps at most, and the step that ends them, pixels.
const STEPS: usize = 12;
const SETTLED_PX: f64 = 0.01;

type Row = [f32; LANES];
type Patch = [Row; SIDE];

/// A zero-mean patch with zero-mean gradients; zero beyond its side.
#[derive(Debug)]
pub(super) struct Template {
    grey: Patch,
    gx: Patch,
    gy: Patch,
    energy: f64,
    /// Sums of grey · gradient.
    own: Vector2<f64>,
    inverse: Matrix2<f64>,
}

/// Sums of an image's patch: values, squares, and products with a template's values and gradients.
#[derive(Clone, Copy)]
struct Sums {
    values: f64,
    squares: f64,
    with_grey: f64,
    with_gradient: Vector2<f64>,
}

impl Template {
    /// Of an image about `centre`; `None` at its border, and where there is nothing to hold on to.
    pub(super) fn at(image: &Image<u8>, centre: &Pixel) -> Option<Self> {
        if !fits(image, centre, HALF + 1) {
            return None;
        }
        let [mut grey, mut gx, mut gy] = [[[0.0; LANES]; SIDE]; 3];
        take(image, &Corner::of(centre, HALF + 1), &mut grey, &mut gx, &mut gy);
        let h = Matrix2::new(dot(&gx, &gx), dot(&gx, &gy), dot(&gx, &gy), dot(&gy, &gy));
        let energy = dot(&grey, &grey);
        let weak = 0.5 * (h.trace() - ((h.m11 - h.m22).powi(2) + 4.0 * h.m12 * h.m12).sqrt());
        // Below a grey level per pixel of gradient, noise decides where the patch goes.
        if !(weak > (SIDE * SIDE) as f64 && energy > 1.0) {
            return None;
        }
        let own = Vector2::new(dot(&grey, &gx), dot(&grey, &gy));
        Some(Self { grey, gx, gy, energy, own, inverse: h.try_inverse()? })
    }

    /// The place of the patch's centre, and the correlation there.
    pub(super) fn find(&self, image: &Image<u8>, start: &Pixel) -> Option<(Pixel, f64)> {
        let mut place = *start;
        for _ in 0..STEPS {
            let (step, ncc) = self.step(image, &place)?;
            place -= step;
            if !((place - start).norm() < 2.0 * SIDE as f64) {
                return None;
            }
            if step.norm() < SETTLED_PX {
                return Some((place, ncc));
            }
        }
        let (step, ncc) = self.step(image, &place)?;
        // What still moves by a pixel found nothing.
        (step.norm() < 0.5).then_some((place, ncc))
    }

    fn step(&self, image: &Image<u8>, place: &Pixel) -> Option<(Vector2<f64>, f64)> {
        if !fits(image, place, HALF) {
            return None;
        }
        let Sums { values, squares, with_grey, with_gradient } = sums(self, image, &Corner::of(place, HALF));
        let n = (SIDE * SIDE) as f64;
        let energy = (squares - values * values / n).max(1.0);
        let ncc = with_grey / (energy * self.energy).sqrt();
        // Far from the match the correlation, and with it the gain, is too small and the step too long.
        let gain = (with_grey / self.energy).max(0.5 * (energy / self.energy).sqrt()).max(0.05);
        Some((self.inverse * (with_gradient / gain - self.own), ncc))
    }
}

/// Where a patch begins, between pixels.
#[derive(Clone, Copy)]
struct Corner {
    left: usize,
    top: usize,
    right_share: f32,
    lower_share: f32,
}

impl Corner {
    fn of(centre: &Pixel, half: usize) -> Self {
        let (x, y) = (centre.x - half as f64, centre.y - half as f64);
        let (left, top) = (x as usize, y as usize);
        Self { left, top, right_share: (x - left as f64) as f32, lower_share: (y - top as f64) as f32 }
    }
}

kernel! {
    /// A patch's zero-mean values and gradients.
    fn take(image: &Image<u8>, corner: &Corner, grey: &mut Patch, gx: &mut Patch, gy: &mut Patch) {
        let mut wide = [[0.0; LANES]; SIDE + 2];
        for y in 0..SIDE + 2 {
            wide[y] = interpolated(image, corner, y);
        }
        for y in 0..SIDE {
            for x in 0..SIDE {
                grey[y][x] = wide[y + 1][x + 1];
                gx[y][x] = 0.5 * (wide[y + 1][x + 2] - wide[y + 1][x]);
                gy[y][x] = 0.5 * (wide[y + 2][x + 1] - wide[y][x + 1]);
            }
        }
        centre(grey);
        centre(gx);
        centre(gy);
    }
}

kernel! {
    /// The sums of an image's patch.
    fn sums(template: &Template, image: &Image<u8>, corner: &Corner) -> Sums {
        let [mut values, mut squares, mut with_grey, mut with_gx, mut with_gy] = [[0.0_f32; LANES]; 5];
        for y in 0..SIDE {
            let mut row = interpolated(image, corner, y);
            for lane in SIDE..LANES {
                row[lane] = 0.0;
            }
            let (grey, gx, gy) = (&template.grey[y], &template.gx[y], &template.gy[y]);
            for k in 0..LANES {
                values[k] += row[k];
                squares[k] += row[k] * row[k];
                with_grey[k] += row[k] * grey[k];
                with_gx[k] += row[k] * gx[k];
                with_gy[k] += row[k] * gy[k];
            }
        }
        Sums {
            values: total(&values),
            squares: total(&squares),
            with_grey: total(&with_grey),
            with_gradient: Vector2::new(total(&with_gx), total(&with_gy)),
        }
    }
}

/// A row of a patch; what lies beyond the image's border is no part of any patch.
#[inline(always)]
fn interpolated(image: &Image<u8>, corner: &Corner, row: usize) -> Row {
    let (upper, lower) =
        (pixels(image, corner.left, corner.top + row), pixels(image, corner.left, corner.top + row + 1));
    let (right, below) = (corner.right_share, corner.lower_share);
    let mut out = [0.0; LANES];
    for k in 0..LANES {
        let a = f32::from(upper[k]) * (1.0 - right) + f32::from(upper[k + 1]) * right;
        let b = f32::from(lower[k]) * (1.0 - right) + f32::from(lower[k + 1]) * right;
        out[k] = a * (1.0 - below) + b * below;
    }
    out
}

#[inline(always)]
fn pixels(image: &Image<u8>, left: usize, row: usize) -> [u8; LANES + 1] {
    let rest = &image.row(row)[left..];
    let mut out = [0; LANES + 1];
    match rest.first_chunk() {
        Some(whole) => out = *whole,
        None => out[..rest.len()].copy_from_slice(rest),
    }
    out
}

/// Takes the mean off a patch.
#[inline(always)]
fn centre(patch: &mut Patch) {
    let mut sums = [0.0_f32; LANES];
    for row in patch.iter() {
        for k in 0..LANES {
            sums[k] += row[k];
        }
    }
    let mean = (total(&sums) / (SIDE * SIDE) as f64) as f32;
    for row in patch.iter_mut() {
        for x in 0..SIDE {
            row[x] -= mean;
        }
    }
}

kernel! {
    /// Sum of the products of two patches.
    fn dot(a: &Patch, b: &Patch) -> f64 {
        let mut sums = [0.0_f32; LANES];
        for y in 0..SIDE {
            for k in 0..LANES {
                sums[k] += a[y][k] * b[y][k];
            }
        }
        total(&sums)
    }
}

#[inline(always)]
fn total(sums: &Row) -> f64 {
    let mut total = 0.0;
    for value in sums {
        total += f64::from(*value);
    }
    total
}

/// Whether a patch of half side `half` with its right and lower neighbours lies in the image; written so that NaN fails.
fn fits(image: &Image<u8>, centre: &Pixel, half: usize) -> bool {
    let half = half as f64;
    centre.x >= half
        && centre.y >= half
        && centre.x + half + 1.0 < image.width() as f64 - 1.0
        && centre.y + half + 1.0 < image.height() as f64 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::testing::same_with_each_instruction_set;

    /// Waves, brighter and with more contrast in the second image, which is shifted.
    fn waves(shift: Pixel, gain: f64, offset: f64) -> Image<u8> {
        Image::from_fn(64, 48, |x, y| {
            let (x, y) = (x as f64 - shift.x, y as f64 - shift.y);
            let wave = (0.31 * x + 0.12 * y).sin() + (0.27 * y - 0.09 * x).cos() + (0.17 * (x + y)).sin();
            (offset + gain * wave).round() as u8
        })
    }

    #[test]
    fn a_patch_is_found_where_it_was_moved_to_whatever_the_instructions() {
        let shift = Pixel::new(2.3, -1.6);
        let (first, second) = (waves(Pixel::zeros(), 30.0, 100.0), waves(shift, 36.0, 120.0));
        // The last one ends with the last column that a patch may have.
        for at in [Pixel::new(20.25, 20.5), Pixel::new(30.0, 25.0), Pixel::new(52.9, 30.25)] {
            let (place, ncc) = same_with_each_instruction_set(|| {
                let found = Template::at(&first, &at).unwrap().find(&second, &at);
                found.map(|(place, ncc)| ([place.x.to_bits(), place.y.to_bits()], ncc.to_bits())).unwrap()
            });
            let place = Pixel::new(f64::from_bits(place[0]), f64::from_bits(place[1]));
            assert!((place - at - shift).norm() < 0.03, "{place:?} for {at:?}");
            assert!(f64::from_bits(ncc) > 0.999);
        }
        assert!(Template::at(&first, &Pixel::new(6.9, 20.0)).is_none());
        assert!(Template::at(&first, &Pixel::new(55.0, 20.0)).is_none());
    }

    #[test]
    fn a_patch_without_texture_is_none() {
        assert!(Template::at(&Image::from_fn(64, 48, |x, _| x as u8), &Pixel::new(20.0, 20.0)).is_none());
    }
}
