//! Levenberg-Marquardt: minimises a sum of squares by damped steps, each of which is tried before it is taken.
//!
//! A problem says how to linearise itself, to try a step and to go back ([`LeastSquares`]), a [`Schedule`] how the damping
//! follows the trials, [`Limits`] when to give up. The damping has no unit: what it multiplies, the system's diagonal or
//! fixed weights, is the problem's own affair. Nothing here allocates.

/// What is minimised, with the values it has.
pub trait LeastSquares {
    /// Why a minimisation cannot go on.
    type Error;

    /// Where a trial leads: what [`accept`](Self::accept) takes over. `()` where trials move the problem itself.
    type Values;

    /// Prepares trials from the present values, whose cost is `cost`; the cost there. They differ where linearising changes
    /// the model.
    ///
    /// # Errors
    /// The caller of [`minimise`] gets them.
    fn linearise(&mut self, cost: f64) -> Result<f64, Self::Error> {
        Ok(cost)
    }

    /// Solves the damped system; the values after its step, and their cost, infinite where they are not allowed. `None`
    /// where the system cannot be solved.
    ///
    /// # Errors
    /// The caller of [`minimise`] gets them.
    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, Self::Values)>, Self::Error>;

    /// The decrease of the cost that the linear model promised of the last trial; [`Decrease::GainRatio`] alone needs it.
    fn promised_decrease(&self) -> f64 {
        0.0
    }

    /// Whether a trial is taken.
    fn improves(&self, cost_before: f64, cost_after: f64) -> bool {
        cost_after < cost_before
    }

    /// Takes the values of the last trial.
    fn accept(&mut self, values: Self::Values);

    /// Goes back to the values before the last trial, whose cost was `cost`; the next trial from there has `next_damping`.
    /// The cost there: it differs where the trial has changed the model.
    fn reject(&mut self, cost: f64, next_damping: f64) -> f64 {
        let _ = next_damping;
        cost
    }

    /// Whether no further step is worth it. Asked after each trial that has a cost, accepted or rejected.
    fn has_converged(&mut self, trial: &Trial) -> bool;
}

/// One step that was tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// Damping used.
    pub damping: f64,
    /// Cost before the step.
    pub cost_before: f64,
    /// Cost after it.
    pub cost_after: f64,
    /// Whether it was taken.
    pub is_accepted: bool,
}

impl Trial {
    /// How much lower the cost is after the step; below 0 where it is higher.
    pub fn decrease(&self) -> f64 {
        self.cost_before - self.cost_after
    }
}

/// How the damping follows what happens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Damping of the first trial.
    pub first: f64,
    /// Least damping after an accepted step.
    pub least: f64,
    /// After an accepted step.
    pub on_accepted: Decrease,
    /// After a rejected step.
    pub on_rejected: Increase,
    /// After a system that cannot be solved; `None` ends the minimisation there.
    pub on_unsolvable: Option<Increase>,
}

/// What an accepted step does to the damping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decrease {
    /// Multiplies it.
    Factor(f64),
    /// Multiplies it by `1 − (2ρ − 1)³` within [1/3, 2], where ρ is the decrease over the one promised (Nielsen, "Damping
    /// parameter in Marquardt's method", IMM-REP-1999-05).
    GainRatio,
}

/// What a rejected step or an unsolvable system does to the damping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Increase {
    /// Multiplies it.
    pub factor: f64,
    /// Multiplies the factor with every further failure from the same values: 1 for none, above 1 as Nielsen does.
    pub acceleration: f64,
    /// Least damping afterwards.
    pub least: f64,
    /// Most damping afterwards.
    pub most: f64,
}

impl Increase {
    /// By a constant factor, without bounds.
    pub const fn by(factor: f64) -> Self {
        Self { factor, acceleration: 1.0, least: 0.0, most: f64::INFINITY }
    }
}

/// When a minimisation ends without having converged: at the first limit that it reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Trials, those that are rejected included.
    pub trials: usize,
    /// Values that trials start from.
    pub iterations: usize,
    /// Trials from the same values.
    pub trials_per_iteration: usize,
    /// Largest damping that is tried.
    pub damping: f64,
}

impl Limits {
    /// No limit: the problem must converge.
    pub const NONE: Self = Self {
        trials: usize::MAX,
        iterations: usize::MAX,
        trials_per_iteration: usize::MAX,
        damping: f64::INFINITY,
    };
}

/// What a minimisation did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Report {
    /// Trials.
    pub trials: usize,
    /// Values that trials started from: accepted steps, and one more where the last trial failed.
    pub iterations: usize,
    /// Cost at the start.
    pub cost_before: f64,
    /// Cost at the end.
    pub cost_after: f64,
    /// Damping that a next trial would have had.
    pub damping: f64,
    /// Whether the problem said that it has converged; else a limit ended it, or a system that cannot be solved.
    pub converged: bool,
}

/// Minimises a problem, whose values have this cost to begin with; it is then at the best ones found.
///
/// # Errors
/// Those of the problem.
pub fn minimise<P: LeastSquares>(
    problem: &mut P,
    cost: f64,
    schedule: &Schedule,
    limits: &Limits,
) -> Result<Report, P::Error> {
    let cost = problem.linearise(cost)?;
    let mut report = Report {
        trials: 0,
        iterations: 0,
        cost_before: cost,
        cost_after: cost,
        damping: schedule.first,
        converged: false,
    };
    let (mut failures, mut acceleration) = (0, 1.0);
    while report.trials < limits.trials
        && failures < limits.trials_per_iteration
        && (failures > 0 || report.iterations < limits.iterations)
        && report.damping <= limits.damping
        && !report.converged
    {
        if failures == 0 {
            if report.iterations > 0 {
                report.cost_after = problem.linearise(report.cost_after)?;
            }
            report.iterations += 1;
        }
        report.trials += 1;
        let (damping, cost_before) = (report.damping, report.cost_after);
        let (cost_after, is_accepted) = match problem.try_step(damping)? {
            Some((cost_after, values)) if problem.improves(cost_before, cost_after) => {
                let factor = match schedule.on_accepted {
                    Decrease::Factor(factor) => factor,
                    Decrease::GainRatio => nielsen(cost_before - cost_after, problem.promised_decrease()),
                };
                problem.accept(values);
                report.damping = (damping * factor).max(schedule.least);
                report.cost_after = cost_after;
                (failures, acceleration) = (0, 1.0);
                (Some(cost_after), true)
            }
            rejected => {
                let increase = match rejected {
                    Some(_) => Some(schedule.on_rejected),
                    None => schedule.on_unsolvable,
                };
                let Some(increase) = increase else { break };
                let raised = damping * (increase.factor * acceleration);
                report.damping = raised.max(increase.least).min(increase.most);
                report.cost_after = problem.reject(cost_before, report.damping);
                (failures, acceleration) = (failures + 1, acceleration * increase.acceleration);
                (rejected.map(|(cost_after, _)| cost_after), false)
            }
        };
        if let Some(cost_after) = cost_after {
            report.converged =
                problem.has_converged(&Trial { damping, cost_before, cost_after, is_accepted });
        }
    }
    Ok(report)
}

/// The factor of [`Decrease::GainRatio`].
fn nielsen(decrease: f64, promised: f64) -> f64 {
    let ratio = decrease / promised.max(1e-300);
    (1.0 - (2.0 * ratio - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0)
}

#[cfg(test)]
mod tests;
