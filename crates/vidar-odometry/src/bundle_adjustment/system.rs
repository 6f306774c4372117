//! The reduced normal equations of states and calibration, and what is kept of the landmarks that were eliminated.

use super::envelope::Envelope;
use super::image_prior::IMAGE_DIM;
use super::observation::STATE_DIM;
use super::problem::{FRAME_DIM, Problem};
use crate::backend::dot;
use nalgebra::{Matrix3, SMatrix, Vector3};

/// `Jᵀ J` between the unknowns of a state and a landmark.
pub(super) type ByState = SMatrix<f64, STATE_DIM, 3>;

/// The same of a landmark and the unknowns of an image.
pub(super) type ByImage = SMatrix<f64, 3, IMAGE_DIM>;

/// A landmark's block of the normal equations, kept to find its step from the states'.
#[derive(Clone, Debug, Default)]
pub(super) struct LandmarkBlock {
    /// Inverse of the damped 3 × 3 block, by [`super::landmark::Landmark::inverse_of`]; `None` leaves the landmark where it is.
    pub(super) inverse: Option<Matrix3<f64>>,
    pub(super) gradient: Vector3<f64>,
    /// Of each observation.
    pub(super) by_state: Vec<(usize, ByState)>,
    /// Of each observation with its image, as many columns as that has unknowns; none where it has none.
    pub(super) by_image: Vec<ByImage>,
    pub(super) by_calibration: Vec<Vector3<f64>>,
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

impl LandmarkBlock {
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
        for (at, (frame, by_state)) in self.by_state.iter().enumerate() {
            let from = frame_dim * frame;
            if let Some(by_image) = self.by_image.get(at) {
                for (column, moved) in by_image.column_iter().zip(&step[from + FRAME_DIM..from + frame_dim]) {
                    gradient += column * *moved;
                }
            }
            let moved = SMatrix::<f64, STATE_DIM, 1>::from_column_slice(&step[from..from + STATE_DIM]);
            gradient += by_state.transpose() * moved;
        }
        for (by_calibration, moved) in self.by_calibration.iter().zip(&step[calibration_offset..]) {
            gradient += by_calibration * *moved;
        }
        Some(-(self.inverse? * gradient))
    }
}
