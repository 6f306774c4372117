//! The normal equations of the window in memory that is used again: motions first, then delays (where frames have them), then poses, then calibration.
//!
//! Velocities and biases couple only to their neighbours in time, so with them in front the Cholesky factor has long
//! runs of leading zeros in their rows.

use super::dense::Cholesky;
use super::optimise::StateBackup;
use super::prior::Part;
use super::visual::CameraPose;
use super::window::CALIBRATION_DIM;
use crate::imu::NavState;
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// A landmark's part in the last linearisation, for back substitution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EliminatedLandmark {
    pub(crate) slot: usize,
    pub(crate) inverse: Matrix3<f64>,
    pub(crate) gradient: Vector3<f64>,
    pub(crate) cross_begin: usize,
    pub(crate) cross_end: usize,
    pub(crate) by_calibration: SMatrix<f64, CALIBRATION_DIM, 3>,
}

/// `J_poseᵀ J_landmark` of one frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PoseLandmarkBlock {
    pub(crate) frame: usize,
    pub(crate) value: SMatrix<f64, 6, 3>,
}

/// The system and everything that is needed to build and solve it without allocating.
#[derive(Clone, Debug, Default)]
pub(crate) struct System {
    pub(crate) frames: usize,
    /// Frames that have a delay: all or none.
    pub(crate) delays: usize,
    /// Frames whose image has a shift: all or none.
    pub(crate) image_shifts: usize,
    pub(crate) n: usize,
    /// Lower triangle of `Jᵀ J`, row-major `n × n`.
    pub(crate) h: Vec<f64>,
    pub(crate) gradient: Vec<f64>,
    pub(crate) first: Vec<usize>,
    pub(crate) damping: Vec<f64>,
    pub(crate) step: Vec<f64>,
    pub(crate) cholesky: Cholesky,
    /// Columns of the factor's inverse, for covariances.
    pub(crate) solved: Vec<f64>,
    /// Whether `cholesky` is of the undamped system at the present states.
    pub(crate) factorised: bool,
    pub(crate) camera_poses: Vec<CameraPose>,
    pub(crate) camera_poses_at: Vec<CameraPose>,
    pub(crate) states_at: Vec<NavState>,
    pub(crate) eliminated: Vec<EliminatedLandmark>,
    pub(crate) cross: Vec<PoseLandmarkBlock>,
    pub(crate) saved: Vec<StateBackup>,
    pub(crate) saved_landmarks: Vec<(usize, Vector3<f64>, f64)>,
}

impl System {
    pub(crate) fn with_capacity(n: usize) -> Self {
        Self {
            h: Vec::with_capacity(n * n),
            gradient: Vec::with_capacity(n),
            first: Vec::with_capacity(n),
            damping: Vec::with_capacity(n),
            step: Vec::with_capacity(n),
            solved: Vec::with_capacity(15 * n),
            cholesky: Cholesky::with_capacity(n),
            eliminated: Vec::with_capacity(1024),
            cross: Vec::with_capacity(16 * 1024),
            saved: Vec::with_capacity(n / 15 + 1),
            saved_landmarks: Vec::with_capacity(1024),
            camera_poses: Vec::with_capacity(n / 15 + 1),
            camera_poses_at: Vec::with_capacity(n / 15 + 1),
            states_at: Vec::with_capacity(n / 15 + 1),
            ..Self::default()
        }
    }

    #[inline(always)]
    pub(crate) fn offset(&self, part: Part) -> usize {
        match part {
            Part::Motion(k) => 9 * k,
            Part::Delay(k) => 9 * self.frames + k,
            Part::ImageShift(k) => 9 * self.frames + self.delays + 2 * k,
            Part::Pose(k) => 9 * self.frames + self.delays + 2 * self.image_shifts + 6 * k,
            Part::Calibration => 15 * self.frames + self.delays + 2 * self.image_shifts,
        }
    }

    /// Whether the calibration is among the unknowns.
    pub(crate) fn calibrates(&self) -> bool {
        self.n > self.offset(Part::Calibration)
    }

    pub(crate) fn begin(
        &mut self,
        frames: usize,
        has_delays: bool,
        has_image_shifts: bool,
        calibrates: bool,
    ) {
        self.frames = frames;
        self.delays = if has_delays { frames } else { 0 };
        self.image_shifts = if has_image_shifts { frames } else { 0 };
        self.n = self.offset(Part::Calibration) + if calibrates { CALIBRATION_DIM } else { 0 };
        let (n, calibration) = (self.n, self.offset(Part::Calibration));
        self.h.clear();
        self.h.resize(n * n, 0.0);
        self.gradient.clear();
        self.gradient.resize(n, 0.0);
        self.first.clear();
        self.first.extend((0..frames).flat_map(|k| [9 * k; 9]));
        self.first.resize(calibration, 9 * frames);
        self.first.resize(n, 0);
        self.eliminated.clear();
        self.cross.clear();
        self.factorised = false;
    }

    /// Says that two parts share a factor.
    pub(crate) fn couple(&mut self, a: Part, b: Part) {
        let (a, b) = if self.offset(a) > self.offset(b) { (a, b) } else { (b, a) };
        let (at, from) = (self.offset(a), self.offset(b));
        for row in at..at + a.dim() {
            self.first[row] = self.first[row].min(from);
        }
    }

    /// Adds a block at (`row`, `col`), `row ≥ col`; of diagonal blocks the upper half is ignored later.
    #[inline(always)]
    pub(crate) fn add<const R: usize, const C: usize>(
        &mut self,
        row: usize,
        col: usize,
        block: &SMatrix<f64, R, C>,
        sign: f64,
    ) {
        for i in 0..R {
            let target = &mut self.h[(row + i) * self.n + col..(row + i) * self.n + col + C];
            for j in 0..C {
                target[j] += sign * block[(i, j)];
            }
        }
    }

    /// As `add`, for a block that may lie above the diagonal.
    #[inline(always)]
    pub(crate) fn add_either<const R: usize, const C: usize>(
        &mut self,
        row: usize,
        col: usize,
        block: &SMatrix<f64, R, C>,
        sign: f64,
    ) {
        if row >= col {
            self.add(row, col, block, sign);
        } else {
            self.add(col, row, &block.transpose(), sign);
        }
    }

    /// Subtracts `left rightᵀ` at (`row`, `col`), or its transpose at (`col`, `row`) where that lies below the diagonal.
    #[inline(always)]
    pub(crate) fn subtract_outer(
        &mut self,
        (row, left): (usize, &SMatrix<f64, 6, 3>),
        (col, right): (usize, &SMatrix<f64, 6, 3>),
    ) {
        let ((row, left), (col, right)) =
            if row >= col { ((row, left), (col, right)) } else { ((col, right), (row, left)) };
        for i in 0..6 {
            let target = &mut self.h[(row + i) * self.n + col..(row + i) * self.n + col + 6];
            for j in 0..6 {
                target[j] -= left[(i, 0)] * right[(j, 0)]
                    + left[(i, 1)] * right[(j, 1)]
                    + left[(i, 2)] * right[(j, 2)];
            }
        }
    }

    #[inline(always)]
    pub(crate) fn add_gradient<const N: usize>(&mut self, at: usize, value: &SVector<f64, N>, sign: f64) {
        for (g, v) in self.gradient[at..at + N].iter_mut().zip(value.iter()) {
            *g += sign * v;
        }
    }
}
