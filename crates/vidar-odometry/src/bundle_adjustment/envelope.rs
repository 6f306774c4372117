//! Symmetric matrices stored by rows from their first non-zero entry (envelope, skyline), and their Cholesky factor.
//!
//! States that see the same landmarks are neighbours in time, so that the reduced system of a recording is a band with a few
//! full rows for the calibration: factorising it costs the square of the band's width per row, and the factor fills nothing
//! outside the envelope (George and Liu 1981, chapter 4). A loop makes the rows of the states that it constrains long, and no others.

use crate::backend::dot;
use std::ops::Range;
use vidar_core::simd::kernel;

/// Lower triangle of a symmetric matrix, or its Cholesky factor.
#[derive(Clone, Debug)]
pub(super) struct Envelope {
    /// First stored column of every row.
    first: Vec<usize>,
    /// Where every row begins in `values`; one more than there are rows.
    begin: Vec<usize>,
    values: Vec<f64>,
}

impl Envelope {
    /// A matrix of zeros whose row `i` is stored from column `first[i] ≤ i` on.
    pub(super) fn new(first: Vec<usize>) -> Self {
        let mut begin = Vec::with_capacity(first.len() + 1);
        let mut length = 0;
        for (row, column) in first.iter().enumerate() {
            begin.push(length);
            length += row + 1 - column;
        }
        begin.push(length);
        Self { first, begin, values: vec![0.0; length] }
    }

    /// Rows.
    pub(super) fn dim(&self) -> usize {
        self.first.len()
    }

    /// Sets every entry to zero.
    pub(super) fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// Adds to an entry of the lower triangle that the envelope holds.
    pub(super) fn add(&mut self, row: usize, column: usize, value: f64) {
        debug_assert!(
            column <= row && column >= self.first[row],
            "({row}, {column}) is outside the envelope"
        );
        self.values[self.begin[row] + column - self.first[row]] += value;
    }

    /// Entry of the diagonal.
    pub(super) fn diagonal(&self, row: usize) -> f64 {
        self.values[self.begin[row + 1] - 1]
    }

    fn row(&self, row: usize) -> &[f64] {
        &self.values[self.begin[row]..self.begin[row + 1]]
    }

    /// `length` entries of a row from `column` on, which the envelope holds.
    #[inline(always)]
    pub(super) fn part_mut(&mut self, row: usize, column: usize, length: usize) -> &mut [f64] {
        let at = self.begin[row] + column - self.first[row];
        &mut self.values[at..at + length]
    }

    /// Factorises `self + diag(extra)` into `factor`, which has the same envelope; whether it is positive definite.
    pub(super) fn factorise(&self, extra: &[f64], factor: &mut Self) -> bool {
        factor.values.copy_from_slice(&self.values);
        factorise_rows(factor, extra)
    }

    /// `L⁻¹ b` in place, for a factor.
    pub(super) fn forward(&self, b: &mut [f64]) {
        for i in 0..self.dim() {
            let row = self.row(i);
            let (left, diagonal) = row.split_at(row.len() - 1);
            b[i] = (b[i] - dot(left, &b[self.first[i]..i])) / diagonal[0];
        }
    }

    /// The entries of the inverse within the envelope, for a factor (Takahashi, Fagan, Chin 1973): no others are needed to find
    /// them. `border` is the number of the first of the last rows that begin at column 0.
    pub(super) fn inverse(&self, border: usize) -> Self {
        let n = self.dim();
        let mut z = Self {
            first: self.first.clone(),
            begin: self.begin.clone(),
            values: vec![0.0; self.values.len()],
        };
        // Last row of the band that is coupled to each column.
        let mut last: Vec<usize> = (0..n).collect();
        for row in 0..border {
            for column in self.first[row]..row {
                last[column] = row;
            }
        }
        let (mut band, mut found) = (Vec::new(), Vec::new());
        let mut edge = vec![0.0; n - border];
        let mut edge_found = edge.clone();
        for j in (0..n).rev() {
            let end = if j < border { last[j] + 1 } else { j + 1 };
            let from = border.max(j + 1);
            band.clear();
            band.extend((j + 1..end).map(|k| if self.first[k] <= j { self.at(k, j) } else { 0.0 }));
            found.clear();
            found.resize(band.len(), 0.0);
            for k in from..n {
                edge[k - border] = self.at(k, j);
                edge_found[k - border] = 0.0;
            }
            for (at, k) in (j + 1..end).enumerate().filter(|(_, k)| self.first[*k] <= j) {
                let row = z.range(k, j + 1, k + 1);
                found[at] += dot(row, &band[..=at]);
                for (sum, value) in found[..at].iter_mut().zip(row) {
                    *sum += value * band[at];
                }
            }
            for k in from..n {
                let row = z.range(k, j + 1, j + 1 + band.len());
                let value = edge[k - border];
                edge_found[k - border] += dot(row, &band);
                for (sum, entry) in found.iter_mut().zip(row) {
                    *sum += entry * value;
                }
                let row = z.range(k, from, k + 1);
                edge_found[k - border] += dot(row, &edge[from - border..=k - border]);
                for (sum, entry) in edge_found[from - border..k - border].iter_mut().zip(row) {
                    *sum += entry * value;
                }
            }
            let diagonal = self.diagonal(j);
            let mut own = 1.0 / (diagonal * diagonal);
            for (at, k) in (j + 1..end).enumerate().filter(|(_, k)| self.first[*k] <= j) {
                let value = -found[at] / diagonal;
                z.set(k, j, value);
                own -= band[at] * value / diagonal;
            }
            for k in from..n {
                let value = -edge_found[k - border] / diagonal;
                z.set(k, j, value);
                own -= edge[k - border] * value / diagonal;
            }
            z.set(j, j, own);
        }
        z
    }

