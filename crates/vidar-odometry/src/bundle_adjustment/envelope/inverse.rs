//! The inverse of an envelope's matrix within the envelope.

use super::{Aligned, Envelope};
use std::ops::Range;
use vidar_core::simd::kernel;

/// Columns that are found together, at most: those of a state. Half of them at a time is what registers hold of [`TOGETHER`] rows.
const HALF: usize = 8;
const WIDTH: usize = 2 * HALF;

/// Rows below that are taken together.
const TOGETHER: usize = 4;

type Half = [f64; HALF];

impl Envelope {
    /// The entries of the inverse within the envelope, for a factor (Takahashi, Fagan, Chin 1973): no others are needed to find
    /// them. `border` is the number of the first of the last rows that begin at column 0.
    ///
    /// With the columns `J` of a block and the rows `R` below it, `W = L_RJ L_JJ⁻¹`, `Z_RJ = -Z_RR W` and
    /// `Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ - Z_RJᵀ W`, from the last block to the first.
    pub(in crate::bundle_adjustment) fn inverse(&self, border: usize) -> Self {
        let mut z = Self {
            first: self.first.clone(),
            begin: self.begin.clone(),
            values: Aligned::zeros(self.values.len()),
        };
        // Last row of the band that reaches a column.
        let mut last: Vec<usize> = (0..self.dim()).collect();
        for row in 0..border {
            last[self.first[row]] = row;
        }
        for column in 1..border {
            last[column] = last[column].max(last[column - 1]);
        }
        let mut products = [Products::default(), Products::default()];
        for columns in self.blocks(border).into_iter().rev() {
            let band =
                columns.end..if columns.start < border { last[columns.start] + 1 } else { columns.end };
            let below = Below { band, border: border.max(columns.end)..self.dim() };
            let factor = Triangle::of(self, &columns);
            products.iter_mut().for_each(|p| p.clear(below.len()));
            for (at, row) in below.rows().filter(|(_, row)| self.first[*row] <= columns.start) {
                let divided = factor.divide(self.range(row, columns.start, columns.end));
                let (low, high) = divided.split_at(HALF);
                products[0].factors[at].copy_from_slice(low);
                products[1].factors[at].copy_from_slice(high);
            }
            products.iter_mut().for_each(|p| multiply(&z, &below, columns.start, &p.factors, &mut p.sums));
            let [low, high] = &products;
            for (at, row) in below.rows().filter(|(_, row)| self.first[*row] <= columns.start) {
                let found = low.sums[at].iter().chain(&high.sums[at]);
                let mut rows = z.rows();
                let target = rows.part_mut(row, columns.start, columns.len());
                target.iter_mut().zip(found).for_each(|(z, sum)| *z = -sum);
            }
            let own = factor.inverse_of_square();
            for i in 0..columns.len() {
                for j in 0..=i {
                    let (a, b) = (&products[i / HALF], &products[j / HALF]);
                    let pairs = a.factors.iter().zip(&b.sums);
                    let sum: f64 = pairs.map(|(w, sum)| w[i % HALF] * sum[j % HALF]).sum();
                    z.set(columns.start + i, columns.start + j, own[i][j] + sum);
                }
            }
        }
        z
    }

    /// Columns in blocks such that a row holds all of a block's columns before it, or none.
    fn blocks(&self, border: usize) -> Vec<Range<usize>> {
        let mut starts: Vec<usize> = self.first.iter().copied().chain([0, border]).collect();
        starts.sort_unstable();
        starts.dedup();
        let ends = starts.iter().skip(1).copied().chain([self.dim()]);
        let wide = starts.iter().zip(ends).map(|(start, end)| *start..end);
        wide.flat_map(|wide| wide.clone().step_by(WIDTH).map(move |start| start..wide.end.min(start + WIDTH)))
            .collect()
    }
}

/// The rows below a block: those of the band, and the border.
struct Below {
    band: Range<usize>,
    border: Range<usize>,
}

impl Below {
    fn len(&self) -> usize {
        self.band.len() + self.border.len()
    }

    /// Their numbers among themselves and in the matrix.
    fn rows(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        self.band.clone().chain(self.border.clone()).enumerate()
    }
}

/// A block of the factor's diagonal.
struct Triangle {
    size: usize,
    rows: [[f64; WIDTH]; WIDTH],
}

impl Triangle {
    fn of(factor: &Envelope, columns: &Range<usize>) -> Self {
        let mut rows = [[0.0; WIDTH]; WIDTH];
        for (i, row) in columns.clone().enumerate() {
            rows[i][..=i].copy_from_slice(factor.range(row, columns.start, row + 1));
        }
        Self { size: columns.len(), rows }
    }

