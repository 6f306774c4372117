//! The Cholesky factor of an envelope, in place.

use super::Envelope;
use crate::backend::dot;
use std::ops::Range;
use vidar_core::simd::kernel;

kernel! {
    /// Replaces a matrix, with `extra` on its diagonal, by its factor; whether it is positive definite.
    pub(super) fn factorise_rows(matrix: &mut Envelope, extra: &[f64]) -> bool {
        matrix.factorise_in_place(extra)
    }
}

/// Rows that are factorised together where they begin at one column, so that what is above is loaded once for all: three times so many are those of
/// a state.
const TOGETHER: usize = 5;

/// So many rows wait for one another while they take so many rows above at a time, which stay in the cache meanwhile: 240 and 128 KB of 2000 unknowns,
/// which 129 states have (24 s of flight).
const PANEL: usize = 30;
const BLOCK: usize = 16;

impl Envelope {
    /// Each entry is found as row by row, from the same products in the same order.
    #[inline(always)]
    fn factorise_in_place(&mut self, extra: &[f64]) -> bool {
        let dim = self.dim();
        for panel in (0..dim).step_by(PANEL) {
            let end = dim.min(panel + PANEL);
            let mut block = self.first[panel..end].iter().copied().min().unwrap_or(panel) / BLOCK * BLOCK;
            while block < panel {
                let columns = block..panel.min(block + BLOCK);
                let mut row = panel;
                while row < end {
                    row = self.solve(row, end, columns.clone());
                }
                block += BLOCK;
            }
            let mut row = panel;
            while row < end {
                let until = self.solve(row, end, panel..row);
                for i in row..until {
                    if !self.finish_row(i, row, extra[i]) {
                        return false;
                    }
                }
                row = until;
            }
        }
        true
    }

    /// Entries in some columns of the row, and of those after it that are solved together with it; where those end.
    #[inline(always)]
    fn solve(&mut self, row: usize, end: usize, columns: Range<usize>) -> usize {
        let first = self.first[row];
        let mut until = row + 1;
        while until < end && until < row + TOGETHER && self.first[until] == first {
            until += 1;
        }
        let columns = first.max(columns.start)..columns.end;
        if until == row + TOGETHER {
            self.solve_together(row, columns);
        } else {
            for i in row..until {
                self.solve_row(i, columns.clone());
            }
        }
        until
    }

    #[inline(always)]
    fn solve_together(&mut self, row: usize, columns: Range<usize>) {
        let first = self.first[row];
        let (above, rows) = self.values.split_at_mut(self.begin[row]);
        let mut starts = [0; TOGETHER];
        for k in 0..TOGETHER {
            starts[k] = self.begin[row + k] - self.begin[row];
        }
        for j in columns {
            let from = first.max(self.first[j]);
            let end = self.begin[j + 1] - 1;
            let known = dots(rows, &starts, from - first, &above[end + from - j..end]);
            for k in 0..TOGETHER {
                let entry = &mut rows[starts[k] + j - first];
                *entry = (*entry - known[k]) / above[end];
            }
        }
    }

    #[inline(always)]
    fn solve_row(&mut self, row: usize, columns: Range<usize>) {
        let first = self.first[row];
        let (above, rest) = self.values.split_at_mut(self.begin[row]);
        for j in columns {
            let from = first.max(self.first[j]);
            let end = self.begin[j + 1] - 1;
            let known = dot(&rest[from - first..j - first], &above[end + from - j..end]);
            rest[j - first] = (rest[j - first] - known) / above[end];
        }
    }

    /// Entries of a row from `column` on; whether its pivot is positive.
    #[inline(always)]
    fn finish_row(&mut self, row: usize, column: usize, extra: f64) -> bool {
        let first = self.first[row];
        self.solve_row(row, first.max(column)..row);
        let (left, last) = self.values[self.begin[row]..self.begin[row + 1]].split_at_mut(row - first);
        let pivot = last[0] + extra - dot(left, left);
        last[0] = pivot.sqrt();
        // A NaN must fail, too.
        pivot > 0.0 && pivot.is_finite()
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
    #[test]
    fn rows_that_are_taken_together_have_the_bits_of_rows_by_themselves() {
        let back = [0, 0, 1, 2, 4, 1, 3, 7, 2, 0];
        let mut first: Vec<usize> = (0..150).map(|i| 15 * (i / 15 - back[i / 15])).collect();
        first.extend([40, 41, 41, 90, 90, 90, 90, 90, 3]);
        first.extend([0; 8]);
        let mut matrix = Envelope::new(first.clone());
        for (i, first) in first.iter().enumerate() {
            for j in *first..=i {
                matrix.add(i, j, if i == j { 200.0 } else { ((3 * i + 7 * j) as f64).sin() });
            }
        }
        let extra: Vec<f64> = (0..matrix.dim()).map(|i| (i as f64).cos().abs()).collect();
        let expected = by_rows(&matrix, &extra);
        with_each_instruction_set(|| {
            let mut factor = matrix.clone();
            assert!(matrix.factorise(&extra, &mut factor));
            assert_eq!(factor.values, expected.values);
        });
        matrix.add(100, 100, -300.0);
        assert!(!matrix.factorise(&extra, &mut matrix.clone()));
    }
}
