use super::*;
use nalgebra::{Matrix2, Vector2};
use std::convert::Infallible;

const SCHEDULE: Schedule = Schedule {
    first: 1e-3,
    least: 1e-12,
    on_accepted: Decrease::Factor(0.2),
    on_rejected: Increase::by(10.0),
    on_unsolvable: Some(Increase::by(10.0)),
};
const LIMITS: Limits = Limits { trials: 200, ..Limits::NONE };
const START: Vector2<f64> = Vector2::new(-1.2, 1.0);

/// Rosenbrock's valley, `½ (10 (y − x²))² + ½ (1 − x)²`: least at (1, 1), a bent way down from [`START`].
struct Valley {
    at: Vector2<f64>,
    jacobian: Matrix2<f64>,
    promised: f64,
    trials: Vec<Trial>,
}

fn residual(at: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(10.0 * (at.y - at.x * at.x), 1.0 - at.x)
}

fn cost(at: &Vector2<f64>) -> f64 {
    0.5 * residual(at).norm_squared()
}

/// Descends from [`START`].
fn descend(schedule: &Schedule, limits: &Limits) -> (Valley, Report) {
    let mut valley = Valley { at: START, jacobian: Matrix2::zeros(), promised: 0.0, trials: Vec::new() };
    let Ok(report) = minimise(&mut valley, cost(&START), schedule, limits);
    assert_eq!((report.cost_before, report.cost_after), (cost(&START), cost(&valley.at)));
    assert_eq!(report.trials, valley.trials.len());
    (valley, report)
}

impl LeastSquares for Valley {
    type Error = Infallible;
    type Values = Vector2<f64>;

    fn linearise(&mut self, cost: f64) -> Result<f64, Infallible> {
        self.jacobian = Matrix2::new(-20.0 * self.at.x, 10.0, -1.0, 0.0);
        Ok(cost)
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, Vector2<f64>)>, Infallible> {
        let gradient = self.jacobian.transpose() * residual(&self.at);
        let damped = self.jacobian.transpose() * self.jacobian + Matrix2::identity() * damping;
        let Some(cholesky) = damped.cholesky() else { return Ok(None) };
        let step = cholesky.solve(&-gradient);
        self.promised = 0.5 * step.dot(&(damping * step - gradient));
        let next = self.at + step;
        Ok(Some((cost(&next), next)))
    }

    fn promised_decrease(&self) -> f64 {
        self.promised
    }

    fn accept(&mut self, values: Vector2<f64>) {
        self.at = values;
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        self.trials.push(*trial);
        trial.is_accepted && trial.cost_after < 1e-20
    }
}

/// A problem that answers trials as written down: with a cost, or that the system cannot be solved.
struct Script {
    answers: Vec<Option<f64>>,
    /// What the model's changes add to the cost whenever it is linearised, and when a step is taken back.
    drift: [f64; 2],
    dampings: Vec<f64>,
    linearised: usize,
}

impl Script {
    fn new(answers: &[Option<f64>]) -> Self {
        Self { answers: answers.to_vec(), drift: [0.0; 2], dampings: Vec::new(), linearised: 0 }
    }

    /// From a cost of 5.
    fn run(&mut self, schedule: &Schedule, limits: Limits) -> Result<Report, &'static str> {
        let trials = limits.trials.min(self.answers.len());
        minimise(self, 5.0, schedule, &Limits { trials, ..limits })
    }
}

impl LeastSquares for Script {
    type Error = &'static str;
    type Values = ();

    fn linearise(&mut self, cost: f64) -> Result<f64, &'static str> {
        self.linearised += 1;
        Ok(cost + self.drift[0])
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, ())>, &'static str> {
        self.dampings.push(damping);
        let cost = self.answers[self.dampings.len() - 1];
        if cost == Some(f64::NEG_INFINITY) { Err("no camera") } else { Ok(cost.map(|cost| (cost, ()))) }
    }

    fn promised_decrease(&self) -> f64 {
        1.0
    }

    fn accept(&mut self, (): ()) {}

    fn reject(&mut self, cost: f64, _: f64) -> f64 {
        cost + self.drift[1]
    }

    fn has_converged(&mut self, _: &Trial) -> bool {
        false
    }
}

#[test]
fn the_valley_is_descended_to_its_bottom_by_either_rule() {
    let on_rejected = Increase { acceleration: 2.0, ..Increase::by(2.0) };
    let nielsen = Schedule { on_accepted: Decrease::GainRatio, on_rejected, ..SCHEDULE };
    for schedule in [SCHEDULE, nielsen] {
        let (valley, report) = descend(&schedule, &LIMITS);
        assert!(report.converged && report.trials < 60, "{report:?}");
        assert!((valley.at - Vector2::new(1.0, 1.0)).norm() < 1e-8, "{}", valley.at);
    }
}

#[test]
fn a_rejected_step_raises_the_damping_and_an_accepted_one_lowers_it() {
    let (valley, report) = descend(&SCHEDULE, &LIMITS);
    let accepted = valley.trials.iter().filter(|t| t.is_accepted).count();
    assert!(accepted < valley.trials.len(), "{report:?}");
    assert_eq!(report.iterations, accepted);
    for pair in valley.trials.windows(2) {
        let (now, next) = (pair[0], pair[1]);
        assert_eq!(now.is_accepted, now.decrease() > 0.0);
        let (factor, cost) = if now.is_accepted { (0.2, now.cost_after) } else { (10.0, now.cost_before) };
        assert_eq!(next.damping, (now.damping * factor).max(SCHEDULE.least));
        assert_eq!(next.cost_before, cost);
    }
}

