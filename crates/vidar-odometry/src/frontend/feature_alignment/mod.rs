//! Feature alignment: a template is shifted over the current image until it fits, free of offset and gain.
//!
//! Inverse compositional (Baker & Matthews 2004) with variable projection: with the current patch I, the zero-mean
//! template T and its gradients g made orthogonal to 1 and T, the shift that is left is `δ = (Σ g gᵀ)⁻¹ Σ g I / a` with
//! the gain `a = Σ T I / Σ T²`. The patch is then looked up at `u − δ`.
//!
//! A patch found on a coarse level is not measured again on finer ones: on rendered rooms that halves no error at 2 grey
//! levels of noise and doubles the error at 8.
//!
//! The covariance follows from the same sums: `Σ_u = s²/a² · (Σ g gᵀ)⁻¹` with s² the variance of what offset, gain and
//! shift could not explain, plus a floor for what the patch model does not know.

#[cfg(test)]
mod tests;

use super::feature::PixelMeasurement;
use super::patch::{Bilinear, sum8};
use super::pyramid::{Pyramid, from_level, level_scale, to_level};
use super::template::{SIDE, Template};
use nalgebra::{Matrix2, Vector2};
use vidar_core::Image;
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;

/// Most steps of one alignment; bounds the time of one that does not settle.
const MAX_ITERATIONS: usize = 12;

/// Step below which an alignment has settled, pixels of its level: far below [`SIGMA_FLOOR_PX`].
const MIN_STEP_PX: f64 = 0.015;

/// Furthest that a feature may be from where it is expected, pixels of its level: the side of the patch.
const MAX_SHIFT_PX: f64 = 8.0;

/// Least correlation of what is accepted; less only resembles the patch.
const MIN_NCC: f64 = 0.8;

/// Least correlation of what differs by no more than image noise.
const MIN_NOISY_NCC: f64 = 0.5;

/// Least change of contrast that is accepted; its inverse is the largest: exposure may change fivefold.
const MIN_GAIN: f64 = 0.2;

/// Least structure of a patch that is aligned: its summed squared gradients in the weakest direction that matters, grey levels²
/// per pixel². At 2 grey levels of noise its error is 0.2 px.
const MIN_TEXTURE: f64 = 100.0;

/// Error that a measurement has at least, pixels of its level: what the patch model does not know.
const SIGMA_FLOOR_PX: f64 = 0.1;

/// A feature found in the current image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignedFeature {
    /// Where, and how surely.
    pub measurement: PixelMeasurement,
    /// Level that it was aligned on.
    pub level: u8,
    /// Zero-mean normalised correlation with the template, −1…1.
    pub ncc: f32,
    /// Root mean square of the grey levels that offset and gain do not explain.
    pub residual_gray: f32,
    /// Contrast of the current image over that of the keyframe.
    pub gain: f32,
    /// Distance from the expected place, level-0 pixels.
    pub moved_px: f64,
}

/// Why a feature was not found in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum MatchFailure {
    /// The point is behind the camera or outside its model, or the patch would be deformed beyond use.
    NotVisible,
    /// The patch leaves the keyframe or the current image.
    OutsideImage,
    /// The patch has no texture in a direction that is needed.
    NoTexture,
    /// The alignment did not settle, or wandered further than allowed.
    Diverged,
    /// It settled on something that looks different.
    Dissimilar,
}

/// Sums over the patch at one place.
struct Sums {
    mean: f64,
    energy: f64,
    with_template: f64,
    with_gradient: Vector2<f64>,
}

kernel! {
    fn sums(image: &Image<u8>, template: &Template, corner: &Pixel) -> Option<Sums> {
        sum_products(image, template, corner)
    }
}

#[inline(always)]
fn sum_products(image: &Image<u8>, template: &Template, corner: &Pixel) -> Option<Sums> {
    let at = Bilinear::for_patch(image, corner.x, corner.y, SIDE)?;
    let (mut sum, mut square) = ([0.0_f32; 8], [0.0_f32; 8]);
    let (mut t, mut x, mut y) = ([0.0_f32; 8], [0.0_f32; 8], [0.0_f32; 8]);
    for row in 0..SIDE {
        let values: [f32; SIDE] = at.row(image, row);
        let span = row * SIDE..(row + 1) * SIDE;
        let intensity = &template.intensity[span.clone()];
        let (gx, gy) = (&template.gx[span.clone()], &template.gy[span]);
        for i in 0..SIDE {
            let v = values[i];
            sum[i] += v;
            square[i] += v * v;
            t[i] += v * intensity[i];
            x[i] += v * gx[i];
            y[i] += v * gy[i];
        }
    }
    let mean = f64::from(sum8(&sum)) / PIXELS;
    Some(Sums {
        mean,
        energy: (f64::from(sum8(&square)) - PIXELS * mean * mean).max(0.0),
        with_template: f64::from(sum8(&t)),
        with_gradient: Vector2::new(sum8(&x).into(), sum8(&y).into()),
    })
}

const PIXELS: f64 = (SIDE * SIDE) as f64;

