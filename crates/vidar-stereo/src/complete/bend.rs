//! A surface through everything measured that has the shape of another one in between: gradient-domain filling.
//!
//! With ln d known at some pixels and a shape g (ln of a network's depth, or 0), the rest minimises
//!
//! `Σ w (x_i − x_j − (g_i − g_j))²`,  `w = exp(−|∇I| / 6 − |∇g| / 0.03)`
//!
//! over neighbouring pixels (Pérez 2003 with the edge weights of Levin 2004), so the log ratio to the shape is a membrane
//! that tears at edges of the image and of the shape. It is solved for u = x − g from coarse to fine: on each size by red-black
//! over-relaxation, started from the size before it.

/// Grey levels and logarithms over which the tie between neighbours falls to 1/e; measured on recordings of an RGB-D camera.
const LUMINANCE_SCALE: f32 = 6.0;
const SHAPE_SCALE: f32 = 0.03;
/// Least tie, so that no pixel is left without a value.
const LEAST_TIE: f32 = 1e-4;
/// Sweeps at the full size, and at each coarser one: what the coarse sizes solved needs only smoothing.
const FINE_SWEEPS: usize = 8;
const COARSE_SWEEPS: usize = 24;
/// Over-relaxation. The optimum for few sweeps; near 2 it would need hundreds.
const RELAXATION: f32 = 1.7;
/// Sizes are halved down to this side.
const LEAST_SIDE: usize = 4;
/// Length of a chain of pixels that stands for the image's end.
const FAR: f32 = 1e9;

/// One size of the problem.
struct Level {
    width: usize,
    height: usize,
    /// u where it is known, NaN elsewhere.
    known: Vec<f32>,
    /// Ties to the pixel on the right, and to the one below; 0 at the last column and row.
    right: Vec<f32>,
    below: Vec<f32>,
}

/// ln(depth) at every pixel, equal to `log_depth` where that is known. `shape` is in any unit; where it is NaN its
/// gradient counts as zero. All NaN where nothing is known.
pub(super) fn bend(
    log_depth: &[f32],
    shape: Option<&[f32]>,
    luminance: &[f32],
    width: usize,
    height: usize,
) -> Vec<f32> {
    if log_depth.iter().all(|d| d.is_nan()) {
        return log_depth.to_vec();
    }
    let shape = shape.map(|s| continued(s, width));
    let shape_at = |i: usize| shape.as_ref().map_or(0.0, |s| s[i]);
    let known = log_depth.iter().enumerate().map(|(i, d)| d - shape_at(i)).collect();
    let tie = |i: usize, j: usize| {
        let steps = (luminance[i] - luminance[j]).abs() / LUMINANCE_SCALE
            + (shape_at(i) - shape_at(j)).abs() / SHAPE_SCALE;
        crate::elementary::exp(-steps).max(LEAST_TIE)
    };
    let mut levels = vec![Level::finest(width, height, known, tie)];
    while let Some(coarser) = levels.last().and_then(Level::halved) {
        levels.push(coarser);
    }
    let mut solution: Option<(Vec<f32>, usize)> = None;
    for (number, level) in levels.iter().enumerate().rev() {
        let start = level.start(solution.as_ref().map(|(u, width)| (&u[..], *width)));
        let sweeps = if number == 0 { FINE_SWEEPS } else { COARSE_SWEEPS };
        solution = Some((level.relaxed(start, sweeps), level.width));
    }
    let bent = solution.map_or_else(Vec::new, |(u, _)| u);
    (0..width * height)
        .map(|i| if log_depth[i].is_nan() { bent[i] + shape_at(i) } else { log_depth[i] })
        .collect()
}

/// The shape with the last value of its row where it is NaN.
fn continued(shape: &[f32], width: usize) -> Vec<f32> {
    let mut continued = shape.to_vec();
    let mut last = shape.iter().copied().find(|g| g.is_finite()).unwrap_or(0.0);
    for row in continued.chunks_mut(width.max(1)) {
        for g in row {
            last = if g.is_finite() { *g } else { last };
            *g = last;
        }
    }
    continued
}

impl Level {
    fn finest(width: usize, height: usize, known: Vec<f32>, tie: impl Fn(usize, usize) -> f32) -> Self {
        let all = |step: usize, has: &dyn Fn(usize) -> bool| -> Vec<f32> {
            (0..width * height).map(|i| if has(i) { tie(i, i + step) } else { 0.0 }).collect()
        };
        let right = all(1, &|i| i % width + 1 < width);
        let below = all(width, &|i| i + width < width * height);
        Self { width, height, known, right, below }
    }

