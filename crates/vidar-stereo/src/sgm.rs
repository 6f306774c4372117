//! Semi-global matching (Hirschmüller 2008): minimal-cost paths into every pixel from eight directions, summed.
//!
//! `L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min_k L(q, k) + P2) − min_k L(q, k)` with q before p on the
//! path; P2 falls with the brightness step between p and q, because depth edges lie on brightness edges.
//! All numbers are integers, so the sum does not depend on the order of directions or threads.

use crate::prepare::Level;
use crate::sweep::INVISIBLE;

/// Penalties of the smoothness term.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Penalties {
    /// One plane.
    pub step: i16,
    /// More than one plane, at equal brightness.
    pub jump: i16,
}

/// Brightness step at which P2 has fallen to half, grey levels.
const HALVING_STEP_GRAY: f32 = 12.0;
/// Neutral cost of a plane that is visible in no neighbour: that of no correlation.
const NEUTRAL: i16 = 254;

/// Sums of the path costs by row, column, plane; `costs` as from the sweep. Needs `2·costs.len()` `i16`.
pub(crate) fn aggregate(image: &Level, costs: &[u8], planes: usize, penalties: Penalties) -> Vec<i16> {
    let pass = |flipped: bool| half_pass(image, costs, planes, penalties, flipped);
    let (mut down, up) = rayon::join(|| pass(false), || pass(true));
    for (a, b) in down.iter_mut().zip(&up) {
        *a += b;
    }
    down
}

/// Four directions in one walk: from the left, and from the three pixels of the row above. `flipped` walks the image
/// turned by 180°, which gives the other four.
fn half_pass(image: &Level, costs: &[u8], planes: usize, penalties: Penalties, flipped: bool) -> Vec<i16> {
    let (w, h) = (image.width, image.height);
    let mut sums = vec![0i16; w * h * planes];
    // Path costs of one row for each direction from above, padded by one plane at both ends.
    let cell = planes + 2;
    let blank = || Row { paths: vec![BLOCKED; w * cell], least: vec![0; w] };
    let mut above = [blank(), blank(), blank()];
    let mut current = [blank(), blank(), blank()];
    let mut left = vec![BLOCKED; cell];
    let mut left_next = vec![BLOCKED; cell];
    let mut cost = vec![0i16; planes];
    for step_y in 0..h {
        let y = if flipped { h - 1 - step_y } else { step_y };
        let mut left_least = 0;
        for step_x in 0..w {
            let x = if flipped { w - 1 - step_x } else { step_x };
            let pixel = y * w + x;
            for (c, &raw) in cost.iter_mut().zip(&costs[pixel * planes..][..planes]) {
                *c = if raw == INVISIBLE { NEUTRAL } else { i16::from(raw) };
            }
            let sum = &mut sums[pixel * planes..][..planes];
            let jump = |qx: usize, qy: usize| {
                let edge = (image.gray[pixel] - image.gray[qy * w + qx]).abs();
                let fallen = f32::from(penalties.jump) / (1.0 + edge / HALVING_STEP_GRAY);
                (fallen as i16).max(penalties.step)
            };
            let back_x = |by: isize| if flipped { x as isize + by } else { x as isize - by };
            let previous_y = if flipped { y + 1 } else { y.wrapping_sub(1) };
            // From the left.
            if step_x == 0 {
                left_least = start(&cost, &mut left_next, sum);
            } else {
                let p2 = jump(back_x(1) as usize, y);
                left_least = extend(&cost, (&left, left_least), (penalties.step, p2), &mut left_next, sum);
            }
            std::mem::swap(&mut left, &mut left_next);
            // From above: by = 1, 0, −1 is above-left, above, above-right of the walk.
            for (direction, by) in [1isize, 0, -1].into_iter().enumerate() {
                let from = step_x as isize - by;
                let target = &mut current[direction];
                let path = &mut target.paths[step_x * cell..][..cell];
                target.least[step_x] = if step_y == 0 || from < 0 || from >= w as isize {
                    start(&cost, path, sum)
                } else {
                    let from = from as usize;
                    let source = &above[direction];
                    let before = (&source.paths[from * cell..][..cell], source.least[from]);
                    let p2 = jump(back_x(by) as usize, previous_y);
                    extend(&cost, before, (penalties.step, p2), path, sum)
                };
            }
        }
        std::mem::swap(&mut above, &mut current);
    }
    sums
}

