//! Calibration of a camera on an IMU from an ordinary recording, with nothing known but the images' size, or the lens.
//!
//! 1. [`FeatureTracker`] follows corners from image to image without a camera model.
//! 2. The rotations of image pairs, compared with the gyroscope's, give a start: clock offset and axis permutation.
//! 3. All stretches of some 1.5 s are adjusted jointly over focal length, distortion, principal point, clock, readout,
//!    rotation and gyroscope errors; camera positions and points are eliminated.
//! 4. Standard deviations come from the residuals.
//!
//! The lever arm and the accelerometer take no part: rotations alone do not show them.

mod fixed;
mod hand_eye;
mod lens;
mod noise;
mod parameters;
mod path;
mod solve;
mod stretches;
mod template;
#[cfg(test)]
mod tests;
mod tracker;
mod tracks;
mod window;

use crate::gyro_alignment::{ImageFeatures, RateSample};
pub use lens::LensModel;
use nalgebra::Vector3;
pub(crate) use noise::loud_noise;
pub use noise::{SensorNoise, sensor_noise};
use parameters::{BIAS, CENTRE, FOCAL, GivenLens, K1, K2, OFFSET, READOUT, ROTATION};
use path::GyroPath;
use solve::sigma_factor;
pub use tracker::FeatureTracker;
use tracks::{DOUBTFUL_PX, Solved, Tracks};
use vidar_core::camera::{CameraModel, Pixel};
use vidar_core::{ImuSample, LandmarkId, So3, Timestamp};

/// Images nearer in time than this add little and cost as much, s.
const IMAGE_SPACING_SECS: f64 = 0.09;
/// Images and samples beyond this time after the first image are not kept, s.
const MAX_SPAN_SECS: f64 = 60.0;
/// Gyroscope samples this far before the first and behind the last image are kept: the largest clock offset.
const MARGIN_SECS: f64 = 0.5;
/// Gyroscope samples that are kept at most, against recordings with absurd rates.
const MAX_SAMPLES: usize = 200_000;

/// Readout that the estimate starts from, s: between a global shutter and a phone's.
const START_READOUT_SECS: f64 = 0.015;

/// Least root mean square of the angular rate, rad/s, that the liveliest stretch must have: below, the gyroscope's noise is
/// fitted to that of the pixels, and whatever fits best looks certain (a camera at rest gave a clock to 4 ms).
const MIN_TURNING: f64 = 0.03;

/// The readout's standard deviation is at least this share of it: positions between images are parabolas, which underrate a
/// hand's fastest translation (errors of 0.6 ms at readouts of 30 ms, `tests/calibration.rs`).
const READOUT_SHARE: f64 = 0.01;

/// What the model leaves out bounds what can be known, however long a recording is. Rotation, rad: axes of consumer gyroscopes
/// are askew by tenths of a degree (0.4° between this and the published calibration of EuRoC's MH_01). Focal length, relative:
/// pixels are square to some tenths of a per cent. Principal point, image widths: tangential distortion moves it (6 px of 752
/// on MH_01).
const ROTATION_FLOOR: f64 = 0.0026;
const FOCAL_FLOOR: f64 = 0.0015;
const CENTRE_FLOOR: f64 = 0.004;

/// How well a clock can be known where images turn otherwise than the gyroscope says, s: a stabiliser that follows the hand late looks like a clock that is
/// late. Those of four rendered recordings were 11 to 20 ms off at stated 2 to 6.
const LAG_SECS: f64 = 0.01;

/// A stabiliser is looked for where the focal length is known worse than this (relative σ), too: unstabilised recordings of 20 s have 0.003 to 0.005, a
/// simulated stabilised one 0.015 where it was 6 % off.
const DOUBTFUL_FOCAL: f64 = 0.01;
/// With a stabiliser in the model: focal lengths of twelve rendered recordings were off by −1.4 to +1.6 % at stated 0.2 to 0.8 (one 2.5), clocks of eleven by
/// up to 9.6 ms at stated 0.2 to 5.2; that of one which circled a hall by 18 at 3.5.
const STABILISED_FOCAL_FLOOR: f64 = 0.008;
const STABILISED_LAG_SECS: f64 = 0.005;

