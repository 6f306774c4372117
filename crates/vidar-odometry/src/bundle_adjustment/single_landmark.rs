//! One landmark with all states held.
//!
//! A landmark of few observations has other minima beside the one that it is in, and no step of all unknowns together is good for it where the
//! linear step leads beyond: rejected for this one landmark, the step of all shrank to nothing. Where a step makes a landmark worse, it is
//! minimised alone before the step is judged (embedded point iterations: Jeong, Nistér, Steedly, Szeliski, Kweon 2012, "Pushing the
//! envelope of modern methods for bundle adjustment").

use super::landmark::Landmark;
use super::linearise::landmark_cost;
use super::observation;
use super::problem::{ObservedLandmark, Problem};
use super::reprojections::KERNEL;
use nalgebra::{Matrix3, Vector3};
use std::convert::Infallible;
use vidar_solve::levenberg_marquardt::{self, Decrease, Increase, LeastSquares, Limits, Schedule, Trial};

/// A landmark that a step makes worse by less than this, in units of squared standard deviations, is left: all of them move somewhat.
const WORSE: f64 = 0.05;

const SCHEDULE: Schedule = Schedule {
    first: 1e-3,
    least: 1e-9,
    on_accepted: Decrease::Factor(0.1),
    on_rejected: Increase::by(10.0),
    on_unsolvable: None,
};

/// From a minimum nearby, few steps lead to the new one.
const LIMITS: Limits = Limits { trials: 12, ..Limits::NONE };

/// The minimisation ends when a step lowers the cost by less than this share.
const SETTLED_SHARE: f64 = 1e-3;

/// The better one of where a landmark is after a step, and of the minimum that follows from where it was `before`, with its cost; `cost_before`
/// is its cost before the states had moved.
pub(super) fn refined(
    problem: &Problem,
    seen: &ObservedLandmark,
    before: Landmark,
    cost_before: f64,
) -> (Landmark, f64) {
    let stepped = landmark_cost(problem, seen, &seen.landmark);
    if stepped <= cost_before + WORSE {
        return (seen.landmark, stepped);
    }
    let mut alone =
        Alone { problem, seen, landmark: before, h: Matrix3::zeros(), gradient: Vector3::zeros() };
    let begin = landmark_cost(problem, seen, &before);
    match levenberg_marquardt::minimise(&mut alone, begin, &SCHEDULE, &LIMITS) {
        Ok(report) if report.cost_after < stepped => (alone.landmark, report.cost_after),
        _ => (seen.landmark, stepped),
    }
}

struct Alone<'a> {
    problem: &'a Problem,
    seen: &'a ObservedLandmark,
    landmark: Landmark,
    h: Matrix3<f64>,
    gradient: Vector3<f64>,
}

impl LeastSquares for Alone<'_> {
    type Error = Infallible;
    type Values = Landmark;

    fn linearise(&mut self, cost: f64) -> Result<f64, Infallible> {
        (self.h, self.gradient) = (Matrix3::zeros(), Vector3::zeros());
        for measured in &self.seen.observations {
            let body = &self.problem.frames[measured.frame].body;
            let calibration = &self.problem.calibration;
            let Some(at) = observation::linearise(body, &self.landmark, calibration, &measured.pixel) else {
                continue;
            };
            let residual = measured.whitening * (at.pixel - measured.pixel);
            let jacobian = measured.whitening * at.by_landmark;
            let weight = KERNEL.weight(residual.norm_squared());
            self.h += weight * jacobian.transpose() * jacobian;
            self.gradient += weight * jacobian.transpose() * residual;
        }
        Ok(cost)
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, Landmark)>, Infallible> {
        let damped = self.h + Matrix3::from_diagonal(&(self.h.diagonal() * damping).add_scalar(1e-9));
        Ok(self.landmark.inverse_of(&damped, &self.gradient).map(|inverse| {
            let moved = self.landmark.plus(&-(inverse * self.gradient));
            (landmark_cost(self.problem, self.seen, &moved), moved)
        }))
    }

    fn accept(&mut self, landmark: Landmark) {
        self.landmark = landmark;
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        trial.is_accepted && trial.decrease() < SETTLED_SHARE * trial.cost_before
    }
}

