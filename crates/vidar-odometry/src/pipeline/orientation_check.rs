//! Whether gyroscope and images agree on the rotation: the camera's orientation on the body is the part of a
//! calibration that is wrong most often (inverted, or of another convention), and wrong by much.
//!
//! Both rates are compared without their means, so a gyroscope bias does not matter. The rotation of the images is the
//! one that fits the motion of bearings best; translation disturbs it, which is why what counts is not a small residual but
//! whether another orientation would explain much more. A camera that circles something and turns with it still shows another rotation than it makes, so a
//! state that is tracked ends only where the other orientation explains the last images better with their translation free, too: by the epipolar constraint.

use crate::tracking::Track;
use nalgebra::{Matrix3, Vector3};
use rustc_hash::FxHashMap;
use std::collections::VecDeque;
use vidar_core::{CameraModel, FrameId, LandmarkId, LieGroup, So3, nearest_rotation};
use vidar_solve::statistics::median_upper;

/// Tracks that a comparison needs.
const MIN_TRACKS: usize = 15;
/// Images before anything is said, and after which nothing more is.
const MIN_IMAGES: usize = 20;
const MAX_IMAGES: usize = 400;
/// Root mean square rate of rotation, mean removed, that is needed, rad/s.
const MIN_RATE: f64 = 0.12;
/// Share of the images' rotation that the given orientation leaves unexplained, from which it is doubted ...
const MAX_UNEXPLAINED_SHARE: f64 = 0.7;
/// ... provided that the best orientation leaves less than this share of that. Where gyroscope and wrong orientation predict the features, those in slow
/// images are followed best, and the rates seen are too small: an inverted EuRoC camera had 0.53 to 0.62 in eight draws of image noise, seven phones
/// without calibration 0.005 to 0.13, an eighth, off by 52 degrees, 0.99. Of 33 recordings with a true orientation none comes as far as this: the images
/// of each show enough of the rotation before.
const BETTER_SHARE: f64 = 0.75;
/// Least ratio of the second to the first singular value of the rates' cross-covariance: turning about one axis leaves the orientation about it
/// free, and the best one is that of the translation. A camera moved to and fro with yaw alone had 0.01 to 0.1 and was off by 128 degrees by it.
const MIN_SECOND_AXIS: f64 = 0.15;
/// Share of the gyroscope's rotation that the images show with the given orientation, from which it is not doubted: what they leave unexplained
/// is translation then. A turn by 60 degrees about any axis leaves two thirds of rotation in all directions.
const SHOWN_SHARE: f64 = 0.7;
/// Pairs of images whose rays are kept for the epipolar constraint, and the share of the given orientation's misfit that the best one may leave.
const KEPT_PAIRS: usize = MIN_IMAGES;
const MISFIT_SHARE: f64 = 0.5;
/// Orientations nearer than this to the best one are not doubted, degrees.
pub(crate) const MAX_TURN_DEG: f64 = 15.0;

/// Rotation vector of the camera as the gyroscope felt it, `before_from_now`, and rays (before, now).
type TurnedRays = (Vector3<f64>, Vec<(Vector3<f64>, Vector3<f64>)>);

/// Sums over pairs of successive images.
#[derive(Debug)]
pub(crate) struct OrientationCheck {
    camera_from_body: So3,
    /// Rays of the newest image's features.
    last: FxHashMap<LandmarkId, Vector3<f64>>,
    current: FxHashMap<LandmarkId, Vector3<f64>>,
    pairs: Vec<(Vector3<f64>, Vector3<f64>)>,
    /// Of the last pairs of images what the gyroscope felt, in axes of the camera, and the rays.
    kept: VecDeque<TurnedRays>,
    images: usize,
    image_sum: Vector3<f64>,
    gyro_sum: Vector3<f64>,
    image_square: f64,
    gyro_square: f64,
    /// Σ felt seenᵀ.
    cross: Matrix3<f64>,
}

impl OrientationCheck {
    pub fn new(body_from_camera: &So3) -> Self {
        Self {
            camera_from_body: body_from_camera.inverse(),
            last: FxHashMap::default(),
            current: FxHashMap::default(),
            pairs: Vec::new(),
            kept: VecDeque::new(),
            images: 0,
            image_sum: Vector3::zeros(),
            gyro_sum: Vector3::zeros(),
            image_square: 0.0,
            gyro_square: 0.0,
            cross: Matrix3::zeros(),
        }
    }

