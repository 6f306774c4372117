//! New features of a keyframe: corners where there are any, edgelets where there are not, one a cell.
//!
//! FAST finds candidates on the lower pyramid levels; per cell the few that FAST likes best are ranked by Shi and Tomasi's
//! smaller eigenvalue, which bounds the error of the alignment that follows (σ² ≈ σ_I² / (N λ)). A cell without a corner
//! may give the place of its steepest gradient as an edgelet. Cells that hold a tracked feature are left alone.

mod fast;
mod occupancy;
mod structure;
#[cfg(test)]
mod tests;

pub use occupancy::OccupancyGrid;

use super::feature::FeatureKind;
use super::pyramid::{Pyramid, from_level, level_scale};
use fast::{Candidate, FastScanner};
use nalgebra::Vector2;
pub(crate) use structure::Structure;
use vidar_core::Image;
use vidar_core::camera::Pixel;

/// Difference to the centre that FAST asks of a circle's pixels, grey levels: low, as structure decides among its candidates.
const FAST_THRESHOLD: u8 = 10;

/// Least structure of a corner: root of the smaller eigenvalue of its mean gradient tensor, grey levels per pixel. It bounds the
/// error of the alignment: with 2 grey levels of noise on the 64 pixels of a patch, 0.1 px.
const MIN_CORNER_STRENGTH: f64 = 2.5;

/// Least gradient of an edgelet, grey levels per pixel. More than of a corner, as it is measured in one direction alone.
const MIN_EDGE_STRENGTH: f64 = 8.0;

/// Distance that features keep from the image's border on their own level, pixels: the patch around them lies inside.
const BORDER_PX: usize = 8;

/// Candidates a cell and level of which the best by structure is taken.
const KEPT: usize = 3;

/// A place worth tracking.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Where it is, level-0 pixels.
    pub pixel: Pixel,
    /// Pyramid level on which it was found.
    pub level: u8,
    /// Corner or edgelet.
    pub kind: FeatureKind,
    /// Corners: Shi-Tomasi strength on their level; edgelets: gradient. Grey levels per pixel.
    pub strength: f64,
}

#[derive(Clone, Copy, Debug)]
struct Cell {
    best: [Candidate; KEPT],
    count: usize,
    corner: Option<Detection>,
}

const EMPTY: Cell = Cell { best: [Candidate { x: 0, y: 0, score: 0 }; KEPT], count: 0, corner: None };

impl Cell {
    /// Keeps the candidates with the highest scores; of equal ones the first.
    fn offer(&mut self, candidate: Candidate) {
        let mut at = self.count;
        while at > 0 && self.best[at - 1].score < candidate.score {
            at -= 1;
        }
        if at < KEPT {
            self.best.copy_within(at..KEPT - 1, at + 1);
            self.best[at] = candidate;
            self.count = (self.count + 1).min(KEPT);
        }
    }
}

/// Where features are looked for. The defaults suit the odometry's images of about 752 × 480; the calibration has others.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectorConfig {
    /// Side of the cells of which each holds at most one feature, level-0 pixels, 8…256. Smaller gives more features.
    pub cell_px: usize,
    /// Pyramid levels on which corners are looked for, 1…5.
    pub levels: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self { cell_px: 32, levels: 3 }
    }
}

/// Finds features; its buffers are kept between keyframes.
#[derive(Clone, Debug)]
pub struct Detector {
    config: DetectorConfig,
    scanner: FastScanner,
    cells: Vec<Cell>,
}

impl Detector {
    /// A detector with no buffers yet.
    pub fn new(config: DetectorConfig) -> Self {
        Self { config, scanner: FastScanner::default(), cells: Vec::new() }
    }

    /// A grid of the configured cell size for images of `width` × `height`.
    pub fn grid(&self, width: usize, height: usize) -> OccupancyGrid {
        OccupancyGrid::new(width, height, self.config.cell_px)
    }

    /// Replaces `found` by the features of free cells, corners before edgelets, each sorted by strength.
    ///
    /// The grid is only read. No allocation once `found` and the buffers have grown to the number of cells.
    pub fn detect(&mut self, pyramid: &Pyramid, taken: &OccupancyGrid, found: &mut Vec<Detection>) {
        found.clear();
        self.cells.clear();
        self.cells.resize(taken.len(), EMPTY);
        for level in 0..self.config.levels.min(pyramid.level_count()) {
            self.collect_corners(pyramid, level, taken);
            self.rank_corners(pyramid.level(level), level);
        }
        found.extend(self.cells.iter().filter_map(|cell| cell.corner));
        let corners = found.len();
        self.find_edgelets(pyramid, taken, found);
        let by_strength = |a: &Detection, b: &Detection| {
            // Ties by place, so that the order is fixed although the sort is not stable.
            let place = (a.pixel.y, a.pixel.x).partial_cmp(&(b.pixel.y, b.pixel.x));
            b.strength.total_cmp(&a.strength).then(place.unwrap_or(std::cmp::Ordering::Equal))
        };
        found[..corners].sort_unstable_by(by_strength);
        found[corners..].sort_unstable_by(by_strength);
    }

