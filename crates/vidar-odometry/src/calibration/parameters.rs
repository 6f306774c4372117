//! What is estimated for the whole recording, and its prior.

use nalgebra::{Matrix2x3, SMatrix, SVector, Vector2, Vector3};
use vidar_core::camera::Pixel;
use vidar_core::{LieGroup, So3};

/// Number of parameters.
pub(super) const DIM: usize = 16;
/// ln of the focal length.
pub(super) const FOCAL: usize = 0;
pub(super) const K1: usize = 1;
pub(super) const K2: usize = 2;
pub(super) const CENTRE: usize = 3;
pub(super) const OFFSET: usize = 5;
pub(super) const READOUT: usize = 6;
pub(super) const ROTATION: usize = 7;
pub(super) const BIAS: usize = 10;
pub(super) const SCALE: usize = 13;

/// Number of parameters of the lens: they come first.
pub(super) const LENS: usize = 5;

pub(super) type Tangent = SVector<f64, DIM>;

/// Lens, clock, shutter, mount and gyroscope.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Parameters {
    /// Of both axes, pixels.
    pub focal: f64,
    pub k1: f64,
    pub k2: f64,
    pub centre: Vector2<f64>,
    /// `t_imu = stamp + offset` for the centre row, s.
    pub offset_secs: f64,
    /// Time from the first to the last row, s.
    pub readout_secs: f64,
    pub body_from_camera: So3,
    /// Gyroscope bias, rad/s, and relative error of its scale per axis.
    pub bias: Vector3<f64>,
    pub scale: Vector3<f64>,
}

/// What is believed before a recording is looked at.
///
/// Focal length: anything from a tele lens to an action camera. Distortion: lenses of phones and of EuRoC have |k1| < 0.3.
/// Principal point: within some per cent of the width. Readout: 0 (global shutter) to 33 ms. Gyroscope: data sheets of
/// consumer sensors state 1 to 3 % for the scale, phones are calibrated in the factory to half a per cent.
pub(super) fn prior_sigmas(width: f64) -> Tangent {
    let centre = 0.02 * width;
    Tangent::from([
        1.0, 0.3, 0.2, centre, centre, 0.2, 0.03, 3.0, 3.0, 3.0, 0.05, 0.05, 0.05, 0.007, 0.007, 0.007,
    ])
}

/// A pixel with its derivatives by the point and by the lens.
pub(super) struct Projection {
    pub pixel: Pixel,
    pub d_point: Matrix2x3<f64>,
    pub d_lens: SMatrix<f64, 2, LENS>,
}

impl Parameters {
    /// The parameters moved by a tangent vector.
    pub fn plus(&self, d: &Tangent) -> Self {
        let three = |at: usize| Vector3::new(d[at], d[at + 1], d[at + 2]);
        Self {
            focal: self.focal * d[FOCAL].exp(),
            k1: self.k1 + d[K1],
            k2: self.k2 + d[K2],
            centre: self.centre + Vector2::new(d[CENTRE], d[CENTRE + 1]),
            offset_secs: self.offset_secs + d[OFFSET],
            readout_secs: self.readout_secs + d[READOUT],
            body_from_camera: self.body_from_camera * So3::exp(&three(ROTATION)),
            bias: self.bias + three(BIAS),
            scale: self.scale + three(SCALE),
        }
    }

    /// `self − prior` as a tangent; the rotation has no prior and gives zero.
    pub fn minus(&self, prior: &Self) -> Tangent {
        let (c, b, s) = (self.centre - prior.centre, self.bias - prior.bias, self.scale - prior.scale);
        Tangent::from([
            (self.focal / prior.focal).ln(),
            self.k1 - prior.k1,
            self.k2 - prior.k2,
            c.x,
            c.y,
            self.offset_secs - prior.offset_secs,
            self.readout_secs - prior.readout_secs,
            0.0,
            0.0,
            0.0,
            b.x,
            b.y,
            b.z,
            s.x,
            s.y,
            s.z,
        ])
    }

    /// Projects a point in camera axes; `None` behind the camera and where the distortion folds back.
    pub fn project(&self, p: &Vector3<f64>) -> Option<Projection> {
        if !(p.z > 0.05 * p.norm()) {
            return None;
        }
        let (iz, x, y) = (1.0 / p.z, p.x / p.z, p.y / p.z);
        let r2 = x * x + y * y;
        let d = 1.0 + r2 * (self.k1 + r2 * self.k2);
        let slope = 1.0 + r2 * (3.0 * self.k1 + r2 * 5.0 * self.k2);
        if !(slope > 0.05 && d > 0.05 && d < 5.0) {
            return None;
        }
        let f = self.focal;
        let dd = 2.0 * (self.k1 + 2.0 * r2 * self.k2);
        let (xx, xy, yy) = (f * (d + x * x * dd), f * x * y * dd, f * (d + y * y * dd));
        let d_point = Matrix2x3::new(
            xx * iz,
            xy * iz,
            -(xx * x + xy * y) * iz,
            xy * iz,
            yy * iz,
            -(xy * x + yy * y) * iz,
        );
        let (fx, fy) = (f * x, f * y);
        let d_lens = SMatrix::<f64, 2, LENS>::from_row_slice(&[
            fx * d,
            fx * r2,
            fx * r2 * r2,
            1.0,
            0.0,
            fy * d,
            fy * r2,
            fy * r2 * r2,
            0.0,
            1.0,
        ]);
        Some(Projection { pixel: self.centre + Vector2::new(fx * d, fy * d), d_point, d_lens })
    }

    /// Unit direction of a pixel in camera axes, by fixed-point iteration; good enough to start from.
    pub fn direction(&self, pixel: &Pixel) -> Vector3<f64> {
        let seen = (pixel - self.centre) / self.focal;
        let mut n = seen;
        for _ in 0..8 {
            let r2 = n.norm_squared();
            n = seen / (1.0 + r2 * (self.k1 + r2 * self.k2)).max(0.3);
        }
        Vector3::new(n.x, n.y, 1.0).normalize()
    }
}
