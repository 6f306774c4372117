//! A surface at twice the size, continued along its local slopes.
//!
//! On a plane in space the inverse depth is affine in the pixel (`warp`), so a plane fitted around each coarse pixel
//! continues the surface between the pixels. The fit takes those of the 5 × 5 pixels around that lie on the same surface.

use rayon::prelude::*;
use vidar_core::simd::kernel;

/// Pixels of the fit on each side.
const REACH: usize = 2;
/// Differences of more than this many steps are another surface.
const SAME_SURFACE_STEPS: f32 = 1.5;
/// Fewest pixels for a fit; with fewer the pixel's own value is repeated.
const FEWEST: f32 = 8.0;
/// Coarse rows that one task continues.
const ROWS: usize = 16;

/// Values at every pixel of an image.
#[derive(Clone, Copy)]
pub(crate) struct Grid<'a> {
    pub width: usize,
    pub height: usize,
    /// NaN where there is none.
    pub values: &'a [f32],
}

/// The surface at `width × height`, twice the size of `coarse` or one more; adjacent values of one surface differ by little
/// more than `step`.
pub(crate) fn doubled(coarse: Grid<'_>, width: usize, height: usize, step: f32) -> Vec<f32> {
    let padded_width = coarse.width + 2 * REACH;
    let mut padded = vec![f32::NAN; padded_width * (coarse.height + 2 * REACH)];
    let inner = padded[REACH * padded_width..].chunks_exact_mut(padded_width);
    for (row, values) in inner.zip(coarse.values.chunks_exact(coarse.width)) {
        row[REACH..REACH + coarse.width].copy_from_slice(values);
    }
    let mut out = vec![f32::NAN; width * height];
    out.par_chunks_mut(2 * ROWS * width).enumerate().for_each(|(strip, rows)| {
        let mut fit = Fit::new(coarse.width);
        let mut fitted = None;
        for (i, row) in rows.chunks_exact_mut(width).enumerate() {
            let y = 2 * ROWS * strip + i;
            // An odd last row continues the last coarse one.
            let from = (y / 2).min(coarse.height - 1);
            if fitted != Some(from) {
                fit_row(&mut fit, &padded, from, SAME_SURFACE_STEPS * step);
                fitted = Some(from);
            }
            fit.continued(offset(y, from), row);
        }
    });
    out
}

/// Where fine pixel `p` lies from the centre of coarse pixel `c`, coarse pixels.
fn offset(p: usize, c: usize) -> f32 {
    (p as f32 + 0.5) * 0.5 - 0.5 - c as f32
}

/// Planes of one row of coarse pixels.
struct Fit {
    rho: Vec<f32>,
    across: Vec<f32>,
    down: Vec<f32>,
    /// Count of pixels, and sums of dx², dy², dx·dρ, dy·dρ, dρ.
    sums: [Vec<f32>; 6],
}

kernel! {
    fn fit_row(fit: &mut Fit, padded: &[f32], y: usize, same_surface: f32) {
        fit.row(padded, y, same_surface);
    }
}

impl Fit {
    fn new(width: usize) -> Self {
        let blank = || vec![0.0; width];
        Self { rho: blank(), across: blank(), down: blank(), sums: std::array::from_fn(|_| blank()) }
    }

    #[inline(always)]
    fn row(&mut self, padded: &[f32], y: usize, same_surface: f32) {
        let width = self.rho.len();
        let padded_width = width + 2 * REACH;
        self.sums.iter_mut().for_each(|s| s.fill(0.0));
        let [count, xx, yy, xr, yr, sum] = &mut self.sums;
        let (count, xx, yy) = (&mut count[..width], &mut xx[..width], &mut yy[..width]);
        let (xr, yr, sum) = (&mut xr[..width], &mut yr[..width], &mut sum[..width]);
        let own = &padded[(y + REACH) * padded_width + REACH..][..width];
        for j in 0..=2 * REACH {
            for i in 0..=2 * REACH {
                let other = &padded[(y + j) * padded_width + i..][..width];
                let (dx, dy) = (i as f32 - REACH as f32, j as f32 - REACH as f32);
                for x in 0..width {
                    let difference = other[x] - own[x];
                    // A NaN fails the comparison.
                    let same = difference.abs() < same_surface;
                    let (difference, one) = if same { (difference, 1.0) } else { (0.0, 0.0) };
                    count[x] += one;
                    xx[x] += dx * dx * one;
                    yy[x] += dy * dy * one;
                    xr[x] += dx * difference;
                    yr[x] += dy * difference;
                    sum[x] += difference;
                }
            }
        }
        for x in 0..width {
            // The window is symmetric but for its holes, so the mixed terms are neglected.
            let enough = count[x] >= FEWEST;
            self.rho[x] = own[x] + if enough { sum[x] / count[x] } else { 0.0 };
            self.across[x] = if enough { xr[x] / xx[x].max(1.0) } else { 0.0 };
            self.down[x] = if enough { yr[x] / yy[x].max(1.0) } else { 0.0 };
        }
    }

    /// One fine row, `down` coarse pixels below the centres of the fitted row.
    fn continued(&self, down: f32, out: &mut [f32]) {
        let last = self.rho.len() - 1;
        for (x, value) in out.iter_mut().enumerate() {
            let c = (x / 2).min(last);
            *value = self.rho[c] + self.across[c] * offset(x, c) + self.down[c] * down;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_is_continued_exactly_and_a_step_stays_sharp() {
        let (width, height) = (12, 9);
        let plane = |x: f32, y: f32| 0.5 + 0.01 * x - 0.005 * y;
        // Behind x = 6 another surface.
        let at = |x: usize, y: usize| plane(x as f32, y as f32) + if x >= 6 { 1.0 } else { 0.0 };
        let values: Vec<f32> = (0..width * height).map(|i| at(i % width, i / width)).collect();
        let fine = doubled(Grid { width, height, values: &values }, 25, 18, 0.05);
        for (x, y) in (4..19).flat_map(|x| (4..14).map(move |y| (x, y))) {
            let expected =
                plane(0.5 * x as f32 - 0.25, 0.5 * y as f32 - 0.25) + if x >= 12 { 1.0 } else { 0.0 };
            // Beside the step the window has holes, and the neglected terms show.
            let limit = if (8..16).contains(&x) { 0.02 } else { 1e-5 };
            assert!((fine[y * 25 + x] - expected).abs() < limit, "{x} {y}: {} {expected}", fine[y * 25 + x]);
        }
    }

    #[test]
    fn the_bits_do_not_depend_on_the_instructions() {
        let values: Vec<f32> = (0..31 * 22)
            .map(|i| if i % 13 == 0 { f32::NAN } else { 0.4 + 0.01 * ((i * 7919) % 17) as f32 })
            .collect();
        let run = || -> Vec<u32> {
            let fine = doubled(Grid { width: 31, height: 22, values: &values }, 63, 45, 0.03);
            fine.into_iter().map(f32::to_bits).collect()
        };
        assert!(!vidar_core::testing::same_with_each_instruction_set(run).is_empty());
    }
}