    /// Takes the tracks as measured in `frame`, and the rotation vector `last_from_current` of the body that the gyroscope
    /// felt since the image before, over `secs`.
    pub fn add(
        &mut self,
        camera: &CameraModel,
        tracks: &[Track],
        frame: FrameId,
        gyro: Option<(Vector3<f64>, f64)>,
    ) {
        if self.images >= MAX_IMAGES {
            return;
        }
        self.pairs.clear();
        self.current.clear();
        for track in tracks.iter().filter(|t| t.last_frame == frame) {
            let Some(ray) = camera.unproject(&track.last_pixel) else { continue };
            self.pairs.extend(self.last.get(&track.id).map(|before| (*before, ray)));
            self.current.insert(track.id, ray);
        }
        std::mem::swap(&mut self.last, &mut self.current);
        if let (Some((turn, secs)), Some(seen)) = (gyro.filter(|f| f.1 > 0.0), rotation_of(&self.pairs)) {
            let felt = self.camera_from_body * turn;
            self.add_rates(felt / secs, seen / secs);
            let spare = if self.kept.len() < KEPT_PAIRS { None } else { self.kept.pop_front() };
            let mut rays = spare.map_or_else(Vec::new, |(_, rays)| rays);
            rays.clone_from(&self.pairs);
            self.kept.push_back((felt, rays));
        }
    }

    /// Rates of one pair of images, rad/s, in axes of the camera.
    fn add_rates(&mut self, gyro: Vector3<f64>, seen: Vector3<f64>) {
        self.images += 1;
        self.gyro_sum += gyro;
        self.image_sum += seen;
        self.gyro_square += gyro.norm_squared();
        self.image_square += seen.norm_squared();
        self.cross += gyro * seen.transpose();
    }

