//! FAST-9 corner candidates (Rosten & Drummond 2006): nine neighbours on a circle that are all brighter or all darker.
//!
//! A vectorised pass over each row keeps what can be a corner at all (of the four compass points of the circle, one of
//! each opposite pair must differ); only those few are tested in full.

use super::super::simd::dispatch;
use vidar_core::Image;

/// The circle of radius 3, clockwise from the top.
const CIRCLE: [(isize, isize); 16] = [
    (0, -3),
    (1, -3),
    (2, -2),
    (3, -1),
    (3, 0),
    (3, 1),
    (2, 2),
    (1, 3),
    (0, 3),
    (-1, 3),
    (-2, 2),
    (-3, 1),
    (-3, 0),
    (-3, -1),
    (-2, -2),
    (-1, -3),
];

/// A corner candidate on its level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Candidate {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// Sum by which the circle exceeds the threshold, grey levels.
    pub score: i32,
}

/// Buffers of the detector for one row and its neighbours.
#[derive(Clone, Debug, Default)]
pub(crate) struct FastScanner {
    possible: Vec<u8>,
    /// Scores of three rows in turn, for the suppression of neighbours.
    scores: [Vec<i32>; 3],
}

impl FastScanner {
    /// Calls `found` for every candidate that is the best among its eight neighbours, row by row.
    pub fn scan(
        &mut self,
        image: &Image<u8>,
        threshold: u8,
        border: usize,
        mut found: impl FnMut(Candidate),
    ) {
        let (width, height) = (image.width(), image.height());
        let border = border.max(4);
        if width <= 2 * border || height <= 2 * border {
            return;
        }
        self.possible.resize(width, 0);
        for row in &mut self.scores {
            row.clear();
            row.resize(width, 0);
        }
        let offsets = CIRCLE.map(|(dx, dy)| dy * width as isize + dx);
        // One row further on each side is scored, so that suppression knows the neighbours of the border rows.
        for y in border - 1..=height - border {
            let scores = &mut self.scores[y % 3];
            scores.fill(0);
            dispatch!(possible_row(image, y, threshold, &mut self.possible));
            let base = y * width;
            for x in border - 1..=width - border {
                if self.possible[x] != 0 {
                    scores[x] = score(image.data(), base + x, &offsets, threshold.into());
                }
            }
            if y > border {
                let rows = [&self.scores[(y - 2) % 3], &self.scores[(y - 1) % 3], &self.scores[y % 3]];
                emit(rows, y - 1, border, &mut found);
            }
        }
    }
}

/// Emits what is strictly better than earlier neighbours and at least as good as later ones.
fn emit(rows: [&Vec<i32>; 3], y: usize, border: usize, found: &mut impl FnMut(Candidate)) {
    let width = rows[1].len();
    for x in border..width - border {
        let s = rows[1][x];
        if s == 0 {
            continue;
        }
        let before = rows[0][x - 1].max(rows[0][x]).max(rows[0][x + 1]).max(rows[1][x - 1]);
        let after = rows[2][x - 1].max(rows[2][x]).max(rows[2][x + 1]).max(rows[1][x + 1]);
        if s > before && s >= after {
            found(Candidate { x, y, score: s });
        }
    }
}

/// Marks the pixels of a row whose compass points allow an arc of nine.
#[inline(always)]
fn possible_row(image: &Image<u8>, y: usize, threshold: u8, out: &mut [u8]) {
    let (width, data) = (image.width(), image.data());
    let n = width - 6;
    let base = y * width + 3;
    let centre = &data[base..][..n];
    let (up, down) = (&data[base - 3 * width..][..n], &data[base + 3 * width..][..n]);
    let (left, right) = (&data[base - 3..][..n], &data[base + 3..][..n]);
    let out = &mut out[3..3 + n];
    for i in 0..n {
        let (high, low) = (centre[i].saturating_add(threshold), centre[i].saturating_sub(threshold));
        let bright = up[i].max(down[i]).min(left[i].max(right[i])) > high;
        let dark = up[i].min(down[i]).max(left[i].min(right[i])) < low;
        out[i] = u8::from(bright) | u8::from(dark);
    }
}