/// Finds `template` in `current`, starting at `start` (level-0 pixels; usually the template's expected place).
///
/// `noise_gray` is the standard deviation of the image noise: what differs by no more than noise is not refused for it.
///
/// # Errors
/// Says why the feature was not found; never an error of the program.
pub fn align_feature(
    template: &Template,
    current: &Pyramid,
    start: &Pixel,
    noise_gray: f64,
) -> Result<AlignedFeature, MatchFailure> {
    let level = template.level;
    let image = current.level(level);
    let scale = level_scale(level);
    let solve = StepSolver::new(template).ok_or(MatchFailure::NoTexture)?;
    let half = Vector2::repeat(0.5 * (SIDE as f64 - 1.0));
    let first = to_level(start, level) - half;
    let mut corner = first;
    for _ in 0..MAX_ITERATIONS {
        let found = sums(image, template, &corner).ok_or(MatchFailure::OutsideImage)?;
        let step = solve.step(template, &found);
        corner -= step;
        if !((corner - first).norm_squared() <= MAX_SHIFT_PX * MAX_SHIFT_PX) {
            return Err(MatchFailure::Diverged);
        }
        if step.norm_squared() < MIN_STEP_PX * MIN_STEP_PX {
            let last = sums(image, template, &corner).ok_or(MatchFailure::OutsideImage)?;
            let moved_px = (corner - first).norm() * scale;
            return evaluate(template, current, &corner, &last, &solve, moved_px, noise_gray);
        }
    }
    Err(MatchFailure::Diverged)
}

/// How sums become a shift: in two directions for corners, across the edge for edgelets.
struct StepSolver {
    /// Maps `Σ g I / a` to the shift; also the shape of the covariance.
    inverse: Matrix2<f64>,
}

impl StepSolver {
    fn new(template: &Template) -> Option<Self> {
        let h = &template.hessian;
        let inverse = match template.normal {
            Some(n) => {
                let strength = (n.transpose() * h * n).x;
                (strength > MIN_TEXTURE).then(|| n * n.transpose() / strength)?
            }
            None => {
                let [_, weak, _] = super::feature::eigen(h);
                (weak > MIN_TEXTURE).then(|| h.try_inverse())??
            }
        };
        Some(Self { inverse })
    }

    fn step(&self, template: &Template, found: &Sums) -> Vector2<f64> {
        // Far from the optimum the correlation, and with it the gain, is too small and the step too long: at most half
        // of the contrast ratio is taken off.
        let contrast = (found.energy / template.energy).sqrt().max(1e-3);
        let gain = (found.with_template / template.energy).max(0.5 * contrast);
        self.inverse * found.with_gradient / gain
    }
}

#[allow(clippy::too_many_arguments)] // The private end of `align_feature`, kept apart for its length only.
fn evaluate(
    template: &Template,
    current: &Pyramid,
    corner: &Pixel,
    found: &Sums,
    solve: &StepSolver,
    moved_px: f64,
    noise_gray: f64,
) -> Result<AlignedFeature, MatchFailure> {
    debug_assert!(found.mean.is_finite());
    let gain = found.with_template / template.energy;
    let unexplained = (found.energy - gain * found.with_template).max(0.0);
    // Offset, gain and two shifts were fitted to the patch.
    let variance = unexplained / (PIXELS - 4.0);
    let ncc = found.with_template / (found.energy * template.energy).sqrt().max(1e-9);
    // Both patches carry noise, the keyframe's times the gain; bilinear sampling smooths it, so this is generous.
    let expected = noise_gray * noise_gray * (1.0 + gain * gain);
    let clipped = saturated_share(current.level(template.level), corner);
    if (clipped - template.saturated_share).abs() > MAX_SATURATED {
        return Err(MatchFailure::Dissimilar);
    }
    let alike = ncc >= MIN_NCC || (ncc >= MIN_NOISY_NCC && variance <= expected);
    if !(alike && gain > MIN_GAIN && gain < 1.0 / MIN_GAIN) {
        return Err(MatchFailure::Dissimilar);
    }
    let pixel = from_level(&corner.add_scalar(0.5 * (SIDE as f64 - 1.0)), template.level);
    let scale = level_scale(template.level);
    // What the residual shows, but never less than rounding to grey levels leaves.
    let noise = variance.max(QUANTISATION_VARIANCE) / (gain * gain);
    let floor = SIGMA_FLOOR_PX * SIGMA_FLOOR_PX;
    let information = match template.normal {
        Some(n) => {
            let across = (n.transpose() * solve.inverse * n).x * noise;
            n * n.transpose() / ((across + floor) * scale * scale)
        }
        None => {
            let covariance = (solve.inverse * noise + Matrix2::identity() * floor) * (scale * scale);
            covariance.try_inverse().ok_or(MatchFailure::NoTexture)?
        }
    };
    Ok(AlignedFeature {
        measurement: PixelMeasurement { pixel, information },
        level: template.level as u8,
        ncc: ncc as f32,
        residual_gray: variance.sqrt() as f32,
        gain: gain as f32,
        moved_px,
    })
}

/// Share of pixels clipped in one patch but not in the other that shifts edges by more than the covariance says.
const MAX_SATURATED: f64 = 0.15;

/// Share of pixels of the patch that are as white as the sensor can tell.
fn saturated_share(image: &Image<u8>, corner: &Pixel) -> f64 {
    let (x, y) = (corner.x.max(0.0) as usize, corner.y.max(0.0) as usize);
    let clipped = |row: usize| image.row(y + row)[x..x + SIDE].iter().filter(|p| **p == u8::MAX).count();
    (0..SIDE).map(clipped).sum::<usize>() as f64 / PIXELS
}

/// Variance of rounding to whole grey levels, 1/12.
const QUANTISATION_VARIANCE: f64 = 1.0 / 12.0;