    /// Angle in degrees by which the given orientation is off and the turn that what the gyroscope felt needs, when it cannot be true.
    fn inconsistency(&self) -> Option<(f64, Matrix3<f64>)> {
        if self.images < MIN_IMAGES {
            return None;
        }
        let n = self.images as f64;
        let gyro2 = self.gyro_square / n - (self.gyro_sum / n).norm_squared();
        let image2 = self.image_square / n - (self.image_sum / n).norm_squared();
        let cross = self.cross / n - (self.gyro_sum / n) * (self.image_sum / n).transpose();
        if !(gyro2.min(image2) > MIN_RATE * MIN_RATE) {
            return None;
        }
        // Σ |seen − R felt|² = Σ |seen|² + Σ |felt|² − 2 tr(R Σ felt seenᵀ), least for Rᵀ nearest to the sum.
        let nearest = nearest_rotation(&cross)?;
        let values = nearest.singular_values;
        if values[1] < MIN_SECOND_AXIS * values[0] || cross.trace() > SHOWN_SHARE * gyro2 {
            return None;
        }
        let best = nearest.rotation.transpose();
        let share = |trace: f64| (image2 + gyro2 - 2.0 * trace) / image2;
        let (given, least) = (share(cross.trace()), share((best * cross).trace()));
        let turn_deg = (0.5 * (best.trace() - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
        let inconsistent =
            given > MAX_UNEXPLAINED_SHARE && least < BETTER_SHARE * given && turn_deg > MAX_TURN_DEG;
        inconsistent.then_some((turn_deg, best))
    }

    /// Angle in degrees by which the given orientation is off, when it cannot be true: where nothing is tracked.
    pub fn inconsistency_deg(&self) -> Option<f64> {
        self.inconsistency().map(|(turn_deg, _)| turn_deg)
    }

    /// The same for a state that is tracked, which speaks for the orientation: another one has to leave less than half of the misfit.
    pub fn contradiction_deg(&self) -> Option<f64> {
        let is_better = |(_, best): &(f64, Matrix3<f64>)| {
            self.misfit(best) < MISFIT_SHARE * self.misfit(&Matrix3::identity())
        };
        self.inconsistency().filter(is_better).map(|(turn_deg, _)| turn_deg)
    }

    /// How far the kept pairs of images are from the epipolar constraint when what the gyroscope felt is turned: the mean over pairs of the median
    /// `|(a × R b) · t|`, with `t` the direction of translation that fits the pair best.
    fn misfit(&self, turned: &Matrix3<f64>) -> f64 {
        let of_pair = |(felt, rays): &TurnedRays| {
            let before_from_now = So3::exp(&(turned * felt));
            let normals: Vec<Vector3<f64>> =
                rays.iter().map(|(a, b)| a.cross(&(before_from_now * *b))).collect();
            let eigen = normals.iter().map(|n| n * n.transpose()).sum::<Matrix3<f64>>().symmetric_eigen();
            let t = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
            let mut off: Vec<f64> = normals.iter().map(|n| n.dot(&t).abs()).collect();
            median_upper(&mut off).unwrap_or(0.0)
        };
        self.kept.iter().map(of_pair).sum::<f64>() / self.kept.len().max(1) as f64
    }
}

/// Rotation vector `before_from_now` that explains most of the motion of bearings (before, now): Gauss-Newton with weights
/// that forget what fits badly.
fn rotation_of(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Vector3<f64>> {
    if pairs.len() < MIN_TRACKS {
        return None;
    }
    let mut turn = Vector3::zeros();
    let mut scale2 = f64::INFINITY;
    for _ in 0..4 {
        let rotation = So3::exp(&turn);
        let (mut h, mut g, mut sum, mut weights) = (Matrix3::<f64>::zeros(), Vector3::zeros(), 0.0, 0.0);
        for (before, now) in pairs {
            let turned = rotation * *now;
            // before ≈ turned + δ × turned.
            let left = before - turned;
            let r2 = left.norm_squared();
            let weight = if scale2.is_finite() { 1.0 / (1.0 + r2 / scale2) } else { 1.0 };
            h += (Matrix3::identity() - turned * turned.transpose()) * weight;
            g += turned.cross(&left) * weight;
            sum += weight * r2;
            weights += weight;
        }
        let step = h.try_inverse()? * g;
        turn = (So3::exp(&step) * rotation).log();
        scale2 = (sum / weights).max(1e-8);
    }
    turn.iter().all(|x| x.is_finite()).then_some(turn)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a camera sees that turns and moves through points some metres away.
    fn pairs(turn: &Vector3<f64>, shift: &Vector3<f64>) -> Vec<(Vector3<f64>, Vector3<f64>)> {
        let points = (0..60).map(|k| {
            let k = f64::from(k);
            Vector3::new((1.3 * k).sin() * 2.0, (2.1 * k).cos() * 1.5, 3.0 + (0.7 * k).sin())
        });
        points
            .map(|p| {
                let now = So3::exp(&-*turn) * (p - shift);
                (p.normalize(), now.normalize())
            })
            .collect()
    }

    /// Adds a pair of images `secs` apart of a body that turns at `rate` while its camera moves by `shift`.
    fn add_pair(
        check: &mut OrientationCheck,
        truth: &So3,
        rate: &Vector3<f64>,
        shift: &Vector3<f64>,
        secs: f64,
    ) {
        let bias = Vector3::new(0.05, -0.03, 0.02);
        let rays = pairs(&(truth.inverse() * (rate * secs)), shift);
        let felt = check.camera_from_body * ((rate + bias) * secs);
        check.add_rates(felt / secs, rotation_of(&rays).unwrap() / secs);
        check.kept.push_back((felt, rays));
        check.kept.truncate(KEPT_PAIRS);
    }

    fn check_with(given: So3, truth: So3) -> Option<f64> {
        let mut check = OrientationCheck::new(&given);
        for k in 0..60 {
            let t = 0.05 * f64::from(k);
            let rate = Vector3::new((2.0 * t).sin(), 0.7 * (3.1 * t).cos(), 0.5 * (1.7 * t).sin());
            let shift = Vector3::new(0.02, -0.01, 0.015) * (2.3 * t).cos();
            add_pair(&mut check, &truth, &rate, &shift, 0.05);
        }
        check.inconsistency_deg()
    }

    #[test]
    fn a_turn_is_read_off_bearings_in_spite_of_translation() {
        let turn = Vector3::new(0.02, -0.01, 0.03);
        let found = rotation_of(&pairs(&turn, &Vector3::new(0.0, 0.0, 0.02))).unwrap();
        assert!((found - turn).norm() < 0.003, "{found}");
    }

    #[test]
    fn turning_about_one_axis_while_moving_does_not_show_an_orientation() {
        // A camera moved sideways in step with its turning: the images show a turn about a second axis, twice as fast.
        let mut check = OrientationCheck::new(&So3::IDENTITY);
        for k in 0..60 {
            let rate = 0.5 * (0.13 * f64::from(k)).sin();
            let ripple = 0.02 * (2.9 * f64::from(k)).sin();
            check.add_rates(Vector3::new(ripple, 0.0, rate), Vector3::new(2.0 * rate, ripple, rate));
            assert_eq!(check.inconsistency_deg(), None, "after {k} images");
        }
    }

    #[test]
    fn a_camera_that_circles_what_it_looks_at_is_not_doubted() {
        // It moves sideways as it turns, twice as fast as would keep the points in place: they seem to turn the other way, about an axis askew.
        let (truth, mut doubts) = (So3::exp(&Vector3::new(0.02, -0.03, 1.55)), 0);
        let mut check = OrientationCheck::new(&truth);
        for k in 0..60 {
            let t = 0.05 * f64::from(k);
            let rate = Vector3::new(0.5 * (1.1 * t).sin(), 0.6 * (0.8 * t).cos(), 0.1 * (1.7 * t).sin());
            let turned = truth.inverse() * rate;
            let shift = Vector3::new(-turned.y, 1.3 * turned.x + 0.8 * turned.y, 0.0) * (2.0 * 3.0 * 0.05);
            add_pair(&mut check, &truth, &rate, &shift, 0.05);
            assert_eq!(check.contradiction_deg(), None, "after {k} images");
            doubts += usize::from(check.inconsistency_deg().is_some());
        }
        assert!(doubts > 0, "the rates alone doubt it");
    }

    #[test]
    fn a_true_orientation_is_not_doubted_and_an_inverted_one_is() {
        let truth = So3::exp(&Vector3::new(0.02, -0.03, 1.55));
        assert_eq!(check_with(truth, truth), None);
        let nearly = truth * So3::exp(&Vector3::new(0.05, -0.05, 0.03));
        assert_eq!(check_with(nearly, truth), None);
        let off = check_with(truth.inverse(), truth).unwrap();
        assert!((off - 177.0).abs() < 12.0, "{off}");
    }
}
