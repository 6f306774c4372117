//! Products of rows by lines of the cache, of eight columns each: eight sums that are added up at the end, in one order.

use super::LINE;
use std::hint::black_box;

/// Rows that are taken together where they begin at one column, with two columns at a time: so many sums, and the lines that they are made of, are held by the
/// registers of AVX2, too.
pub(super) const TOGETHER: usize = 3;

pub(super) type Line = [f64; LINE];

/// The inverse of a triangle on the diagonal, by columns.
pub(super) type Inverse = [Line; LINE];

/// The lines of a row from an entry on, which begins one.
#[inline(always)]
pub(super) fn lines(row: &[f64], from: usize) -> &[Line] {
    row[from..].as_chunks().0
}

/// Products of a row with another.
#[inline(always)]
pub(super) fn product(x: &[Line], y: &[Line]) -> Line {
    let mut sums = [0.0; LINE];
    let y = &y[..x.len()];
    for i in 0..x.len() {
        add_products(&mut sums, &x[i], &y[i]);
    }
    sums
}

/// Products of three rows with two others.
#[inline(always)]
pub(super) fn products(
    rows: [&[f64]; TOGETHER],
    a: &[Line],
    b: &[Line],
) -> ([Line; TOGETHER], [Line; TOGETHER]) {
    let n = a.len();
    let [x, y, z] = [lines(rows[0], 0), lines(rows[1], 0), lines(rows[2], 0)];
    let (x, y, z, b) = (&x[..n], &y[..n], &z[..n], &b[..n]);
    let [mut xa, mut ya, mut za, mut xb, mut yb, mut zb] = [[0.0; LINE]; 2 * TOGETHER];
    for i in 0..n {
        add_products(&mut xa, &x[i], &a[i]);
        add_products(&mut ya, &y[i], &a[i]);
        add_products(&mut za, &z[i], &a[i]);
        add_products(&mut xb, &x[i], &b[i]);
        add_products(&mut yb, &y[i], &b[i]);
        add_products(&mut zb, &z[i], &b[i]);
    }
    // Else the compiler arranges the sums for their totals, and takes them apart in every line.
    black_box(([xa, ya, za], [xb, yb, zb]))
}

/// Adds products of three rows with another.
#[inline(always)]
pub(super) fn add_each(sums: &mut [Line; TOGETHER], rows: [&[f64]; TOGETHER], other: &[f64]) {
    for r in 0..TOGETHER {
        let more = product(lines(rows[r], 0), lines(other, 0));
        for k in 0..LINE {
            sums[r][k] += more[k];
        }
    }
}

#[inline(always)]
fn add_products(sums: &mut Line, x: &Line, y: &Line) {
    for k in 0..LINE {
        sums[k] += x[k] * y[k];
    }
}

#[inline(always)]
pub(super) fn total(sums: &Line) -> f64 {
    let [s0, s1, s2, s3, s4, s5, s6, s7] = sums;
    ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7))
}

/// A block's entries from what is left of them.
#[inline(always)]
pub(super) fn divided(left: &Line, inverse: &Inverse) -> Line {
    let mut out = [0.0; LINE];
    for k in 0..LINE {
        for c in 0..LINE {
            out[c] += left[k] * inverse[k][c];
        }
    }
    out
}
