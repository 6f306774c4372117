//! Radial-tangential distortion. Parameters [fx, fy, cx, cy, k1, k2, p1, p2, k3], in the order of OpenCV; Kalibr's
//! and EuRoC's files have k3 = 0.
//!
//! With x = X/Z, y = Y/Z, r² = x² + y², d = 1 + k1·r² + k2·r⁴ + k3·r⁶:
//! x' = x·d + 2·p1·x·y + p2·(r² + 2x²), y' = y·d + p1·(r² + 2y²) + 2·p2·x·y, u = fx·x' + cx, v = fy·y' + cy.
//! Domain: Z > 0 and the radius inside which the map is surely one-to-one (`one_to_one_limit`); beyond, the polynomial
//! folds back and two directions would share a pixel.

use super::parametric::invalid_intrinsics;
use super::{CameraError, InvalidExample, ParametricCamera, Pinhole, Pixel, finite};
use nalgebra::{Matrix2, Matrix2x3, SMatrix, Vector2, Vector3};

/// Pinhole with radial-tangential distortion.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RadTan {
    /// Focal lengths, principal point, size.
    pub pinhole: Pinhole,
    /// `[k1, k2, p1, p2]`.
    pub distortion: [f64; 4],
    /// Third radial term; 0 where the calibration has two.
    pub k3: f64,
    /// Largest r² (undistorted, normalised) of the domain.
    max_r2: f64,
}

impl RadTan {
    /// Two radial and two tangential terms, `[k1, k2, p1, p2]`; checks that they are finite.
    pub fn new(pinhole: Pinhole, distortion: [f64; 4]) -> Result<Self, CameraError> {
        Self::with_k3(pinhole, distortion, 0.0)
    }

    /// As [`RadTan::new`] with a third radial term, as TUM RGB-D and OpenCV's five coefficients have it.
    pub fn with_k3(pinhole: Pinhole, distortion: [f64; 4], k3: f64) -> Result<Self, CameraError> {
        if let Some(&found) = distortion.iter().chain([&k3]).find(|d| !d.is_finite()) {
            return Err(CameraError::BadParameter { parameter: "distortion", expected: "finite", found });
        }
        Ok(Self { pinhole, distortion, k3, max_r2: one_to_one_limit(distortion, k3) })
    }

    fn distort(&self, n: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let ([k1, k2, p1, p2], k3) = (self.distortion, self.k3);
        let (x, y) = (n.x, n.y);
        let r2 = x * x + y * y;
        let d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        // The derivative of d by r², times 2.
        let dd = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
        let out = Vector2::new(
            x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let jacobian = Matrix2::new(
            d + x * x * dd + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * dd + 2.0 * p1 * x + 2.0 * p2 * y,
            x * y * dd + 2.0 * p1 * x + 2.0 * p2 * y,
            d + y * y * dd + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (out, jacobian)
    }

    /// The normalised point `(X/Z, Y/Z)` with its distortion, where the model holds.
    fn normalised(&self, p: &Vector3<f64>) -> Option<(Vector2<f64>, Vector2<f64>, Matrix2<f64>)> {
        if !(p.z > super::pinhole::MIN_Z && p.z.is_finite()) {
            return None;
        }
        let n = Vector2::new(p.x / p.z, p.y / p.z);
        if !(n.norm_squared() < self.max_r2) {
            return None;
        }
        let (distorted, d_distorted_d_n) = self.distort(&n);
        Some((n, distorted, d_distorted_d_n))
    }

    fn pixel_of(&self, distorted: &Vector2<f64>) -> Option<Pixel> {
        let k = &self.pinhole;
        finite(Vector2::new(k.fx * distorted.x + k.cx, k.fy * distorted.y + k.cy))
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        let (_, distorted, _) = self.normalised(p)?;
        self.pixel_of(&distorted)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let (n, distorted, d_distorted_d_n) = self.normalised(p)?;
        let pixel = self.pixel_of(&distorted)?;
        let iz = 1.0 / p.z;
        let d_n_d_point = Matrix2x3::new(iz, 0.0, -n.x * iz, 0.0, iz, -n.y * iz);
        let d_pixel_d_distorted = Matrix2::new(self.pinhole.fx, 0.0, 0.0, self.pinhole.fy);
        Some((pixel, d_pixel_d_distorted * d_distorted_d_n * d_n_d_point))
    }

    /// See [`super::CameraModel::unproject`]. The radial part is undone first, then Newton's method does the rest.
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let k = &self.pinhole;
        let target = Vector2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let radius = target.norm();
        if !radius.is_finite() {
            return None;
        }
        let mut n = target * if radius > 0.0 { self.undistorted_radius(radius) / radius } else { 1.0 };
        for _ in 0..30 {
            let (value, jacobian) = self.distort(&n);
            let step = jacobian.try_inverse()? * (value - target);
            n -= step;
            if !(step.norm() > 1e-15 * n.norm()) {
                break;
            }
        }
        let (value, _) = self.distort(&n);
        let solved = (value - target).norm() < 1e-10 * radius.max(1.0);
        let in_domain = n.norm_squared() < self.max_r2;
        (solved && in_domain).then(|| Vector3::new(n.x, n.y, 1.0).normalize())
    }

    /// Solves r·d(r²) = `distorted` for the r where r·d grows; near the fold when there is none.
    fn undistorted_radius(&self, distorted: f64) -> f64 {
        let ([k1, k2, ..], k3) = (self.distortion, self.k3);
        let value = |r: f64| r * (1.0 + r * r * (k1 + r * r * (k2 + r * r * k3)));
        let slope = |r: f64| 1.0 + r * r * (3.0 * k1 + r * r * (5.0 * k2 + r * r * 7.0 * k3));
        let (mut low, mut high) = (0.0, 1.0);
        while value(high) < distorted && high * high < self.max_r2 {
            high *= 2.0;
        }
        // A little inside the fold, so that Newton's method starts on the right side of it.
        high = high.min(0.999 * self.max_r2.sqrt());
        let mut r = distorted.min(high);
        for _ in 0..50 {
            let error = value(r) - distorted;
            if error > 0.0 {
                high = r
            } else {
                low = r
            }
            let newton = r - error / slope(r);
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if (next - r).abs() <= 1e-12 * r {
                break;
            }
            r = next;
        }
        r
    }
}

impl ParametricCamera<9> for RadTan {
    const PARAMETER_NAMES: [&'static str; 9] = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];

    fn parameters(&self) -> [f64; 9] {
        let ([fx, fy, cx, cy], [k1, k2, p1, p2]) = (self.pinhole.parameters(), self.distortion);
        [fx, fy, cx, cy, k1, k2, p1, p2, self.k3]
    }

    fn from_parameters(parameters: &[f64; 9], width: usize, height: usize) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = *parameters;
        Self::with_k3(Pinhole::new(fx, fy, cx, cy, width, height)?, [k1, k2, p1, p2], k3)
    }

