//! Corners of a view, and their search in another.

use crate::prepare::{GRAY_STEPS, Level};
use nalgebra::{Matrix2, Vector2};
use vidar_core::simd::kernel;

/// One corner per square of this size, working pixels.
const CELL_PX: usize = 20;
/// Radius of a corner's template.
pub(super) const TEMPLATE: usize = 4;
const SIDE: usize = 2 * TEMPLATE + 1;
const AREA: usize = SIDE * SIDE;
/// Radius of the search around the predicted position, working pixels.
const SEARCH: usize = 6;
/// Shifts in one direction.
const SHIFTS: usize = 2 * SEARCH + 1;
/// Shifts across, padded for vectors.
const LANES: usize = 16;
/// Rows and (padded) columns that the shifted templates cover.
const ROWS: usize = SHIFTS + SIDE - 1;
const COLUMNS: usize = LANES + SIDE - 1;
/// Least normalised correlation of a match.
const MIN_CORRELATION: f32 = 0.85;
/// Pixels around a match in which other shifts belong to the same peak.
const PEAK_RADIUS: usize = 2;
/// How much farther from a perfect correlation every shift beyond the peak must be: what repeats (tiles, books, the rim of a shelf)
/// matches wrongly where poses are off by some pixels. F@0.05 of stereo's map on given poses without it and at 1.5, 2 and 3: redkitchen
/// .459, .507, .540, .529, on which 2 was chosen; HoloLens .757 each.
const UNIQUENESS: f32 = 2.0;

/// The best corner of each square by the smaller eigenvalue of the structure tensor (Shi and Tomasi 1994).
pub(super) fn corners(level: &Level) -> Vec<(usize, usize)> {
    let (w, h) = (level.width, level.height);
    let margin = TEMPLATE + 1;
    let mut out = Vec::new();
    let mut tensor = Tensor::new(w);
    for top in (margin..h.saturating_sub(margin)).step_by(CELL_PX) {
        let cells = (margin..w.saturating_sub(margin)).step_by(CELL_PX);
        let mut best = vec![(0.0f32, None); cells.clone().count()];
        // Every other pixel: a corner is wider than that, and the match is found to a fraction of a pixel anyway.
        for y in (top..(top + CELL_PX).min(h - margin)).step_by(2) {
            tensor_row(&mut tensor, level, y);
            for (best, left) in best.iter_mut().zip(cells.clone()) {
                for x in (left..(left + CELL_PX).min(w - margin)).step_by(2) {
                    if tensor.strength[x] > best.0 {
                        *best = (tensor.strength[x], Some((x, y)));
                    }
                }
            }
        }
        out.extend(best.into_iter().filter_map(|b| b.1));
    }
    out
}

kernel! {
    fn tensor_row(tensor: &mut Tensor, level: &Level, y: usize) {
        tensor.row(level, y);
    }
}

kernel! {
    fn correlate(
        template: &Template,
        around: &[[f32; COLUMNS]; ROWS],
        correlations: &mut [[f32; LANES]; SHIFTS],
    ) {
        template.correlate(around, correlations);
    }
}

/// Strength of the corners in one row.
struct Tensor {
    /// Column sums of gx², gx·gy, gy² over the window's rows.
    columns: [Vec<f32>; 3],
    strength: Vec<f32>,
}

impl Tensor {
    /// Radius of the window.
    const REACH: usize = 2;

    fn new(width: usize) -> Self {
        Self { columns: std::array::from_fn(|_| vec![0.0; width]), strength: vec![0.0; width] }
    }

