//! Loops: landmarks that a later image shows again under another name are measured in it, which constrains the states of both times.
//!
//! The log keeps the grey levels of an image now and then (a *place*). At the solution, the landmarks that one place shows are
//! projected into another one, long before or after it, and their patches aligned there. What is left between prediction and
//! measurement must be one smooth shift of the whole image, as drift makes it; what departs from it is a wrong match. The
//! measurements that remain join the landmarks' other observations, and everything is adjusted again. The loops are kept only if the
//! other measurements do not contradict them.

use super::AdjustmentError;
use super::landmark::Landmark;
use super::linearise::{Cost, cost};
use super::log::TrackLog;
use super::observation;
use super::optimise::{self, OptimiseReport};
use super::problem::{Problem, WhitenedObservation};
use super::progress::Watch;
use crate::backend::whitening;
use crate::frontend::{Feature, FeatureKind, Warp};
use crate::tracking::{HostImage, Measurer};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use vidar_core::{LieGroup, Se3, camera::Pixel};
use vidar_solve::statistics::median_upper;

/// States that are closer in time are constrained by tracks and IMU well enough, s.
const MIN_GAP_SECS: f64 = 5.0;

/// Places that a place is matched with: those that should show most of what it shows. More say the same again, and each costs as much.
const MAX_PARTNERS: usize = 2;

/// Fewest matches between two places, and the least share of the attempts.
const MIN_MATCHES: usize = 12;
const MIN_SHARE: f64 = 0.4;

/// Pyramid level that patches are aligned on: 16 pixels wide, they are the same thing seen again, not a corner like it.
const LEVEL: u8 = 1;

/// Largest difference in distance between two views of a patch, as a ratio, and in direction, as a cosine (35°): beyond it a plane
/// patch does not look the same.
const MAX_ZOOM: f64 = 1.7;
const MIN_SAME_DIRECTION: f64 = 0.82;

/// Departure from the smooth shift beyond which a match is wrong, px: three standard deviations of a match.
const MAX_DEPARTURE_PX: f64 = 2.0;

/// Standard deviation of a match besides what its alignment states, px: a patch that is seen from elsewhere is no plane.
const MATCH_SIGMA_PX: f64 = 0.5;

/// Rounds of matching and adjusting: the second finds what drift had kept out of reach.
const ROUNDS: usize = 2;

/// What the loop constraint of one pair of places may raise the cost of all other measurements by: half of χ² of its six degrees
/// of freedom at 99.9 %. More says that tracks and IMU contradict it.
const MAX_COST_PER_PAIR: f64 = 11.2;

/// A match: which landmark, in which state's image, where.
#[derive(Clone, Copy, Debug)]
struct Match {
    landmark: usize,
    observation: WhitenedObservation,
}

/// The loop constraints that were kept: pairs of places and matches between them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Closed {
    pub(super) pairs: usize,
    pub(super) matches: usize,
}

/// Adds loop constraints between places that show the same, and adjusts again. Without loops, or where they contradict the rest,
/// `problem` is as it was.
pub(super) fn close(
    problem: &mut Problem,
    report: &mut OptimiseReport,
    log: &TrackLog,
    images: &[usize],
    watch: &mut Watch<'_>,
) -> Result<Closed, AdjustmentError> {
    let places: Vec<(usize, &HostImage)> = (images.iter().enumerate())
        .filter_map(|(state, image)| Some((state, log.place_of(*image)?)))
        .collect();
    let mut kept = Closed::default();
    let mut measurer = Measurer::new(NOISE_GRAY);
    let mut constrained = problem.clone();
    let mut constrained_report = *report;
    for _ in 0..ROUNDS {
        let found = matches(problem, &constrained, &places, &mut measurer);
        if found.pairs == 0 || found.all.len() <= kept.matches {
            break;
        }
        // Matches are found anew at the better solution, so that the first round's do not count twice.
        let mut next = problem.clone();
        for (state, place) in next.frames.iter_mut().zip(&constrained.frames) {
            state.body = place.body;
        }
        next.calibration = constrained.calibration.clone();
        for (seen, other) in next.landmarks.iter_mut().zip(&constrained.landmarks) {
            seen.landmark = other.landmark;
        }
        for one in &found.all {
            let observations = &mut next.landmarks[one.landmark].observations;
            let at = observations.partition_point(|o| o.frame < one.observation.frame);
            if observations.get(at).is_none_or(|o| o.frame != one.observation.frame) {
                observations.insert(at, one.observation);
            }
        }
        constrained_report = *report;
        optimise::finish(&mut next, &mut constrained_report, watch)?;
        let raised = without(&next, &found.all).total() - cost(problem).total();
        if raised > MAX_COST_PER_PAIR * found.pairs as f64 {
            break;
        }
        kept = Closed { pairs: found.pairs, matches: found.all.len() };
        constrained = next;
    }
    if kept.pairs > 0 {
        *problem = constrained;
        *report = constrained_report;
    }
    Ok(kept)
}

