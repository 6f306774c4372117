//! Sparse image alignment: where the camera is, from small patches of earlier frames.
//!
//! Unknown are the motion `T = current_from_anchor` and, per reference image r, gain and offset of the exposure. For a pixel
//! of a patch around point p of reference r, with I the current image and Tr the reference,
//!
//! `e = I(π(T · anchor_from_r · p)) − a_r · Tr(π(p)) − b_r`.
//!
//! Inverse compositional (Baker & Matthews 2004; Forster 2017, sec. IV): the motion is perturbed on the reference's side, so
//! Jacobians and their products are constant on a level, and `T ← T · exp(−δ)`. Two references share one δ of the anchor.
//! Patches are weighted as wholes (Geman-McClure on their rms over the median's): what moves or is hidden is a patch, not a
//! pixel. The prediction enters as a Gaussian prior, with the patches' noise taken from the same median.

mod limits;
mod patches;
#[cfg(test)]
mod tests;

use super::pyramid::{Pyramid, level_scale};
use limits::{
    COARSEST_LEVEL, COST_SLACK, MAX_ITERATIONS, MIN_GAIN, MIN_NOISE_GRAY, MIN_PATCHES, MIN_STEP_PX,
    OUTLIER_RATIO,
};
use nalgebra::{Matrix6, SMatrix, SVector, Vector3, Vector6};
use patches::{PIXELS, Patch};
use vidar_core::camera::Pixel;
use vidar_core::{CameraModel, LieGroup, Se3};
use vidar_solve::statistics::median_upper;

/// Most reference images of one alignment.
pub const MAX_REFERENCES: usize = 2;

/// Motion, then gain and offset of each reference.
const UNKNOWNS: usize = 6 + 2 * MAX_REFERENCES;

/// A point of a reference image whose distance is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignmentPoint {
    /// Where the reference shows it, level-0 pixels.
    pub pixel: Pixel,
    /// Unit direction in the reference's camera.
    pub bearing: Vector3<f64>,
    /// Inverse distance along it, 1/m; 0 is infinitely far.
    pub inverse_distance: f64,
}

/// An earlier image with points.
#[derive(Clone, Copy, Debug)]
pub struct AlignmentReference<'a> {
    /// The image.
    pub pyramid: &'a Pyramid,
    /// Where its camera stood.
    pub anchor_from_reference: Se3,
    /// What it showed.
    pub points: &'a [AlignmentPoint],
}

/// What is known of the motion before looking.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionPrediction {
    /// The motion expected, from the gyroscope or the whole inertial state.
    pub current_from_anchor: Se3,
    /// Inverse covariance of its right perturbation, [rotation (1/rad²), translation (1/m²)]; zero where nothing is known.
    pub information: Matrix6<f64>,
}

/// Outcome of an alignment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageAlignment {
    /// The motion found; the prediction when `converged` is false for want of patches.
    pub current_from_anchor: Se3,
    /// Inverse covariance of its right perturbation, [rotation, translation], prior included, exposure eliminated.
    /// Pixels of one patch are taken as independent, which is optimistic.
    pub information: Matrix6<f64>,
    /// Median over patches of the rms residual, grey levels.
    pub residual_gray: f64,
    /// Patches that the current image shows on the finest level.
    pub patches: usize,
    /// Share of them that count more than half.
    pub inlier_ratio: f64,
    /// Gain of each reference: current contrast over the reference's.
    pub gain: [f64; MAX_REFERENCES],
    /// Offset of each reference, grey levels.
    pub offset: [f64; MAX_REFERENCES],
    /// Steps taken on all levels.
    pub iterations: usize,
    /// Whether enough patches were seen and the finest level settled.
    pub converged: bool,
}

/// Aligns frames; its buffers are kept.
#[derive(Clone, Debug)]
pub struct ImageAligner {
    finest_level: usize,
    patches: Vec<Patch>,
    scratch: Vec<f64>,
}

/// The state that is refined.
#[derive(Clone, Copy, Debug)]
struct State {
    current_from_anchor: Se3,
    gain: [f64; MAX_REFERENCES],
    offset: [f64; MAX_REFERENCES],
}

