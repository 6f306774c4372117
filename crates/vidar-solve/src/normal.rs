//! Sparse normal equations `(JᵀJ) δ = −Jᵀr` over blocks of unknowns.

use nalgebra::{DMatrix, DMatrixView, DVector};
use nalgebra_sparse::factorization::{CscCholesky, CscSymbolicCholesky};
use nalgebra_sparse::{CooMatrix, CscMatrix};
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Why a step could not be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SolveError {
    /// An entry of the matrix or the right-hand side is not a finite number.
    #[error("the equations hold a number that is not finite")]
    NotFinite,
    /// The matrix is not positive definite: some unknown is not observed, or the damping is too small.
    #[error("the equations are not positive definite ({unknowns} unknowns)")]
    NotPositiveDefinite {
        /// How many unknowns there are.
        unknowns: usize,
    },
}

/// `JᵀJ` (lower triangle, by blocks) and `Jᵀr`.
#[derive(Debug)]
pub struct NormalEquations {
    /// First unknown of each block, and one past the last.
    starts: Vec<usize>,
    /// Blocks (row, column) with row ≥ column.
    blocks: BTreeMap<(usize, usize), DMatrix<f64>>,
    gradient: Vec<f64>,
    structure: Option<Structure>,
}

/// An elimination order and the pattern it makes; valid while no block is added.
#[derive(Debug)]
struct Structure {
    /// Place of each unknown in the elimination order.
    places: Vec<usize>,
    factor: CscSymbolicCholesky,
}

impl NormalEquations {
    /// Equations over blocks of these sizes.
    pub fn new(block_sizes: &[usize]) -> Self {
        let mut starts = vec![0];
        let mut end = 0;
        for size in block_sizes {
            end += size;
            starts.push(end);
        }
        // The diagonal is always there, so that damping reaches every unknown.
        let diagonal = block_sizes.iter().enumerate().map(|(k, &n)| ((k, k), DMatrix::zeros(n, n)));
        Self { blocks: diagonal.collect(), gradient: vec![0.0; end], starts, structure: None }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.gradient.len()
    }

    /// Sets all sums to zero; which blocks exist is remembered.
    pub fn clear(&mut self) {
        self.blocks.values_mut().for_each(|b| b.fill(0.0));
        self.gradient.fill(0.0);
    }