/// Standard deviation of grey levels that patches are compared with.
const NOISE_GRAY: f64 = 3.0;

/// Cost of all but the matches.
fn without(problem: &Problem, matches: &[Match]) -> Cost {
    let mut rest = problem.clone();
    for one in matches {
        rest.landmarks[one.landmark].observations.retain(|o| o.pixel != one.observation.pixel);
    }
    cost(&rest)
}

/// All matches, and how many pairs of places they are between.
struct LoopMatches {
    pairs: usize,
    all: Vec<Match>,
}

/// Matches between all places that are far apart in time. Landmarks are those of `problem`; `solution` has the same ones with the
/// values that predict best.
fn matches(
    problem: &Problem,
    solution: &Problem,
    places: &[(usize, &HostImage)],
    measurer: &mut Measurer,
) -> LoopMatches {
    let mut shown: Vec<Vec<(usize, Pixel)>> = vec![Vec::new(); problem.frames.len()];
    for (k, seen) in problem.landmarks.iter().enumerate() {
        for observation in &seen.observations {
            shown[observation.frame].push((k, observation.pixel));
        }
    }
    let mut found = LoopMatches { pairs: 0, all: Vec::new() };
    for (from, host) in places {
        let far = |to: usize| {
            let secs = (solution.frames[to].time - solution.frames[*from].time).as_secs_f64();
            secs >= MIN_GAP_SECS
        };
        let mut partners: Vec<(Pair<'_>, Vec<Predicted>)> = places
            .iter()
            .filter(|(to, _)| far(*to))
            .map(|(to, image)| Pair { solution, from: *from, to: *to, host, image })
            .map(|pair| {
                let predicted = pair.all_predicted(&shown[*from]);
                (pair, predicted)
            })
            .filter(|(_, predicted)| predicted.len() >= MIN_MATCHES)
            .collect();
        partners.sort_by_key(|(_, predicted)| std::cmp::Reverse(predicted.len()));
        for (pair, predicted) in partners.iter().take(MAX_PARTNERS) {
            let verified = pair.verified(predicted, measurer);
            found.pairs += usize::from(!verified.is_empty());
            found.all.extend(verified);
        }
    }
    found
}

/// A landmark that another place should show.
struct Predicted {
    landmark: usize,
    /// Where the first place shows it, and where the other should.
    pixel: Pixel,
    expected: Pixel,
    warp: Warp,
}

/// Two places.
struct Pair<'a> {
    solution: &'a Problem,
    from: usize,
    to: usize,
    host: &'a HostImage,
    image: &'a HostImage,
}

