//! The Cholesky factor of an envelope, in place.
//!
//! Blocks of eight columns, which are lines of the cache: what the columns to the left contribute to a block's entries are products of whole lines, and the
//! triangle on the diagonal is inverted once for all rows below it.

use super::lines::{Inverse, TOGETHER, add_each, divided, lines, product, products, total};
use super::{Envelope, LINE, line_of};
use std::ops::Range;
use vidar_core::simd::kernel;

/// So many rows wait for one another while they take a block of columns at a time, which stays in the cache meanwhile: 512 and 128 KB of 2000 unknowns,
/// which 129 states have (24 s of flight).
const PANEL: usize = 32;
const _: () = assert!(PANEL.is_multiple_of(LINE));

/// Products before a panel from which its groups of rows are worth threads: some 30 µs of work.
const WORTH_THREADS: usize = 400_000;

/// Replaces a matrix, with `extra` on its diagonal, by its factor; whether it is positive definite. Each entry is found from the same sums in the same order by
/// however many threads.
pub(super) fn factorise_rows(matrix: &mut Envelope, extra: &[f64]) -> bool {
    let largest = matrix.first.iter().enumerate().map(|(row, first)| PANEL * work(row - first)).max();
    if rayon::current_num_threads() < 2 || largest.is_none_or(|largest| largest < WORTH_THREADS) {
        return factorise_panels(matrix, extra, 1);
    }
    // On a thread of the pool, which wakes another one for each panel, but is not woken itself.
    rayon::scope(|_| factorise_panels(matrix, extra, rayon::current_num_threads()))
}

/// Products that the entries of a row need which reaches back over so many columns.
fn work(reach: usize) -> usize {
    reach * reach / 2
}

fn factorise_panels(matrix: &mut Envelope, extra: &[f64], threads: usize) -> bool {
    let Envelope { first, begin, values } = matrix;
    let shape = Shape { first, begin };
    let dim = first.len();
    let mut inverses: Vec<Inverse> = Vec::with_capacity(dim.div_ceil(LINE));
    (0..dim).step_by(PANEL).all(|panel| {
        let rows = panel..dim.min(panel + PANEL);
        let (above, own) = values.split_at_mut(shape.line(panel));
        let own = &mut own[..shape.line(rows.end) - shape.line(panel)];
        let groups = shape.groups(rows.clone());
        let to_do: usize = rows.clone().map(|row| work(panel.saturating_sub(first[row]))).sum();
        let parts = if to_do < WORTH_THREADS { 1 } else { threads };
        let left = Left { above, panel, inverses: &inverses };
        solve_by_threads(shape, &left, &groups, groups.len().div_ceil(parts), own);
        finish_panel(shape, rows, own, extra, &mut inverses)
    })
}

/// Entries of a panel's rows in the columns before it, in parts of at most `part` groups.
fn solve_by_threads(
    shape: Shape<'_>,
    left: &Left<'_>,
    groups: &[Range<usize>],
    part: usize,
    rows: &mut [f64],
) {
    if groups.len() <= part {
        return solve_left(shape, left, groups, rows);
    }
    let (here, there) = groups.split_at(part);
    let (mine, others) = rows.split_at_mut(shape.line(there[0].start) - shape.line(here[0].start));
    rayon::join(
        || solve_left(shape, left, here, mine),
        || solve_by_threads(shape, left, there, part, others),
    );
}

kernel! {
    /// Entries of groups of rows, which `rows` begin with, in the columns before their panel.
    fn solve_left(shape: Shape<'_>, left: &Left<'_>, groups: &[Range<usize>], rows: &mut [f64]) {
        shape.solve_left(left, groups, rows);
    }
}

kernel! {
    /// The other entries of a panel, which `rows` are; whether all its pivots are positive.
    fn finish_panel(shape: Shape<'_>, panel: Range<usize>, rows: &mut [f64], extra: &[f64], inverses: &mut Vec<Inverse>) -> bool {
        shape.finish_panel(panel, rows, extra, inverses)
    }
}

