//! Distance of a point from two rays.

use super::RayPair;
use vidar_core::Se3;

/// A point on the ray of the first view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangulated {
    /// Inverse distance along the first ray, in units of one over the baseline's unit; negative behind the camera.
    pub inverse_distance: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Angle between the rays, rad.
    pub parallax_rad: f64,
    /// Angle of the second ray to the epipolar plane, rad.
    pub off_plane_rad: f64,
}

/// Intersects `pair.a` and `pair.b`; `sigma_rad` is the angular error of the second ray.
///
/// From `R a + ρ t ∥ b` follows `ρ = −(R a × b)·(t × b) / |t × b|²`, which knows points at infinity (ρ = 0) and behind
/// (ρ < 0). `None` when the second ray points along the baseline.
pub fn triangulate(pair: &RayPair, b_from_a: &Se3, sigma_rad: f64) -> Option<Triangulated> {
    let turned = b_from_a.rotation * pair.a;
    let across = b_from_a.translation.cross(&pair.b);
    let base2 = across.norm_squared();
    if !(base2 > 1e-18) {
        return None;
    }
    let rays = turned.cross(&pair.b);
    let inverse_distance = -rays.dot(&across) / base2;
    let point = turned + b_from_a.translation * inverse_distance;
    let normal = turned.cross(&b_from_a.translation);
    Some(Triangulated {
        inverse_distance,
        sigma: sigma_rad * point.norm() / base2.sqrt(),
        parallax_rad: rays.norm().atan2(turned.dot(&pair.b)),
        off_plane_rad: (pair.b.dot(&normal) / normal.norm().max(1e-12)).abs().min(1.0).asin(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use vidar_core::random::SplitMix64;
    use vidar_core::{LieGroup, So3};

    #[test]
    fn exact_rays_give_the_exact_distance_and_noise_the_stated_error() {
        let mut random = SplitMix64::new(2);
        let b_from_a = Se3::new(So3::exp(&Vector3::new(0.1, -0.2, 0.05)), Vector3::new(-0.3, 0.05, 0.1));
        let mut normalised = Vec::new();
        for _ in 0..2000 {
            let point = Vector3::new(random.normal(), random.normal(), 4.0 + random.uniform());
            let mut pair = RayPair { a: point.normalize(), b: (b_from_a * point).normalize() };
            let exact = triangulate(&pair, &b_from_a, 1e-3).unwrap();
            assert!((exact.inverse_distance * point.norm() - 1.0).abs() < 1e-9);
            assert!(exact.off_plane_rad < 1e-9);
            let angle = (b_from_a.rotation * pair.a).dot(&pair.b).clamp(-1.0, 1.0).acos();
            assert!((exact.parallax_rad - angle).abs() < 1e-6);
            pair.b = (pair.b + random.normal3() * 1e-3).normalize();
            let noisy = triangulate(&pair, &b_from_a, 1e-3).unwrap();
            normalised.push((noisy.inverse_distance - exact.inverse_distance) / exact.sigma);
        }
        let variance = normalised.iter().map(|v| v * v).sum::<f64>() / normalised.len() as f64;
        assert!((variance - 1.0).abs() < 0.15, "{variance}");
    }

    #[test]
    fn infinity_is_zero_behind_is_negative_and_along_the_baseline_is_nothing() {
        let b_from_a = Se3::from_translation(Vector3::new(-1.0, 0.0, 0.0));
        let far = RayPair { a: Vector3::z(), b: Vector3::z() };
        assert_eq!(triangulate(&far, &b_from_a, 1e-3).unwrap().inverse_distance, 0.0);
        let behind = RayPair { a: Vector3::z(), b: Vector3::new(0.1, 0.0, 1.0).normalize() };
        assert!(triangulate(&behind, &b_from_a, 1e-3).unwrap().inverse_distance < 0.0);
        let along = RayPair { a: Vector3::x(), b: Vector3::x() };
        assert!(triangulate(&along, &b_from_a, 1e-3).is_none());
    }
}
