//! The Cholesky factor of an envelope, in place.

use super::Envelope;
use crate::backend::dot;
use std::ops::Range;
use vidar_core::simd::kernel;

/// Rows that are factorised together where they begin at one column, so that what is above is loaded once for all: three times so many are those of
/// a state.
const TOGETHER: usize = 5;

/// So many rows wait for one another while they take so many rows above at a time, which stay in the cache meanwhile: 240 and 128 KB of 2000 unknowns,
/// which 129 states have (24 s of flight).
const PANEL: usize = 30;
const BLOCK: usize = 16;

/// Products before a panel from which its groups of rows are worth threads: some 30 µs of work.
const WORTH_THREADS: usize = 200_000;

/// Replaces a matrix, with `extra` on its diagonal, by its factor; whether it is positive definite. Each entry is found as row by row, from the same products in
/// the same order, by however many threads.
pub(super) fn factorise_rows(matrix: &mut Envelope, extra: &[f64]) -> bool {
    let Envelope { first, begin, values } = matrix;
    let shape = Shape { first, begin };
    let dim = first.len();
    (0..dim).step_by(PANEL).all(|panel| {
        let rows = panel..dim.min(panel + PANEL);
        let (above, own) = values.split_at_mut(begin[panel]);
        let own = &mut own[..begin[rows.end] - begin[panel]];
        let groups = shape.groups(rows.clone());
        let reach: usize = rows.clone().map(|row| panel.saturating_sub(first[row])).sum();
        let threads =
            if reach * reach / (2 * rows.len()) < WORTH_THREADS { 1 } else { rayon::current_num_threads() };
        solve_by_threads(shape, above, panel, &groups, groups.len().div_ceil(threads), own);
        finish_panel(shape, panel, &groups, own, extra)
    })
}

/// Entries of a panel's rows in the columns before it, in parts of at most `part` groups.
fn solve_by_threads(
    shape: Shape<'_>,
    above: &[f64],
    panel: usize,
    groups: &[Range<usize>],
    part: usize,
    rows: &mut [f64],
) {
    if groups.len() <= part {
        return solve_left(shape, above, panel, groups, rows);
    }
    let (here, there) = groups.split_at(part);
    let (mine, others) = rows.split_at_mut(shape.begin[there[0].start] - shape.begin[here[0].start]);
    rayon::join(
        || solve_left(shape, above, panel, here, mine),
        || solve_by_threads(shape, above, panel, there, part, others),
    );
}

kernel! {
    /// Entries of groups of rows, which `rows` begin with, in the columns before `panel`, where `above` ends.
    fn solve_left(shape: Shape<'_>, above: &[f64], panel: usize, groups: &[Range<usize>], rows: &mut [f64]) {
        shape.solve_left(above, panel, groups, rows);
    }
}

kernel! {
    /// The other entries of a panel, which `rows` are; whether all its pivots are positive.
    fn finish_panel(shape: Shape<'_>, panel: usize, groups: &[Range<usize>], rows: &mut [f64], extra: &[f64]) -> bool {
        shape.finish_panel(panel, groups, rows, extra)
    }
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
    /// Rows that are solved together.
    fn groups(&self, rows: Range<usize>) -> Vec<Range<usize>> {
        let mut groups = Vec::new();
        let mut row = rows.start;
        while row < rows.end {
            let alike =
                (row..rows.end.min(row + TOGETHER)).take_while(|k| self.first[*k] == self.first[row]).count();
            groups.push(row..row + alike);
            row += alike;
        }
        groups
    }

    #[inline(always)]
    fn solve_left(&self, above: &[f64], panel: usize, groups: &[Range<usize>], rows: &mut [f64]) {
        let above = Above { values: above, from: 0 };
        let (Some(first), Some(last)) = (groups.first(), groups.last()) else { return };
        let mut block = panel;
        for row in first.start..last.end {
            block = block.min(self.first[row]);
        }
        block = block / BLOCK * BLOCK;
        while block < panel {
            let columns = block..panel.min(block + BLOCK);
            for group in groups {
                let own = &mut rows[self.begin[group.start] - self.begin[first.start]..];
                self.solve(above, group, columns.clone(), own);
            }
            block += BLOCK;
        }
    }

    #[inline(always)]
    fn finish_panel(&self, panel: usize, groups: &[Range<usize>], rows: &mut [f64], extra: &[f64]) -> bool {
        for group in groups {
            let (before, own) = rows.split_at_mut(self.begin[group.start] - self.begin[panel]);
            self.solve(Above { values: before, from: panel }, group, panel..group.start, own);
            for row in group.clone() {
                let (before, own) = rows.split_at_mut(self.begin[row] - self.begin[panel]);
                if !self.finish_row(Above { values: before, from: panel }, row, group.start, own, extra[row])
                {
                    return false;
                }
            }
        }
        true
    }

    /// Entries of a row from `column` on; whether its pivot is positive.
    #[inline(always)]
    fn finish_row(&self, above: Above<'_>, row: usize, column: usize, own: &mut [f64], extra: f64) -> bool {
        let first = self.first[row];
        self.solve_row(above, row, first.max(column)..row, own);
        let (left, last) = own[..row + 1 - first].split_at_mut(row - first);
        let pivot = last[0] + extra - dot(left, left);
        last[0] = pivot.sqrt();
        // A NaN must fail, too.
        pivot > 0.0 && pivot.is_finite()
    }

    /// Entries in some columns of a group of rows, which `rows` begin with.
    #[inline(always)]
    fn solve(&self, above: Above<'_>, group: &Range<usize>, columns: Range<usize>, rows: &mut [f64]) {
        let columns = columns.start.max(self.first[group.start])..columns.end;
        if group.len() == TOGETHER {
            self.solve_together(above, group.start, columns, rows);
        } else {
            for row in group.clone() {
                self.solve_row(
                    above,
                    row,
                    columns.clone(),
                    &mut rows[self.begin[row] - self.begin[group.start]..],
                );
            }
        }
    }

    #[inline(always)]
    fn solve_together(&self, above: Above<'_>, row: usize, columns: Range<usize>, rows: &mut [f64]) {
        let first = self.first[row];
        let mut starts = [0; TOGETHER];
        for k in 0..TOGETHER {
            starts[k] = self.begin[row + k] - self.begin[row];
        }
        for j in columns {
            let from = first.max(self.first[j]);
            let end = self.begin[j + 1] - self.begin[above.from] - 1;
            let known = dots(rows, &starts, from - first, &above.values[end + from - j..end]);
            for k in 0..TOGETHER {
                let entry = &mut rows[starts[k] + j - first];
                *entry = (*entry - known[k]) / above.values[end];
            }
        }
    }

    #[inline(always)]
    fn solve_row(&self, above: Above<'_>, row: usize, columns: Range<usize>, own: &mut [f64]) {
        let first = self.first[row];
        for j in columns {
            let from = first.max(self.first[j]);
            let end = self.begin[j + 1] - self.begin[above.from] - 1;
            let known = dot(&own[from - first..j - first], &above.values[end + from - j..end]);
            own[j - first] = (own[j - first] - known) / above.values[end];
        }
    }
}

