//! Dense linear algebra on preallocated slices: a Cholesky factorisation that skips leading zeros of its rows, and
//! Householder QR of tall matrices.

use vidar_core::simd::kernel;

/// Dot product with eight independent sums: vectorises, and adds in one fixed order.
#[inline(always)]
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let mut tail = 0.0;
    for (x, y) in a8.remainder().iter().zip(b8.remainder()) {
        tail += x * y;
    }
    for (x, y) in a8.zip(b8) {
        for k in 0..8 {
            sums[k] += x[k] * y[k];
        }
    }
    let [s0, s1, s2, s3, s4, s5, s6, s7] = sums;
    ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7)) + tail
}

/// `y += a · x`.
#[inline]
pub(crate) fn axpy(a: f64, x: &[f64], y: &mut [f64]) {
    for (x, y) in x.iter().zip(y) {
        *y += a * x;
    }
}

/// Lower Cholesky factor `A = L Lᵀ`, row-major; row `i` begins at column `first[i]`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cholesky {
    n: usize,
    l: Vec<f64>,
    first: Vec<usize>,
    inverse_diagonal: Vec<f64>,
}

impl Cholesky {
    /// Room for matrices up to `n` without allocating later.
    pub(crate) fn with_capacity(n: usize) -> Self {
        Self {
            n: 0,
            l: Vec::with_capacity(n * n),
            first: Vec::with_capacity(n),
            inverse_diagonal: Vec::with_capacity(n),
        }
    }

    /// Factorises `a + diag(extra)`, `a` row-major `n × n` of which the lower triangle from column `first[i]` of each
    /// row is read. `false` when a pivot is not positive; the factor is of no use then.
    pub(crate) fn factorise(&mut self, a: &[f64], extra: &[f64], first: &[usize]) -> bool {
        factorise_rows(self, a, extra, first)
    }

    #[inline(always)]
    fn factorise_rows(&mut self, a: &[f64], extra: &[f64], first: &[usize]) -> bool {
        let n = first.len();
        self.n = n;
        self.first.clear();
        self.first.extend_from_slice(first);
        self.inverse_diagonal.clear();
        self.inverse_diagonal.resize(n, 0.0);
        self.l.clear();
        self.l.resize(n * n, 0.0);
        for i in 0..n {
            let (above, rest) = self.l.split_at_mut(i * n);
            let row = &mut rest[..=i];
            let begin = first[i];
            row[begin..=i].copy_from_slice(&a[i * n + begin..=i * n + i]);
            for j in begin..i {
                let from = begin.max(first[j]);
                let other = &above[j * n..j * n + j];
                if from < j {
                    row[j] -= dot(&row[from..j], &other[from..j]);
                }
                row[j] *= self.inverse_diagonal[j];
            }
            let pivot = row[i] + extra[i] - dot(&row[begin..i], &row[begin..i]);
            // A NaN pivot must fail too.
            if !(pivot > 0.0 && pivot.is_finite()) {
                return false;
            }
            row[i] = pivot.sqrt();
            self.inverse_diagonal[i] = 1.0 / row[i];
        }
        true
    }

    /// Half the logarithm of the determinant of what was factorised.
    pub(crate) fn half_log_det(&self) -> f64 {
        -self.inverse_diagonal.iter().map(|d| d.ln()).sum::<f64>()
    }

    /// Dimension of the factor.
    pub(crate) fn dim(&self) -> usize {
        self.n
    }

    /// Solves `L y = b` in place.
    pub(crate) fn forward(&self, b: &mut [f64]) {
        self.forward_from(0, b);
    }

    /// The same of a `b` that is zero before entry `begin`, as `y` is, too.
    pub(crate) fn forward_from(&self, begin: usize, b: &mut [f64]) {
        for i in begin..self.n {
            let from = self.first[i];
            let row = &self.l[i * self.n..i * self.n + i];
            b[i] = (b[i] - dot(&row[from..], &b[from..i])) * self.inverse_diagonal[i];
        }
    }

    /// Solves `Lᵀ x = y` in place.
    pub(crate) fn backward(&self, b: &mut [f64]) {
        for i in (0..self.n).rev() {
            let x = b[i] * self.inverse_diagonal[i];
            b[i] = x;
            let from = self.first[i];
            axpy(-x, &self.l[i * self.n + from..i * self.n + i], &mut b[from..i]);
        }
    }

    /// Solves `A x = b` in place.
    pub(crate) fn solve(&self, b: &mut [f64]) {
        self.forward(b);
        self.backward(b);
    }
}

kernel! {
    fn factorise_rows(factor: &mut Cholesky, a: &[f64], extra: &[f64], first: &[usize]) -> bool {
        factor.factorise_rows(a, extra, first)
    }
}

/// A tall matrix by columns with spare rows, for QR.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tall {
    stride: usize,
    rows: usize,
    cols: usize,
    data: Vec<f64>,
}

