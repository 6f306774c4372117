//! Symmetric matrices stored by rows from their first non-zero entry (envelope, skyline), and their Cholesky factor.
//!
//! States that see the same landmarks are neighbours in time, so that the reduced system of a recording is a band with a few
//! full rows for the calibration: factorising it costs the square of the band's width per row, and the factor fills nothing
//! outside the envelope (George and Liu 1981, chapter 4). A loop makes the rows of the states that it constrains long, and no others.

mod aligned;
mod factorise;
mod inverse;
mod lines;

use crate::backend::dot;
use aligned::{Aligned, LINE};

/// Lower triangle of a symmetric matrix, or its Cholesky factor.
#[derive(Clone, Debug)]
pub(super) struct Envelope {
    /// First column of every row.
    first: Vec<usize>,
    /// Where every row begins in `values`; one more than there are rows. Column 0, 8, 16, … of a row begins a line of the cache; what a row's lines hold before its
    /// first column is zero.
    begin: Vec<usize>,
    values: Aligned,
}

impl Envelope {
    /// A matrix of zeros whose row `i` is stored from column `first[i] ≤ i` on.
    pub(super) fn new(first: Vec<usize>) -> Self {
        let mut begin = Vec::with_capacity(first.len() + 1);
        let mut length = 0;
        for (row, column) in first.iter().enumerate() {
            begin.push(length + column % LINE);
            length += (row / LINE + 1 - column / LINE) * LINE;
        }
        begin.push(length);
        Self { first, begin, values: Aligned::zeros(length) }
    }

    /// Rows.
    pub(super) fn dim(&self) -> usize {
        self.first.len()
    }

    /// All rows, to be split and added to.
    pub(super) fn rows(&mut self) -> Rows<'_> {
        let Self { first, begin, values } = self;
        Rows { first, begin, offset: 0, values }
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
        self.at(row, row)
    }

    fn row(&self, row: usize) -> &[f64] {
        self.range(row, self.first[row], row + 1)
    }

    /// Factorises `self + diag(extra)` into `factor`, which has the same envelope; whether it is positive definite.
    pub(super) fn factorise(&self, extra: &[f64], factor: &mut Self) -> bool {
        factor.values.copy_from_slice(&self.values);
        factorise::factorise_rows(factor, extra)
    }

    /// `L⁻¹ b` in place, for a factor.
    pub(super) fn forward(&self, b: &mut [f64]) {
        for i in 0..self.dim() {
            let row = self.row(i);
            let (left, diagonal) = row.split_at(row.len() - 1);
            b[i] = (b[i] - dot(left, &b[self.first[i]..i])) / diagonal[0];
        }
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

/// Neighbouring rows of an envelope.
#[derive(Debug)]
pub(super) struct Rows<'a> {
    first: &'a [usize],
    begin: &'a [usize],
    values: &'a mut [f64],
    /// Where these begin among the envelope's.
    offset: usize,
}

impl Rows<'_> {
    /// The rows before `row`, and the others.
    pub(super) fn split_at(self, row: usize) -> (Self, Self) {
        let Self { first, begin, values, offset } = self;
        let at = line_of(first, begin, row);
        let (before, others) = values.split_at_mut(at - offset);
        (Self { first, begin, values: before, offset }, Self { first, begin, values: others, offset: at })
    }

    /// As [`Envelope::add`].
    #[inline(always)]
    pub(super) fn add(&mut self, row: usize, column: usize, value: f64) {
        self.part_mut(row, column, 1)[0] += value;
    }

    /// `length` entries of a row from `column` on, which the envelope holds.
    #[inline(always)]
    pub(super) fn part_mut(&mut self, row: usize, column: usize, length: usize) -> &mut [f64] {
        let at = self.begin[row] - self.offset + column - self.first[row];
        &mut self.values[at..at + length]
    }
}

/// Where the lines of a row begin; of one beyond the last, where those end.
#[inline(always)]
fn line_of(first: &[usize], begin: &[usize], row: usize) -> usize {
    begin[row] - first.get(row).map_or(0, |first| first % LINE)
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
