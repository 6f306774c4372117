//! Parts of the image that move with the camera: a robot's body, a finger, dirt on the lens, a time that is written into the picture.
//!
//! A track that stays where it began although the camera turned shows no point of the world. It ends, and its cell of the image gets no
//! new ones for some images: more each time, so that a part which stays costs little and one that goes away is forgotten. A point of the
//! world stays only where the camera moves around it without the least shake; then it loses a track.

use crate::frontend::OccupancyGrid;
use vidar_core::FrameId;
use vidar_core::camera::Pixel;

/// A track that was never further than this from where it began is fixed: twice to four times the noise of an alignment. With 1 px what is as far away
/// as the middle of an orbit was taken for fixed, too ...
const FIXED_PX: f64 = 0.4;
/// ... once the camera's turn alone would have moved it by this share of the image's width, 15 pixels of 640: two degrees.
const TURNED_SHARE: f64 = 0.023;

/// Further than this from where it began, a track has moved.
const MOVED_PX: f64 = 4.0;

/// Images for which a cell gets no tracks the first time, 2 s at 30 a second; each time twice as many, up to six times.
const FIRST_PAUSE: u32 = 64;
const MAX_DOUBLINGS: u32 = 6;

#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    times: u32,
    until: u32,
}

/// Which cells of the image show the carrier.
#[derive(Clone, Debug)]
pub(super) struct FixedParts {
    cells: Vec<Cell>,
    turned_px: f64,
    /// Most cells that got no tracks at a time.
    most: usize,
}

impl FixedParts {
    pub fn new(grid: &OccupancyGrid, width: usize) -> Self {
        Self { cells: vec![Cell::default(); grid.len()], turned_px: TURNED_SHARE * width as f64, most: 0 }
    }

    /// Whether a track that was at most so far from where it began stays there.
    pub fn stays(moved_px: f64) -> bool {
        moved_px < FIXED_PX
    }

    /// Whether it moves, beyond doubt.
    pub fn moves(moved_px: f64) -> bool {
        moved_px > MOVED_PX
    }

    /// Whether a point of the world would have moved, were it as far away as can be.
    pub fn should_move(&self, by_turn_px: f64) -> bool {
        by_turn_px > self.turned_px
    }

    /// A fixed track at `pixel` ended in image `frame`.
    pub fn add(&mut self, grid: &OccupancyGrid, pixel: &Pixel, frame: FrameId) {
        let Some(cell) = grid.index(pixel).and_then(|index| self.cells.get_mut(index)) else { return };
        cell.until = frame.0.saturating_add(FIRST_PAUSE << cell.times.min(MAX_DOUBLINGS));
        cell.times += 1;
        self.most = self.most.max(self.cells.iter().filter(|cell| frame.0 < cell.until).count());
    }

    /// Largest share of the image that got no tracks at a time.
    pub fn share(&self) -> f64 {
        self.most as f64 / self.cells.len().max(1) as f64
    }

    /// Takes the cells that get no tracks in image `frame`.
    pub fn take(&self, grid: &mut OccupancyGrid, frame: FrameId) {
        for (index, _) in self.cells.iter().enumerate().filter(|(_, cell)| frame.0 < cell.until) {
            grid.take_index(index);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_left_alone_for_longer_each_time() {
        let mut grid = OccupancyGrid::new(640, 480, 32);
        let mut parts = FixedParts::new(&grid, 640);
        let at = Pixel::new(100.0, 470.0);
        let is_free = |parts: &FixedParts, grid: &mut OccupancyGrid, frame| {
            grid.clear();
            parts.take(grid, FrameId(frame));
            assert!(grid.is_free(&Pixel::new(140.0, 470.0)), "the next cell");
            grid.is_free(&at)
        };
        assert!(is_free(&parts, &mut grid, 0));
        parts.add(&grid, &at, FrameId(10));
        assert!(!is_free(&parts, &mut grid, 73) && is_free(&parts, &mut grid, 74));
        parts.add(&grid, &at, FrameId(80));
        assert_eq!(parts.share(), 1.0 / 300.0);
        assert!(!is_free(&parts, &mut grid, 207) && is_free(&parts, &mut grid, 208));
        for _ in 0..100 {
            parts.add(&grid, &at, FrameId(u32::MAX - 5));
        }
        assert!(!is_free(&parts, &mut grid, u32::MAX - 1));
    }
}
