//! Semi-global matching (Hirschmüller 2008): minimal-cost paths into every pixel from eight directions, summed.
//!
//! `L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min_k L(q, k) + P2) − min_k L(q, k)` with q before p on the
//! path; P2 falls with the brightness step between p and q, because depth edges lie on brightness edges.
//! All numbers are integers, so the sum does not depend on the order of directions or threads.

use crate::prepare::{GRAY_STEPS, Level};
use crate::sweep::{INVISIBLE, LANES, Labels, Volume, WORST};
use vidar_core::simd::kernel;

/// Penalties of the smoothness term.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Penalties {
    /// One label.
    pub step: i16,
    /// More than one label, at equal brightness.
    pub jump: i16,
}

impl Penalties {
    /// A share of both, at least one.
    pub fn scaled(self, share: f32) -> Self {
        let scaled = |penalty: i16| ((f32::from(penalty) * share) as i16).max(1);
        Self { step: scaled(self.step), jump: scaled(self.jump) }
    }
}

/// Brightness step at which P2 has fallen to half, grey levels.
const HALVING_STEP_GRAY: f32 = 12.0;
/// Cost of a label that is visible in no neighbour: that of no correlation.
const NEUTRAL: u8 = INVISIBLE - 1;
/// A path cost that never wins; small enough that adding a penalty does not overflow.
const BLOCKED: i16 = i16::MAX / 2;

/// Sums of the path costs, in the volume's order.
pub(crate) fn aggregate(image: &Level, volume: &Volume, penalties: Penalties) -> Vec<i16> {
    let jumps = Jumps::new(penalties);
    let mut sums = vec![0i16; volume.costs.len()];
    for flipped in [false, true] {
        let mut walk = Walk::new(image, volume, penalties.step, &jumps, flipped);
        run(&mut walk, &mut sums);
    }
    sums
}

kernel! {
    fn run(walk: &mut Walk<'_>, sums: &mut [i16]) {
        walk.run(sums);
    }
}

/// P2 by brightness step.
struct Jumps([i16; 256]);

impl Jumps {
    fn new(penalties: Penalties) -> Self {
        let fallen = |step: usize| f32::from(penalties.jump) / (1.0 + step as f32 / HALVING_STEP_GRAY);
        Self(std::array::from_fn(|step| (fallen(step) as i16).max(penalties.step)))
    }

    #[inline(always)]
    fn between(&self, a: i16, b: i16) -> i16 {
        self.0[usize::from(a.abs_diff(b) / GRAY_STEPS as u16).min(255)]
    }
}

/// Paths of one direction into the pixels of a row.
struct Row {
    /// `cell` for each pixel: its labels, padded by one blocked label at both ends.
    paths: Vec<i16>,
    least: Vec<i16>,
}

/// Four directions in one walk: from the left, and from the three pixels of the row above. `flipped` walks the image
/// turned by 180°, which gives the other four.
struct Walk<'a> {
    image: &'a Level,
    volume: &'a Volume,
    step: i16,
    jumps: &'a Jumps,
    flipped: bool,
    /// Entries of a padded pixel.
    cell: usize,
    above: [Row; 3],
    current: [Row; 3],
    left: [Vec<i16>; 2],
}

impl<'a> Walk<'a> {
    fn new(image: &'a Level, volume: &'a Volume, step: i16, jumps: &'a Jumps, flipped: bool) -> Self {
        let cell = volume.stride + 2;
        let row = || Row { paths: vec![BLOCKED; image.width * cell], least: vec![0; image.width] };
        let rows = || [row(), row(), row()];
        let left = [vec![BLOCKED; cell], vec![BLOCKED; cell]];
        Self { image, volume, step, jumps, flipped, cell, above: rows(), current: rows(), left }
    }

    #[inline(always)]
    fn run(&mut self, sums: &mut [i16]) {
        let (w, h, stride, cell) = (self.image.width, self.image.height, self.volume.stride, self.cell);
        let gray = &self.image.gray;
        for step_y in 0..h {
            let y = if self.flipped { h - 1 - step_y } else { step_y };
            let mut left_least = 0;
            for step_x in 0..w {
                let x = if self.flipped { w - 1 - step_x } else { step_x };
                let pixel = y * w + x;
                let cost = &self.volume.costs[pixel * stride..][..stride];
                let sum = &mut sums[pixel * stride..][..stride];
                let [before, after] = &mut self.left;
                left_least = if step_x == 0 {
                    start(cost, after, sum)
                } else {
                    let from = if self.flipped { pixel + 1 } else { pixel - 1 };
                    let p2 = self.jumps.between(gray[pixel], gray[from]);
                    extend(cost, (before, left_least), (self.step, p2), after, sum)
                };
                self.left.swap(0, 1);
                // From above: by = 1, 0, −1 is above-left, above, above-right of the walk.
                for (direction, by) in [1isize, 0, -1].into_iter().enumerate() {
                    let from = step_x as isize - by;
                    let target = &mut self.current[direction];
                    let path = &mut target.paths[step_x * cell..][..cell];
                    target.least[step_x] = if step_y == 0 || from < 0 || from >= w as isize {
                        start(cost, path, sum)
                    } else {
                        let from = from as usize;
                        let row = &self.above[direction];
                        let (qx, qy) = if self.flipped { (w - 1 - from, y + 1) } else { (from, y - 1) };
                        let p2 = self.jumps.between(gray[pixel], gray[qy * w + qx]);
                        let before = (&row.paths[from * cell..][..cell], row.least[from]);
                        extend(cost, before, (self.step, p2), path, sum)
                    };
                }
            }
            std::mem::swap(&mut self.above, &mut self.current);
        }
    }
}

