//! Tracks: features of keyframes that are measured in every new frame against their keyframe's patch.

use crate::frontend::{
    AlignedFeature, Feature, MatchFailure, PixelMeasurement, Pyramid, Template, Warp, align_feature,
};
use crate::gyro_alignment::RollingShutter;
use nalgebra::{Matrix2, Matrix2x1, Vector2};
use std::sync::Arc;
use vidar_core::camera::Pixel;
use vidar_core::{CameraModel, FrameId, FrameImage, LandmarkId, LieGroup, Se3};
use vidar_solve::Kernel;

/// An image whose patches are followed.
#[derive(Debug)]
pub(crate) struct HostImage {
    /// Which image.
    pub frame: FrameId,
    /// Its grey levels.
    pub pyramid: Pyramid,
    /// How the camera moved while it was read out.
    pub shutter: RollingShutter,
}

/// Images whose memory is used again once nobody holds them.
#[derive(Debug, Default)]
pub(crate) struct ImagePool {
    images: Vec<Arc<HostImage>>,
}

impl ImagePool {
    /// The pyramid of `image`, called `frame`; `None` for an image of another size than those before.
    pub fn take(
        &mut self,
        frame: FrameId,
        image: &FrameImage,
        levels: usize,
        shutter: RollingShutter,
    ) -> Option<Arc<HostImage>> {
        let free = self.images.iter_mut().find_map(Arc::get_mut);
        match free {
            Some(host) => {
                host.frame = frame;
                host.shutter = shutter;
                host.pyramid.rebuild(image).ok()?;
            }
            None => {
                let mut pyramid = Pyramid::new(image.width(), image.height(), levels);
                pyramid.rebuild(image).ok()?;
                self.images.push(Arc::new(HostImage { frame, pyramid, shutter }));
            }
        }
        self.images.iter().find(|h| h.frame == frame).cloned()
    }
}

/// Whitened residuals beyond this pull only linearly.
const KERNEL: Kernel = Kernel::Huber { k: 2.0 };

/// Gaussian belief of an inverse distance (1/m along the bearing).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct InverseDistance {
    pub mean: f64,
    pub variance: f64,
}

/// A feature that is followed.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    pub id: LandmarkId,
    /// Where its patch comes from.
    pub host: Arc<HostImage>,
    pub feature: Feature,
    pub distance: InverseDistance,
    /// Whether the smoother knows it.
    pub is_landmark: bool,
    /// Where the image in which it was found last shows it, and where a global shutter would have.
    pub last_pixel: Pixel,
    pub last_global_pixel: Pixel,
    /// That image.
    pub last_frame: FrameId,
    /// Where the newest keyframe shows it.
    pub keyframe_pixel: Option<Pixel>,
    /// Where frames of the window showed it, while the smoother does not know it.
    pub observations: Vec<(FrameId, PixelMeasurement)>,
    /// Furthest that an image showed it from where it began, pixels.
    pub moved_px: f64,
    /// What the last prediction was off by, pixels per second: continues into the next one while no depth is known.
    pub drift: Vector2<f64>,
    /// Frames in which it was found.
    pub found: u32,
    /// Frames in a row in which it was not.
    pub missed: u32,
    /// Where it is in the current frame.
    pub measured: Option<PixelMeasurement>,
}

/// The belief of an inverse distance of which only a typical value is known: 0 to three times it within 2 σ.
pub(crate) fn unknown_distance(typical_inverse: f64) -> InverseDistance {
    InverseDistance { mean: typical_inverse, variance: typical_inverse * typical_inverse }
}

/// One track in one image, for plots.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackRecord {
    /// Its name.
    pub id: LandmarkId,
    /// Pyramid level that it is measured on.
    pub level: u8,
    /// Whether the smoother knows it.
    pub is_landmark: bool,
    /// Where the image shows it, pixels.
    pub pixel: Pixel,
    /// That, less where the state says it should be, pixels; `None` without a known distance.
    pub residual: Option<Vector2<f64>>,
    /// Inverse of its distance from its host, 1/m, and standard deviation.
    pub inverse_distance: [f64; 2],
}

/// Measures features; holds the buffers.
#[derive(Debug)]
pub(crate) struct Measurer {
    template: Template,
    noise_gray: f64,
}

impl Measurer {
    pub fn new(noise_gray: f64) -> Self {
        Self { template: Template::empty(), noise_gray }
    }

    pub fn noise_gray(&self) -> f64 {
        self.noise_gray
    }

    /// Finds `feature` of `host` in `current` around `expected`, the patch deformed by `warp`.
    ///
    /// What is not found on its own level is looked for two levels up first, where four times the distance is in reach.
    pub fn find(
        &mut self,
        host: &Pyramid,
        feature: &Feature,
        warp: &Warp,
        expected: &Pixel,
        current: &Pyramid,
        search_wide: bool,
    ) -> Result<AlignedFeature, MatchFailure> {
        let mut start = *expected;
        if search_wide {
            let coarse = Feature { level: feature.level + 2, ..*feature };
            if self.template.fill(host, &coarse, warp)
                && let Ok(found) = align_feature(&self.template, current, &start, self.noise_gray)
            {
                start = found.measurement.pixel;
            }
        }
        if !self.template.fill(host, feature, warp) {
            return Err(MatchFailure::NoTexture);
        }
        align_feature(&self.template, current, &start, self.noise_gray)
    }
}