/// A number of the calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The value.
    pub value: f64,
    /// Standard deviation, same unit.
    pub sigma: f64,
    /// Whether the recording shows it: its standard deviation is well below what is believed of any camera.
    pub is_observable: bool,
}

/// Calibration of one camera on an IMU. Pixels, seconds, radians.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// Focal length of both axes, pixels.
    pub focal_px: Estimate,
    /// Principal point, pixels.
    pub centre_px: [Estimate; 2],
    /// The kind of lens that the next two belong to.
    pub lens: LensModel,
    /// Where a lens was given, by how many of its standard deviations the focal length is off that one's.
    pub off_given_lens: Option<f64>,
    /// Radial distortion, k1 and k2 of the lens.
    pub radial: [Estimate; 2],
    /// `t_imu = stamp + offset` for the centre row, s.
    pub time_offset_secs: Estimate,
    /// Time from the first to the last row, s.
    pub readout_secs: Estimate,
    /// Rotation body_from_camera, and its standard deviations about the camera's axes, rad.
    pub body_from_camera: So3,
    /// Standard deviation about each axis of the camera, rad.
    pub rotation_sigmas: [f64; 3],
    /// Whether the mount was given, or assumed because the recording does not show it, and held within some degrees.
    pub mount_is_assumed: bool,
    /// Whether the rotation is observable about every axis.
    pub rotation_is_observable: bool,
    /// Gyroscope bias, rad/s.
    pub gyro_bias: [Estimate; 3],
    /// Standard deviation of a pixel measurement, pixels.
    pub pixel_sigma: f64,
    /// Images and stretches that were used.
    pub images: usize,
    /// Stretches of about 1.5 s that were adjusted.
    pub stretches: usize,
    /// How many times the gyroscope's noise images turn otherwise than it says, as where they are stabilised or stamps scatter; 1 where that is nothing but
    /// noise. Standard deviations are multiplied by it.
    pub gyro_noise_ratio: f64,
    /// How far images are shifted, as the angle by which the camera would have to turn (root mean square of each axis, rad), where a stabiliser explains the
    /// tracks better than the noise of the gyroscope does. Stamps that scatter look like that, too.
    pub image_shift_rad: Option<f64>,
}

impl Calibration {
    /// The largest of [`Self::rotation_sigmas`], rad.
    pub fn rotation_sigma(&self) -> f64 {
        self.rotation_sigmas.into_iter().fold(0.0, f64::max)
    }
}

/// Feature tracks and gyroscope samples of a recording.
#[derive(Debug, Default)]
pub struct CalibrationLog {
    images: Vec<(Timestamp, Vec<(LandmarkId, Pixel)>)>,
    samples: Vec<ImuSample>,
}

/// What is known of a camera before its recording is looked at.
#[derive(Clone, Copy, Debug, Default)]
pub struct KnownCamera<'a> {
    /// The lens: it is held to a per cent where it was measured and to three where it has no distortion, and mount, clock and shutter are found by it.
    pub lens: Option<&'a CameraModel>,
    /// The rotation body_from_camera, if it was measured: it is held within some degrees where that explains the tracks.
    pub mount: Option<&'a So3>,
    /// The rotation body_from_camera with which cameras of this kind are mounted: taken, as it is, turned about the view by quarter turns, or looking the
    /// other way, where the body turns too little to show the mount, or about one axis only as in a hand that walks.
    pub assumed_mount: Option<&'a So3>,
}

/// Why there is no calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CalibrationFailure {
    /// Too few images with common features, or too few gyroscope samples beside them.
    TooLittleData,
    /// The body turned too little, or about one axis only.
    TooLittleRotation,
    /// No camera explains the tracks by the gyroscope's rotations.
    Unexplained,
}

impl CalibrationLog {
    /// Takes a gyroscope sample; samples come in the order of time.
    pub fn add_gyro(&mut self, sample: &ImuSample) {
        let is_later = self.samples.last().is_none_or(|last| sample.time > last.time);
        let is_finite = sample.gyro.0.iter().all(|r| r.is_finite());
        if is_later && is_finite && self.samples.len() < MAX_SAMPLES && !self.is_full() {
            self.samples.push(*sample);
        }
    }