impl Tall {
    /// An all-zero matrix with `cols` columns, no rows yet, and room for `capacity` rows.
    pub(crate) fn reset(&mut self, capacity: usize, cols: usize) {
        self.stride = capacity;
        self.rows = 0;
        self.cols = cols;
        self.data.clear();
        self.data.resize(capacity * cols, 0.0);
    }

    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    pub(crate) fn cols(&self) -> usize {
        self.cols
    }

    /// Adds `count` zero rows and returns the number of the first.
    pub(crate) fn add_rows(&mut self, count: usize) -> usize {
        let first = self.rows;
        debug_assert!(first + count <= self.stride);
        self.rows += count;
        first
    }

    pub(crate) fn get(&self, row: usize, col: usize) -> f64 {
        self.data[col * self.stride + row]
    }

    pub(crate) fn set(&mut self, row: usize, col: usize, value: f64) {
        self.data[col * self.stride + row] = value;
    }

    pub(crate) fn add(&mut self, row: usize, col: usize, value: f64) {
        self.data[col * self.stride + row] += value;
    }

    /// Reduces columns `0..until` to a staircase by Householder reflections and carries later columns along; returns the
    /// number of steps, so that rows from there on have zeros in all those columns.
    ///
    /// A column that depends on those before it (up to 1e-13 of its length) makes no step: its row would otherwise
    /// be lost to what is said of later columns.
    pub(crate) fn triangularise(&mut self, from_row: usize, from: usize, until: usize) -> usize {
        let (stride, rows, cols) = (self.stride, self.rows, self.cols);
        let mut at = from_row;
        for k in from..until.min(cols) {
            if at >= rows {
                break;
            }
            let (left, right) = self.data.split_at_mut((k + 1) * stride);
            let whole = &mut left[k * stride..k * stride + rows];
            let above = dot(&whole[..at], &whole[..at]);
            let column = &mut whole[at..];
            let square = dot(column, column);
            if !(square > 1e-26 * (square + above)) {
                column.fill(0.0);
                continue;
            }
            let norm = square.sqrt();
            // The sign avoids cancellation.
            let alpha = if column[0] > 0.0 { -norm } else { norm };
            column[0] -= alpha;
            let half_square = -alpha * column[0]; // |v|²/2
            for j in 0..cols - k - 1 {
                let other = &mut right[j * stride + at..j * stride + rows];
                let scale = -dot(column, other) / half_square;
                axpy(scale, column, other);
            }
            column.fill(0.0);
            column[0] = alpha;
            at += 1;
        }
        at
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    fn noise(seed: u64, n: usize) -> Vec<f64> {
        let mut random = crate::simulate::Random::new(seed);
        (0..n).map(|_| random.normal()).collect()
    }

    #[test]
    fn a_system_with_leading_zeros_is_solved_as_by_nalgebra() {
        let n = 37;
        let first: Vec<usize> = (0..n).map(|i| if i < 20 { i - i % 5 } else { 3 }).collect();
        // A matrix with that profile: L Lᵀ of a random profile L keeps it.
        let random = noise(5, n * n);
        let mut l = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in first[i]..=i {
                l[(i, j)] = random[i * n + j] + if i == j { 8.0 } else { 0.0 };
            }
        }
        let a = &l * l.transpose();
        let rows: Vec<f64> = a.transpose().iter().copied().collect();
        let mut factor = Cholesky::with_capacity(n);
        let extra = vec![0.25; n];
        assert!(factor.factorise(&rows, &extra, &first));
        let b = DVector::from_vec(noise(6, n));
        let mut x = b.as_slice().to_vec();
        factor.solve(&mut x);
        let expected = (a + DMatrix::identity(n, n) * 0.25).lu().solve(&b).unwrap();
        assert!((DVector::from_vec(x) - &expected).amax() < 1e-11 * expected.amax().max(1.0));
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        let mut factor = Cholesky::with_capacity(2);
        assert!(!factor.factorise(&[1.0, 0.0, 2.0, 1.0], &[0.0; 2], &[0, 0]));
        assert!(!factor.factorise(&[f64::NAN, 0.0, 0.0, 1.0], &[0.0; 2], &[0, 0]));
        assert!(factor.factorise(&[1.0, 0.0, 2.0, 5.0], &[0.0; 2], &[0, 0]));
    }

    #[test]
    fn reflections_keep_the_gram_matrix() {
        let (rows, cols) = (40, 13);
        let values = noise(9, rows * cols);
        let a = DMatrix::from_vec(rows, cols, values);
        let mut tall = Tall::default();
        tall.reset(rows, cols);
        tall.add_rows(rows);
        for r in 0..rows {
            for c in 0..cols {
                tall.set(r, c, a[(r, c)]);
            }
        }
        assert_eq!(tall.triangularise(0, 0, cols), cols);
        let r = DMatrix::from_fn(rows, cols, |i, j| tall.get(i, j));
        assert!((r.transpose() * &r - a.transpose() * &a).amax() < 1e-12);
        assert!((0..cols).all(|c| (c + 1..rows).all(|i| r[(i, c)] == 0.0)));
    }
}
