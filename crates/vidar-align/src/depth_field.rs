//! A smooth correction of a view's depth, fitted to landmarks.
//!
//! `log D'(u) = log D(u) + β + Σₘ φₘ(u) gₘ`, φ = bilinear weights of a 6 × 4 grid over the image. A model's depth of one
//! view is off by a factor that varies slowly across the image, which no similarity of a chunk can repair.

use serde::{Deserialize, Serialize};
use vidar_core::Image;

/// Columns of the grid.
pub const FIELD_COLUMNS: usize = 6;
/// Rows of the grid.
pub const FIELD_ROWS: usize = 4;
const NODES: usize = FIELD_COLUMNS * FIELD_ROWS;

/// ln of the factor by which a view's depth is to be multiplied, over its image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