    /// Takes the features of an image with its own stamp; images come in the order of time.
    pub fn add_image(&mut self, stamp: Timestamp, features: impl Iterator<Item = (LandmarkId, Pixel)>) {
        let is_near = |(last, _): &(Timestamp, _)| (stamp - *last).as_secs_f64() < IMAGE_SPACING_SECS;
        if self.images.last().is_some_and(is_near) || self.is_full() {
            return;
        }
        let mut features: Vec<(LandmarkId, Pixel)> =
            features.filter(|(_, p)| p.x.is_finite() && p.y.is_finite()).collect();
        features.sort_unstable_by_key(|f| f.0);
        features.dedup_by_key(|f| f.0);
        self.images.push((stamp, features));
    }

    /// Whether more of the recording would not be used.
    pub fn is_full(&self) -> bool {
        match (self.images.first(), self.samples.last()) {
            (Some((first, _)), Some(last)) => {
                (last.time - *first).as_secs_f64() > MAX_SPAN_SECS + MARGIN_SECS
            }
            _ => false,
        }
    }

    /// Estimates the calibration of a camera with images of `width` × `height`, of which `known` is known.
    ///
    /// # Errors
    /// Says why the recording does not show it; never an error of the program.
    pub fn calibrate(
        &self,
        width: usize,
        height: usize,
        known: &KnownCamera<'_>,
    ) -> Result<Calibration, CalibrationFailure> {
        let Some(origin) = self.images.first().map(|(t, _)| *t) else {
            return Err(CalibrationFailure::TooLittleData);
        };
        let secs = |t: Timestamp| (t - origin).as_secs_f64();
        let samples: Vec<RateSample> = self
            .samples
            .iter()
            .map(|s| RateSample { secs: secs(s.time), rate: s.gyro.0 })
            .filter(|s| s.secs > -MARGIN_SECS)
            .collect();
        let (Some(begin), Some(end)) = (samples.first(), samples.last()) else {
            return Err(CalibrationFailure::TooLittleData);
        };
        let mut images: Vec<ImageFeatures> = self
            .images
            .iter()
            .map(|(t, features)| ImageFeatures { secs: secs(*t), features: features.clone() })
            .filter(|i| i.secs > begin.secs - 0.05 && i.secs < end.secs + 0.05)
            .collect();
        let size = (width as f64, height as f64);
        let as_measured = GyroPath::new(&samples, &Vector3::zeros(), &Vector3::zeros());
        fixed::leave_out(&mut images, &as_measured, size.0);
        let windows = stretches::stretches(size, &images, &samples);
        if windows.is_empty() || samples.len() < 50 {
            return Err(CalibrationFailure::TooLittleData);
        }
        if windows.iter().map(|w| w.turning(&samples)).fold(0.0, f64::max) < MIN_TURNING {
            return Err(CalibrationFailure::TooLittleRotation);
        }
        // From below: rates between samples are interpolated. From above: vibration is no white noise.
        let gyro_noise = sensor_noise(&self.samples).map_or(5e-4, |n| n.gyro).clamp(2e-4, 5e-3);
        let tracks = Tracks {
            size,
            images: &images,
            samples: &samples,
            as_measured: &as_measured,
            gyro_noise,
            windows: &windows,
            lens: known.lens.and_then(|lens| GivenLens::of(lens, START_READOUT_SECS)),
        };
        if let Some(solved) = known.mount.and_then(|mount| tracks.explained_by_a_given_mount(mount)) {
            return behind_any_stabiliser(&tracks, &solved);
        }
        let found =
            tracks.explained_by_a_lens(None).and_then(|solved| behind_any_stabiliser(&tracks, &solved));
        let is_decided = match &found {
            Ok(found) => found.rotation_is_observable,
            Err(failure) => *failure != CalibrationFailure::TooLittleRotation,
        };
        let Some(assumed) = known.assumed_mount.filter(|_| !is_decided) else { return found };
        let usual = behind_any_stabiliser(&tracks, &tracks.explained_by_a_mount(assumed)?)?;
        if usual.rotation_is_observable { Ok(usual) } else { Err(CalibrationFailure::TooLittleRotation) }
    }
}

