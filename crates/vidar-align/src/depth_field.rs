//! A smooth correction of a view's depth, fitted to landmarks.
//!
//! `log D'(u) = log D(u) + β + Σₘ φₘ(u) gₘ`, φ = bilinear weights of a 6 × 4 grid over the image. A model's depth of one
//! view is off by a factor that varies slowly across the image, which no similarity of a chunk can repair.
//!
//! Minimised is `Σ ρ((rⱼ − β − φ(uⱼ)·g)/sⱼ) + β²/(0.02 l)² + |g|²/(0.03 l)² + |∇g|²/(0.02 l)²` with Cauchy's loss, in closed
//! form per reweighting (25 unknowns). The prior's scale l (1, 4 or 16), and whether the grid is kept at all, are chosen on
//! held-out landmarks: fitted to one half of them, the wider prior or the grid must lower the error of the other half. Good
//! networks are off by a few per cent and keep l = 1; small ones are off by tens of per cent and need l = 4 or 16.

use crate::landmark_scale::{DepthRatio, RatioSource};
use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};
use vidar_core::Image;
use vidar_solve::statistics::{STD_PER_MAD, median_upper};

/// Columns of the grid.
pub const FIELD_COLUMNS: usize = 6;
/// Rows of the grid.
pub const FIELD_ROWS: usize = 4;
const NODES: usize = FIELD_COLUMNS * FIELD_ROWS;

/// ln of the factor by which a view's depth is to be multiplied, over its image.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DepthField {
    /// The view's own factor, ln.
    pub offset: f64,
    /// ln of the factor at the grid's nodes beyond `offset`, row-major; the corner nodes are the image's corner pixels.
    pub grid: [f64; NODES],
}

impl DepthField {
    /// ln of the factor at pixel (x, y) of an image of this size.
    pub fn log_factor(&self, x: f64, y: f64, width: usize, height: usize) -> f64 {
        self.offset + weights(x, y, width, height).iter().map(|(node, w)| w * self.grid[*node]).sum::<f64>()
    }

    /// The corrected depth.
    pub fn apply(&self, depth: &Image<f32>) -> Image<f32> {
        let (w, h) = (depth.width(), depth.height());
        Image::from_fn(w, h, |x, y| {
            let factor = self.log_factor(x as f64, y as f64, w, h).exp();
            (f64::from(depth[(x, y)]) * factor) as f32
        })
    }
}

/// The four nodes around a pixel with their bilinear weights.
fn weights(x: f64, y: f64, width: usize, height: usize) -> [(usize, f64); 4] {
    let place = |p: f64, size: usize, cells: usize| {
        let at = (p / (size.max(2) - 1) as f64).clamp(0.0, 1.0) * (cells - 1) as f64;
        let low = (at as usize).min(cells - 2);
        (low, at - low as f64)
    };
    let (column, fx) = place(x, width, FIELD_COLUMNS);
    let (row, fy) = place(y, height, FIELD_ROWS);
    let node = |c: usize, r: usize| (row + r) * FIELD_COLUMNS + column + c;
    [
        (node(0, 0), (1.0 - fx) * (1.0 - fy)),
        (node(1, 0), fx * (1.0 - fy)),
        (node(0, 1), (1.0 - fx) * fy),
        (node(1, 1), fx * fy),
    ]
}

/// A fitted field.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldFit {
    /// The correction.
    pub field: DepthField,
    /// Whether the grid improved held-out landmarks and was kept.
    pub keeps_grid: bool,
    /// Factor on the prior's standard deviations: 1, 4 or 16.
    pub prior_scale: f64,
    /// Median error of held-out landmarks: uncorrected, with the offset, with the grid.
    pub held_out: [f64; 3],
}

const UNKNOWNS: usize = 1 + NODES;
type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type Vector = SVector<f64, UNKNOWNS>;

/// Prior σ of the offset, of the grid's nodes and of the difference of neighbouring nodes, ln, for a good network.
const OFFSET_STD: f64 = 0.02;
const NODE_STD: f64 = 0.03;
const SLOPE_STD: f64 = 0.02;
const CAUCHY: f64 = 2.0;
const ROUNDS: usize = 5;
/// The grid must lower the held-out error by this share to be kept, and so must a wider prior.
const IMPROVEMENT: f64 = 0.03;
/// Factors on the prior's standard deviations that are tried.
const PRIOR_SCALES: [f64; 3] = [1.0, 4.0, 16.0];

