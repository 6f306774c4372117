//! Iteratively reweighted least squares over point pairs with Huber's loss.
//!
//! `min Σ wᵢ ρ(rᵢ)`, rᵢ = |yᵢ − (s R xᵢ + t)|, ρ(r) = r²/2 up to δ and δ(r − δ/2) beyond.

use super::{AlignMethod, Compat, StreamingError, weighted_similarity};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use vidar_core::{LieGroup, Sim3};
use vidar_solve::Kernel;

/// How pairs are fitted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct IrlsConfig {
    /// Residual beyond which a pair pulls with constant force, in units of the target chunk.
    pub huber_delta: f64,
    /// Most reweightings.
    pub max_iterations: usize,
    /// Change of parameters, or relative change of cost, that ends the loop.
    pub tolerance: f64,
    /// Whether to follow the reference where it errs: on stopping it returns the parameters of the step before.
    pub compat: Compat,
}

impl Default for IrlsConfig {
    fn default() -> Self {
        Self { huber_delta: 0.1, max_iterations: 5, tolerance: 1e-9, compat: Compat::Off }
    }
}

/// One reweighting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IrlsStep {
    /// Mean residual before the step.
    pub mean_residual: f64,
    /// Cost before the step.
    pub cost: f64,
    /// The parameters after it.
    pub target_from_source: Sim3,
}

/// The fit and how it came about.
#[derive(Clone, Debug, PartialEq)]
pub struct IrlsOutcome {
    /// Maps source points to the target.
    pub target_from_source: Sim3,
    /// The least-squares start followed by every accepted step.
    pub trace: Vec<IrlsStep>,
}

/// Fits `target ≈ S · source`.
///
/// # Errors
/// Those of [`weighted_similarity`], and [`StreamingError::WrongLength`].
pub fn fit_irls(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
    method: AlignMethod,
    config: &IrlsConfig,
) -> Result<IrlsOutcome, StreamingError> {
    for (what, found) in [("target points", target.len()), ("weights", weights.len())] {
        if found != source.len() {
            return Err(StreamingError::WrongLength { what, found, expected: source.len() });
        }
    }
    let huber = Kernel::Huber { k: config.huber_delta };
    let mut current = weighted_similarity(source, target, weights, method)?;
    let mut trace =
        vec![IrlsStep { mean_residual: f64::NAN, cost: f64::INFINITY, target_from_source: current }];
    let mut previous_cost = f64::INFINITY;
    let mut reweighted = vec![0.0; weights.len()];
    for _ in 0..config.max_iterations {
        let (mut cost, mut residual_sum, mut weight_sum) = (0.0, 0.0, 0.0);
        for (((x, y), w), out) in source.iter().zip(target).zip(weights).zip(&mut reweighted) {
            let residual = (y - current.act(x)).norm();
            residual_sum += residual;
            cost += w * huber.loss_of_length(residual);
            *out = w * huber.weight_of_length(residual);
            weight_sum += *out;
        }
        reweighted.iter_mut().for_each(|w| *w /= weight_sum + 1e-12);
        let next = weighted_similarity(source, target, &reweighted, method)?;
        let moved = (next.scale - current.scale).abs() + (next.translation - current.translation).norm();
        let turned = (current.rotation.inverse() * next.rotation).angle_rad();
        let settled = (moved < config.tolerance && turned < 0.1_f64.to_radians())
            || (previous_cost - cost).abs() < config.tolerance * previous_cost;
        if settled && config.compat.is_reference() {
            break;
        }
        current = next;
        previous_cost = cost;
        let mean_residual = residual_sum / source.len() as f64;
        trace.push(IrlsStep { mean_residual, cost, target_from_source: current });
        if settled {
            break;
        }
    }
    Ok(IrlsOutcome { target_from_source: current, trace })
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::So3;

    #[test]
    fn a_few_gross_errors_move_the_fit_less_with_reweighting_than_without() {
        let truth =
            Sim3::new(So3::from_axis_angle(&Vector3::z(), 0.4), Vector3::new(1.0, 0.0, -2.0), 1.3).unwrap();
        let source: Vec<_> = (0..200)
            .map(|i| {
                let a = f64::from(i);
                Vector3::new((1.3 * a).sin() * 2.0, (0.7 * a).cos() * 2.0, 3.0 + (2.1 * a).sin())
            })
            .collect();
        let mut target: Vec<_> = source.iter().map(|p| truth.act(p)).collect();
        target.iter_mut().step_by(10).for_each(|p| p.x += 3.0);
        let weights = vec![1.0; source.len()];
        let error = |iterations| {
            let config = IrlsConfig { max_iterations: iterations, ..Default::default() };
            let fit = fit_irls(&source, &target, &weights, AlignMethod::Sim3, &config).unwrap();
            (fit.target_from_source.inverse() * truth).log().norm()
        };
        assert!(error(20) < 0.1 * error(0), "{} {}", error(20), error(0));
    }

    #[test]
    fn slices_of_different_lengths_are_refused() {
        let x = [Vector3::x(), Vector3::y()];
        let error =
            fit_irls(&x, &x[..1], &[1.0, 1.0], AlignMethod::Sim3, &IrlsConfig::default()).unwrap_err();
        assert_eq!(error.to_string(), "target points: 1 values, expected 2");
    }
}
