//! The square-root prior: `½ |r₀ + R δ|²` over the steps δ of the states that are in it.

use super::window::{CALIBRATION_DIM, Calibration, Frame};

/// A part of the unknowns, with frames by their place in the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// Rotation and position of a frame.
    Pose(usize),
    /// Velocity and biases of a frame.
    Motion(usize),
    /// The calibration.
    Calibration,
}

impl Part {
    pub(crate) const fn dim(self) -> usize {
        match self {
            Self::Pose(_) => 6,
            Self::Motion(_) => 9,
            Self::Calibration => CALIBRATION_DIM,
        }
    }

    pub(crate) const fn frame(self) -> Option<usize> {
        match self {
            Self::Pose(k) | Self::Motion(k) => Some(k),
            Self::Calibration => None,
        }
    }
}

/// The prior; empty until the first frame is marginalised.
#[derive(Clone, Debug, Default)]
pub(crate) struct Prior {
    pub(crate) parts: Vec<Part>,
    /// First column of every part.
    pub(crate) starts: Vec<usize>,
    pub(crate) dim: usize,
    pub(crate) rows: usize,
    /// `R`, row-major, upper triangular.
    pub(crate) root: Vec<f64>,
    /// `r₀`.
    pub(crate) residual: Vec<f64>,
    /// `Rᵀ R`, row-major.
    pub(crate) information: Vec<f64>,
    /// δ and `r₀ + R δ` of the last evaluation.
    pub(crate) step: Vec<f64>,
    pub(crate) value: Vec<f64>,
    pub(crate) gradient: Vec<f64>,
}

impl Prior {
    pub(crate) fn clear(&mut self) {
        self.parts.clear();
        self.starts.clear();
        (self.dim, self.rows) = (0, 0);
    }

    pub(crate) fn touches(&self, frame: usize) -> bool {
        self.parts.iter().any(|p| p.frame() == Some(frame))
    }

    /// Sets the parts and a root and residual of zeros with `rows` rows.
    pub(crate) fn reset(&mut self, parts: &[Part], rows: usize) {
        self.parts.clear();
        self.starts.clear();
        self.dim = 0;
        for &part in parts {
            self.parts.push(part);
            self.starts.push(self.dim);
            self.dim += part.dim();
        }
        self.rows = rows;
        for (vector, size) in [
            (&mut self.root, rows * self.dim),
            (&mut self.residual, rows),
            (&mut self.information, self.dim * self.dim),
        ] {
            vector.clear();
            vector.resize(size, 0.0);
        }
    }

    /// `Rᵀ R` after the root was filled.
    pub(crate) fn square(&mut self) {
        let n = self.dim;
        self.information.fill(0.0);
        for row in 0..self.rows {
            let root = &self.root[row * n..(row + 1) * n];
            for i in 0..n {
                if root[i] != 0.0 {
                    super::dense::axpy(root[i], root, &mut self.information[i * n..(i + 1) * n]);
                }
            }
        }
    }

    /// A frame left the window: later ones move up.
    pub(crate) fn frame_left(&mut self, gone: usize) {
        for part in &mut self.parts {
            match part {
                Part::Pose(k) | Part::Motion(k) if *k > gone => *k -= 1,
                _ => {}
            }
        }
    }

    /// Evaluates residual and gradient at the present steps, and returns the cost.
    pub(crate) fn evaluate(&mut self, frames: &[Frame], calibration: &Calibration) -> f64 {
        let n = self.dim;
        self.step.clear();
        for part in &self.parts {
            match *part {
                Part::Pose(k) => self.step.extend_from_slice(&frames[k].step.as_slice()[..6]),
                Part::Motion(k) => self.step.extend_from_slice(&frames[k].step.as_slice()[6..]),
                Part::Calibration => self.step.extend_from_slice(calibration.step.as_slice()),
            }
        }
        self.value.clear();
        self.gradient.clear();
        self.gradient.resize(n, 0.0);
        let mut cost = 0.0;
        for row in 0..self.rows {
            let root = &self.root[row * n..(row + 1) * n];
            let value = self.residual[row] + super::dense::dot(root, &self.step);
            self.value.push(value);
            super::dense::axpy(value, root, &mut self.gradient);
            cost += 0.5 * value * value;
        }
        cost
    }
}