/// Fits a view's field to landmarks. `log_scale` is the chunk's; ratios are this view's. `None` below `min_landmarks`
/// (fewer than 15 fix no field) or when that is 0.
pub fn fit_depth_field(
    ratios: &[DepthRatio],
    log_scale: f64,
    size: (usize, usize),
    min_landmarks: usize,
) -> Option<FieldFit> {
    if min_landmarks == 0 || ratios.len() < min_landmarks.max(15) {
        return None;
    }
    let rows: Vec<Row> = ratios
        .iter()
        .map(|r| Row { half: half(r.source), ..Row::new(&FieldConstraint::of_landmark(r, log_scale), size) })
        .collect();
    let best =
        PRIOR_SCALES.map(|prior_scale| held_out(&rows, prior_scale)).into_iter().reduce(|best, wider| {
            let is_better = wider.error() < (1.0 - IMPROVEMENT) * best.error();
            if is_better { wider } else { best }
        })?;
    let all: Vec<&Row> = rows.iter().collect();
    let found = solve(&all, if best.keeps_grid { UNKNOWNS } else { 1 }, best.prior_scale);
    let (keeps_grid, prior_scale) = (best.keeps_grid, best.prior_scale);
    Some(FieldFit { field: field_of(&found), keeps_grid, prior_scale, held_out: best.errors })
}

/// Which half of the landmarks: by a hash of the landmark, so that no landmark is in both halves. Points are hashed to the
/// other half than the landmark of the same number.
fn half(source: RatioSource) -> usize {
    let top_bit = |number: u32| (number.wrapping_mul(0x9e37_79b9) >> 31) as usize;
    match source {
        RatioSource::Landmark(id) => top_bit(id.0),
        RatioSource::Point(number) => 1 - top_bit(number),
    }
}

fn field_of(x: &Vector) -> DepthField {
    DepthField { offset: x[0], grid: std::array::from_fn(|m| x[m + 1]) }
}

/// A measured correction at one pixel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldConstraint {
    pub pixel: [f64; 2],
    /// ln of the measured factor.
    pub log_factor: f64,
    /// Standard deviation of it.
    pub std: f64,
    /// How much of an independent observation it is.
    pub share: f64,
}

impl FieldConstraint {
    /// The correction at a landmark of a depth that already has the chunk's scale.
    pub fn of_landmark(ratio: &DepthRatio, log_scale: f64) -> Self {
        Self { pixel: ratio.pixel, log_factor: ratio.log_ratio - log_scale, std: ratio.std, share: 1.0 }
    }
}

/// The field from constraints of all kinds.
pub(crate) fn field_from(
    constraints: &[FieldConstraint],
    prior_scale: f64,
    size: (usize, usize),
) -> DepthField {
    let rows: Vec<Row> = constraints.iter().map(|c| Row::new(c, size)).collect();
    field_of(&solve(&rows.iter().collect::<Vec<_>>(), UNKNOWNS, prior_scale))
}

/// Held-out errors of one prior scale.
struct HeldOut {
    prior_scale: f64,
    /// Median error: uncorrected, with the offset, with the grid.
    errors: [f64; 3],
    keeps_grid: bool,
}

impl HeldOut {
    /// Median error of the correction that would be kept.
    fn error(&self) -> f64 {
        self.errors[if self.keeps_grid { 2 } else { 1 }]
    }
}

/// Fits each half of the landmarks and measures the error of the other.
fn held_out(rows: &[Row], prior_scale: f64) -> HeldOut {
    let mut errors: [Vec<f64>; 3] = Default::default();
    let mut improves_both = true;
    for half in 0..2 {
        let (fitted, held): (Vec<&Row>, Vec<&Row>) = rows.iter().partition(|r| r.half == half);
        let (offset, grid) = (solve(&fitted, 1, prior_scale), solve(&fitted, UNKNOWNS, prior_scale));
        let by = |x: &Vector| held.iter().map(|r| r.error(x).abs()).collect::<Vec<f64>>();
        let (with_offset, with_grid) = (by(&offset), by(&grid));
        improves_both &= median(with_grid.clone()) < median(with_offset.clone());
        errors[0].extend(by(&Vector::zeros()));
        errors[1].extend(with_offset);
        errors[2].extend(with_grid);
    }
    let errors = errors.map(median);
    let keeps_grid = improves_both && errors[2] < (1.0 - IMPROVEMENT) * errors[1];
    HeldOut { prior_scale, errors, keeps_grid }
}

