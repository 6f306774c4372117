//! Memory for marginalising: the stack of rows, and which part of the unknowns has which columns.

use super::super::dense::Tall;
use super::super::prior::Part;
use super::super::window::LandmarkObservation;
use nalgebra::{SMatrix, SVector};

/// Memory for marginalising.
#[derive(Clone, Debug, Default)]
pub(crate) struct Workspace {
    pub(super) parts: Vec<Part>,
    /// So many of them, in front, leave.
    pub(super) leaving_parts: usize,
    pub(super) starts: Vec<usize>,
    pub(super) stack: Tall,
    pub(super) one: Tall,
    pub(super) leaving: Vec<(usize, usize)>,
    pub(super) parting: Vec<LandmarkObservation>,
}

impl Workspace {
    pub(super) fn column(&self, part: Part) -> Option<usize> {
        self.parts.iter().position(|&p| p == part).map(|at| self.starts[at])
    }

    pub(super) fn rhs(&self) -> usize {
        self.stack.cols() - 1
    }

    pub(super) fn insert(&mut self, part: Part) {
        if !self.parts.contains(&part) {
            self.parts.push(part);
        }
    }

    /// Writes a block of rows of one part and, for parts that already have a step, its share of the right-hand side.
    pub(super) fn put<const R: usize, const C: usize>(
        &mut self,
        row: usize,
        part: Part,
        block: &SMatrix<f64, R, C>,
        step: Option<SVector<f64, C>>,
    ) {
        let Some(col) = self.column(part) else { return };
        let rhs = self.rhs();
        for c in 0..C {
            for r in 0..R {
                self.stack.add(row + r, col + c, block[(r, c)]);
            }
        }
        if let Some(step) = step {
            let shift = block * step;
            for r in 0..R {
                self.stack.add(row + r, rhs, -shift[r]);
            }
        }
    }

    pub(super) fn put_rhs(&mut self, row: usize, values: &[f64]) {
        let rhs = self.rhs();
        for (r, v) in values.iter().enumerate() {
            self.stack.add(row + r, rhs, *v);
        }
    }
}