    /// The same at half the size: a cell is known where one of its pixels is; ties are those of chains of pixels between the
    /// cells' centres, side by side.
    fn halved(&self) -> Option<Self> {
        if self.width.min(self.height) <= LEAST_SIDE {
            return None;
        }
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut halved = Self {
            width,
            height,
            known: vec![f32::NAN; width * height],
            right: vec![0.0; width * height],
            below: vec![0.0; width * height],
        };
        for y in 0..height {
            for x in 0..width {
                let (mut sum, mut count) = (0.0, 0.0);
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    if let Some(i) = self.at(2 * x + dx, 2 * y + dy).filter(|i| self.known[*i].is_finite()) {
                        (sum, count) = (sum + self.known[i], count + 1.0);
                    }
                }
                let i = y * width + x;
                if count > 0.0 {
                    halved.known[i] = sum / count;
                }
                let chain = |ties: &[f32], x: usize, y: usize, dx: usize, dy: usize| {
                    let tie = |k: usize| self.at(x + k * dx, y + k * dy).map_or(0.0, |i| ties[i]);
                    let resistance = |tie: f32| if tie > 0.0 { 1.0 / tie } else { FAR };
                    // Half of each cell's inner tie, and the one between the cells; the last cell may be half a one.
                    let inner = 0.5 * (resistance(tie(0)) + resistance(tie(2)).min(resistance(tie(1))));
                    if tie(1) > 0.0 { 1.0 / (inner + resistance(tie(1))) } else { 0.0 }
                };
                halved.right[i] =
                    chain(&self.right, 2 * x, 2 * y, 1, 0) + chain(&self.right, 2 * x, 2 * y + 1, 1, 0);
                halved.below[i] =
                    chain(&self.below, 2 * x, 2 * y, 0, 1) + chain(&self.below, 2 * x + 1, 2 * y, 0, 1);
            }
        }
        Some(halved)
    }

    fn at(&self, x: usize, y: usize) -> Option<usize> {
        (x < self.width && y < self.height).then_some(y * self.width + x)
    }

    /// The coarser solution at this size, or the mean of what is known.
    fn start(&self, coarser: Option<(&[f32], usize)>) -> Vec<f32> {
        let mean = || {
            let known = || self.known.iter().filter(|u| u.is_finite());
            known().sum::<f32>() / known().count().max(1) as f32
        };
        let fallback = if coarser.is_none() { mean() } else { 0.0 };
        let value = |i: usize| match coarser {
            _ if self.known[i].is_finite() => self.known[i],
            Some((u, width)) => u[(i / self.width / 2) * width + i % self.width / 2],
            None => fallback,
        };
        (0..self.known.len()).map(value).collect()
    }

    /// Red-black over-relaxation: pixels of one colour depend on the other's alone.
    fn relaxed(&self, mut u: Vec<f32>, sweeps: usize) -> Vec<f32> {
        for half in 0..2 * sweeps {
            for y in 0..self.height {
                for x in ((y + half) % 2..self.width).step_by(2) {
                    let i = y * self.width + x;
                    if !self.known[i].is_finite() {
                        u[i] += RELAXATION * (self.neighbours_mean(&u, x, y) - u[i]);
                    }
                }
            }
        }
        u
    }

    /// Mean of the neighbours, weighted by their ties.
    #[inline(always)]
    fn neighbours_mean(&self, u: &[f32], x: usize, y: usize) -> f32 {
        let (w, i) = (self.width, y * self.width + x);
        let (mut sum, mut ties) = (0.0, 0.0);
        let mut add = |tie: f32, value: f32| {
            sum += tie * value;
            ties += tie;
        };
        if x > 0 {
            add(self.right[i - 1], u[i - 1]);
        }
        if x + 1 < w {
            add(self.right[i], u[i + 1]);
        }
        if y > 0 {
            add(self.below[i - w], u[i - w]);
        }
        if y + 1 < self.height {
            add(self.below[i], u[i + w]);
        }
        if ties > 0.0 { sum / ties } else { u[i] }
    }
}

/// Distance of each pixel to the nearest known one, pixels, by two passes of a 3-4 chamfer (Borgefors 1986; within 8 %).
pub(super) fn distances(log_depth: &[f32], width: usize, height: usize) -> Vec<f32> {
    const STRAIGHT: f32 = 1.0;
    const DIAGONAL: f32 = 4.0 / 3.0;
    let mut distance: Vec<f32> =
        log_depth.iter().map(|d| if d.is_finite() { 0.0 } else { f32::INFINITY }).collect();
    let mut pass = |forward: bool| {
        for step in 0..width * height {
            let i = if forward { step } else { width * height - 1 - step };
            let (x, y) = ((i % width) as i64, (i / width) as i64);
            let sign = if forward { -1 } else { 1 };
            let mut nearest = distance[i];
            for (dx, dy, length) in [(1, 0, STRAIGHT), (0, 1, STRAIGHT), (1, 1, DIAGONAL), (-1, 1, DIAGONAL)]
            {
                let (x, y) = (x + sign * dx, y + sign * dy);
                if x >= 0 && y >= 0 && x < width as i64 && y < height as i64 {
                    nearest = nearest.min(distance[y as usize * width + x as usize] + length);
                }
            }
            distance[i] = nearest;
        }
    };
    pass(true);
    pass(false);
    distance
}