/// What is known when a panel is begun: the rows above it, and the inverses of their triangles.
struct Left<'a> {
    above: &'a [f64],
    panel: usize,
    inverses: &'a [Inverse],
}

/// Where the rows of an envelope begin.
#[derive(Clone, Copy)]
struct Shape<'a> {
    first: &'a [usize],
    begin: &'a [usize],
}

/// Rows above those that are solved, from row `from` on.
#[derive(Clone, Copy)]
struct Above<'a> {
    values: &'a [f64],
    from: usize,
}

impl Shape<'_> {
    /// Where the lines of a row begin.
    #[inline(always)]
    fn line(&self, row: usize) -> usize {
        line_of(self.first, self.begin, row)
    }

    /// First column of a row's lines.
    #[inline(always)]
    fn first_line(&self, row: usize) -> usize {
        self.first[row] / LINE * LINE
    }

    /// Groups of rows that are solved together.
    fn groups(&self, rows: Range<usize>) -> Vec<Range<usize>> {
        let next = |row: usize| (row < rows.end).then(|| self.group(row, rows.end));
        std::iter::successors(next(rows.start), |group| next(group.end)).collect()
    }

    /// The rows that are solved together with `row`, of those before `end`.
    #[inline(always)]
    fn group(&self, row: usize, end: usize) -> Range<usize> {
        let mut until = row + 1;
        while until < end && until < row + TOGETHER && self.first[until] == self.first[row] {
            until += 1;
        }
        row..until
    }

    #[inline(always)]
    fn solve_left(&self, left: &Left<'_>, groups: &[Range<usize>], rows: &mut [f64]) {
        let (Some(first), Some(last)) = (groups.first(), groups.last()) else { return };
        let mut block = left.panel;
        for row in first.start..last.end {
            block = block.min(self.first_line(row));
        }
        let above = Above { values: left.above, from: 0 };
        while block < left.panel {
            for group in groups {
                if self.first_line(group.start) <= block {
                    let own = &mut rows[self.line(group.start) - self.line(first.start)..];
                    self.solve_group(above, group, block, &left.inverses[block / LINE], own);
                }
            }
            block += LINE;
        }
    }

    #[inline(always)]
    fn finish_panel(
        &self,
        panel: Range<usize>,
        rows: &mut [f64],
        extra: &[f64],
        inverses: &mut Vec<Inverse>,
    ) -> bool {
        let begin = self.line(panel.start);
        let mut block = panel.start;
        while block < panel.end {
            let below = panel.end.min(block + LINE);
            for row in block..below {
                let (before, own) = rows.split_at_mut(self.line(row) - begin);
                let above = Above { values: before, from: panel.start };
                if !self.finish_row(above, row, block, own, extra[row]) {
                    return false;
                }
            }
            let inverse = self.inverse(&rows[self.line(block) - begin..], block..below);
            let mut row = below;
            while row < panel.end {
                let group = self.group(row, panel.end);
                row = group.end;
                if self.first_line(group.start) <= block {
                    let (before, own) = rows.split_at_mut(self.line(group.start) - begin);
                    let above = Above { values: before, from: panel.start };
                    self.solve_group(above, &group, block, &inverse, own);
                }
            }
            inverses.push(inverse);
            block += LINE;
        }
        true
    }

    /// Entries of a row within the triangle of its block; whether its pivot is positive.
    #[inline(always)]
    fn finish_row(&self, above: Above<'_>, row: usize, block: usize, own: &mut [f64], extra: f64) -> bool {
        let from = self.first_line(row);
        let (left, triangle) = own.split_at_mut(block - from);
        for j in block..row {
            let other = &above.values[self.line(j) - self.line(above.from)..];
            let other_from = self.first_line(j);
            let common = from.max(other_from);
            let mut known = total(&product(
                lines(left, common - from),
                lines(&other[..block - other_from], common - other_from),
            ));
            let of_triangle = &other[block - other_from..];
            for k in 0..j - block {
                known += triangle[k] * of_triangle[k];
            }
            triangle[j - block] = (triangle[j - block] - known) / of_triangle[j - block];
        }
        let left = lines(left, 0);
        let mut square = total(&product(left, left));
        for k in 0..row - block {
            square += triangle[k] * triangle[k];
        }
        let pivot = triangle[row - block] + extra - square;
        triangle[row - block] = pivot.sqrt();
        // A NaN must fail, too.
        pivot > 0.0 && pivot.is_finite()
    }

    /// The inverse of the triangle of a block, whose rows `own` begins with.
    #[inline(always)]
    fn inverse(&self, own: &[f64], block: Range<usize>) -> Inverse {
        let mut inverse = [[0.0; LINE]; LINE];
        for column in 0..block.len() {
            for row in column..block.len() {
                let at = block.start + row;
                let entries =
                    &own[self.line(at) - self.line(block.start) + block.start - self.first_line(at)..];
                let mut sum = if row == column { 1.0 } else { 0.0 };
                for k in column..row {
                    sum -= entries[k] * inverse[column][k];
                }
                inverse[column][row] = sum / entries[row];
            }
        }
        inverse
    }

    /// Entries of a group of rows, which `rows` begin with, in a block of columns.
    #[inline(always)]
    fn solve_group(
        &self,
        above: Above<'_>,
        group: &Range<usize>,
        block: usize,
        inverse: &Inverse,
        rows: &mut [f64],
    ) {
        if group.len() == TOGETHER {
            self.solve_three(above, group.start, block, inverse, rows);
        } else {
            for row in group.clone() {
                let own = &mut rows[self.line(row) - self.line(group.start)..];
                self.solve_one(above, row, block, inverse, own);
            }
        }
    }

    /// Entries in a block of columns of a row by itself.
    #[inline(always)]
    fn solve_one(&self, above: Above<'_>, row: usize, block: usize, inverse: &Inverse, own: &mut [f64]) {
        let from = self.first_line(row);
        let at = block - from;
        let mut left = [0.0; LINE];
        for k in 0..LINE {
            let (other, other_from) = self.left_of(above, block + k, block);
            let common = from.max(other_from);
            left[k] = own[at + k]
                - total(&product(lines(&own[..at], common - from), lines(other, common - other_from)));
        }
        own[at..at + LINE].copy_from_slice(&divided(&left, inverse));
    }

    /// The same of three rows, with two columns at a time.
    #[inline(always)]
    fn solve_three(&self, above: Above<'_>, row: usize, block: usize, inverse: &Inverse, rows: &mut [f64]) {
        let from = self.first_line(row);
        let at = block - from;
        let starts = [0, self.line(row + 1) - self.line(row), self.line(row + 2) - self.line(row)];
        let mut left = [[0.0; LINE]; TOGETHER];
        for k in (0..LINE).step_by(2) {
            let (a, a_from) = self.left_of(above, block + k, block);
            let (b, b_from) = self.left_of(above, block + k + 1, block);
            let common = from.max(a_from).max(b_from);
            let part = |start: usize, from: usize, until: usize| &rows[start + from..start + until];
            let three = |begin: usize, end: usize| starts.map(|start| part(start, begin - from, end - from));
            let (mut by_a, mut by_b) =
                products(three(common, block), lines(a, common - a_from), lines(b, common - b_from));
            // Columns of two states may begin apart.
            for (sums, other, other_from) in [(&mut by_a, a, a_from), (&mut by_b, b, b_from)] {
                let begin = from.max(other_from);
                if begin < common {
                    add_each(sums, three(begin, common), &other[begin - other_from..common - other_from]);
                }
            }
            for r in 0..TOGETHER {
                left[r][k] = rows[starts[r] + at + k] - total(&by_a[r]);
                left[r][k + 1] = rows[starts[r] + at + k + 1] - total(&by_b[r]);
            }
        }
        for r in 0..TOGETHER {
            let entries = &mut rows[starts[r] + at..starts[r] + at + LINE];
            entries.copy_from_slice(&divided(&left[r], inverse));
        }
    }

    /// A row of those above before a block, and where it begins.
    #[inline(always)]
    fn left_of<'v>(&self, above: Above<'v>, row: usize, block: usize) -> (&'v [f64], usize) {
        let (from, at) = (self.first_line(row), self.line(row) - self.line(above.from));
        (&above.values[at..at + block - from], from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::dot;
    use vidar_core::testing::with_each_instruction_set;

    /// Row by row, each entry by itself.
    fn by_rows(matrix: &Envelope, extra: &[f64]) -> Envelope {
        let mut factor = matrix.clone();
        for i in 0..matrix.dim() {
            for j in matrix.first[i]..i {
                let from = matrix.first[i].max(matrix.first[j]);
                let known = dot(factor.range(i, from, j), factor.range(j, from, j));
                factor.set(i, j, (factor.at(i, j) - known) / factor.at(j, j));
            }
            let left = factor.range(i, matrix.first[i], i);
            let pivot = matrix.at(i, i) + extra[i] - dot(left, left);
            factor.set(i, i, pivot.sqrt());
        }
        factor
    }

    /// States of fifteen rows that reach back by different lengths, some rows by themselves, and a border.
    fn example(back: impl Fn(usize) -> usize, states: usize) -> Envelope {
        let mut first: Vec<usize> = (0..15 * states).map(|i| 15 * (i / 15 - back(i / 15))).collect();
        let some = 15 * (states / 2);
        first.extend([40, 41, 41, some, some, some, some, some, 3]);
        first.extend([0; 8]);
        let mut matrix = Envelope::new(first.clone());
        for (i, first) in first.iter().enumerate() {
            for j in *first..=i {
                matrix.add(i, j, if i == j { 900.0 } else { ((3 * i + 7 * j) as f64).sin() });
            }
        }
        matrix
    }

    fn damping(matrix: &Envelope) -> Vec<f64> {
        (0..matrix.dim()).map(|i| (i as f64).cos().abs()).collect()
    }

    #[test]
    fn the_factor_is_that_of_rows_by_themselves_with_the_same_bits_for_all_instructions() {
        let mut matrix = example(|state| [0, 0, 1, 2, 4, 1, 3, 7, 2, 0][state], 10);
        let extra = damping(&matrix);
        let expected = by_rows(&matrix, &extra);
        let factors = with_each_instruction_set(|| {
            let mut factor = matrix.clone();
            assert!(matrix.factorise(&extra, &mut factor));
            factor.values.to_vec()
        });
        for (instructions, factor) in &factors {
            assert!(*factor == factors[0].1, "{instructions:?}");
            let off = factor.iter().zip(expected.values.iter()).map(|(a, b)| (a - b).abs());
            assert!(off.fold(0.0, f64::max) < 1e-12, "{instructions:?}");
        }
        matrix.add(100, 100, -1800.0);
        assert!(!matrix.factorise(&extra, &mut matrix.clone()));
    }

    /// Of 50 states that reach back over up to 40: enough for threads.
    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let matrix = example(|state| state.min(40 - state % 3), 50);
        let extra = damping(&matrix);
        let expected = by_rows(&matrix, &extra);
        let mut of_one: Option<Vec<f64>> = None;
        for threads in [1, 2, 3, 5, 16] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut factor = matrix.clone();
            assert!(pool.install(|| matrix.factorise(&extra, &mut factor)));
            let off = factor.values.iter().zip(expected.values.iter()).map(|(a, b)| (a - b).abs());
            assert!(off.fold(0.0, f64::max) < 1e-11);
            assert!(
                factor.values[..] == of_one.get_or_insert_with(|| factor.values.to_vec())[..],
                "{threads} threads"
            );
        }
    }
}
