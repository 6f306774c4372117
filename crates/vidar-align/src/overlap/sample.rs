//! A view as a few thousand depths at pixels that depend on the frame alone.

use super::PointPairs;
use nalgebra::Vector3;
use vidar_core::random::splitmix64;
use vidar_core::{FrameId, LieGroup, Pinhole, Se3, ViewGeometry};
use vidar_solve::statistics::median_upper;

/// Pixels of a view, one per cell of a grid, jittered by a hash of the frame: two chunks that hold the same frame at the
/// same size sample the same pixels, so that their samples are pairs.
#[derive(Clone, Debug, PartialEq)]
pub struct SampledView {
    /// Which frame.
    pub frame_id: FrameId,
    /// Pose in the chunk's frame, translation in chunk units.
    pub chunk_from_camera: Se3,
    /// Intrinsics at the depth's size.
    pub intrinsics: Pinhole,
    pattern: Pattern,
    /// z-depth in chunk units; NaN where there is none or where a depth edge runs through.
    depth: Vec<f32>,
    /// Confidence, 0…1.
    confidence: Vec<f32>,
}

/// Relative range of the 3 × 3 neighbours above which a pixel lies on a depth edge: there a pixel's depth belongs to
/// either surface by chance.
const EDGE_RANGE: f32 = 0.08;

impl SampledView {
    /// Samples about `count` pixels of a view.
    pub fn new(view: &ViewGeometry, count: usize) -> Self {
        let depth = view.depth.image();
        let confidence = view.confidence.image();
        let (width, height) = (depth.width(), depth.height());
        let pattern = Pattern::new(view.frame_id, width, height, count);
        let pixels = || (0..pattern.len()).map(|cell| pattern.pixel(cell));
        let at_edge = |x: usize, y: usize, z: f32| {
            let (mut low, mut high) = (z, z);
            for ny in y.saturating_sub(1)..(y + 2).min(height) {
                for v in &depth.row(ny)[x.saturating_sub(1)..(x + 2).min(width)] {
                    if v.is_finite() {
                        low = low.min(*v);
                        high = high.max(*v);
                    }
                }
            }
            high - low > EDGE_RANGE * z
        };
        let is_posed = view.chunk_from_camera.is_finite();
        let kept = |(x, y): (usize, usize)| {
            let z = depth[(x, y)];
            let usable = is_posed && z.is_finite() && z > 0.0 && !at_edge(x, y, z);
            if usable { z } else { f32::NAN }
        };
        Self {
            frame_id: view.frame_id,
            chunk_from_camera: view.chunk_from_camera,
            intrinsics: view.intrinsics,
            depth: pixels().map(kept).collect(),
            confidence: pixels().map(|p| confidence.get(p.0, p.1).copied().unwrap_or(0.0)).collect(),
            pattern,
        }
    }

    /// Number of samples, usable or not.
    pub fn len(&self) -> usize {
        self.depth.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.depth.is_empty()
    }

    /// The median depth in chunk units; `None` when no sample has one.
    pub fn median_depth(&self) -> Option<f64> {
        let mut valid: Vec<f32> = self.depth.iter().copied().filter(|z| z.is_finite()).collect();
        median_upper(&mut valid).map(f64::from)
    }

