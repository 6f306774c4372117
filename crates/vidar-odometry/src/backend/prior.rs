//! The square-root prior: `½ |r₀ + R δ|²` over the steps δ of the states that are in it.

use super::window::{CALIBRATION_DIM, CalibrationState, Frame};
use nalgebra::Vector3;
use vidar_core::LieGroup;

/// A part of the unknowns, with frames by their place in the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// Rotation and position of a frame.
    Pose(usize),
    /// Velocity and biases of a frame.
    Motion(usize),
    /// How much later than its stamp a frame was exposed, where stamps scatter.
    Delay(usize),
    /// How far its image is shifted, where a stabiliser does that.
    ImageShift(usize),
    /// The calibration.
    Calibration,
}

impl Part {
    pub(crate) const fn dim(self) -> usize {
        match self {
            Self::Pose(_) => 6,
            Self::Motion(_) => 9,
            Self::Delay(_) => 1,
            Self::ImageShift(_) => 2,
            Self::Calibration => CALIBRATION_DIM,
        }
    }

    pub(crate) const fn frame(self) -> Option<usize> {
        match self {
            Self::Pose(k) | Self::Motion(k) | Self::Delay(k) | Self::ImageShift(k) => Some(k),
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
    /// `R n`, with n the direction of a turn of everything about the vertical, at the linearisation points: what the
    /// prior knows of heading (nothing but what the anchor said).
    heading: Vec<f64>,
    turn: Vec<f64>,
    /// The correction `d uᵀ` of R: u, `Rᵀ d`, and `dᵀ d`.
    along: Vec<f64>,
    missing: Vec<f64>,
    root_missing: Vec<f64>,
    missing_square: f64,
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

    /// Direction of a turn of all parts about the vertical at the present states, into `turn`; the same about the middle
    /// of the positions, which no shift is part of, into `along`.
    fn place_turn(&mut self, frames: &[Frame]) {
        let up = Vector3::z();
        let poses = self.parts.iter().filter_map(|p| if let Part::Pose(k) = p { Some(*k) } else { None });
        let place = |k: usize| frames[k].state.world_from_body.translation;
        let (sum, count) = poses.fold((Vector3::zeros(), 0.0), |(sum, n), k| (sum + place(k), n + 1.0));
        let middle = if count > 0.0 { sum / count } else { sum };
        self.turn.clear();
        self.along.clear();
        for part in &self.parts {
            match *part {
                Part::Pose(k) => {
                    let body_up = frames[k].state.world_from_body.rotation.inverse() * up;
                    for (vector, from) in [(&mut self.turn, Vector3::zeros()), (&mut self.along, middle)] {
                        vector.extend_from_slice(body_up.as_slice());
                        vector.extend_from_slice(up.cross(&(place(k) - from)).as_slice());
                    }
                }
                Part::Motion(k) => {
                    for vector in [&mut self.turn, &mut self.along] {
                        vector.extend_from_slice(up.cross(&frames[k].state.velocity).as_slice());
                        vector.extend([0.0; 6]);
                    }
                }
                Part::Delay(_) | Part::ImageShift(_) => {
                    self.turn.extend(std::iter::repeat_n(0.0, part.dim()));
                    self.along.extend(std::iter::repeat_n(0.0, part.dim()));
                }
                Part::Calibration => {
                    self.turn.extend([0.0; CALIBRATION_DIM]);
                    self.along.extend([0.0; CALIBRATION_DIM]);
                }
            }
        }
    }

    /// Notes what the prior knows of heading at the present states, which must be its linearisation points.
    pub(crate) fn note_heading(&mut self, frames: &[Frame]) {
        self.place_turn(frames);
        let n = self.dim;
        self.heading.clear();
        let rows = (0..self.rows).map(|r| super::dense::dot(&self.root[r * n..(r + 1) * n], &self.turn));
        self.heading.extend(rows);
    }

    /// After [`Prior::evaluate`]: finds the smallest change `d uᵀ` of R after which it knows of heading, at the present
    /// states, what it knew at its linearisation points, and of shifts what it did; corrects the gradient.
    pub(crate) fn constrain(&mut self, frames: &[Frame], constrained: bool) {
        let n = self.dim;
        self.root_missing.clear();
        self.root_missing.resize(n, 0.0);
        self.missing.clear();
        self.missing_square = 0.0;
        self.place_turn(frames);
        let length = super::dense::dot(&self.along, &self.along);
        if !constrained || !(length > 0.0) {
            self.along.fill(0.0);
            self.missing.resize(self.rows, 0.0);
            return;
        }
        self.along.iter_mut().for_each(|u| *u /= length);
        let mut pull = 0.0;
        for row in 0..self.rows {
            let root = &self.root[row * n..(row + 1) * n];
            let missing = self.heading[row] - super::dense::dot(root, &self.turn);
            self.missing.push(missing);
            super::dense::axpy(missing, root, &mut self.root_missing);
            self.missing_square += missing * missing;
            pull += missing * self.value[row];
        }
        super::dense::axpy(pull, &self.along, &mut self.gradient);
    }

    /// Entry of `(R + d uᵀ)ᵀ (R + d uᵀ) − Rᵀ R`.
    pub(crate) fn correction(&self, i: usize, j: usize) -> f64 {
        self.root_missing[i] * self.along[j]
            + self.along[i] * self.root_missing[j]
            + self.missing_square * self.along[i] * self.along[j]
    }

    /// Moves the linearisation points to the present states: the residual becomes its present value, the root its
    /// corrected self. The frames' own points are the caller's to move.
    pub(crate) fn relinearise(
        &mut self,
        frames: &[Frame],
        calibration: &CalibrationState,
        constrained: bool,
    ) {
        self.evaluate(frames, calibration);
        self.constrain(frames, constrained);
        let n = self.dim;
        for row in 0..self.rows {
            super::dense::axpy(self.missing[row], &self.along, &mut self.root[row * n..(row + 1) * n]);
        }
        self.residual.clear();
        self.residual.extend_from_slice(&self.value);
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
                Part::Pose(k) | Part::Motion(k) | Part::Delay(k) | Part::ImageShift(k) if *k > gone => {
                    *k -= 1
                }
                _ => {}
            }
        }
    }

    /// Evaluates residual and gradient at the present steps, and returns the cost.
    pub(crate) fn evaluate(&mut self, frames: &[Frame], calibration: &CalibrationState) -> f64 {
        let n = self.dim;
        self.step.clear();
        for part in &self.parts {
            match *part {
                Part::Pose(k) => self.step.extend_from_slice(&frames[k].step.as_slice()[..6]),
                Part::Motion(k) => self.step.extend_from_slice(&frames[k].step.as_slice()[6..]),
                Part::Delay(k) => self.step.push(frames[k].delay.step.x),
                Part::ImageShift(k) => self.step.extend_from_slice(frames[k].image_shift.step.as_slice()),
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