    /// Row `y`, at least one pixel more than the window from the border.
    #[inline(always)]
    fn row(&mut self, level: &Level, y: usize) {
        let w = level.width;
        let [xx, xy, yy] = &mut self.columns;
        let (xx, xy, yy) = (&mut xx[..w], &mut xy[..w], &mut yy[..w]);
        for column in [&mut *xx, &mut *xy, &mut *yy] {
            column.fill(0.0);
        }
        for row in y - Self::REACH..=y + Self::REACH {
            let own = &level.gray[row * w..][..w];
            let (above, below) = (&level.gray[(row - 1) * w..][..w], &level.gray[(row + 1) * w..][..w]);
            for x in 1..w - 1 {
                let gx = (i32::from(own[x + 1]) - i32::from(own[x - 1])) as f32;
                let gy = (i32::from(below[x]) - i32::from(above[x])) as f32;
                xx[x] += gx * gx;
                xy[x] += gx * gy;
                yy[x] += gy * gy;
            }
        }
        let strength = &mut self.strength[..w];
        for x in Self::REACH..w - Self::REACH {
            let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
            for i in x - Self::REACH..=x + Self::REACH {
                a += xx[i];
                b += xy[i];
                c += yy[i];
            }
            strength[x] = 0.5 * (a + c - ((a - c) * (a - c) + 4.0 * b * b).sqrt());
        }
    }
}

/// A window of grey levels, with zero mean.
pub(super) struct Template {
    gray: [[f32; SIDE]; SIDE],
    /// Sum of squares.
    square: f32,
}

impl Template {
    pub fn cut(level: &Level, x: usize, y: usize) -> Option<Self> {
        if x < TEMPLATE || y < TEMPLATE || x + TEMPLATE >= level.width || y + TEMPLATE >= level.height {
            return None;
        }
        let mut gray = [[0.0; SIDE]; SIDE];
        for (j, target) in gray.iter_mut().enumerate() {
            let row = &level.gray[(y - TEMPLATE + j) * level.width + x - TEMPLATE..][..SIDE];
            *target = std::array::from_fn(|i| f32::from(row[i]));
        }
        Some(Self::centred(gray))
    }

    /// The window as another view sees it, whose pixels lie at `own_from_other` in this one; `None` beyond the border, and where it reaches
    /// what must not be used.
    pub fn warped(level: &Level, x: usize, y: usize, own_from_other: &Matrix2<f32>) -> Option<Self> {
        let reach = TEMPLATE as f32;
        let (x, y) = (x as f32, y as f32);
        let extent = own_from_other.abs() * Vector2::repeat(reach);
        let (last_x, last_y) = ((level.width - 1) as f32, (level.height - 1) as f32);
        // Four pixels around each position, so strictly less than the last one; false for NaN.
        let is_inside =
            x - extent.x >= 0.0 && y - extent.y >= 0.0 && x + extent.x < last_x && y + extent.y < last_y;
        if !is_inside {
            return None;
        }
        let mut gray = [[0.0; SIDE]; SIDE];
        for (j, row) in gray.iter_mut().enumerate() {
            for (i, target) in row.iter_mut().enumerate() {
                let offset = own_from_other * Vector2::new(i as f32 - reach, j as f32 - reach);
                let (u, v) = (x + offset.x, y + offset.y);
                if !level.hidden.is_empty() && level.hidden[v as usize * level.width + u as usize] {
                    return None;
                }
                *target = bilinear(level, u, v);
            }
        }
        Some(Self::centred(gray))
    }

    fn centred(mut gray: [[f32; SIDE]; SIDE]) -> Self {
        let mean = gray.iter().flatten().sum::<f32>() / AREA as f32;
        gray.iter_mut().flatten().for_each(|g| *g -= mean);
        let square = gray.iter().flatten().map(|g| g * g).sum::<f32>();
        Self { gray, square }
    }

    /// Standard deviation, grey levels.
    pub fn deviation(&self) -> f32 {
        (self.square / AREA as f32).sqrt() / GRAY_STEPS as f32
    }