impl Pair<'_> {
    fn all_predicted(&self, shown: &[(usize, Pixel)]) -> Vec<Predicted> {
        let one = |(landmark, pixel): &(usize, Pixel)| {
            let (expected, warp) = self.predicted(&self.solution.landmarks[*landmark].landmark, pixel)?;
            Some(Predicted { landmark: *landmark, pixel: *pixel, expected, warp })
        };
        shown.iter().filter_map(one).collect()
    }

    /// The predicted landmarks that were found, where they agree with one shift of the image; none otherwise.
    fn verified(&self, predicted: &[Predicted], measurer: &mut Measurer) -> Vec<Match> {
        let camera = &self.solution.calibration.camera;
        let mut aligned = Vec::with_capacity(predicted.len());
        for Predicted { landmark, pixel, expected, warp } in predicted {
            let Some(feature) = Feature::new(camera, *pixel, LEVEL, FeatureKind::Corner) else { continue };
            let (host, image) = (&self.host.pyramid, &self.image.pyramid);
            if let Ok(found) = measurer.find(host, &feature, warp, expected, image, true) {
                aligned.push((*landmark, *expected, found.measurement));
            }
        }
        let shifts: Vec<(Vector2<f64>, Vector2<f64>)> =
            aligned.iter().map(|(_, expected, m)| (*expected, m.pixel - expected)).collect();
        let fits = smooth(&shifts);
        let agreeing = fits.iter().filter(|fit| **fit).count();
        if agreeing < MIN_MATCHES || (agreeing as f64) < MIN_SHARE * predicted.len() as f64 {
            return Vec::new();
        }
        let one = |(k, _, measured): &(usize, Pixel, crate::frontend::PixelMeasurement)| {
            let covariance = measured.covariance() + Matrix2::identity() * MATCH_SIGMA_PX.powi(2);
            let whitening = whitening(&covariance)?;
            let observation = WhitenedObservation { frame: self.to, pixel: measured.pixel, whitening };
            Some(Match { landmark: *k, observation })
        };
        aligned.iter().zip(&fits).filter(|(_, fit)| **fit).filter_map(|(a, _)| one(a)).collect()
    }

    /// Where the other place should show a landmark, and how its patch is deformed; `None` where it does not, or looks different.
    fn predicted(&self, landmark: &Landmark, pixel: &Pixel) -> Option<(Pixel, Warp)> {
        let Problem { calibration, frames, .. } = self.solution;
        let (from, to) = (&frames[self.from].body, &frames[self.to].body);
        let camera = &calibration.camera;
        // The row is that of where it is seen.
        let mut expected = Vector2::new(0.0, 0.5 * camera.height() as f64);
        for _ in 0..3 {
            expected = observation::project(to, landmark, calibration, &expected)?;
        }
        if !camera.contains(&expected, 12.0) {
            return None;
        }
        let host: Se3 = observation::camera_pose(from, calibration, pixel);
        let other: Se3 = observation::camera_pose(to, calibration, &expected);
        let ray = observation::from_camera(landmark, &host.translation);
        let other_ray = observation::from_camera(landmark, &other.translation);
        let zoom = ray.norm() / other_ray.norm();
        let is_alike = ray.normalize().dot(&other_ray.normalize()) > MIN_SAME_DIRECTION
            && (1.0 / MAX_ZOOM..MAX_ZOOM).contains(&zoom);
        let inverse_distance = landmark.positive_inverse() / ray.norm();
        let feature = Feature::new(camera, *pixel, LEVEL, FeatureKind::Corner).filter(|_| is_alike)?;
        Some((expected, Warp::new(camera, &feature, inverse_distance, &(other.inverse() * host))?))
    }
}

/// Which shifts agree with one affine function of the place in the image: fitted to all, then to those near it.
fn smooth(shifts: &[(Vector2<f64>, Vector2<f64>)]) -> Vec<bool> {
    let median = |k: usize| {
        let mut along: Vec<f64> = shifts.iter().map(|(_, shift)| shift[k]).collect();
        median_upper(&mut along).unwrap_or(0.0)
    };
    let middle = Vector2::from_fn(|k, _| median(k));
    // Within reach of the median a patch is at most twice as far off as a match can be wrong.
    let mut fits: Vec<bool> =
        shifts.iter().map(|(_, shift)| (shift - middle).norm() < 3.0 * MAX_DEPARTURE_PX).collect();
    for _ in 0..3 {
        let mut square = Matrix3::<f64>::identity() * 1e-6;
        let mut sums = [Vector3::<f64>::zeros(); 2];
        for ((at, shift), _) in shifts.iter().zip(&fits).filter(|(_, fit)| **fit) {
            let row = Vector3::new(1.0, 1e-2 * at.x, 1e-2 * at.y);
            square += row * row.transpose();
            sums[0] += row * shift.x;
            sums[1] += row * shift.y;
        }
        let Some(inverse) = square.try_inverse() else { return vec![false; shifts.len()] };
        let [x, y] = sums.map(|sum| inverse * sum);
        let departure = |(at, shift): &(Vector2<f64>, Vector2<f64>)| {
            let row = Vector3::new(1.0, 1e-2 * at.x, 1e-2 * at.y);
            (shift - Vector2::new(x.dot(&row), y.dot(&row))).norm()
        };
        fits = shifts.iter().map(|shift| departure(shift) < MAX_DEPARTURE_PX).collect();
    }
    fits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shifts_that_depart_from_a_smooth_one_are_left_out() {
        let place = |k: usize| Vector2::new(40.0 * (k % 8) as f64, 45.0 * (k / 8) as f64);
        let shift = |k: usize| {
            let at = place(k);
            let drift = Vector2::new(1.5 + 0.004 * at.x - 0.003 * at.y, -0.7 + 0.005 * at.y);
            if k.is_multiple_of(5) { drift + Vector2::new(4.0, -3.0) } else { drift }
        };
        let shifts: Vec<_> = (0..40).map(|k| (place(k), shift(k))).collect();
        let fits = smooth(&shifts);
        for (k, fit) in fits.iter().enumerate() {
            assert_eq!(*fit, !k.is_multiple_of(5), "match {k}");
        }
    }
}