    fn collect_corners(&mut self, pyramid: &Pyramid, level: usize, taken: &OccupancyGrid) {
        let cells = &mut self.cells;
        cells.iter_mut().for_each(|cell| cell.count = 0);
        self.scanner.scan(pyramid.level(level), FAST_THRESHOLD, BORDER_PX, |candidate| {
            let pixel = from_level(&Pixel::new(candidate.x as f64, candidate.y as f64), level);
            if let Some(index) = taken.index(&pixel).filter(|i| !taken.is_taken_at(*i)) {
                cells[index].offer(candidate);
            }
        });
    }

    fn rank_corners(&mut self, image: &Image<u8>, level: usize) {
        for cell in &mut self.cells {
            for candidate in &cell.best[..cell.count] {
                let strength = Structure::around(image, candidate.x, candidate.y).weak;
                // A finer level localises better, so a coarser one must be clearly stronger.
                let asked = cell.corner.map_or(MIN_CORNER_STRENGTH, |c| {
                    if usize::from(c.level) == level { c.strength } else { COARSER_MUST_EXCEED * c.strength }
                });
                if strength > asked {
                    let pixel = from_level(&Pixel::new(candidate.x as f64, candidate.y as f64), level);
                    let kind = FeatureKind::Corner;
                    cell.corner = Some(Detection { pixel, level: level as u8, kind, strength });
                }
            }
        }
    }

    /// One edgelet per free cell without a corner, at the steepest place of level 1 (level 0 of a lone level).
    fn find_edgelets(&self, pyramid: &Pyramid, taken: &OccupancyGrid, found: &mut Vec<Detection>) {
        let level = 1.min(pyramid.level_count() - 1);
        let image = pyramid.level(level);
        let cell = taken.cell_px() as f64 / level_scale(level);
        for (index, corner) in self.cells.iter().map(|c| c.corner).enumerate() {
            if corner.is_some() || taken.is_taken_at(index) {
                continue;
            }
            let (column, row) = (index % taken.columns(), index / taken.columns());
            let span = |c: usize, size: usize| {
                let (low, high) = ((c as f64 * cell) as usize, ((c + 1) as f64 * cell) as usize);
                low.max(BORDER_PX)..high.min(size - BORDER_PX)
            };
            let area = (span(column, image.width()), span(row, image.height()));
            if let Some(edgelet) = self.edgelet_in(image, level, area) {
                found.push(edgelet);
            }
        }
    }

    fn edgelet_in(
        &self,
        image: &Image<u8>,
        level: usize,
        area: (std::ops::Range<usize>, std::ops::Range<usize>),
    ) -> Option<Detection> {
        let (mut steepest, mut place) = (0, None);
        for y in area.1 {
            for x in area.0.clone() {
                let [gx, gy] = smoothed_gradient(image, x, y);
                let square = gx * gx + gy * gy;
                if square > steepest {
                    (steepest, place) = (square, Some((x, y)));
                }
            }
        }
        let (x, y) = place?;
        // The kernel sums to eight times the gradient per pixel.
        let strength = f64::from(steepest).sqrt() / 8.0;
        let structure = Structure::around(image, x, y);
        // Where the patch's gradients do not agree with each other, the direction means nothing.
        let is_edge = structure.strong > EDGE_RATIO * structure.weak;
        if strength < MIN_EDGE_STRENGTH || !is_edge {
            return None;
        }
        let normal: Vector2<f64> = structure.direction;
        let pixel = from_level(&Pixel::new(x as f64, y as f64), level);
        Some(Detection { pixel, level: level as u8, kind: FeatureKind::Edgelet { normal }, strength })
    }
}

/// How much stronger a corner of a coarser level must be to replace one of a finer level.
const COARSER_MUST_EXCEED: f64 = 1.5;

/// Least ratio of gradients across and along an edge.
const EDGE_RATIO: f64 = 3.0;

/// Sobel's gradient times eight.
#[inline(always)]
fn smoothed_gradient(image: &Image<u8>, x: usize, y: usize) -> [i32; 2] {
    let (width, data) = (image.width(), image.data());
    let at = y * width + x;
    let v = |offset: usize| i32::from(data[offset]);
    let (up, down) = (at - width, at + width);
    let (nw, n, ne) = (v(up - 1), v(up), v(up + 1));
    let (sw, s, se) = (v(down - 1), v(down), v(down + 1));
    let gx = ne + 2 * v(at + 1) + se - nw - 2 * v(at - 1) - sw;
    let gy = sw + 2 * s + se - nw - 2 * n - ne;
    [gx, gy]
}
