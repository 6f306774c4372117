//! Which cells of an image already hold a feature.

use vidar_core::camera::Pixel;

/// A grid of cells over an image; each holds at most one feature.
#[derive(Clone, Debug)]
pub struct OccupancyGrid {
    cell_px: usize,
    columns: usize,
    rows: usize,
    taken: Vec<bool>,
}

impl OccupancyGrid {
    /// An empty grid of `cell_px` × `cell_px` cells over an image of `width` × `height`.
    pub fn new(width: usize, height: usize, cell_px: usize) -> Self {
        let cell_px = cell_px.max(1);
        let (columns, rows) = (width.div_ceil(cell_px), height.div_ceil(cell_px));
        Self { cell_px, columns, rows, taken: vec![false; columns * rows] }
    }

    /// Frees every cell.
    pub fn clear(&mut self) {
        self.taken.fill(false);
    }

    /// Number of cells.
    pub fn len(&self) -> usize {
        self.taken.len()
    }

    /// Whether there is no cell.
    pub fn is_empty(&self) -> bool {
        self.taken.is_empty()
    }

    /// Number of cells that hold a feature.
    #[cfg(test)]
    fn taken_count(&self) -> usize {
        self.taken.iter().filter(|t| **t).count()
    }

    /// Takes the cell of `pixel` (level 0); `false` when it was taken before or lies outside.
    pub fn take(&mut self, pixel: &Pixel) -> bool {
        match self.index(pixel) {
            Some(index) => !std::mem::replace(&mut self.taken[index], true),
            None => false,
        }
    }

    /// Takes a cell by its number.
    pub fn take_index(&mut self, index: usize) {
        self.taken[index] = true;
    }

    /// Whether the cell of `pixel` is free; outside nothing is.
    pub fn is_free(&self, pixel: &Pixel) -> bool {
        self.index(pixel).is_some_and(|index| !self.taken[index])
    }

    /// The number of the cell of `pixel`, row by row.
    pub fn index(&self, pixel: &Pixel) -> Option<usize> {
        let cell = |v: f64, n: usize| {
            let c = ((v + 0.5) / self.cell_px as f64).floor();
            (c >= 0.0 && c < n as f64).then_some(c as usize)
        };
        Some(cell(pixel.y, self.rows)? * self.columns + cell(pixel.x, self.columns)?)
    }

    pub(super) fn cell_px(&self) -> usize {
        self.cell_px
    }

    pub(super) fn columns(&self) -> usize {
        self.columns
    }

    pub(super) fn is_taken_at(&self, index: usize) -> bool {
        self.taken[index]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_taken_once_and_outside_is_never_free() {
        let mut grid = OccupancyGrid::new(100, 50, 32);
        assert_eq!((grid.len(), grid.taken_count(), grid.is_empty()), (8, 0, false));
        let at = Pixel::new(40.0, 10.0);
        assert!(grid.is_free(&at) && grid.take(&at) && !grid.take(&at) && !grid.is_free(&at));
        assert!(!grid.take(&Pixel::new(63.4, 31.4)), "the same cell");
        assert!(grid.take(&Pixel::new(63.6, 31.4)), "its right neighbour");
        assert_eq!(grid.taken_count(), 2);
        for outside in [Pixel::new(-1.0, 3.0), Pixel::new(128.0, 3.0), Pixel::new(f64::NAN, 3.0)] {
            assert!(!grid.is_free(&outside) && !grid.take(&outside));
        }
        grid.clear();
        assert_eq!(grid.taken_count(), 0);
    }
}
