//! Refinement of a two-view motion: Gauss-Newton on Sampson distances, translation on the unit sphere.

use super::RayPair;
use crate::frontend::template::tangents;
use nalgebra::{Matrix5, RowVector5, Vector3, Vector5};
use vidar_core::{LieGroup, Se3, So3};
use vidar_solve::Kernel;

/// Errors beyond this many standard deviations lose weight.
const KERNEL: Kernel = Kernel::Huber { k: 1.5 };

/// The motion that fits the marked pairs best, from a start that fits them well.
pub(super) fn refine(pairs: &[RayPair], inliers: &[bool], start: &Se3, sigma_rad: f64) -> Se3 {
    let mut motion = *start;
    for _ in 0..8 {
        let (mut h, mut g) = (Matrix5::zeros(), Vector5::zeros());
        for pair in pairs.iter().zip(inliers).filter(|(_, i)| **i).map(|(p, _)| p) {
            let (error, slope, jacobian) = sampson(pair, &motion);
            let normalised = (error / slope / sigma_rad).abs();
            let weight = KERNEL.weight_of_length(normalised) / (slope * slope);
            h += jacobian.transpose() * jacobian * weight;
            g += jacobian.transpose() * (error * weight);
        }
        // Directions that nothing fixes must not move.
        let ridge = 1e-9 * h.trace().max(1e-12);
        for k in 0..5 {
            h[(k, k)] += ridge;
        }
        let Some(factor) = h.cholesky() else { break };
        let step = -factor.solve(&g);
        motion = moved(&motion, &step);
        if step.norm() < 1e-9 {
            break;
        }
    }
    motion
}

/// `R exp(θ)` and the translation turned along its two tangents.
fn moved(motion: &Se3, step: &Vector5<f64>) -> Se3 {
    let theta: Vector3<f64> = step.fixed_rows::<3>(0).into_owned();
    let shift = tangents(&motion.translation) * step.fixed_rows::<2>(3);
    Se3::new(motion.rotation * So3::exp(&theta), (motion.translation + shift).normalize())
}

/// The epipolar error `t · (R a × b)`, its derivative's length by the rays, and its Jacobian by rotation and direction.
fn sampson(pair: &RayPair, motion: &Se3) -> (f64, f64, RowVector5<f64>) {
    let (rotation, t) = (motion.rotation.matrix(), motion.translation);
    let turned = rotation * pair.a;
    let normal = turned.cross(&pair.b);
    let error = t.dot(&normal);
    let slope = (t.cross(&turned).norm_squared() + t.cross(&pair.b).norm_squared()).max(1e-12).sqrt();
    // t · (R (θ × a) × b) = θ · (a × Rᵀ (b × t)).
    let by_rotation = pair.a.cross(&(rotation.transpose() * pair.b.cross(&t)));
    let by_direction = normal.transpose() * tangents(&t);
    let mut jacobian = RowVector5::zeros();
    jacobian.fixed_columns_mut::<3>(0).copy_from(&by_rotation.transpose());
    jacobian.fixed_columns_mut::<2>(3).copy_from(&by_direction);
    (error, slope, jacobian)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector1;
    use vidar_core::random::SplitMix64;
    use vidar_core::testing::check_jacobian;

    #[test]
    fn the_epipolar_jacobian_is_the_numeric_one() {
        let mut random = SplitMix64::new(8);
        for _ in 0..20 {
            let pair = RayPair { a: random.normal3().normalize(), b: random.normal3().normalize() };
            let motion = Se3::new(So3::exp(&random.normal3()), random.normal3().normalize());
            let (_, _, jacobian) = sampson(&pair, &motion);
            let f = |x: &Vector5<f64>| Vector1::new(sampson(&pair, &moved(&motion, x)).0);
            check_jacobian("epipolar", &jacobian, f, &Vector5::zeros(), 1e-6).unwrap();
        }
    }
}