    /// `w` with `w L = row`.
    fn divide(&self, row: &[f64]) -> [f64; WIDTH] {
        let mut w = [0.0; WIDTH];
        w[..self.size].copy_from_slice(row);
        for j in (0..self.size).rev() {
            w[j] /= self.rows[j][j];
            let divided = w[j];
            for (entry, l) in w[..j].iter_mut().zip(&self.rows[j]) {
                *entry -= divided * l;
            }
        }
        w
    }

    /// `(L Lᵀ)⁻¹`.
    fn inverse_of_square(&self) -> [[f64; WIDTH]; WIDTH] {
        let mut unit = [[0.0; WIDTH]; WIDTH];
        for i in 0..self.size {
            let mut row = [0.0; WIDTH];
            row[i] = 1.0;
            unit[i] = self.divide(&row[..self.size]);
        }
        // Row i of `unit` is that of L⁻¹.
        let mut square = [[0.0; WIDTH]; WIDTH];
        for i in 0..self.size {
            for j in 0..=i {
                square[i][j] = (i..self.size).map(|k| unit[k][i] * unit[k][j]).sum();
            }
        }
        square
    }
}

/// Half of the columns of `W`, and of `Z_RR W`.
#[derive(Default)]
struct Products {
    factors: Vec<Half>,
    sums: Vec<Half>,
}

impl Products {
    fn clear(&mut self, rows: usize) {
        for halves in [&mut self.factors, &mut self.sums] {
            halves.clear();
            halves.resize(rows, [0.0; HALF]);
        }
    }
}

kernel! {
    /// Adds `Z_RR W` of half of the columns. Rows that do not reach the block, which begins at `column`, have no part in it.
    fn multiply(z: &Envelope, below: &Below, column: usize, factors: &[Half], sums: &mut [Half]) {
        let reaches = |row: usize| z.first[row] <= column;
        // Rows of the border hold the band's columns before their own.
        let parts = [(below.band.clone(), 0..0), (below.border.clone(), below.band.clone())];
        let mut at = 0;
        for (rows, band) in parts {
            let mut row = rows.start;
            while row < rows.end {
                let together = (row..rows.end.min(row + TOGETHER)).take_while(|r| reaches(*r)).count();
                let done = if together == TOGETHER { TOGETHER } else { 1 };
                if together == TOGETHER {
                    let four = |columns: Range<usize>| {
                        std::array::from_fn(|k| z.range(row + k, columns.start, columns.end))
                    };
                    add_rows(four(band.clone()), at, 0, factors, sums);
                    add_rows(four(rows.start..row), at, band.len(), factors, sums);
                    for k in 0..TOGETHER {
                        add_row(z.range(row + k, row, row + k + 1), at + k, at, factors, sums);
                    }
                } else if together > 0 {
                    add_row(z.range(row, band.start, band.end), at, 0, factors, sums);
                    add_row(z.range(row, rows.start, row + 1), at, band.len(), factors, sums);
                }
                row += done;
                at += done;
            }
        }
    }
}

/// The part of one row `at` whose entries are those of the rows from `from` on; the last one may be its own, on the diagonal.
#[inline(always)]
fn add_row(z: &[f64], at: usize, from: usize, factors: &[Half], sums: &mut [Half]) {
    let mut own = sums[at];
    for (i, z) in z.iter().enumerate() {
        let other = from + i;
        for c in 0..HALF {
            own[c] += z * factors[other][c];
        }
        if other != at {
            for c in 0..HALF {
                sums[other][c] += z * factors[at][c];
            }
        }
    }
    sums[at] = own;
}

/// The same of four rows from `at` on, before their own block of the diagonal.
#[inline(always)]
fn add_rows(z: [&[f64]; TOGETHER], at: usize, from: usize, factors: &[Half], sums: &mut [Half]) {
    let length = z[0].len();
    let (before, own) = sums.split_at_mut(at);
    let mut totals: [Half; TOGETHER] = std::array::from_fn(|k| own[k]);
    let of_rows: [Half; TOGETHER] = std::array::from_fn(|k| factors[at + k]);
    let [z0, z1, z2, z3] = z.map(|row| &row[..length]);
    let (others, targets) = (&factors[from..from + length], &mut before[from..from + length]);
    for i in 0..length {
        let z = [z0[i], z1[i], z2[i], z3[i]];
        let (other, target) = (&others[i], &mut targets[i]);
        for c in 0..HALF {
            for k in 0..TOGETHER {
                totals[k][c] += z[k] * other[c];
            }
            target[c] +=
                (z[0] * of_rows[0][c] + z[1] * of_rows[1][c]) + (z[2] * of_rows[2][c] + z[3] * of_rows[3][c]);
        }
    }
    own[..TOGETHER].copy_from_slice(&totals);
}