struct Row {
    residual: f64,
    std: f64,
    /// How much of an independent observation it is.
    share: f64,
    nodes: [(usize, f64); 4],
    half: usize,
}

impl Row {
    fn new(c: &FieldConstraint, size: (usize, usize)) -> Self {
        let nodes = weights(c.pixel[0], c.pixel[1], size.0, size.1);
        Self { residual: c.log_factor, std: c.std, share: c.share, nodes, half: 0 }
    }

    fn error(&self, x: &Vector) -> f64 {
        self.residual - x[0] - self.nodes.iter().map(|(m, w)| w * x[m + 1]).sum::<f64>()
    }
}

/// The first `unknowns` of offset and grid, the others zero.
fn solve(rows: &[&Row], unknowns: usize, prior_scale: f64) -> Vector {
    let mut x = Vector::zeros();
    for _ in 0..ROUNDS {
        let (mut information, mut right) = prior(prior_scale);
        // An error that most landmarks have is no outlier, only more noise than their σ states.
        let wider =
            (STD_PER_MAD * median(rows.iter().map(|r| (r.error(&x) / r.std).abs()).collect())).max(1.0);
        for row in rows {
            let std = wider * row.std;
            let e = row.error(&x) / std;
            let weight = row.share / ((1.0 + (e / CAUCHY).powi(2)) * std * std);
            let terms: [(usize, f64); 5] = [
                (0, 1.0),
                (row.nodes[0].0 + 1, row.nodes[0].1),
                (row.nodes[1].0 + 1, row.nodes[1].1),
                (row.nodes[2].0 + 1, row.nodes[2].1),
                (row.nodes[3].0 + 1, row.nodes[3].1),
            ];
            for (i, a) in terms {
                right[i] += weight * a * row.residual;
                for (j, b) in terms {
                    information[(i, j)] += weight * a * b;
                }
            }
        }
        for m in unknowns..UNKNOWNS {
            information.row_mut(m).fill(0.0);
            information.column_mut(m).fill(0.0);
            information[(m, m)] = 1.0;
            right[m] = 0.0;
        }
        // The prior makes it positive definite.
        let Some(factor) = information.cholesky() else { return Vector::zeros() };
        x = factor.solve(&right);
    }
    x
}

fn prior(prior_scale: f64) -> (Matrix, Vector) {
    let information_of = |std: f64| (prior_scale * std).powi(-2);
    let mut information = Matrix::identity() * information_of(NODE_STD);
    information[(0, 0)] = information_of(OFFSET_STD);
    let slope = information_of(SLOPE_STD);
    let mut add_slope = |a: usize, b: usize| {
        information[(a, a)] += slope;
        information[(b, b)] += slope;
        information[(a, b)] -= slope;
        information[(b, a)] -= slope;
    };
    for row in 0..FIELD_ROWS {
        for column in 0..FIELD_COLUMNS {
            let node = 1 + row * FIELD_COLUMNS + column;
            if column + 1 < FIELD_COLUMNS {
                add_slope(node, node + 1);
            }
            if row + 1 < FIELD_ROWS {
                add_slope(node, node + FIELD_COLUMNS);
            }
        }
    }
    (information, Vector::zeros())
}