/// Begins a path: its cost is the pixel's own.
#[inline(always)]
fn start(cost: &[u8], path: &mut [i16], sum: &mut [i16]) -> i16 {
    let mut least = i16::MAX;
    for ((p, s), &c) in path[1..].iter_mut().zip(sum).zip(cost) {
        let c = i16::from(c.min(NEUTRAL));
        (*p, *s) = (c, *s + c);
        least = least.min(c);
    }
    least
}

/// One step along a path; returns the least cost of the new pixel. The ends of `path` stay blocked.
#[inline(always)]
fn extend(
    cost: &[u8],
    (before, before_least): (&[i16], i16),
    (p1, p2): (i16, i16),
    path: &mut [i16],
    sum: &mut [i16],
) -> i16 {
    let n = cost.len();
    let jump = before_least + p2;
    let (costs, _) = cost.as_chunks::<LANES>();
    let (lower, _) = before[..n].as_chunks::<LANES>();
    let (same, _) = before[1..=n].as_chunks::<LANES>();
    let (upper, _) = before[2..n + 2].as_chunks::<LANES>();
    let (path, _) = path[1..=n].as_chunks_mut::<LANES>();
    let (sums, _) = sum.as_chunks_mut::<LANES>();
    let mut least = [i16::MAX; LANES];
    let befores = lower.iter().zip(same).zip(upper);
    for (((cost, ((lower, same), upper)), path), sum) in costs.iter().zip(befores).zip(path).zip(sums) {
        for d in 0..LANES {
            let best = same[d].min((lower[d] + p1).min(upper[d] + p1)).min(jump);
            let value = i16::from(cost[d].min(NEUTRAL)) + (best - before_least);
            path[d] = value;
            sum[d] += value;
            least[d] = least[d].min(value);
        }
    }
    least.into_iter().fold(i16::MAX, i16::min)
}

/// The best label of every pixel.
pub(crate) struct Winners {
    /// Inverse depth, 1/m; NaN where no neighbour sees the label.
    pub rho: Vec<f32>,
    /// Matching cost, 0…1.
    pub cost: Vec<f32>,
    /// How much worse the next best label is, in units of a full mismatch.
    pub margin: Vec<f32>,
}

/// Labels this near to the winner are not the next best.
const BESIDE: usize = 2;

impl Winners {
    /// Picks the least sum, fits a parabola through its neighbours, and finds the least sum more than two labels away.
    pub fn pick(volume: &Volume, sums: &[i16], labels: &Labels) -> Self {
        let n = volume.costs.len() / volume.stride;
        let mut winners = Self { rho: vec![f32::NAN; n], cost: vec![1.0; n], margin: vec![0.0; n] };
        let pixels = sums.chunks_exact(volume.stride).zip(volume.costs.chunks_exact(volume.stride));
        for (pixel, (sums, costs)) in pixels.enumerate() {
            let (sums, costs) = (&sums[..volume.count], &costs[..volume.count]);
            let least = sums.iter().copied().fold(i16::MAX, i16::min);
            let Some(best) = sums.iter().position(|&s| s == least) else { continue };
            if costs[best] == INVISIBLE {
                continue;
            }
            let (below, above) = (best.saturating_sub(BESIDE), (best + BESIDE + 1).min(sums.len()));
            let least_of = |sums: &[i16]| sums.iter().copied().fold(i16::MAX, i16::min);
            let next = least_of(&sums[..below]).min(least_of(&sums[above..]));
            let next = if next == i16::MAX { least } else { next };
            winners.rho[pixel] = labels.rho(best as f32 + parabola_offset(sums, best));
            winners.cost[pixel] = f32::from(costs[best]) / WORST;
            winners.margin[pixel] = f32::from(next - least) / (8.0 * WORST);
        }
        winners
    }
}

/// Offset in −0.5…0.5 of the least of the parabola through the sums around `best`.
fn parabola_offset(sums: &[i16], best: usize) -> f32 {
    if best == 0 || best + 1 >= sums.len() {
        return 0.0;
    }
    let (a, b, c) = (f32::from(sums[best - 1]), f32::from(sums[best]), f32::from(sums[best + 1]));
    let curvature = a - 2.0 * b + c;
    if curvature > 0.0 { (0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
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
        let mut volume = Volume { count: planes, stride: LANES, costs: vec![INVISIBLE; w * LANES] };
        for (padded, costs) in volume.costs.chunks_exact_mut(LANES).zip(costs.chunks_exact(planes)) {
            padded[..planes].copy_from_slice(costs);
        }
        let k = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: w, height: 1 };
        let image = Level { width: w, height: 1, gray: vec![9; w], intrinsics: k, hidden: Vec::new() };
        let (p1, p2) = (5i16, 30i16);
        let sums = aggregate(&image, &volume, Penalties { step: p1, jump: p2 });
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
                assert_eq!(i64::from(sums[x * LANES + d]), expected, "x {x} d {d}");
            }
        }
    }

    #[test]
    fn the_bits_do_not_depend_on_the_instructions() {
        let (w, h, stride) = (23, 17, 3 * LANES);
        let k = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: w, height: h };
        let gray = (0..w * h).map(|i| ((i * 7919) % 4096) as i16 - 2048).collect();
        let image = Level { width: w, height: h, gray, intrinsics: k, hidden: Vec::new() };
        let costs = (0..w * h * stride).map(|i| ((i * 104_729 + 17) % 256) as u8).collect();
        let volume = Volume { count: stride, stride, costs };
        let run = || aggregate(&image, &volume, Penalties { step: 12, jump: 80 });
        assert!(!vidar_core::testing::same_with_each_instruction_set(run).is_empty());
    }
}