/// The products of [`dot`] of rows, which begin at `starts` and are taken from `from` on, with another.
#[inline(always)]
fn dots(rows: &[f64], starts: &[usize; TOGETHER], from: usize, other: &[f64]) -> [f64; TOGETHER] {
    let (y, y_rest) = other.as_chunks::<8>();
    let eights = y.len();
    let [(a, a_rest), (b, b_rest), (c, c_rest), (d, d_rest), (e, e_rest)] = [
        row_part(rows, starts[0] + from, other.len()),
        row_part(rows, starts[1] + from, other.len()),
        row_part(rows, starts[2] + from, other.len()),
        row_part(rows, starts[3] + from, other.len()),
        row_part(rows, starts[4] + from, other.len()),
    ];
    let (a, b, c, d, e) = (&a[..eights], &b[..eights], &c[..eights], &d[..eights], &e[..eights]);
    let [mut of_a, mut of_b, mut of_c, mut of_d, mut of_e] = [[0.0; 8]; TOGETHER];
    for i in 0..eights {
        add_products(&mut of_a, &a[i], &y[i]);
        add_products(&mut of_b, &b[i], &y[i]);
        add_products(&mut of_c, &c[i], &y[i]);
        add_products(&mut of_d, &d[i], &y[i]);
        add_products(&mut of_e, &e[i], &y[i]);
    }
    [
        total(&of_a, a_rest, y_rest),
        total(&of_b, b_rest, y_rest),
        total(&of_c, c_rest, y_rest),
        total(&of_d, d_rest, y_rest),
        total(&of_e, e_rest, y_rest),
    ]
}

#[inline(always)]
fn row_part(rows: &[f64], from: usize, length: usize) -> (&[[f64; 8]], &[f64]) {
    rows[from..from + length].as_chunks()
}

#[inline(always)]
fn add_products(sums: &mut [f64; 8], x: &[f64; 8], y: &[f64; 8]) {
    for k in 0..8 {
        sums[k] += x[k] * y[k];
    }
}

/// In the order of [`dot`].
#[inline(always)]
fn total(sums: &[f64; 8], x: &[f64], y: &[f64]) -> f64 {
    let mut tail = 0.0;
    for (x, y) in x.iter().zip(y) {
        tail += x * y;
    }
    let [s0, s1, s2, s3, s4, s5, s6, s7] = sums;
    ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7)) + tail
}

#[cfg(test)]
mod tests {
    use super::*;
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
    fn rows_that_are_taken_together_have_the_bits_of_rows_by_themselves() {
        let mut matrix = example(|state| [0, 0, 1, 2, 4, 1, 3, 7, 2, 0][state], 10);
        let extra = damping(&matrix);
        let expected = by_rows(&matrix, &extra);
        with_each_instruction_set(|| {
            let mut factor = matrix.clone();
            assert!(matrix.factorise(&extra, &mut factor));
            assert_eq!(factor.values, expected.values);
        });
        matrix.add(100, 100, -1800.0);
        assert!(!matrix.factorise(&extra, &mut matrix.clone()));
    }

    /// Of 50 states that reach back over up to 40: enough for threads.
    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let matrix = example(|state| state.min(40 - state % 3), 50);
        let extra = damping(&matrix);
        let expected = by_rows(&matrix, &extra);
        for threads in [1, 2, 3, 5, 16] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut factor = matrix.clone();
            assert!(pool.install(|| matrix.factorise(&extra, &mut factor)));
            assert!(factor.values == expected.values, "{threads} threads");
        }
    }
}