    /// Confidences of the usable samples.
    pub(crate) fn confidences(&self) -> impl Iterator<Item = f32> + '_ {
        self.depth.iter().zip(&self.confidence).filter(|(z, _)| z.is_finite()).map(|(_, c)| *c)
    }

    /// Memory it takes.
    pub(crate) fn bytes(&self) -> usize {
        self.depth.len() * 8 + size_of::<Self>()
    }

    /// Adds the pairs "this view in `self`'s chunk (target) and in `source`'s chunk", every `stride`-th cell.
    ///
    /// Views of another frame or size have no pairs. `is_trusted` selects the confidences that take part, `weigh` makes
    /// a weight of the two confidences.
    pub(crate) fn pair_with(
        &self,
        source: &Self,
        stride: usize,
        is_trusted: impl Fn(f32) -> bool,
        weigh: impl Fn(f32, f32) -> f64,
        pairs: &mut PointPairs,
    ) {
        if self.pattern != source.pattern {
            return;
        }
        for cell in (0..self.len()).step_by(stride.max(1)) {
            let (zt, zs) = (self.depth[cell], source.depth[cell]);
            let (ct, cs) = (self.confidence[cell], source.confidence[cell]);
            if zt.is_finite() && zs.is_finite() && is_trusted(ct) && is_trusted(cs) {
                let (target, source_point) = (self.point(cell), source.point(cell));
                pairs.push(source_point, target, f64::from(zs), f64::from(zt), weigh(ct, cs));
            }
        }
    }

    /// The sample of a cell in the chunk's frame.
    pub(crate) fn point(&self, cell: usize) -> Vector3<f64> {
        let (x, y) = self.pattern.pixel(cell);
        let ray = self.intrinsics.ray(x as f64, y as f64);
        self.chunk_from_camera.act(&(ray * f64::from(self.depth[cell])))
    }

    /// The usable samples as points in the chunk's frame with their z-depth and confidence.
    pub(crate) fn points(&self) -> impl Iterator<Item = (Vector3<f64>, f64, f32)> + '_ {
        (0..self.len())
            .filter(|&cell| self.depth[cell].is_finite())
            .map(|cell| (self.point(cell), f64::from(self.depth[cell]), self.confidence[cell]))
    }

    /// The cell that shows a pixel, and its depth; `None` outside the image or without depth.
    pub(crate) fn cell_at(&self, x: f64, y: f64) -> Option<(usize, f64)> {
        let cell = self.pattern.cell_at(x, y)?;
        let z = self.depth[cell];
        z.is_finite().then_some((cell, f64::from(z)))
    }

    /// Points of the cells left, right, above and below, where they exist and are usable.
    pub(crate) fn normal(&self, cell: usize) -> Option<Vector3<f64>> {
        let (nx, z) = (self.pattern.columns, self.depth[cell]);
        let (column, row) = (cell % nx, cell / nx);
        let near = |c: Option<usize>| {
            let c = c?;
            let d = self.depth[c];
            (d.is_finite() && (d - z).abs() < 0.15 * z).then(|| self.point(c))
        };
        let left = near((column > 0).then(|| cell - 1)).unwrap_or_else(|| self.point(cell));
        let right = near((column + 1 < nx).then(|| cell + 1)).unwrap_or_else(|| self.point(cell));
        let above = near((row > 0).then(|| cell - nx)).unwrap_or_else(|| self.point(cell));
        let below =
            near((row + 1 < self.pattern.rows).then(|| cell + nx)).unwrap_or_else(|| self.point(cell));
        (right - left).cross(&(below - above)).try_normalize(1e-12)
    }
}

/// A grid of cells with one pixel in each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Pattern {
    frame: u32,
    width: usize,
    height: usize,
    columns: usize,
    rows: usize,
}

impl Pattern {
    fn new(frame: FrameId, width: usize, height: usize, count: usize) -> Self {
        let (w, h) = (width.max(1) as f64, height.max(1) as f64);
        let columns = ((count as f64 * w / h).sqrt().round() as usize).clamp(1, width.max(1));
        let rows = (count / columns).clamp(1, height.max(1));
        let empty = width == 0 || height == 0;
        let (columns, rows) = if empty { (0, 0) } else { (columns, rows) };
        Self { frame: frame.0, width, height, columns, rows }
    }

    fn len(&self) -> usize {
        self.columns * self.rows
    }

    fn pixel(&self, cell: usize) -> (usize, usize) {
        let (column, row) = (cell % self.columns, cell / self.columns);
        let hash = splitmix64((u64::from(self.frame) << 32) ^ cell as u64);
        let within = |index: usize, cells: usize, size: usize, bits: u64| {
            let (from, to) = (index * size / cells, (index + 1) * size / cells);
            from + (bits % (to - from).max(1) as u64) as usize
        };
        (
            within(column, self.columns, self.width, hash & 0xffff_ffff),
            within(row, self.rows, self.height, hash >> 32),
        )
    }

    fn cell_at(&self, x: f64, y: f64) -> Option<usize> {
        let (x, y) = (x.round(), y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        inside.then(|| {
            let find = |p: usize, cells: usize, size: usize| {
                // The cell whose range holds p: ⌊index · size / cells⌋ ≤ p.
                let guess = (p * cells / size).min(cells - 1);
                if (guess + 1) * size / cells <= p { guess + 1 } else { guess }
            };
            let column = find(x as usize, self.columns, self.width);
            let row = find(y as usize, self.rows, self.height);
            row * self.columns + column
        })
    }
}