/// Zero unless nine neighbours in a row differ; else the sum of what exceeds the threshold, of the stronger side.
fn score(data: &[u8], at: usize, offsets: &[isize; 16], threshold: i32) -> i32 {
    let centre = i32::from(data[at]);
    let (mut bright, mut dark) = (0_u32, 0_u32);
    let (mut above, mut below) = (0, 0);
    for (bit, offset) in offsets.iter().enumerate() {
        let difference = i32::from(data[at.wrapping_add_signed(*offset)]) - centre;
        if difference > threshold {
            bright |= 1 << bit;
            above += difference - threshold;
        } else if difference < -threshold {
            dark |= 1 << bit;
            below -= difference + threshold;
        }
    }
    let is_corner = |mask: u32| {
        // Nine set bits in a row, round the circle: and-ing shifted copies leaves the starts of ever longer runs.
        let ring = mask | mask << 16;
        let runs2 = ring & ring >> 1;
        let runs4 = runs2 & runs2 >> 2;
        let runs8 = runs4 & runs4 >> 4;
        runs8 & ring >> 8 & 0xffff != 0
    };
    match (is_corner(bright), is_corner(dark)) {
        (true, false) => above,
        (false, true) => below,
        (true, true) => above.max(below),
        (false, false) => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::simd::narrow;

    /// The definition, pixel by pixel, without shortcuts.
    fn is_corner_by_definition(image: &Image<u8>, x: usize, y: usize, threshold: i32) -> bool {
        let centre = i32::from(image[(x, y)]);
        let ring = CIRCLE.map(|(dx, dy)| {
            i32::from(image[(x.wrapping_add_signed(dx), y.wrapping_add_signed(dy))]) - centre
        });
        let arc = |holds: &dyn Fn(i32) -> bool| (0..16).any(|s| (0..9).all(|k| holds(ring[(s + k) % 16])));
        arc(&|d| d > threshold) || arc(&|d| d < -threshold)
    }

    fn blobs() -> Image<u8> {
        let mut state = 1_u32;
        let noise: Vec<u8> = (0..90 * 70)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        // Blocks of random grey: corners where they meet.
        Image::from_fn(90, 70, |x, y| noise[(y / 7) * 90 + x / 7])
    }

    #[test]
    fn candidates_are_corners_by_definition_and_none_is_missed() {
        let image = blobs();
        let mut scanner = FastScanner::default();
        let mut found = Vec::new();
        scanner.scan(&image, 10, 4, |c| found.push(c));
        assert!(found.len() > 30, "{}", found.len());
        for c in &found {
            assert!(is_corner_by_definition(&image, c.x, c.y, 10), "{c:?}");
        }
        for y in 5..65 {
            for x in 5..85 {
                if is_corner_by_definition(&image, x, y, 10) {
                    // Suppressed only by another corner: climbing to better neighbours always ends at a candidate.
                    let near = found.iter().any(|c| c.x.abs_diff(x) <= 4 && c.y.abs_diff(y) <= 4);
                    assert!(near, "corner at {x}, {y} without a candidate near it");
                }
            }
        }
    }

    #[test]
    fn no_two_candidates_touch_and_paths_agree() {
        let image = blobs();
        let run = || {
            let mut found = Vec::new();
            FastScanner::default().scan(&image, 15, 6, |c| found.push(c));
            found
        };
        let found = run();
        assert_eq!(found, narrow(run));
        for (i, a) in found.iter().enumerate() {
            assert!((6..84).contains(&a.x) && (6..64).contains(&a.y));
            for b in &found[i + 1..] {
                assert!(a.x.abs_diff(b.x) > 1 || a.y.abs_diff(b.y) > 1, "{a:?} {b:?}");
            }
        }
        let flat = Image::filled(40, 40, 77_u8);
        FastScanner::default().scan(&flat, 5, 4, |c| panic!("{c:?} in a flat image"));
    }
}
