//! What is estimated for the whole recording, and its prior.

use super::lens::LensModel;
use nalgebra::{Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};
use vidar_core::camera::{CameraModel, Pixel};
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
    /// The family that focal length, k1 and k2 belong to; not estimated but tried.
    pub lens: LensModel,
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
/// Focal length: anything from a tele lens to an action camera. Principal point: within some per cent of the width. Readout: 0 (global shutter) to 33 ms. Gyroscope: data sheets of
/// consumer sensors state 1 to 3 % for the scale, phones are calibrated in the factory to half a per cent.
pub(super) fn prior_sigmas(lens: LensModel, width: f64) -> Tangent {
    let (centre, [k1, k2]) = (0.02 * width, lens.radial_sigmas());
    Tangent::from([
        1.0, k1, k2, centre, centre, 0.2, 0.03, 3.0, 3.0, 3.0, 0.05, 0.05, 0.05, 0.007, 0.007, 0.007,
    ])
}

/// How far a measured lens is believed (σ): a calibration by a chessboard is right to some tenths of a per cent, and an autofocus moves the focal length by
/// one per cent since. Focal length (relative), k1, k2, and the principal point in image widths.
const MEASURED_FOCAL: f64 = 0.01;
const MEASURED_RADIAL: f64 = 0.02;
const MEASURED_CENTRE: f64 = 0.005;
/// The focal length of a lens without distortion, which nobody measured: data sheets and other recordings of the same model are right to some per cent.
const STATED_FOCAL: f64 = 0.03;

/// Places in an image, along each side, at which a given lens is asked.
const PLACES: usize = 9;

/// A lens that is given.
#[derive(Clone, Copy, Debug)]
pub(super) struct GivenLens {
    /// The camera, as far as a focal length and two coefficients say it, in the body's axes.
    pub camera: Parameters,
    /// Whether it has distortion: somebody measured it.
    pub is_measured: bool,
    /// Its standard deviations are divided by this: by how much the stretches of a recording differ from each other more than their residuals say.
    pub weight: f64,
}

impl GivenLens {
    /// By least squares of the radii over the image. `None` where a focal length and two coefficients do not say it.
    pub fn of(model: &CameraModel, readout_secs: f64) -> Option<Self> {
        let lens = match model {
            CameraModel::Pinhole(_) | CameraModel::RadTan(_) => LensModel::RadTan,
            _ => LensModel::Equidistant,
        };
        let size = (model.width() as f64, model.height() as f64);
        let centre = model.principal_point();
        let share = |k: usize| k as f64 / (PLACES - 1) as f64;
        let (mut h, mut g) = (Matrix3::<f64>::zeros(), Vector3::zeros());
        for (row, column) in (0..PLACES).flat_map(|row| (0..PLACES).map(move |column| (row, column))) {
            let pixel = Pixel::new(share(column) * (size.0 - 1.0), share(row) * (size.1 - 1.0));
            let Some(ray) = model.unproject(&pixel) else { continue };
            let theta = ray.xy().norm().atan2(ray.z);
            let t = if lens == LensModel::RadTan { theta.tan() } else { theta };
            let powers = Vector3::new(t, t.powi(3), t.powi(5));
            h += powers * powers.transpose();
            g += powers * (pixel - centre).norm();
        }
        let radius = h.cholesky()?.solve(&g);
        let (focal, k1, k2) = (radius.x, radius.y / radius.x, radius.z / radius.x);
        if !(focal > 0.0 && [focal, k1, k2].iter().all(|x| x.is_finite())) {
            return None;
        }
        let camera = Parameters { k1, k2, centre, ..Parameters::plain(lens, focal, size, readout_secs) };
        Some(Self { camera, is_measured: !model.is_undistorted(), weight: 1.0 })
    }

    fn focal_sigma(&self) -> f64 {
        if self.is_measured { MEASURED_FOCAL } else { STATED_FOCAL }
    }

    /// By how many of its standard deviations a focal length is off its own.
    pub fn off(&self, focal: f64) -> f64 {
        (focal / self.camera.focal).ln().abs() / self.focal_sigma()
    }

    /// What is believed before a recording is looked at.
    pub fn sigmas(&self, width: f64) -> Tangent {
        let mut sigmas = prior_sigmas(self.camera.lens, width);
        sigmas[FOCAL] = self.focal_sigma();
        if self.is_measured {
            (sigmas[K1], sigmas[K2]) = (MEASURED_RADIAL, MEASURED_RADIAL);
            sigmas.fixed_rows_mut::<2>(CENTRE).fill(MEASURED_CENTRE * width);
        }
        let mut of_the_lens = sigmas.fixed_rows_mut::<LENS>(0);
        of_the_lens /= self.weight;
        sigmas
    }
}

/// A pixel with its derivatives by the point and by the lens.
pub(super) struct Projection {
    pub pixel: Pixel,
    pub d_point: Matrix2x3<f64>,
    pub d_lens: SMatrix<f64, 2, LENS>,
}

impl Parameters {
    /// A camera without distortion that sees the middle of the image straight ahead, in the body's axes, on the gyroscope's clock.
    pub fn plain(lens: LensModel, focal: f64, size: (f64, f64), readout_secs: f64) -> Self {
        Self {
            lens,
            focal,
            k1: 0.0,
            k2: 0.0,
            centre: Vector2::new(0.5 * (size.0 - 1.0), 0.5 * (size.1 - 1.0)),
            offset_secs: 0.0,
            readout_secs,
            body_from_camera: So3::IDENTITY,
            bias: Vector3::zeros(),
            scale: Vector3::zeros(),
        }
    }

    /// [`Parameters::plain`] with each of a lens's trial focal lengths.
    pub fn trials(lens: LensModel, size: (f64, f64), readout_secs: f64) -> Vec<Self> {
        let focals = lens.trial_focals().iter().map(|widths| widths * size.0);
        focals.map(|focal| Self::plain(lens, focal, size, readout_secs)).collect()
    }

    /// The parameters moved by a tangent vector.
    pub fn plus(&self, d: &Tangent) -> Self {
        let three = |at: usize| Vector3::new(d[at], d[at + 1], d[at + 2]);
        Self {
            lens: self.lens,
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

    /// `self − prior` as a tangent, but for the rotation, which gives zero.
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
        let seen = self.lens.project(self.focal, [self.k1, self.k2], p)?;
        let [by_k1, by_k2] = [0, 1].map(|k| seen.d_radial.column(k).into_owned());
        let d_lens =
            SMatrix::<f64, 2, LENS>::from_columns(&[seen.at, by_k1, by_k2, Vector2::x(), Vector2::y()]);
        Some(Projection { pixel: self.centre + seen.at, d_point: seen.d_point, d_lens })
    }

    /// Unit direction of a pixel in camera axes, by fixed-point iteration; good enough to start from.
    pub fn direction(&self, pixel: &Pixel) -> Vector3<f64> {
        self.lens.direction([self.k1, self.k2], &((pixel - self.centre) / self.focal))
    }
}