#[cfg(test)]
mod tests {
    use super::super::image_prior::ImagePrior;
    use super::super::observation::tests::example;
    use super::super::problem::{CalibrationPrior, FrameState, WhitenedObservation};
    use super::*;
    use nalgebra::Matrix2;
    use vidar_core::Timestamp;

    /// Three states, 0.2 m from one to the next, that see one landmark where it is.
    fn problem() -> Problem {
        let (body, landmark, calibration, measured) = example();
        let mut frames = Vec::new();
        let mut observations = Vec::new();
        for frame in 0..3 {
            let mut body = body;
            body.state.world_from_body.translation += Vector3::new(0.2, 0.05, -0.1) * frame as f64;
            let mut pixel = measured;
            // The row decides on the instant, which decides on the row.
            for _ in 0..20 {
                pixel = observation::project(&body, &landmark, &calibration, &pixel).unwrap();
            }
            let whitening = Matrix2::identity();
            observations.push(WhitenedObservation { frame, pixel, whitening });
            frames.push(FrameState { time: Timestamp::from_nanos(frame as i64), body, inertial: None });
        }
        let sigmas = vec![0.0; calibration.dim()];
        let prior = CalibrationPrior { sigmas, mean: calibration.clone(), image: ImagePrior::default() };
        let gauge = (0, frames[0].body.state);
        let landmarks = vec![ObservedLandmark { landmark, observations }];
        Problem { frames, landmarks, calibration, prior, active: Vec::new(), gauge }
    }

    #[test]
    fn a_landmark_that_a_step_leads_astray_follows_the_states() {
        let mut problem = problem();
        let truth = problem.landmarks[0].landmark;
        let before = landmark_cost(&problem, &problem.landmarks[0], &truth);
        assert!(before < 1e-9, "{before}");
        for frame in &mut problem.frames[1..] {
            frame.body.state.world_from_body.translation += Vector3::new(0.02, -0.01, 0.01);
        }
        problem.landmarks[0].landmark.inverse_distance *= 0.2;
        let seen = &problem.landmarks[0];
        let (landmark, found) = refined(&problem, seen, truth, before);
        assert_eq!(found, landmark_cost(&problem, seen, &landmark));
        let unmoved = landmark_cost(&problem, seen, &truth);
        assert!(
            found < 0.5 * unmoved && found < landmark_cost(&problem, seen, &seen.landmark),
            "{found} {unmoved}"
        );
        // It is at a minimum.
        for k in 0..3 {
            for step in [-1e-4, 1e-4] {
                let moved = landmark.plus(&Vector3::ith(k, step));
                assert!(landmark_cost(&problem, seen, &moved) > found - 1e-4 * found, "{k} {step}");
            }
        }
    }

    #[test]
    fn a_landmark_may_be_past_infinity() {
        let mut problem = problem();
        // What noise makes of one that is far: the images see it where no point is.
        let found_there = Landmark { inverse_distance: -0.02, ..problem.landmarks[0].landmark };
        for observation in &mut problem.landmarks[0].observations {
            let body = &problem.frames[observation.frame].body;
            for _ in 0..20 {
                observation.pixel =
                    observation::project(body, &found_there, &problem.calibration, &observation.pixel)
                        .unwrap();
            }
        }
        let (landmark, cost) = refined(&problem, &problem.landmarks[0], found_there.plus(&Vector3::z()), 0.0);
        assert!((landmark.inverse_distance + 0.02).abs() < 1e-4 && cost < 1e-3, "{landmark:?} {cost}");
        assert_eq!(landmark.positive_inverse(), super::super::landmark::MIN_INVERSE_DISTANCE);
    }

    #[test]
    fn a_landmark_that_is_no_worse_stays_where_the_step_leads() {
        let mut problem = problem();
        let truth = problem.landmarks[0].landmark;
        problem.landmarks[0].landmark = truth.plus(&Vector3::new(1e-5, 0.0, 0.0));
        let seen = &problem.landmarks[0];
        let (stays, _) = refined(&problem, seen, truth, 0.0);
        assert_eq!(stays.direction, seen.landmark.direction);
        // The cost of what projects nowhere is bounded, so that a landmark behind the camera is brought back.
        problem.landmarks[0].landmark.direction = -truth.direction;
        let seen = &problem.landmarks[0];
        assert!(landmark_cost(&problem, seen, &refined(&problem, seen, truth, 0.0).0) < 1e-6);
    }
}