    fn project_with_parameter_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, SMatrix<f64, 2, 9>)> {
        let (n, distorted, _) = self.normalised(p)?;
        let pixel = self.pixel_of(&distorted)?;
        let (x, y, r2) = (n.x, n.y, n.norm_squared());
        let (fx, fy, r4, r6) = (self.pinhole.fx, self.pinhole.fy, r2 * r2, r2 * r2 * r2);
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, 9>::from_row_slice(&[
            distorted.x, 0.0, 1.0, 0.0, fx * x * r2, fx * x * r4, fx * 2.0 * x * y, fx * (r2 + 2.0 * x * x), fx * x * r6,
            0.0, distorted.y, 0.0, 1.0, fy * y * r2, fy * y * r4, fy * (r2 + 2.0 * y * y), fy * 2.0 * x * y, fy * y * r6,
        ]);
        Some((pixel, jacobian))
    }

    fn examples() -> Vec<Self> {
        let make = |p: &[f64; 9], width, height| Self::from_parameters(p, width, height).ok();
        [
            // EuRoC cam0.
            make(
                &[
                    458.654,
                    457.296,
                    367.215,
                    248.375,
                    -0.28340811,
                    0.07395907,
                    0.00019359,
                    1.76187114e-05,
                    0.0,
                ],
                752,
                480,
            ),
            // TUM RGB-D fr1 as published, and with its fifth term left out: then the corners lie beyond the fold.
            make(&[517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633], 640, 480),
            make(&[517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 0.0], 640, 480),
            // A strong barrel that folds, and pincushion with tangential terms.
            make(&[300.0, 310.0, 320.0, 240.0, -0.2, 0.0, 0.0, 0.0, 0.0], 640, 480),
            make(&[400.0, 400.0, 300.0, 200.0, 0.15, 0.02, 0.004, -0.003, 0.0], 640, 480),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn invalid_examples() -> Vec<InvalidExample<9>> {
        let good = [458.0, 457.0, 367.0, 248.0, -0.28, 0.07, 0.0, 0.0, 0.0];
        let mut examples = invalid_intrinsics(good);
        for (index, found) in
            [(4, f64::NAN), (5, f64::INFINITY), (6, f64::NAN), (7, f64::NEG_INFINITY), (8, f64::NAN)]
        {
            examples.push(InvalidExample::of_parameter(good, index, "distortion", "finite", found));
        }
        examples
    }
}

/// The r² up to which the distortion surely maps one-to-one.
///
/// Its Jacobian is symmetric, `J = d·I + d'·n nᵀ + T`, with eigenvalues of the radial part
/// d = 1 + k1·r² + k2·r⁴ + k3·r⁶ and d(r·d)/dr = 1 + 3·k1·r² + 5·k2·r⁴ + 7·k3·r⁶, and of the tangential part T not below −6·r·|(p1, p2)|. Where their sum stays
/// positive, J is positive definite, and a map with that property on a disc takes no value twice.
fn one_to_one_limit([k1, k2, p1, p2]: [f64; 4], k3: f64) -> f64 {
    let tangential = 6.0 * p1.hypot(p2);
    let holds = |r: f64| {
        let r2 = r * r;
        let along = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3));
        let across = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        along.min(across) > tangential * r
    };
    // Steps of 2 % from far inside to the largest X/Z that projects; then bisection.
    let mut low = 1e-6;
    while low < 1.0 / super::pinhole::MIN_Z {
        let mut high = 1.02 * low;
        if !holds(high) {
            for _ in 0..60 {
                let mid = 0.5 * (low + high);
                if holds(mid) { low = mid } else { high = mid }
            }
            return low * low;
        }
        low = high;
    }
    f64::INFINITY
}