    /// Entry of a symmetric matrix that the envelope holds.
    pub(super) fn entry(&self, a: usize, b: usize) -> f64 {
        self.at(a.max(b), a.min(b))
    }

    fn at(&self, row: usize, column: usize) -> f64 {
        self.values[self.begin[row] + column - self.first[row]]
    }

    fn range(&self, row: usize, from: usize, until: usize) -> &[f64] {
        &self.values[self.begin[row] + from - self.first[row]..self.begin[row] + until - self.first[row]]
    }

    fn set(&mut self, row: usize, column: usize, value: f64) {
        self.values[self.begin[row] + column - self.first[row]] = value;
    }

    /// `L⁻ᵀ b` in place, for a factor.
    pub(super) fn backward(&self, b: &mut [f64]) {
        for i in (0..self.dim()).rev() {
            let row = self.row(i);
            let (left, diagonal) = row.split_at(row.len() - 1);
            let value = b[i] / diagonal[0];
            b[i] = value;
            for (target, l) in b[self.first[i]..i].iter_mut().zip(left) {
                *target -= l * value;
            }
        }
    }
}

kernel! {
    /// Replaces a matrix, with `extra` on its diagonal, by its factor; whether it is positive definite.
    fn factorise_rows(matrix: &mut Envelope, extra: &[f64]) -> bool {
        matrix.factorise_in_place(extra)
    }
}

/// Rows that are factorised together where they begin at one column, so that what is above is loaded once for all: three times so many are those of
/// a state.
const TOGETHER: usize = 5;

/// So many rows wait for one another while they take so many rows above at a time, which stay in the cache meanwhile: 240 and 128 KB for the 2000
/// unknowns of a minute.
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
    use nalgebra::{DMatrix, DVector};

    /// A positive definite matrix with this envelope.
    fn example(first: &[usize]) -> (Envelope, DMatrix<f64>) {
        let n = first.len();
        let mut envelope = Envelope::new(first.to_vec());
        let mut dense = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in first[i]..=i {
                let value = if i == j { 10.0 + i as f64 } else { ((3 * i + 7 * j) as f64).sin() };
                envelope.add(i, j, value);
                dense[(i, j)] = value;
                dense[(j, i)] = value;
            }
        }
        (envelope, dense)
    }

    #[test]
    fn a_band_with_a_full_last_row_is_solved_as_a_dense_matrix_is() {
        let (envelope, mut dense) = example(&[0, 0, 1, 1, 3, 4, 2, 0]);
        let extra: Vec<f64> = (0..8).map(|i| 0.1 * f64::from(i)).collect();
        for (i, e) in extra.iter().enumerate() {
            dense[(i, i)] += e;
        }
        let mut factor = envelope.clone();
        assert!(envelope.factorise(&extra, &mut factor));
        let b = DVector::from_fn(8, |i, _| (i as f64).cos());
        let mut x = b.as_slice().to_vec();
        factor.forward(&mut x);
        factor.backward(&mut x);
        let expected = dense.lu().solve(&b).unwrap();
        for (found, wanted) in x.iter().zip(expected.iter()) {
            assert!((found - wanted).abs() < 1e-12, "{found} instead of {wanted}");
        }
    }

    #[test]
    fn the_inverse_within_the_envelope_is_that_of_the_dense_matrix() {
        // The last two rows are the border; row 5 is coupled to less than row 4 is.
        let (envelope, dense) = example(&[0, 0, 1, 1, 2, 4, 4, 0, 0]);
        let mut factor = envelope.clone();
        assert!(envelope.factorise(&[0.0; 9], &mut factor));
        let inverse = factor.inverse(7);
        let expected = dense.try_inverse().unwrap();
        for i in 0..9 {
            for j in envelope.first[i]..=i {
                let (found, wanted) = (inverse.entry(j, i), expected[(i, j)]);
                assert!((found - wanted).abs() < 1e-12, "({i}, {j}): {found} instead of {wanted}");
            }
        }
    }

    #[test]
    fn an_indefinite_matrix_is_refused() {
        let (mut envelope, _) = example(&[0, 0, 0]);
        envelope.add(2, 2, -30.0);
        let mut factor = envelope.clone();
        assert!(!envelope.factorise(&[0.0; 3], &mut factor));
    }
}
