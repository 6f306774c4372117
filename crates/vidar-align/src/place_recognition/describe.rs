//! Descriptors that need no network of their own.

use vidar_core::Image;

/// Cells across and down, and numbers per cell: mean brightness and eight gradient directions.
const COLUMNS: usize = 8;
const ROWS: usize = 6;
const DIRECTIONS: usize = 8;
const PER_CELL: usize = 1 + DIRECTIONS;

/// Length of the descriptors of [`describe_image`].
pub const IMAGE_DESCRIPTOR_LEN: usize = COLUMNS * ROWS * PER_CELL;

/// The descriptor of an image from a geometry network's tokens: the mean of the unit-length tokens, of unit length.
///
/// `tokens` is row-major `[tokens, channels]`. Tokens are normalised first so that one with a large norm does not dominate
/// the mean. Empty for an empty grid or one with values that are not finite.
pub fn describe_tokens(tokens: &[f32], channels: usize) -> Vec<f32> {
    if channels == 0 || tokens.len() < channels || !tokens.iter().all(|v| v.is_finite()) {
        return Vec::new();
    }
    let mut mean = vec![0.0_f64; channels];
    for token in tokens.chunks_exact(channels) {
        let length = token.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt().max(1e-12);
        mean.iter_mut().zip(token).for_each(|(m, v)| *m += f64::from(*v) / length);
    }
    unit(mean)
}

/// The descriptor of an image from brightness and gradient directions on an 8 × 6 grid, normalised for contrast.
///
/// Used where no network runs. It recognises the same view under another exposure and up to about one cell of displacement,
/// but not the same place from another direction.
pub fn describe_image(gray: &Image<f32>) -> Vec<f32> {
    let (w, h) = (gray.width(), gray.height());
    if w < 2 * COLUMNS || h < 2 * ROWS {
        return Vec::new();
    }
    let mut cells = vec![[0.0_f64; PER_CELL]; COLUMNS * ROWS];
    for y in 1..h - 1 {
        for x in 1..w - 1 {
            let value = gray[(x, y)];
            let dx = f64::from(gray[(x + 1, y)] - gray[(x - 1, y)]);
            let dy = f64::from(gray[(x, y + 1)] - gray[(x, y - 1)]);
            if !(value.is_finite() && dx.is_finite() && dy.is_finite()) {
                continue;
            }
            let strength = dx.hypot(dy);
            let angle = dy.atan2(dx).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU;
            let direction = angle * DIRECTIONS as f64;
            let (first, share) = (direction as usize % DIRECTIONS, direction.fract());
            // Soft assignment in space and direction, so that a small shift changes the descriptor little.
            for (cell, weight) in spread(x, y, w, h) {
                let cell = &mut cells[cell];
                cell[0] += weight * f64::from(value);
                cell[1 + first] += weight * strength * (1.0 - share);
                cell[1 + (first + 1) % DIRECTIONS] += weight * strength * share;
            }
        }
    }
    let count = cells.len() as f64;
    // Only the pattern of brightness counts; its mean and contrast depend on the exposure.
    let mean = cells.iter().map(|c| c[0]).sum::<f64>() / count;
    let contrast = (cells.iter().map(|c| (c[0] - mean).powi(2)).sum::<f64>() / count).sqrt().max(1e-9);
    let total: f64 = cells.iter().flat_map(|c| &c[1..]).sum::<f64>().max(1e-9);
    let typical = total / (count * DIRECTIONS as f64);
    let mut values = Vec::with_capacity(IMAGE_DESCRIPTOR_LEN);
    for cell in &cells {
        values.push((cell[0] - mean) / contrast);
        // The square root limits the weight of one strong edge (as in RootSIFT); the mean carries no information.
        values.extend(cell[1..].iter().map(|g| (g / typical).sqrt() - 0.9));
    }
    unit(values)
}

/// The (up to four) cells a pixel belongs to, with bilinear weights.
fn spread(x: usize, y: usize, width: usize, height: usize) -> impl Iterator<Item = (usize, f64)> {
    let place = |p: usize, size: usize, cells: usize| {
        let at = ((p as f64 + 0.5) * cells as f64 / size as f64 - 0.5).clamp(0.0, (cells - 1) as f64);
        let low = (at as usize).min(cells - 2);
        (low, at - low as f64)
    };
    let (column, fx) = place(x, width, COLUMNS);
    let (row, fy) = place(y, height, ROWS);
    [(0, 0, (1.0 - fx) * (1.0 - fy)), (1, 0, fx * (1.0 - fy)), (0, 1, (1.0 - fx) * fy), (1, 1, fx * fy)]
        .into_iter()
        .map(move |(c, r, weight)| ((row + r) * COLUMNS + column + c, weight))
}

fn unit(values: Vec<f64>) -> Vec<f32> {
    let length = values.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !(length > 1e-12) {
        return Vec::new();
    }
    values.into_iter().map(|v| (v / length) as f32).collect()
}
