//! The reduced normal equations of states and calibration, and what is kept of the landmarks that were eliminated.

use super::envelope::{Envelope, Rows};
use super::image_prior::IMAGE_DIM;
use super::observation::STATE_DIM;
use super::problem::{FRAME_DIM, Problem};
use crate::backend::dot;
use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};
use std::ops::Range;

/// `Jᵀ J` between the unknowns of a state and a landmark.
pub(super) type ByState = SMatrix<f64, STATE_DIM, 3>;

/// The same of a landmark and the unknowns of an image.
pub(super) type ByImage = SMatrix<f64, 3, IMAGE_DIM>;

/// What an observation adds, whitened.
#[derive(Clone, Debug)]
pub(super) struct ObservationBlock {
    pub(super) frame: usize,
    pub(super) residual: Vector2<f64>,
    pub(super) by_state: SMatrix<f64, 2, STATE_DIM>,
    pub(super) with_landmark: ByState,
}

/// What an observation adds for its image's own unknowns, as many columns as there are.
#[derive(Clone, Debug)]
pub(super) struct ImageBlock {
    pub(super) by_image: SMatrix<f64, 2, IMAGE_DIM>,
    pub(super) with_landmark: ByImage,
}

/// A landmark's block of the normal equations, kept to find its step from the states'.
#[derive(Clone, Debug, Default)]
pub(super) struct LandmarkBlock {
    /// Inverse of the damped 3 × 3 block, by [`super::landmark::Landmark::inverse_of`]; `None` leaves the landmark where it is.
    pub(super) inverse: Option<Matrix3<f64>>,
    pub(super) gradient: Vector3<f64>,
    pub(super) observations: Vec<ObservationBlock>,
    /// Of each observation, where images have unknowns; else none.
    pub(super) images: Vec<ImageBlock>,
    /// Derivatives of each observation by the active unknowns of the camera, one observation after the other.
    pub(super) by_calibration: Vec<Vector2<f64>>,
    /// `Jᵀ J` of the landmark and each of them.
    pub(super) with_calibration: Vec<Vector3<f64>>,
}

/// The reduced normal equations `H x = −g` of states and calibration.
#[derive(Clone, Debug)]
pub(super) struct System {
    pub(super) h: Envelope,
    pub(super) factor: Envelope,
    pub(super) gradient: Vec<f64>,
    pub(super) landmarks: Vec<LandmarkBlock>,
}

impl System {
    pub(super) fn new(problem: &Problem) -> Self {
        let h = problem.envelope();
        Self { factor: h.clone(), h, gradient: vec![0.0; problem.dim()], landmarks: Vec::new() }
    }

    /// Standard deviation of a linear function of the unknowns, by the factor.
    pub(super) fn sigma_of(&self, mut slope: Vec<f64>) -> f64 {
        self.factor.forward(&mut slope);
        dot(&slope, &slope).sqrt()
    }
}

/// Rows of the reduced system that one thread adds to.
pub(super) struct Part<'a> {
    /// States and unknowns of the camera whose rows they are.
    pub(super) frames: Range<usize>,
    pub(super) calibrations: Range<usize>,
    pub(super) h: Rows<'a>,
    /// The gradient from row `begin` on.
    gradient: &'a mut [f64],
    begin: usize,
}

impl<'a> Part<'a> {
    pub(super) fn of_all(problem: &Problem, h: Rows<'a>, gradient: &'a mut [f64]) -> Self {
        let (frames, calibrations) = (0..problem.frames.len(), 0..problem.active_camera());
        Self { frames, calibrations, h, gradient, begin: 0 }
    }

    /// The rows before `row`, and the others.
    pub(super) fn split_at(self, problem: &Problem, row: usize) -> (Self, Self) {
        let Self { frames, calibrations, h, gradient, begin } = self;
        let frame = (row / problem.frame_dim()).min(problem.frames.len());
        let calibration = row.saturating_sub(problem.calibration_offset());
        let (above, h) = h.split_at(row);
        let (before, gradient) = gradient.split_at_mut(row - begin);
        let first = Self {
            frames: frames.start..frame,
            calibrations: calibrations.start..calibration,
            h: above,
            gradient: before,
            begin,
        };
        let (frames, calibrations) = (frame..frames.end, calibration..calibrations.end);
        (first, Self { frames, calibrations, h, gradient, begin: row })
    }

    /// Entry of the gradient.
    #[inline(always)]
    pub(super) fn gradient(&mut self, row: usize) -> &mut f64 {
        &mut self.gradient[row - self.begin]
    }

    /// Whether nothing of a landmark belongs to these rows.
    pub(super) fn is_beside(&self, block: &LandmarkBlock) -> bool {
        let frame = |o: Option<&ObservationBlock>| o.map(|o| o.frame);
        let (oldest, newest) = (frame(block.observations.first()), frame(block.observations.last()));
        self.calibrations.is_empty()
            && (oldest.is_none_or(|k| k >= self.frames.end) || newest.is_none_or(|k| k < self.frames.start))
    }
}

impl LandmarkBlock {
    /// Without observations.
    pub(super) fn clear(&mut self, calibrations: usize) {
        self.inverse = None;
        self.gradient = Vector3::zeros();
        self.observations.clear();
        self.images.clear();
        self.by_calibration.clear();
        self.with_calibration.clear();
        self.with_calibration.resize(calibrations, Vector3::zeros());
    }

    /// Derivatives of an observation by the active unknowns of the camera.
    #[inline(always)]
    pub(super) fn by_calibration(&self, at: usize) -> &[Vector2<f64>] {
        let count = self.with_calibration.len();
        &self.by_calibration[count * at..count * (at + 1)]
    }

    /// Standard deviation of the inverse distance with the states held, 1/m; infinite where it is at its bound.
    pub(super) fn inverse_distance_sigma(&self) -> f64 {
        let variance = self.inverse.map(|inverse| inverse[(2, 2)]).filter(|variance| *variance > 0.0);
        variance.map_or(f64::INFINITY, f64::sqrt)
    }

    /// The landmark's step that belongs to a step of states and calibration.
    pub(super) fn step(
        &self,
        step: &[f64],
        frame_dim: usize,
        calibration_offset: usize,
    ) -> Option<Vector3<f64>> {
        let mut gradient = self.gradient;
        for (at, seen) in self.observations.iter().enumerate() {
            let from = frame_dim * seen.frame;
            if let Some(image) = self.images.get(at) {
                let columns = image.with_landmark.column_iter();
                for (column, moved) in columns.zip(&step[from + FRAME_DIM..from + frame_dim]) {
                    gradient += column * *moved;
                }
            }
            let moved = SMatrix::<f64, STATE_DIM, 1>::from_column_slice(&step[from..from + STATE_DIM]);
            gradient += seen.with_landmark.transpose() * moved;
        }
        for (by_calibration, moved) in self.with_calibration.iter().zip(&step[calibration_offset..]) {
            gradient += by_calibration * *moved;
        }
        Some(-(self.inverse? * gradient))
    }
}