/// A path cost that never wins; small enough that adding a penalty does not overflow.
const BLOCKED: i16 = i16::MAX / 2;

struct Row {
    paths: Vec<i16>,
    least: Vec<i16>,
}

/// Begins a path: its cost is the pixel's own.
fn start(cost: &[i16], path: &mut [i16], sum: &mut [i16]) -> i16 {
    let n = cost.len();
    path[1..=n].copy_from_slice(cost);
    (path[0], path[n + 1]) = (BLOCKED, BLOCKED);
    for (s, c) in sum.iter_mut().zip(cost) {
        *s += c;
    }
    cost.iter().copied().min().unwrap_or(0)
}

/// One step along a path; returns the least cost of the new cell.
#[inline]
fn extend(
    cost: &[i16],
    (before, before_least): (&[i16], i16),
    (p1, p2): (i16, i16),
    path: &mut [i16],
    sum: &mut [i16],
) -> i16 {
    let n = cost.len();
    let (lower, same, upper) = (&before[..n], &before[1..=n], &before[2..n + 2]);
    let jump = before_least + p2;
    (path[0], path[n + 1]) = (BLOCKED, BLOCKED);
    let out = &mut path[1..=n];
    let sum = &mut sum[..n];
    let mut least = i16::MAX;
    for d in 0..n {
        let best = same[d].min(lower[d] + p1).min(upper[d] + p1).min(jump);
        let value = cost[d] + best - before_least;
        out[d] = value;
        sum[d] += value;
        least = least.min(value);
    }
    least
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Pinhole;

    /// Cheapest cost of any labelling of a path that ends in each label, by trying every labelling.
    fn brute_force(costs: &[Vec<i64>], p1: i64, p2: i64) -> Vec<i64> {
        let labels = costs[0].len();
        let mut best = vec![i64::MAX; labels];
        for code in 0..labels.pow(costs.len() as u32) {
            let labelling: Vec<usize> =
                (0..costs.len()).map(|i| code / labels.pow(i as u32) % labels).collect();
            let data: i64 = labelling.iter().zip(costs).map(|(&l, c)| c[l]).sum();
            let smooth: i64 = labelling
                .windows(2)
                .map(|w| match w[0].abs_diff(w[1]) {
                    0 => 0,
                    1 => p1,
                    _ => p2,
                })
                .sum();
            let last = labelling[labelling.len() - 1];
            best[last] = best[last].min(data + smooth);
        }
        best
    }

    #[test]
    fn a_path_costs_what_trying_every_labelling_finds() {
        // One row, so that only the two horizontal directions have predecessors; the six others add C each.
        let (w, planes) = (5, 4);
        let costs: Vec<u8> = (0..w * planes).map(|i| ((i * 7919 + 13) % 97) as u8).collect();
        let k = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: w, height: 1 };
        let image = Level { width: w, height: 1, gray: vec![9.0; w], intrinsics: k };
        let (p1, p2) = (5i16, 30i16);
        let sums = aggregate(&image, &costs, planes, Penalties { step: p1, jump: p2 });
        let cell = |x: usize| -> Vec<i64> {
            costs[x * planes..(x + 1) * planes].iter().map(|&c| i64::from(c)).collect()
        };
        let to_relative = |prefix: &[Vec<i64>]| -> Vec<i64> {
            // Eq. 13 subtracts the least of the cell before at each step.
            let total = brute_force(prefix, i64::from(p1), i64::from(p2));
            let before = if prefix.len() > 1 {
                let previous = brute_force(&prefix[..prefix.len() - 1], i64::from(p1), i64::from(p2));
                previous.into_iter().min().unwrap_or(0)
            } else {
                0
            };
            total.into_iter().map(|t| t - before).collect()
        };
        for x in 0..w {
            let from_left: Vec<Vec<i64>> = (0..=x).map(cell).collect();
            let from_right: Vec<Vec<i64>> = (x..w).rev().map(cell).collect();
            let (l, r) = (to_relative(&from_left), to_relative(&from_right));
            for d in 0..planes {
                let expected = l[d] + r[d] + 6 * cell(x)[d];
                assert_eq!(i64::from(sums[x * planes + d]), expected, "x {x} d {d}");
            }
        }
    }
}