    /// Adds a residual that depends on `jacobians` = (block, ∂residual/∂block), each block at most once.
    ///
    /// Residual and Jacobians are whitened: the residual's covariance is the identity.
    pub fn add(&mut self, jacobians: &[(usize, DMatrixView<'_, f64>)], residual: &[f64]) {
        for (i, (row, left)) in jacobians.iter().enumerate() {
            for (k, value) in left.column_iter().enumerate() {
                let product: f64 = value.iter().zip(residual).map(|(j, r)| j * r).sum();
                self.gradient[self.starts[*row] + k] += product;
            }
            for (column, right) in &jacobians[..=i] {
                let (row, column, left, right) =
                    if row >= column { (*row, *column, left, right) } else { (*column, *row, right, left) };
                let (rows, columns) = (left.ncols(), right.ncols());
                let block = self.blocks.entry((row, column)).or_insert_with(|| {
                    self.structure = None;
                    DMatrix::zeros(rows, columns)
                });
                block.gemm_tr(1.0, left, right, 1.0);
            }
        }
    }

    /// The gradient `Jᵀr`.
    pub fn gradient(&self) -> &[f64] {
        &self.gradient
    }

    /// Solves `(JᵀJ with its diagonal mapped by `damp`) δ = −Jᵀr`.
    ///
    /// # Errors
    /// [`SolveError`].
    pub fn solve(&mut self, damp: impl Fn(f64) -> f64) -> Result<Vec<f64>, SolveError> {
        let unknowns = self.unknowns();
        let finite = self.blocks.values().flat_map(|b| b.iter()).chain(&self.gradient).all(|v| v.is_finite());
        if !finite {
            return Err(SolveError::NotFinite);
        }
        let structure = match self.structure.take() {
            Some(known) => known,
            None => self.analyse(),
        };
        let matrix = self.permuted(&structure.places, damp);
        let factored = CscCholesky::factor_numerical(structure.factor.clone(), matrix.values());
        let places = &self.structure.insert(structure).places;
        let factor = factored.map_err(|_| SolveError::NotPositiveDefinite { unknowns })?;
        let mut right = DVector::zeros(unknowns);
        places.iter().zip(&self.gradient).for_each(|(&place, g)| right[place] = -g);
        let solution = factor.solve(&right);
        let solution: Vec<f64> = places.iter().map(|&place| solution[place]).collect();
        if solution.iter().all(|v| v.is_finite()) {
            Ok(solution)
        } else {
            Err(SolveError::NotPositiveDefinite { unknowns })
        }
    }

    /// The symmetric matrix in elimination order.
    fn permuted(&self, places: &[usize], damp: impl Fn(f64) -> f64) -> CscMatrix<f64> {
        let mut entries = CooMatrix::new(self.unknowns(), self.unknowns());
        for (&(row, column), block) in &self.blocks {
            let (top, left) = (self.starts[row], self.starts[column]);
            for (c, values) in block.column_iter().enumerate() {
                for (r, &value) in values.iter().enumerate().skip(if row == column { c } else { 0 }) {
                    let (a, b) = (places[top + r], places[left + c]);
                    if a == b {
                        entries.push(a, a, damp(value));
                    } else {
                        // The factorisation reads one triangle, but its analysis wants the pattern of both.
                        entries.push(a, b, value);
                        entries.push(b, a, value);
                    }
                }
            }
        }
        CscMatrix::from(&entries)
    }

    fn analyse(&self) -> Structure {
        let mut places = vec![0; self.unknowns()];
        let order = minimum_degree(self.starts.len() - 1, self.blocks.keys().copied());
        let unknowns = order.iter().flat_map(|&block| self.starts[block]..self.starts[block + 1]);
        unknowns.enumerate().for_each(|(place, unknown)| places[unknown] = place);
        let pattern = self.permuted(&places, |d| d).pattern().clone();
        Structure { factor: CscSymbolicCholesky::factor(pattern), places }
    }
}

/// An order of elimination that keeps the factor thin: always the node with the fewest neighbours left.
fn minimum_degree(nodes: usize, edges: impl Iterator<Item = (usize, usize)>) -> Vec<usize> {
    let mut neighbours = vec![BTreeSet::new(); nodes];
    for (a, b) in edges.filter(|(a, b)| a != b) {
        neighbours[a].insert(b);
        neighbours[b].insert(a);
    }
    let mut queue: BTreeSet<(usize, usize)> = neighbours.iter().map(BTreeSet::len).zip(0..).collect();
    let mut order = Vec::with_capacity(nodes);
    while let Some((_, node)) = queue.pop_first() {
        order.push(node);
        let around = std::mem::take(&mut neighbours[node]);
        for &a in &around {
            queue.remove(&(neighbours[a].len(), a));
            neighbours[a].remove(&node);
            neighbours[a].extend(around.iter().copied().filter(|&b| b != a));
            queue.insert((neighbours[a].len(), a));
        }
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;
    use vidar_core::random::SplitMix64;

    /// A chain of blocks of different sizes with one long loop, and its dense twin.
    fn problem() -> (NormalEquations, DMatrix<f64>, DVector<f64>) {
        let sizes = [7, 6, 1, 7, 3];
        let starts = [0, 7, 13, 14, 21, 24];
        let mut sparse = NormalEquations::new(&sizes);
        let mut dense = DMatrix::zeros(24, 24);
        let mut gradient = DVector::zeros(24);
        let mut random = SplitMix64::new(1);
        let mut next = || 2.0 * random.uniform() - 1.0;
        for (i, j) in [(0, 1), (2, 1), (2, 3), (4, 3), (4, 0), (0, 0)] {
            let a = DMatrix::from_fn(9, sizes[i], |_, _| next());
            let b = DMatrix::from_fn(9, sizes[j], |_, _| next());
            let r = DVector::from_fn(9, |_, _| next());
            let mut whole = DMatrix::zeros(9, 24);
            whole.columns_mut(starts[i], sizes[i]).copy_from(&a);
            if i == j {
                sparse.add(&[(i, a.as_view())], r.as_slice());
            } else {
                whole.columns_mut(starts[j], sizes[j]).copy_from(&b);
                sparse.add(&[(i, a.as_view()), (j, b.as_view())], r.as_slice());
            }
            dense += whole.transpose() * &whole;
            gradient += whole.transpose() * r;
        }
        (sparse, dense, gradient)
    }

    #[test]
    fn the_sparse_solution_is_the_dense_one() {
        let (mut sparse, dense, gradient) = problem();
        let mut damped = dense.clone();
        (0..24).for_each(|i| damped[(i, i)] = damped[(i, i)] * 1.01 + 1e-3);
        let expected = damped.lu().solve(&-&gradient).unwrap();
        for _ in 0..2 {
            let found = sparse.solve(|d| d * 1.01 + 1e-3).unwrap();
            assert!((DVector::from_vec(found) - &expected).norm() < 1e-9 * expected.norm());
        }
        assert!((DVector::from_column_slice(sparse.gradient()) - gradient).norm() < 1e-12);
    }

    #[test]
    fn a_chain_with_a_loop_is_eliminated_without_filling_up() {
        let n = 50;
        let edges = (1..n).map(|k| (k, k - 1)).chain([(n - 1, 0)]);
        let order = minimum_degree(n, edges);
        let mut seen = order.clone();
        seen.sort_unstable();
        assert_eq!(seen, (0..n).collect::<Vec<_>>());
        let mut equations = NormalEquations::new(&vec![1; n]);
        let one = DMatrix::from_element(1, 1, 1.0);
        (0..n).for_each(|k| equations.add(&[(k, one.as_view()), ((k + 1) % n, one.as_view())], &[1.0]));
        equations.solve(|d| d + 1.0).unwrap();
        let factor = &equations.structure.as_ref().unwrap().factor;
        assert!(factor.l_pattern().nnz() <= 3 * n, "{}", factor.l_pattern().nnz());
    }

    #[test]
    fn what_is_not_observed_or_not_finite_is_an_error() {
        let (mut sparse, ..) = problem();
        assert!(sparse.solve(|_| f64::NAN).is_err());
        sparse.add(&[(0, DMatrix::from_element(1, 7, f64::INFINITY).as_view())], &[1.0]);
        assert_eq!(sparse.solve(|d| d), Err(SolveError::NotFinite));
        let mut unseen = NormalEquations::new(&[2, 3]);
        assert_eq!(unseen.solve(|d| d), Err(SolveError::NotPositiveDefinite { unknowns: 5 }));
        assert!(unseen.solve(|d| d + 1.0).unwrap().iter().all(|v| *v == 0.0));
    }
}