#[test]
fn a_system_that_cannot_be_solved_is_damped_more_or_is_the_end() {
    let answers = [None, None, Some(4.0)];
    let damped = Increase { least: 1.0, ..Increase::by(10.0) };
    let mut script = Script::new(&answers);
    let report = script.run(&Schedule { on_unsolvable: Some(damped), ..SCHEDULE }, LIMITS).unwrap();
    assert_eq!(script.dampings, [1e-3, 1.0, 10.0]);
    assert_eq!((report.cost_after, report.damping, report.iterations), (4.0, 2.0, 1));
    let report = Script::new(&answers).run(&Schedule { on_unsolvable: None, ..SCHEDULE }, LIMITS).unwrap();
    assert_eq!((report.trials, report.cost_after, report.converged), (1, 5.0, false));
}

#[test]
fn a_cost_that_is_no_number_is_not_taken_and_an_error_is_handed_on() {
    let mut script = Script::new(&[Some(f64::NAN), Some(f64::INFINITY), Some(5.0)]);
    let report = script.run(&SCHEDULE, LIMITS).unwrap();
    assert_eq!((report.cost_after, report.iterations, script.linearised), (5.0, 1, 1));
    assert_eq!(Script::new(&[Some(f64::NEG_INFINITY)]).run(&SCHEDULE, LIMITS), Err("no camera"));
}

#[test]
fn each_limit_ends_it() {
    let (none, run) = (Limits::NONE, |answers: &[Option<f64>], limits| {
        let mut script = Script::new(answers);
        let report = script.run(&SCHEDULE, limits).unwrap();
        assert!(!report.converged);
        (report.trials, report.iterations, script.linearised)
    });
    let falling: Vec<Option<f64>> = (0..9).map(|k| Some(4.0 - 0.1 * f64::from(k))).collect();
    let rising = [Some(6.0); 9];
    assert_eq!(run(&falling, Limits { trials: 0, ..none }), (0, 0, 1));
    assert_eq!(run(&falling, Limits { iterations: 0, ..none }), (0, 0, 1));
    // The values after the last step are not linearised: nothing is tried from there.
    assert_eq!(run(&falling, Limits { trials: 3, ..none }), (3, 3, 3));
    assert_eq!(run(&falling, Limits { iterations: 4, ..none }), (4, 4, 4));
    assert_eq!(run(&falling, Limits { trials_per_iteration: 1, ..none }), (9, 9, 9));
    assert_eq!(run(&rising, Limits { iterations: 1, ..none }), (9, 1, 1));
    assert_eq!(run(&rising, Limits { trials_per_iteration: 8, ..none }), (8, 1, 1));
    assert_eq!(run(&rising, Limits { damping: 0.5, ..none }), (3, 1, 1));
    let mut mixed = falling;
    mixed.extend(rising);
    assert_eq!(run(&mixed, Limits { trials_per_iteration: 2, ..none }), (11, 10, 10));
}

#[test]
fn damping_stays_within_its_bounds() {
    let on_rejected = Increase { least: 0.5, most: 20.0, ..Increase::by(10.0) };
    let mut script = Script::new(&[Some(6.0), Some(6.0), Some(6.0), Some(4.0), Some(3.0), Some(2.0)]);
    let report = script.run(&Schedule { least: 3.0, on_rejected, ..SCHEDULE }, LIMITS).unwrap();
    assert_eq!(script.dampings, [1e-3, 0.5, 5.0, 20.0, 4.0, 3.0]);
    assert_eq!(report.damping, 3.0);
}

#[test]
fn nielsens_damping_follows_the_gain_ratio_and_grows_ever_faster_while_steps_fail() {
    // Decrease over the one promised, and the factor.
    for (ratio, factor) in
        [(-0.1, 2.0), (0.0, 2.0), (0.25, 1.125), (0.5, 1.0), (0.75, 0.875), (1.0, 1.0 / 3.0)]
    {
        assert_eq!(nielsen(3.0 * ratio, 3.0), factor, "{ratio}");
    }
    let on_rejected = Increase { acceleration: 2.0, ..Increase::by(2.0) };
    let schedule = Schedule { first: 1.0, on_accepted: Decrease::GainRatio, on_rejected, ..SCHEDULE };
    let mut script = Script::new(&[Some(6.0), Some(6.0), Some(6.0), Some(4.5), Some(6.0), Some(6.0)]);
    let report = script.run(&schedule, LIMITS).unwrap();
    // A half of what was promised leaves the damping as it is; then the growth begins again.
    assert_eq!(script.dampings, [1.0, 2.0, 8.0, 64.0, 64.0, 128.0]);
    assert_eq!(report.damping, 512.0);
}

#[test]
fn a_model_that_changes_is_compared_with_its_own_cost() {
    let mut script = Script::new(&[Some(5.5), Some(6.0), Some(6.5), Some(7.0)]);
    script.drift = [1.0, 0.25];
    let report = script.run(&SCHEDULE, LIMITS).unwrap();
    // 5 is 6 when linearised, 5.5 is accepted, is 6.5 when linearised; 6 likewise is 7; 6.5 is 7.5; 7 is taken.
    assert_eq!((report.cost_before, report.cost_after, report.iterations), (6.0, 7.0, 4));
    let mut script = Script::new(&[Some(6.1), Some(6.2)]);
    script.drift = [1.0, 0.25];
    let report = script.run(&SCHEDULE, LIMITS).unwrap();
    assert_eq!((report.cost_after, report.trials, report.iterations), (6.2, 2, 1));
}