fn median(mut values: Vec<f64>) -> f64 {
    median_upper(&mut values).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{RngCore, SeedableRng};
    use vidar_core::{FrameId, LandmarkId};

    const SIZE: (usize, usize) = (504, 322);

    fn ratios(n: u32, seed: u64, noise: f64, field: impl Fn(f64, f64) -> f64) -> Vec<DepthRatio> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut uniform = || (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        (0..n)
            .map(|k| {
                let (x, y) = (503.0 * uniform(), 321.0 * uniform());
                let error = noise * (0..6).map(|_| uniform() - 0.5).sum::<f64>() * 2.0_f64.sqrt();
                let gross = if k % 9 == 0 { 0.5 } else { 0.0 };
                DepthRatio {
                    frame_id: FrameId(0),
                    source: RatioSource::Landmark(LandmarkId(k)),
                    pixel: [x, y],
                    log_ratio: 0.3 + field(x, y) + error + gross,
                    std: noise.max(0.01),
                }
            })
            .collect()
    }

    #[test]
    fn a_smooth_field_is_found_and_halves_the_error_or_better() {
        let truth = |x: f64, y: f64| 0.05 * (x / 503.0 - 0.5) - 0.04 * (y / 321.0 - 0.5) + 0.01;
        let fit = fit_depth_field(&ratios(150, 1, 0.005, truth), 0.3, SIZE, 15).unwrap();
        assert!(fit.keeps_grid, "{:?}", fit.held_out);
        assert!(fit.held_out[2] < 0.6 * fit.held_out[1], "{:?}", fit.held_out);
        let worst = [(50.0, 50.0), (450.0, 280.0), (252.0, 161.0), (450.0, 40.0)]
            .iter()
            .map(|&(x, y)| (fit.field.log_factor(x, y, SIZE.0, SIZE.1) - truth(x, y)).abs())
            .fold(0.0, f64::max);
        assert!(worst < 0.012, "{worst}");
    }

    #[test]
    fn a_small_network_gets_a_wider_prior_and_a_good_one_does_not() {
        let bent = |x: f64, y: f64| 0.25 * (5.0 * x / 503.0).sin() - 0.3 * (y / 321.0 - 0.5) - 0.2;
        let fit = fit_depth_field(&ratios(80, 4, 0.06, bent), 0.3, SIZE, 15).unwrap();
        assert!(fit.keeps_grid && fit.prior_scale > 1.0, "{fit:?}");
        let off = |field: &DepthField| {
            let places = (0..60).map(|k| (40.0 + 7.0 * f64::from(k), 20.0 + 4.5 * f64::from((k * 17) % 60)));
            let squares = places.map(|(x, y)| (field.log_factor(x, y, SIZE.0, SIZE.1) - bent(x, y)).powi(2));
            (squares.sum::<f64>() / 60.0).sqrt()
        };
        let (uncorrected, corrected) = (off(&DepthField::default()), off(&fit.field));
        assert!(corrected < 0.3 * uncorrected, "{corrected} of {uncorrected}");
        let slight = |x: f64, _: f64| 0.03 * (x / 503.0 - 0.5);
        let loose = (0..20).filter(|seed| {
            fit_depth_field(&ratios(80, *seed, 0.02, slight), 0.3, SIZE, 15).unwrap().prior_scale > 1.0
        });
        assert!(loose.count() <= 3);
    }

    #[test]
    fn noise_alone_keeps_no_grid_and_few_landmarks_change_nothing() {
        let kept = (0..40)
            .filter(|seed| {
                let all = ratios(60, *seed, 0.03, |_, _| 0.0);
                fit_depth_field(&all, 0.3, SIZE, 15).unwrap().keeps_grid
            })
            .count();
        assert!(kept <= 10, "{kept} of 40");
        assert!(fit_depth_field(&ratios(14, 1, 0.01, |_, _| 0.0), 0.3, SIZE, 1).is_none());
        assert!(fit_depth_field(&ratios(200, 1, 0.01, |_, _| 0.0), 0.3, SIZE, 0).is_none());
    }

    #[test]
    fn the_corner_nodes_are_the_corner_pixels_and_holes_stay_holes() {
        let mut field = DepthField { offset: 0.1, grid: [0.0; NODES] };
        field.grid[0] = 0.2;
        assert!((field.log_factor(0.0, 0.0, 10, 8) - 0.3).abs() < 1e-12);
        assert!((field.log_factor(9.0, 7.0, 10, 8) - 0.1).abs() < 1e-12);
        let mut depth = Image::filled(10, 8, 2.0_f32);
        depth.data_mut()[0] = f32::NAN;
        let corrected = field.apply(&depth);
        assert!(corrected[(0, 0)].is_nan());
        assert!((f64::from(corrected[(9, 7)]) - 2.0 * 0.1_f64.exp()).abs() < 1e-6);
    }
}