/// Normal equations with what was learned while filling them.
struct System {
    hessian: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    gradient: SVector<f64, UNKNOWNS>,
    cost: f64,
    weights: f64,
}

impl ImageAligner {
    /// Finest pyramid level for a prediction: features are measured on their own afterwards, on their own level.
    pub const FINEST_LEVEL: usize = 2;

    /// An aligner with no buffers yet. `finest_level` is the pyramid level that it ends on; a lower one is more exact and
    /// slower.
    pub fn new(finest_level: usize) -> Self {
        Self { finest_level, patches: Vec::new(), scratch: Vec::new() }
    }

    /// Aligns `current` with up to [`MAX_REFERENCES`] references (further ones are ignored).
    pub fn align(
        &mut self,
        camera: &CameraModel,
        references: &[AlignmentReference<'_>],
        current: &Pyramid,
        prediction: &MotionPrediction,
    ) -> ImageAlignment {
        let references = &references[..references.len().min(MAX_REFERENCES)];
        self.collect(camera, references);
        let start = prediction.current_from_anchor;
        let mut state = State { current_from_anchor: start, gain: [1.0; 2], offset: [0.0; 2] };
        let coarsest = COARSEST_LEVEL.min(current.level_count() - 1);
        let finest = self.finest_level.min(coarsest);
        let (mut iterations, mut converged) = (0, false);
        for level in (finest..=coarsest).rev() {
            for patch in &mut self.patches {
                patch.prepare(references[patch.reference].pyramid, level);
            }
            let before = state;
            let (taken, settled) = self.descend(camera, references, current, level, prediction, &mut state);
            iterations += taken;
            converged = settled;
            if taken == 0 {
                // Too few patches fit this level; a finer one may show more.
                state = before;
            }
        }
        self.conclude(camera, references, current, finest, prediction, state, iterations, converged)
    }

    fn collect(&mut self, camera: &CameraModel, references: &[AlignmentReference<'_>]) {
        self.patches.clear();
        for (index, reference) in references.iter().enumerate() {
            let anchor = &reference.anchor_from_reference;
            self.patches.extend(
                reference.points.iter().filter_map(|p| {
                    Patch::new(camera, index, anchor, p.pixel, &p.bearing, p.inverse_distance)
                }),
            );
        }
    }

    /// Gauss-Newton on one level; steps taken and whether it settled.
    fn descend(
        &mut self,
        camera: &CameraModel,
        references: &[AlignmentReference<'_>],
        current: &Pyramid,
        level: usize,
        prediction: &MotionPrediction,
        state: &mut State,
    ) -> (usize, bool) {
        let mut previous: Option<(f64, State)> = None;
        for iteration in 0..MAX_ITERATIONS {
            if self.look(camera, references, current, level, state) < MIN_PATCHES {
                return (0, false);
            }
            if iteration == 0 {
                self.fit_exposure(references.len(), state);
            }
            let sigma = self.weigh(state);
            let system = self.assemble(sigma, prediction, state);
            if let Some((cost, last)) = previous
                && system.cost > cost * COST_SLACK
            {
                *state = last;
                return (iteration, true);
            }
            previous = Some((system.cost, *state));
            let Some(factor) = system.hessian.cholesky() else { return (iteration, false) };
            let step = factor.solve(&system.gradient);
            if !step.iter().all(|v| v.is_finite()) {
                return (iteration, false);
            }
            apply(state, &step);
            if self.mean_motion_px(&step) < MIN_STEP_PX * level_scale(level) {
                return (iteration + 1, true);
            }
        }
        (MAX_ITERATIONS, false)
    }

    /// Reads all patches; how many are seen.
    fn look(
        &mut self,
        camera: &CameraModel,
        references: &[AlignmentReference<'_>],
        current: &Pyramid,
        level: usize,
        state: &State,
    ) -> usize {
        let mut from_reference = [Se3::IDENTITY; MAX_REFERENCES];
        for (t, r) in from_reference.iter_mut().zip(references) {
            *t = state.current_from_anchor * r.anchor_from_reference;
        }
        let image = current.level(level);
        let mut seen = 0;
        for patch in &mut self.patches {
            patch.look(camera, image, level, &from_reference[patch.reference]);
            seen += usize::from(patch.seen.is_some());
        }
        seen
    }

    /// Gain and offset in closed form; twice, the second time without what fits badly.
    fn fit_exposure(&mut self, references: usize, state: &mut State) {
        for patch in &mut self.patches {
            patch.weight = 1.0;
        }
        for _ in 0..2 {
            for reference in 0..references {
                let (mut n, mut t, mut tt, mut i, mut ti) = (0.0, 0.0, 0.0, 0.0, 0.0);
                for patch in self.patches.iter().filter(|p| p.reference == reference) {
                    let Some(seen) = &patch.seen else { continue };
                    let w = patch.weight;
                    n += w * PIXELS;
                    t += w * patch.constant.t;
                    tt += w * patch.constant.tt;
                    i += w * seen.i;
                    ti += w * seen.ti;
                }
                let spread = tt - t * t / n;
                if n > 0.0 && spread > n {
                    // Misaligned patches correlate less, so a start may only find too little gain, never none.
                    let gain = ((ti - t * i / n) / spread).clamp(MIN_GAIN, 1.0 / MIN_GAIN);
                    state.gain[reference] = gain;
                    state.offset[reference] = (i - gain * t) / n;
                }
            }
            self.weigh(state);
        }
    }

    /// Weighs every patch by its residual over the median's; returns the median rms, grey levels.
    fn weigh(&mut self, state: &State) -> f64 {
        self.scratch.clear();
        for patch in &self.patches {
            let (a, b) = (state.gain[patch.reference], state.offset[patch.reference]);
            self.scratch.extend(patch.squared_residual(a, b));
        }
        let Some(median) = median_upper(&mut self.scratch) else { return MIN_NOISE_GRAY };
        let variance = (median / PIXELS).max(MIN_NOISE_GRAY * MIN_NOISE_GRAY);
        let k2 = OUTLIER_RATIO * OUTLIER_RATIO * variance * PIXELS;
        for patch in &mut self.patches {
            let (a, b) = (state.gain[patch.reference], state.offset[patch.reference]);
            let share = patch.squared_residual(a, b).map_or(0.0, |e| k2 / (k2 + e));
            patch.weight = share * share;
        }
        variance.sqrt()
    }

    fn assemble(&self, sigma: f64, prediction: &MotionPrediction, state: &State) -> System {
        let mut system = self.image_terms(state);
        // The prior in the image's units: grey levels².
        let prior = prediction.information * (sigma * sigma);
        let deviation: Vector6<f64> = state.current_from_anchor.minus(&prediction.current_from_anchor);
        let mut h = system.hessian.fixed_view_mut::<6, 6>(0, 0);
        h += prior;
        let mut g = system.gradient.fixed_rows_mut::<6>(0);
        g += prior * deviation;
        // Per patch of full weight, so that a step is not praised for losing patches.
        system.cost =
            (system.cost + (deviation.transpose() * prior * deviation).x) / system.weights.max(1e-9);
        system
    }

    /// `H δ = Σ w [a Pᵀ Σ g e; Σ T e; Σ e]` with P the pixel's derivative by the motion.
    fn image_terms(&self, state: &State) -> System {
        let mut system =
            System { hessian: SMatrix::zeros(), gradient: SVector::zeros(), cost: 0.0, weights: 0.0 };
        for patch in &self.patches {
            let Some(m) = &patch.seen else { continue };
            let (c, w) = (&patch.constant, patch.weight);
            let (a, b) = (state.gain[patch.reference], state.offset[patch.reference]);
            let residual_g = m.gi - c.gt * a - c.g * b;
            let residual_t = m.ti - a * c.tt - b * c.t;
            let residual = m.i - a * c.t - b * PIXELS;
            let p_t = patch.d_pixel_d_anchor.transpose();
            let column = 6 + 2 * patch.reference;
            let mut view = system.hessian.fixed_view_mut::<6, 6>(0, 0);
            view += p_t * (c.gg * (w * a * a)) * patch.d_pixel_d_anchor;
            let mut view = system.hessian.fixed_view_mut::<6, 1>(0, column);
            view += p_t * (c.gt * (w * a));
            let mut view = system.hessian.fixed_view_mut::<6, 1>(0, column + 1);
            view += p_t * (c.g * (w * a));
            system.hessian[(column, column)] += w * c.tt;
            system.hessian[(column, column + 1)] += w * c.t;
            system.hessian[(column + 1, column + 1)] += w * PIXELS;
            let mut rows = system.gradient.fixed_rows_mut::<6>(0);
            rows += p_t * (residual_g * (w * a));
            system.gradient[column] += w * residual_t;
            system.gradient[column + 1] += w * residual;
            system.weights += w;
            system.cost += w * patch.squared_residual(a, b).unwrap_or(0.0);
        }
        system.hessian.fill_lower_triangle_with_upper_triangle();
        for k in 6..UNKNOWNS {
            // A reference without patches keeps its exposure.
            if system.hessian[(k, k)] == 0.0 {
                system.hessian[(k, k)] = 1.0;
            }
        }
        system
    }

    /// Root mean square motion of the patches by a step, level-0 pixels.
    fn mean_motion_px(&self, step: &SVector<f64, UNKNOWNS>) -> f64 {
        let motion: Vector6<f64> = step.fixed_rows::<6>(0).into_owned();
        let (mut sum, mut n) = (0.0, 0.0);
        for patch in self.patches.iter().filter(|p| p.seen.is_some()) {
            sum += (patch.d_pixel_d_anchor * motion).norm_squared();
            n += 1.0;
        }
        (sum / f64::max(n, 1.0)).sqrt()
    }

    #[allow(clippy::too_many_arguments)] // The private end of `align`, kept apart for its length only.
    fn conclude(
        &mut self,
        camera: &CameraModel,
        references: &[AlignmentReference<'_>],
        current: &Pyramid,
        level: usize,
        prediction: &MotionPrediction,
        state: State,
        iterations: usize,
        converged: bool,
    ) -> ImageAlignment {
        let patches = self.look(camera, references, current, level, &state);
        let enough = patches >= MIN_PATCHES && iterations > 0;
        let state = if enough {
            state
        } else {
            State { current_from_anchor: prediction.current_from_anchor, ..state }
        };
        let sigma = self.weigh(&state);
        let inliers = self.patches.iter().filter(|p| p.seen.is_some() && p.weight > 0.5).count();
        let mut information = prediction.information;
        if enough {
            information += motion_information(&self.image_terms(&state).hessian) / (sigma * sigma);
        }
        ImageAlignment {
            current_from_anchor: state.current_from_anchor,
            information,
            residual_gray: sigma,
            patches,
            inlier_ratio: inliers as f64 / patches.max(1) as f64,
            gain: state.gain,
            offset: state.offset,
            iterations,
            converged: converged && enough,
        }
    }
}

fn apply(state: &mut State, step: &SVector<f64, UNKNOWNS>) {
    let motion: Vector6<f64> = step.fixed_rows::<6>(0).into_owned();
    state.current_from_anchor = state.current_from_anchor.plus(&-motion);
    for r in 0..MAX_REFERENCES {
        state.gain[r] = (state.gain[r] + step[6 + 2 * r]).clamp(MIN_GAIN, 1.0 / MIN_GAIN);
        state.offset[r] += step[7 + 2 * r];
    }
}

/// The Schur complement of the exposures.
fn motion_information(hessian: &SMatrix<f64, UNKNOWNS, UNKNOWNS>) -> Matrix6<f64> {
    let motion = hessian.fixed_view::<6, 6>(0, 0);
    let cross = hessian.fixed_view::<6, { UNKNOWNS - 6 }>(0, 6);
    let exposure = hessian.fixed_view::<{ UNKNOWNS - 6 }, { UNKNOWNS - 6 }>(6, 6).into_owned();
    match exposure.try_inverse() {
        Some(inverse) => motion - cross * inverse * cross.transpose(),
        None => motion.into_owned(),
    }
}
