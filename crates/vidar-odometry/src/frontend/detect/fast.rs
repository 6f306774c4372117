//! FAST-9 corner candidates (Rosten & Drummond 2006): nine neighbours on a circle that are all brighter or all darker.
//!
//! Blocks of 32 pixels at a time, without a branch per pixel: the least of every arc of nine is found by doubling, and the
//! best arc's margin over the centre is the score, i.e. the largest threshold for which the pixel would still be a corner.
//! Only minima and maxima of bytes are taken, so every width of vector gives the same bits.

use vidar_core::Image;
use vidar_core::simd::kernel;

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
    /// Largest threshold for which it is a corner, grey levels.
    pub score: u8,
}

/// Buffers of the detector for one row and its neighbours.
#[derive(Clone, Debug, Default)]
pub(crate) struct FastScanner {
    /// Scores of three rows in turn, for the suppression of neighbours.
    scores: [Vec<u8>; 3],
    best: Vec<u8>,
}

/// Pixels that are worked on at once.
const LANES: usize = 32;
type Block = [u8; LANES];

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
        if width <= 2 * border + LANES || height <= 2 * border {
            return;
        }
        for row in self.scores.iter_mut().chain([&mut self.best]) {
            row.clear();
            row.resize(width, 0);
        }
        // One row further on each side is scored, so that suppression knows the neighbours of the border rows.
        for y in border - 1..=height - border {
            let scores = &mut self.scores[y % 3];
            score_row(image, y, threshold, scores);
            if y <= border {
                continue;
            }
            let rows = [&self.scores[(y - 2) % 3], &self.scores[(y - 1) % 3], &self.scores[y % 3]];
            suppress(rows, border, &mut self.best);
            for (block, scores) in self.best.chunks(LANES).enumerate() {
                if scores.iter().all(|s| *s == 0) {
                    continue;
                }
                for (lane, score) in scores.iter().enumerate().filter(|(_, s)| **s != 0) {
                    found(Candidate { x: block * LANES + lane, y: y - 1, score: *score });
                }
            }
        }
    }
}

kernel! {
    fn score_row(image: &Image<u8>, y: usize, threshold: u8, scores: &mut [u8]) {
        score_blocks(image, y, threshold, scores);
    }
}

kernel! {
    fn suppress(rows: [&Vec<u8>; 3], border: usize, best: &mut [u8]) {
        keep_greatest(rows, border, best);
    }
}

/// Scores of a row; zero where no arc exceeds the threshold, and in the three outermost columns.
#[inline(always)]
fn score_blocks(image: &Image<u8>, y: usize, threshold: u8, scores: &mut [u8]) {
    let width = image.width();
    let end = width - 3 - LANES;
    let mut x = 3;
    loop {
        // The last block overlaps the one before, so that none is short.
        let start = x.min(end);
        let block = score_block(image.data(), y * width + start, width, threshold);
        scores[start..start + LANES].copy_from_slice(&block);
        if x >= end {
            break;
        }
        x += LANES;
    }
}

#[inline(always)]
fn score_block(data: &[u8], at: usize, width: usize, threshold: u8) -> Block {
    let centre = load(data, at, width, (0, 0));
    // Of the four compass points an arc of nine holds one of each opposite pair; most blocks of calm images end here.
    let (up, down) = (load(data, at, width, CIRCLE[0]), load(data, at, width, CIRCLE[8]));
    let (right, left) = (load(data, at, width, CIRCLE[4]), load(data, at, width, CIRCLE[12]));
    let bright = least(&greatest(&up, &down), &greatest(&left, &right));
    let dark = greatest(&least(&up, &down), &least(&left, &right));
    let margin = greatest(&above(&bright, &centre), &above(&centre, &dark));
    if margin.iter().fold(0, |m: u8, v| m.max(*v)) <= threshold {
        return [0; LANES];
    }
    let mut ring = [[0; LANES]; 16];
    for (block, offset) in ring.iter_mut().zip(CIRCLE) {
        *block = load(data, at, width, offset);
    }
    let brightest = best_arc(&ring, least, greatest);
    let darkest = best_arc(&ring, greatest, least);
    let mut score = greatest(&above(&brightest, &centre), &above(&centre, &darkest));
    for s in &mut score {
        *s = if *s > threshold { *s } else { 0 };
    }
    score
}

#[inline(always)]
fn load(data: &[u8], at: usize, width: usize, offset: (isize, isize)) -> Block {
    let start = at.wrapping_add_signed(offset.1 * width as isize + offset.0);
    let mut block = [0; LANES];
    block.copy_from_slice(&data[start..start + LANES]);
    block
}