/// Where a ray of the host at `inverse_distance` lies in another camera, and its derivative by the inverse distance.
pub(crate) fn project_with_distance(
    camera: &CameraModel,
    feature: &Feature,
    inverse_distance: f64,
    current_from_host: &Se3,
) -> Option<(Pixel, Matrix2x1<f64>)> {
    let scaled =
        current_from_host.rotation * feature.bearing + current_from_host.translation * inverse_distance;
    let (pixel, d_pixel_d_point) = camera.project_with_jacobian(&scaled)?;
    Some((pixel, d_pixel_d_point * current_from_host.translation))
}

impl InverseDistance {
    /// The belief after `seen`, each a measurement and the pose current_from_host it was made from.
    ///
    /// Gauss-Newton on one unknown with Huber weights, starting from `self`, which also is the prior. `None` when the
    /// measurements contradict each other: mean chi-square of two degrees of freedom above `gate`.
    pub fn updated(
        &self,
        camera: &CameraModel,
        feature: &Feature,
        observations: &[(Se3, PixelMeasurement)],
        gate: f64,
    ) -> Option<Self> {
        let prior_information = 1.0 / self.variance;
        let (mut mean, mut information, mut chi2) = (self.mean, prior_information, 0.0);
        for _ in 0..6 {
            let mut gradient = prior_information * (self.mean - mean);
            information = prior_information;
            chi2 = 0.0;
            for (current_from_host, measured) in observations {
                let (pixel, d_pixel) = project_with_distance(camera, feature, mean, current_from_host)?;
                let left = measured.pixel - pixel;
                let error2 = left.dot(&(measured.information * left));
                let weighted = measured.information * d_pixel * KERNEL.weight(error2);
                gradient += weighted.dot(&left);
                information += weighted.dot(&d_pixel);
                chi2 += error2;
            }
            let step = gradient / information;
            // A step past infinity would mirror the point; half way there is far enough for one step.
            mean = if mean + step < 0.0 { 0.5 * mean } else { mean + step };
            if step.abs() < 0.01 / information.sqrt() {
                break;
            }
        }
        let fits = chi2 <= gate * observations.len() as f64;
        (fits && mean.is_finite() && mean < 20.0).then_some(Self { mean, variance: 1.0 / information })
    }

    /// Standard deviation relative to the value: how well the distance is known.
    pub fn relative_std(&self) -> f64 {
        self.variance.sqrt() / self.mean.abs().max(1e-9)
    }
}

/// Standard deviation of the place that a patch itself defines, pixels of its level.
const HOST_SIGMA_PX: f64 = 0.3;

/// Covariance of a track's place in its host.
pub(crate) fn host_covariance(track: &Track) -> Matrix2<f64> {
    let scale = crate::frontend::level_scale(track.feature.level.into());
    Matrix2::identity() * (HOST_SIGMA_PX * scale).powi(2)
}

/// Covariance of a measurement, `noise_px` beyond what the alignment knows.
pub(crate) fn noisy_covariance(measured: &PixelMeasurement, noise_px: f64) -> Matrix2<f64> {
    measured.covariance() + Matrix2::identity() * (noise_px * noise_px)
}

/// Angle between the rays of two cameras to a point, rad.
pub(crate) fn parallax(feature: &Feature, inverse_distance: f64, current_from_host: &Se3) -> f64 {
    let rotated = current_from_host.rotation * feature.bearing;
    let scaled = rotated + current_from_host.translation * inverse_distance;
    rotated.cross(&scaled).norm().atan2(rotated.dot(&scaled))
}

/// Where a pixel of the last frame lies in this one if the camera only turned.
pub(crate) fn rotated_pixel(camera: &CameraModel, pixel: &Pixel, current_from_last: &Se3) -> Option<Pixel> {
    let bearing = camera.unproject(pixel)?;
    camera.project(&(current_from_last.rotation.act(&bearing)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::FeatureKind;
    use nalgebra::Vector3;
    use vidar_core::{Pinhole, So3};

    #[test]
    fn seeing_a_point_from_aside_tells_its_distance_with_an_honest_deviation() {
        let camera = CameraModel::Pinhole(Pinhole::new(458.0, 457.0, 367.0, 248.0, 752, 480).unwrap());
        let feature = Feature::new(&camera, Pixel::new(300.0, 200.0), 0, FeatureKind::Corner).unwrap();
        let truth = 1.0 / 2.5;
        let mut observations = Vec::new();
        for k in 1..=8 {
            let x = 0.03 * f64::from(k);
            let turn = So3::exp(&Vector3::new(0.01, 0.02 * f64::from(k), 0.0));
            let current_from_host = Se3::new(turn, Vector3::new(-x, 0.3 * x, 0.1 * x));
            let (pixel, _) = project_with_distance(&camera, &feature, truth, &current_from_host).unwrap();
            observations.push((
                current_from_host,
                PixelMeasurement { pixel, information: Matrix2::identity() / 0.09 },
            ));
        }
        let estimate = unknown_distance(0.2).updated(&camera, &feature, &observations, 9.0).unwrap();
        assert!((estimate.mean - truth).abs() < 0.5 * estimate.variance.sqrt(), "{estimate:?}");
        assert!(estimate.relative_std() < 0.01, "{estimate:?}");
        observations[3].1.pixel.y += 30.0;
        assert!(unknown_distance(0.2).updated(&camera, &feature, &observations, 9.0).is_none());
        let aside = Se3::from_translation(Vector3::new(-0.2, 0.0, 0.0));
        assert!((parallax(&feature, truth, &aside) - 0.08).abs() < 0.01);
    }
}
