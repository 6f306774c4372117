//! The normal equations of a stretch: what observations add, and what points leave when they are eliminated.

use super::{OF_NODES, SHAKES, TOUCHED};
use crate::calibration::parameters::DIM;
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector2, Vector3};
use std::ops::Range;
use vidar_core::simd::kernel;

/// A residual with its derivatives, whitened: by unknowns of images, which are those of `columns`, by the shares of a stabiliser, by the parameters.
pub(super) struct Linear {
    pub(super) residual: Vector2<f64>,
    pub(super) columns: [usize; OF_NODES],
    pub(super) jacobian: SMatrix<f64, 2, TOUCHED>,
    pub(super) d_point: SMatrix<f64, 2, 3>,
}

/// `H δ = g` of a stretch's own unknowns, then of the parameters; of `H` the lower triangle.
pub(super) struct NormalEquations {
    pub(super) h: DMatrix<f64>,
    pub(super) g: DVector<f64>,
    /// Derivatives of an observation by what all observations share, and where these unknowns begin.
    shared: Range<usize>,
    first_shared: usize,
}

impl NormalEquations {
    /// Of so many own unknowns, the shares of a stabiliser among them or not.
    pub(super) fn new(own: usize, has_shakes: bool) -> Self {
        let all = own + DIM;
        // Shares that nothing is taken back of have no derivative.
        let shakes = if has_shakes { SHAKES } else { 0 };
        Self {
            h: DMatrix::zeros(all, all),
            g: DVector::zeros(all),
            shared: TOUCHED - DIM - shakes..TOUCHED,
            first_shared: own - shakes,
        }
    }

    /// Of a point, to be added to: one row of three for each unknown.
    pub(super) fn no_coupling(&self) -> DMatrix<f64> {
        DMatrix::zeros(self.g.len(), 3)
    }

    /// Adds an observation with a weight, and its coupling to its point.
    pub(super) fn add(&mut self, linear: &Linear, weight: f64, coupling: &mut DMatrix<f64>) {
        let Linear { residual, columns, jacobian, d_point } = linear;
        let rows = |k: usize| -> [f64; TOUCHED] { std::array::from_fn(|c| jacobian[(k, c)]) };
        let observed = Observed { columns, by: [rows(0), rows(1)], shared: self.shared.clone() };
        let (n, first) = (self.g.len(), self.first_shared);
        let weighted = observed.weighted(weight);
        add_products(self.h.as_mut_slice(), n, first, &observed, &weighted);
        add_gradient(self.g.as_mut_slice(), first, &observed, &weighted, [residual.x, residual.y]);
        for p in 0..3 {
            let column = &mut coupling.as_mut_slice()[n * p..n * (p + 1)];
            add_gradient(column, first, &observed, &weighted, [d_point[(0, p)], d_point[(1, p)]]);
        }
    }

    /// Takes a point with block inverse `inverse` and coupling out.
    pub(super) fn eliminate(
        &mut self,
        coupling: &DMatrix<f64>,
        inverse: &Matrix3<f64>,
        gradient: &Vector3<f64>,
    ) {
        let product = coupling * inverse;
        self.g -= &product * gradient;
        subtract_products(self.h.as_mut_slice(), self.g.len(), coupling.as_slice(), product.as_slice());
    }
}

/// An observation's derivatives by rows of its residual.
struct Observed<'a> {
    columns: &'a [usize; OF_NODES],
    by: [[f64; TOUCHED]; 2],
    shared: Range<usize>,
}

impl Observed<'_> {
    fn weighted(&self, weight: f64) -> [[f64; TOUCHED]; 2] {
        self.by.map(|row| row.map(|value| value * weight))
    }
}

kernel! {
    /// Adds `Jᵀ W J` to the lower triangle of an `n` × `n` matrix.
    fn add_products(h: &mut [f64], n: usize, first: usize, observed: &Observed<'_>, weighted: &[[f64; TOUCHED]; 2]) {
        let Observed { columns, by: [x, y], shared } = observed;
        let [wx, wy] = weighted;
        for a in 0..OF_NODES {
            for b in a..OF_NODES {
                let (column, row) = (columns[a].min(columns[b]), columns[a].max(columns[b]));
                h[n * column + row] += wx[a] * x[b] + wy[a] * y[b];
            }
            let at = n * columns[a] + first;
            add_scaled(&mut h[at..at + shared.len()], [&x[shared.clone()], &y[shared.clone()]], [wx[a], wy[a]]);
        }
        for a in shared.clone() {
            let column = first + a - shared.start;
            let (at, rest) = (n * column + column, a..shared.end);
            add_scaled(&mut h[at..at + rest.len()], [&x[rest.clone()], &y[rest.clone()]], [wx[a], wy[a]]);
        }
    }
}

kernel! {
    /// Adds `Jᵀ W r` for a residual or for one of its derivatives.
    fn add_gradient(g: &mut [f64], first: usize, observed: &Observed<'_>, weighted: &[[f64; TOUCHED]; 2], r: [f64; 2]) {
        let Observed { columns, shared, .. } = observed;
        let [wx, wy] = weighted;
        for a in 0..OF_NODES {
            g[columns[a]] += wx[a] * r[0] + wy[a] * r[1];
        }
        add_scaled(&mut g[first..first + shared.len()], [&wx[shared.clone()], &wy[shared.clone()]], r);
    }
}

kernel! {
    /// Takes `coupling · productᵀ`, three columns each, off the lower triangle of an `n` × `n` matrix.
    fn subtract_products(h: &mut [f64], n: usize, coupling: &[f64], product: &[f64]) {
        let (a, rest) = coupling.split_at(n);
        let (b, c) = rest.split_at(n);
        for column in 0..n {
            let (x, y, z) = (product[column], product[n + column], product[2 * n + column]);
            if x == 0.0 && y == 0.0 && z == 0.0 {
                continue;
            }
            let target = &mut h[n * column + column..n * (column + 1)];
            let (a, b, c) = (&a[column..], &b[column..], &c[column..]);
            for k in 0..target.len() {
                target[k] -= a[k] * x + b[k] * y + c[k] * z;
            }
        }
    }
}

#[inline(always)]
fn add_scaled(target: &mut [f64], [x, y]: [&[f64]; 2], [by_x, by_y]: [f64; 2]) {
    let (x, y) = (&x[..target.len()], &y[..target.len()]);
    for k in 0..target.len() {
        target[k] += by_x * x[k] + by_y * y[k];
    }
}