/// What was found; where images turn otherwise than the gyroscope says, or the lens is known badly, with a stabiliser if one explains the tracks better: a
/// picture that moves less than the camera turns looks like a shorter focal length and a late clock.
fn behind_any_stabiliser(
    tracks: &Tracks<'_>,
    solved: &Solved<'_>,
) -> Result<Calibration, CalibrationFailure> {
    let found = calibration(tracks, solved)?;
    let is_lens_doubtful =
        tracks.lens.is_none() && found.focal_px.sigma > DOUBTFUL_FOCAL * found.focal_px.value;
    // Shifts would explain a gyroscope that is left-handed, too.
    let is_explained = found.pixel_sigma < DOUBTFUL_PX;
    if !is_explained || !is_lens_doubtful && found.gyro_noise_ratio <= 1.0 {
        return Ok(found);
    }
    let stabilised = tracks.explained_by_a_stabiliser(solved);
    Ok(stabilised.and_then(|stabilised| calibration(tracks, &stabilised).ok()).unwrap_or(found))
}

/// A solution with its standard deviations.
fn calibration(
    tracks: &Tracks<'_>,
    (problem, solution): &Solved<'_>,
) -> Result<Calibration, CalibrationFailure> {
    let width = tracks.size.0;
    let stretches = tracks.windows.len();
    let [formal, spread] = problem.covariances(solution).ok_or(CalibrationFailure::Unexplained)?;
    let x = &solution.parameters;
    let priors = problem.sigmas();
    let gyro_noise_ratio = solution.gyro_noise_ratio();
    let image_shift_rad = solution.image_shift_rad();
    let factor = sigma_factor(stretches, gyro_noise_ratio);
    let sigma = |p: usize| {
        let floor = match p {
            FOCAL if image_shift_rad.is_some() => STABILISED_FOCAL_FLOOR,
            FOCAL => FOCAL_FLOOR,
            READOUT => READOUT_SHARE * x.readout_secs,
            OFFSET if image_shift_rad.is_some() => STABILISED_LAG_SECS,
            OFFSET if gyro_noise_ratio > 1.0 => LAG_SECS,
            _ if (CENTRE..CENTRE + 2).contains(&p) => CENTRE_FLOOR * width,
            _ if (ROTATION..ROTATION + 3).contains(&p) => ROTATION_FLOOR,
            _ => 0.0,
        };
        floor.hypot(factor * formal[(p, p)].max(spread[(p, p)]).sqrt()).hypot(solution.spread[p])
    };
    // Half of what is believed of any camera: more than that is the prior's, not the recording's.
    let estimate = |p: usize, value: f64| Estimate {
        value,
        sigma: sigma(p),
        is_observable: formal[(p, p)].sqrt().max(solution.spread[p]) < 0.5 * priors[p],
    };
    let focal = estimate(FOCAL, x.focal);
    let rotation_sigmas = [0, 1, 2].map(|a| sigma(ROTATION + a));
    Ok(Calibration {
        focal_px: Estimate { sigma: focal.sigma * x.focal, is_observable: focal.sigma < 0.1, ..focal },
        centre_px: [estimate(CENTRE, x.centre.x), estimate(CENTRE + 1, x.centre.y)],
        lens: x.lens,
        off_given_lens: problem.lens.map(|given| given.off(x.focal)),
        radial: [estimate(K1, x.k1), estimate(K2, x.k2)],
        time_offset_secs: estimate(OFFSET, x.offset_secs),
        readout_secs: estimate(READOUT, x.readout_secs),
        body_from_camera: x.body_from_camera,
        rotation_sigmas,
        mount_is_assumed: problem.mount_sigma.is_some(),
        rotation_is_observable: rotation_sigmas.iter().all(|s| *s < 0.1),
        gyro_bias: [0, 1, 2].map(|a| estimate(BIAS + a, x.bias[a])),
        pixel_sigma: solution.noise.pixel,
        images: tracks.images.len(),
        stretches,
        gyro_noise_ratio,
        image_shift_rad,
    })
}
