//! Looking for tracks in an image: where they are predicted, and where the image turned otherwise, displaced as those are that were found.

use super::track::{HostImage, InverseDistance, Measurer, Track, rotated_pixel};
use crate::frontend::{MatchFailure, PixelMeasurement, Warp};
use nalgebra::Vector2;
use vidar_core::camera::Pixel;
use vidar_core::{CameraModel, FrameId, LieGroup, Se3};
use vidar_solve::statistics::median_upper;

/// Relative deviation of a distance below which the point's place is predicted from it rather than from its motion.
const KNOWN_DISTANCE: f64 = 0.3;

/// Tracks may not come nearer than this to the border of the image, pixels.
pub(super) const BORDER_PX: f64 = 8.0;

/// Where fewer than half of the tracks are found, the others are looked for once more, in so many rounds: displaced as those are in the median that were found, and
/// further round there. A stabiliser takes turns back that the gyroscope feels.
const ROUNDS: usize = 3;
/// Fewest tracks whose displacement says anything of the others'.
const LEAST_COMMON: usize = 5;

/// Where the camera of a frame is.
pub(crate) trait CameraPoses {
    /// Pose of the camera of `frame`, or `None` when it is not held.
    fn world_from_camera(&self, frame: FrameId) -> Option<Se3>;
}

/// The motion of the camera into the image that is measured, as predicted.
pub(crate) struct Prediction<'a> {
    pub poses: &'a dyn CameraPoses,
    pub world_from_current: Se3,
    pub current_from_last: Se3,
    /// Whether translations mean anything.
    pub has_translation: bool,
    /// Whether images may turn otherwise than predicted: before anything tells that no stabiliser takes turns back, or where one does.
    pub may_be_stabilised: bool,
    pub last: FrameId,
    /// Seconds since it.
    pub secs: f64,
}

/// Looks for every track and writes into `all` what was found of each; whether fewer than half were where they were predicted.
pub(super) fn find_all(
    camera: &CameraModel,
    measurer: &mut Measurer,
    tracks: &mut [Track],
    current: &HostImage,
    prediction: &Prediction<'_>,
    all: &mut Vec<Result<Found, MatchFailure>>,
) -> bool {
    all.clear();
    all.resize(tracks.len(), Err(MatchFailure::NotVisible));
    let mut search = Search { displaced: Vector2::zeros(), is_wide: false };
    for round in 0..ROUNDS {
        for (track, found) in tracks.iter_mut().zip(all.iter_mut()).filter(|(_, found)| found.is_err()) {
            *found = find(camera, measurer, track, current, prediction, search);
        }
        let many = all.iter().flatten().count();
        if !prediction.may_be_stabilised || 2 * many >= all.len() {
            return round > 0;
        }
        let common = median(all.iter().flatten().map(|found| found.off)).filter(|_| many >= LEAST_COMMON);
        search = Search { displaced: common.unwrap_or_default(), is_wide: true };
    }
    true
}

/// The median of each coordinate.
pub(super) fn median(vectors: impl Iterator<Item = Vector2<f64>>) -> Option<Vector2<f64>> {
    let (mut x, mut y): (Vec<f64>, Vec<f64>) = vectors.map(|v| (v.x, v.y)).unzip();
    Some(Vector2::new(median_upper(&mut x)?, median_upper(&mut y)?))
}

pub(super) fn is_known(distance: &InverseDistance, has_translation: bool) -> bool {
    has_translation && distance.relative_std() < KNOWN_DISTANCE
}

/// How a track is looked for.
#[derive(Clone, Copy)]
struct Search {
    /// How far from where it is expected, pixels.
    displaced: Vector2<f64>,
    /// Whether far round that place.
    is_wide: bool,
}

/// A track in an image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    /// Where the image shows it.
    pub pixel: Pixel,
    /// As a global shutter would give it.
    pub measurement: PixelMeasurement,
    /// How far that is from where it was expected, pixels.
    off: Vector2<f64>,
}

/// Looks for a track.
fn find(
    camera: &CameraModel,
    measurer: &mut Measurer,
    track: &mut Track,
    current: &HostImage,
    prediction: &Prediction<'_>,
    search: Search,
) -> Result<Found, MatchFailure> {
    let world_from_host =
        prediction.poses.world_from_camera(track.host.frame).ok_or(MatchFailure::NotVisible)?;
    let current_from_host = prediction.world_from_current.inverse() * world_from_host;
    let known = is_known(&track.distance, prediction.has_translation);
    let inverse = if prediction.has_translation { track.distance.mean.max(0.0) } else { 0.0 };
    let mut warp =
        Warp::new(camera, &track.feature, inverse, &current_from_host).ok_or(MatchFailure::NotVisible)?;
    let turned = (!known && track.last_frame == prediction.last)
        .then(|| rotated_pixel(camera, &track.last_global_pixel, &prediction.current_from_last))
        .flatten();
    let expected = match turned {
        Some(turned) => turned + track.drift * prediction.secs,
        None => warp.pixel,
    };
    let expected = current.shutter.add_motion(camera, &expected, inverse);
    let start = expected + search.displaced;
    if !camera.contains(&start, BORDER_PX) {
        return Err(MatchFailure::OutsideImage);
    }
    warp.pixel = start;
    let is_wide = !known || search.is_wide;
    let found =
        measurer.find(&track.host.pyramid, &track.feature, &warp, &start, &current.pyramid, is_wide)?;
    let shown = found.measurement.pixel;
    let pixel = current.shutter.remove_motion(camera, &shown, inverse);
    if let Some(turned) = turned {
        track.drift = (pixel - turned) / prediction.secs.max(1e-3);
    }
    let measurement = PixelMeasurement { pixel, ..found.measurement };
    Ok(Found { pixel: shown, measurement, off: shown - expected })
}