/// `better` over all arcs of nine of `worse` within the arc.
///
/// Two arcs that differ by one step share eight pixels: with `e` the worst of those, the better of the two arcs is
/// `worse(e, better(first, last))`, so eight runs of eight do for sixteen arcs of nine.
#[inline(always)]
fn best_arc(
    ring: &[Block; 16],
    worse: impl Fn(&Block, &Block) -> Block,
    better: impl Fn(&Block, &Block) -> Block,
) -> Block {
    let (mut two, mut four) = ([[0; LANES]; 8], [[0; LANES]; 8]);
    for k in 0..8 {
        two[k] = worse(&ring[2 * k + 1], &ring[(2 * k + 2) % 16]);
    }
    for k in 0..8 {
        four[k] = worse(&two[k], &two[(k + 1) % 8]);
    }
    let mut best = [0; LANES];
    for k in 0..8 {
        let eight = worse(&four[k], &four[(k + 2) % 8]);
        let arcs = worse(&eight, &better(&ring[2 * k], &ring[(2 * k + 9) % 16]));
        best = if k == 0 { arcs } else { better(&best, &arcs) };
    }
    best
}

#[inline(always)]
fn least(a: &Block, b: &Block) -> Block {
    let mut out = *a;
    for (o, v) in out.iter_mut().zip(b) {
        *o = (*o).min(*v);
    }
    out
}

#[inline(always)]
fn greatest(a: &Block, b: &Block) -> Block {
    let mut out = *a;
    for (o, v) in out.iter_mut().zip(b) {
        *o = (*o).max(*v);
    }
    out
}

/// `a − b` where that is positive, else zero.
#[inline(always)]
fn above(a: &Block, b: &Block) -> Block {
    let mut out = *a;
    for (o, v) in out.iter_mut().zip(b) {
        *o = o.saturating_sub(*v);
    }
    out
}

/// Keeps what is strictly better than earlier neighbours and at least as good as later ones; zero elsewhere.
#[inline(always)]
fn keep_greatest(rows: [&Vec<u8>; 3], border: usize, best: &mut [u8]) {
    let n = best.len() - 2 * border;
    let part = |row: usize, shift: usize| &rows[row][border + shift - 1..][..n];
    let (nw, no, ne, we) = (part(0, 0), part(0, 1), part(0, 2), part(1, 0));
    let (ea, sw, so, se) = (part(1, 2), part(2, 0), part(2, 1), part(2, 2));
    let own = part(1, 1);
    let out = &mut best[border..border + n];
    for i in 0..n {
        let before = nw[i].max(no[i]).max(ne[i]).max(we[i]);
        let after = ea[i].max(sw[i]).max(so[i]).max(se[i]);
        let s = own[i];
        out[i] = if (s > before) & (s >= after) { s } else { 0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::random::SplitMix64;
    use vidar_core::testing::same_with_each_instruction_set;

    /// The definition, pixel by pixel, without shortcuts.
    fn score_by_definition(image: &Image<u8>, x: usize, y: usize, threshold: i32) -> i32 {
        let centre = i32::from(image[(x, y)]);
        let ring = CIRCLE.map(|(dx, dy)| {
            i32::from(image[(x.wrapping_add_signed(dx), y.wrapping_add_signed(dy))]) - centre
        });
        let arcs = |sign: i32| (0..16).map(move |s| (0..9).map(|k| sign * ring[(s + k) % 16]).min().unwrap());
        let best = arcs(1).chain(arcs(-1)).max().unwrap();
        if best > threshold { best } else { 0 }
    }

    fn blobs() -> Image<u8> {
        let mut random = SplitMix64::new(1);
        let noise: Vec<u8> = (0..90 * 70).map(|_| random.below(256) as u8).collect();
        // Blocks of random grey: corners where they meet.
        Image::from_fn(90, 70, |x, y| noise[(y / 7) * 90 + x / 7])
    }

    #[test]
    fn candidates_are_the_best_corners_by_definition_and_none_is_missed() {
        for image in [blobs(), Image::from_fn(90, 70, |x, y| ((x * x * 3 + y * y * 5 + x * y) % 251) as u8)] {
            let mut found = Vec::new();
            FastScanner::default().scan(&image, 10, 4, |c| found.push(c));
            let score = |x: usize, y: usize| score_by_definition(&image, x, y, 10);
            let mut expected = Vec::new();
            for y in 4..66 {
                for x in 4..86 {
                    let s = score(x, y);
                    let before = [(x - 1, y - 1), (x, y - 1), (x + 1, y - 1), (x - 1, y)];
                    let after = [(x + 1, y), (x - 1, y + 1), (x, y + 1), (x + 1, y + 1)];
                    let best = before.iter().all(|(u, v)| score(*u, *v) < s)
                        && after.iter().all(|(u, v)| score(*u, *v) <= s);
                    if s > 0 && best {
                        expected.push(Candidate { x, y, score: s as u8 });
                    }
                }
            }
            assert!(expected.len() > 30, "{}", expected.len());
            assert_eq!(found, expected);
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
        let found = same_with_each_instruction_set(run);
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