    /// Position of the best correlation within the search radius, to a fraction of a pixel; `None` if the correlation is
    /// too low, highest at the border of the search, or nearly as high elsewhere.
    pub fn search(&self, level: &Level, u: f32, v: f32) -> Option<Vector2<f64>> {
        if !(u.abs() < 1e6 && v.abs() < 1e6) {
            return None;
        }
        let (u, v) = (u.round() as i64, v.round() as i64);
        let (w, h) = (level.width as i64, level.height as i64);
        let (left, top) = (u - (SEARCH + TEMPLATE) as i64, v - (SEARCH + TEMPLATE) as i64);
        if left + COLUMNS as i64 <= 0 || top + ROWS as i64 <= 0 || left >= w || top >= h {
            return None;
        }
        let mut around = [[0.0f32; COLUMNS]; ROWS];
        let (first, last) = (left.max(0), (left + COLUMNS as i64).min(w));
        for (j, target) in around.iter_mut().enumerate() {
            let y = top + j as i64;
            if (0..h).contains(&y) {
                let row = &level.gray[(y * w + first) as usize..][..(last - first) as usize];
                let target = &mut target[(first - left) as usize..];
                target.iter_mut().zip(row).for_each(|(t, &g)| *t = f32::from(g));
            }
        }
        let mut correlations = [[0.0f32; LANES]; SHIFTS];
        correlate(self, &around, &mut correlations);
        // A template that reaches beyond the image matches nothing.
        let fits = |begin: i64, shift: usize, size: i64| {
            let first = begin + shift as i64;
            first >= 0 && first + SIDE as i64 <= size
        };
        for (j, row) in correlations.iter_mut().enumerate() {
            for (i, c) in row.iter_mut().enumerate() {
                *c = if fits(left, i, w) && fits(top, j, h) { *c } else { -1.0 };
            }
        }
        let mut best = (MIN_CORRELATION, None);
        for (j, row) in correlations.iter().enumerate() {
            for (i, &c) in row[..SHIFTS].iter().enumerate() {
                if c > best.0 {
                    best = (c, Some((i, j)));
                }
            }
        }
        let (i, j) = best.1?;
        if i == 0 || j == 0 || i + 1 == SHIFTS || j + 1 == SHIFTS || !is_unique(&correlations, (i, j)) {
            return None;
        }
        let vertex = |a: f32, b: f32| {
            let curvature = a - 2.0 * best.0 + b;
            if curvature < -1e-6 { (0.5 * (a - b) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let x =
            (left + (TEMPLATE + i) as i64) as f32 + vertex(correlations[j][i - 1], correlations[j][i + 1]);
        let y = (top + (TEMPLATE + j) as i64) as f32 + vertex(correlations[j - 1][i], correlations[j + 1][i]);
        Some(Vector2::new(f64::from(x), f64::from(y)))
    }

    /// The correlation at every shift, all shifts of a row at once.
    #[inline(always)]
    fn correlate(&self, around: &[[f32; COLUMNS]; ROWS], correlations: &mut [[f32; LANES]; SHIFTS]) {
        for (dy, out) in correlations.iter_mut().enumerate() {
            let mut cross = [0.0f32; LANES];
            let (mut sums, mut squares) = ([0.0f32; COLUMNS], [0.0f32; COLUMNS]);
            for (row, template) in around[dy..dy + SIDE].iter().zip(&self.gray) {
                for (i, &t) in template.iter().enumerate() {
                    for l in 0..LANES {
                        cross[l] += t * row[i + l];
                    }
                }
                for c in 0..COLUMNS {
                    sums[c] += row[c];
                    squares[c] += row[c] * row[c];
                }
            }
            let (mut sum, mut square) = ([0.0f32; LANES], [0.0f32; LANES]);
            for i in 0..SIDE {
                for l in 0..LANES {
                    sum[l] += sums[i + l];
                    square[l] += squares[i + l];
                }
            }
            for l in 0..LANES {
                let variance = (square[l] - sum[l] * sum[l] / AREA as f32).max(0.0);
                // The template has zero mean, so the window's mean drops out.
                out[l] = cross[l] / (self.square * variance).max(1.0).sqrt();
            }
        }
    }
}

/// Whether no shift away from the peak correlates nearly as well.
fn is_unique(correlations: &[[f32; LANES]; SHIFTS], (i, j): (usize, usize)) -> bool {
    let bound = 1.0 - UNIQUENESS * (1.0 - correlations[j][i]);
    correlations.iter().enumerate().all(|(b, row)| {
        let mut rivals = row[..SHIFTS].iter().enumerate().filter(|(_, c)| **c > bound);
        rivals.all(|(a, _)| a.abs_diff(i).max(b.abs_diff(j)) <= PEAK_RADIUS)
    })
}

/// Grey level between pixels, from the four around the position.
fn bilinear(level: &Level, u: f32, v: f32) -> f32 {
    let (left, top) = (u as usize, v as usize);
    let (across, down) = (u - left as f32, v - top as f32);
    let row = |y: usize| {
        let [a, b] = [0, 1].map(|i| f32::from(level.gray[y * level.width + left + i]));
        a + (b - a) * across
    };
    let (upper, lower) = (row(top), row(top + 1));
    upper + (lower - upper) * down
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Pinhole;

    const SIZE: usize = 96;

    fn level(gray: impl Fn(f32, f32) -> f32) -> Level {
        let pixel = |i: usize| gray((i % SIZE) as f32, (i / SIZE) as f32).round() as i16;
        Level {
            width: SIZE,
            height: SIZE,
            gray: (0..SIZE * SIZE).map(pixel).collect(),
            intrinsics: Pinhole::new(80.0, 80.0, 47.5, 47.5, SIZE, SIZE).expect("valid"),
            hidden: Vec::new(),
        }
    }

    /// Smooth and without repetition, about the centre of the image.
    fn blobs(x: f32, y: f32) -> f32 {
        let (x, y) = (x - 48.0, y - 48.0);
        700.0 * ((0.31 * x).sin() + (0.23 * y + 0.004 * x * y).cos() + (0.05 * (x + 1.7 * y)).sin())
    }

    #[test]
    fn a_turned_window_is_found_where_it_is() {
        let turn = Matrix2::new(0.3f32.cos(), -(0.3f32.sin()), 0.3f32.sin(), 0.3f32.cos());
        // The other view shows the first one turned about its centre and moved by a fraction of a pixel.
        let shift = Vector2::new(2.3, -1.6);
        let other = level(|x, y| {
            let p = turn * (Vector2::new(x - 48.0, y - 48.0) - shift);
            blobs(p.x + 48.0, p.y + 48.0)
        });
        let own = level(blobs);
        let seen = Template::warped(&own, 48, 48, &turn).expect("inside");
        let found = seen.search(&other, 48.0, 48.0).expect("unique");
        let error = found - Vector2::new(50.3, 46.4);
        assert!(error.norm() < 0.1, "off by {error}");
        let upright = Template::cut(&own, 48, 48).expect("inside").search(&other, 48.0, 48.0);
        let error = upright.map(|p| (p - Vector2::new(50.3, 46.4)).norm());
        assert!(error.is_none_or(|e| e > 0.2), "the upright window is found as well: {error:?}");
    }

    #[test]
    fn what_repeats_within_the_search_is_not_matched() {
        let stripes = |period: f32| {
            move |x: f32, y: f32| 900.0 * (x * std::f32::consts::TAU / period).sin() + 500.0 * (0.2 * y).cos()
        };
        for (period, is_found) in [(4.0, false), (6.0, false), (40.0, true)] {
            let own = level(stripes(period));
            // Noise of some grey levels, as between two images.
            let noise = |x: f32, y: f32| 60.0 * ((12.9 * x + 78.2 * y).sin() * 4375.5).fract();
            let other = level(|x, y| stripes(period)(x, y) + noise(x, y));
            let found = Template::cut(&own, 48, 48).expect("inside").search(&other, 49.0, 48.0);
            assert_eq!(found.is_some(), is_found, "period {period}: {found:?}");
        }
    }

    #[test]
    fn a_window_that_reaches_beyond_the_image_has_no_template() {
        let own = level(blobs);
        for (x, y) in [(4, 48), (48, 91), (92, 48), (0, 0)] {
            let seen = Template::warped(&own, x, y, &(Matrix2::identity() * 1.2));
            assert!(seen.is_none(), "({x}, {y})");
        }
        assert!(Template::warped(&own, 48, 48, &Matrix2::repeat(f32::NAN)).is_none());
    }

    #[test]
    fn a_window_that_reaches_a_mask_has_no_template() {
        let mut own = level(blobs);
        // Eight pixels to the right of the corner: a window of the own size ends before it, one of twice the size reaches it.
        own.hidden = (0..SIZE * SIZE).map(|i| i % SIZE == 56).collect();
        assert!(Template::warped(&own, 48, 48, &Matrix2::identity()).is_some());
        assert!(Template::warped(&own, 48, 48, &(Matrix2::identity() * 2.0)).is_none());
    }
}
