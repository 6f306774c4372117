//! Results of a check.

use crate::config::Variant;
use crate::da3::Da3;
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;

/// The rows of one reference file.
#[derive(Clone, Debug, Serialize)]
pub struct CheckReport {
    /// The file.
    pub file: PathBuf,
    /// The network.
    pub model: String,
    /// Kernels and precision ([`crate::Arithmetic`]).
    pub compute: String,
    /// The difference that rows are evaluated by.
    pub measure: Measure,
    /// One row a tensor, in the order of computation.
    pub rows: Vec<Row>,
}

/// One compared tensor.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Its name in the reference.
    pub tensor: String,
    /// Largest difference.
    pub max_difference: f64,
    /// The difference that one number in a thousand exceeds.
    pub p999_difference: f64,
    /// Root mean square of the differences.
    pub rms_difference: f64,
    /// Standard deviation of the reference (its size, for a constant one).
    pub deviation: f64,
    /// Largest allowed difference over deviation, of the `measure`; infinite where there is no tolerance.
    pub tolerance: f64,
    /// The difference that is evaluated.
    pub measure: Measure,
    /// Whether it passed.
    pub result: CheckResult,
    /// Remarks.
    pub note: String,
}

/// The difference that a tolerance bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Measure {
    /// The largest one.
    Largest,
    /// The root mean square: bounded where the largest error is not ([`crate::Arithmetic`]). (The official
    /// code in bf16 is off by up to 0.054 of the deviation of depth at single pixels, 0.009 in the mean square, on the
    /// same references.)
    RootMeanSquare,
}

impl fmt::Display for Measure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Largest => "the largest difference",
            Self::RootMeanSquare => "the root mean square of the differences",
        })
    }
}

/// Outcome of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum CheckResult {
    /// Within tolerance.
    Passed,
    /// Outside.
    Failed,
    /// This precision has no tolerance for it.
    NotEvaluated,
}

impl Row {
    /// The evaluated difference over deviation.
    pub fn ratio(&self) -> f64 {
        match self.measure {
            Measure::Largest => self.max_difference / self.deviation,
            Measure::RootMeanSquare => self.rms_difference / self.deviation,
        }
    }
}

impl CheckReport {
    /// Whether no row failed.
    pub fn passed(&self) -> bool {
        self.rows.iter().all(|row| row.result != CheckResult::Failed)
    }

    /// The first tensor, in the order of computation, that failed.
    pub fn first_failure(&self) -> Option<&Row> {
        self.rows.iter().find(|row| row.result == CheckResult::Failed)
    }

    /// The row with the largest ratio among those that are evaluated.
    pub fn worst(&self) -> Option<&Row> {
        let evaluated = self.rows.iter().filter(|row| row.result != CheckResult::NotEvaluated);
        evaluated.max_by(|a, b| a.ratio().total_cmp(&b.ratio()))
    }
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} · {} · {}", self.file.display(), self.model, self.compute)?;
        writeln!(f, "evaluated by {} over the standard deviation", self.measure)?;
        let width = self.rows.iter().map(|row| row.tensor.len()).max().unwrap_or(0).max(6);
        writeln!(
            f,
            "{:width$}  {:>9}  {:>9}  {:>9}  {:>9}  {:>9}  result",
            "tensor", "max|d|", "/std", "99.9%/std", "rms/std", "allowed"
        )?;
        for row in &self.rows {
            let result = match row.result {
                CheckResult::Passed => "passed",
                CheckResult::Failed => "FAILED",
                CheckResult::NotEvaluated => "not evaluated",
            };
            let allowed = if row.tolerance.is_finite() {
                format!("{:9.1e}", row.tolerance)
            } else {
                format!("{:>9}", "-")
            };
            let (name, worst) = (&row.tensor, row.max_difference);
            let [largest, high, rms] =
                [worst, row.p999_difference, row.rms_difference].map(|difference| difference / row.deviation);
            write!(
                f,
                "{name:width$}  {worst:9.2e}  {largest:9.2e}  {high:9.2e}  {rms:9.2e}  {allowed}  {result}"
            )?;
            if row.note.is_empty() { writeln!(f)? } else { writeln!(f, " ({})", row.note)? }
        }
        match self.first_failure() {
            Some(row) => writeln!(f, "first failure: {}", row.tensor),
            None => writeln!(f, "all {} rows pass", self.rows.len()),
        }
    }
}

/// Tolerances of a model's outputs, as difference over standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerances {
    /// The difference that they bound.
    pub measure: Measure,
    /// Depth.
    pub depth: f64,
    /// Everything else; `None` is not evaluated.
    pub others: Option<f64>,
    /// Outputs that the manifest marks as ill-conditioned.
    pub ill_conditioned: f64,
}

/// Half the tight tolerance: an output that the official code itself rounds this far is ill-conditioned.
const ILL_CONDITIONED: f64 = 1e-4;

impl Tolerances {
    /// The tolerances for a model's precision and size.
    pub fn of(model: &Da3) -> Self {
        let is_giant = matches!(model.config().variant, Some(Variant::Giant | Variant::NestedGiantLarge));
        let arithmetic = model.arithmetic();
        if arithmetic.is_exact() {
            let tight = if is_giant { 1e-3 } else { 2e-4 };
            return Self {
                measure: Measure::Largest,
                depth: tight,
                others: Some(tight),
                ill_conditioned: 1e-3,
            };
        }
        let measure =
            if arithmetic.bounds_largest_error() { Measure::Largest } else { Measure::RootMeanSquare };
        Self { measure, depth: 2e-2, others: None, ill_conditioned: 2e-2 }
    }

    /// The tolerance of a tensor, given the rounding error of the official code itself.
    pub(super) fn of_output(&self, name: &str, rounding: Option<f64>) -> Option<f64> {
        let is_depth = matches!(name, "out.depth" | "any.depth");
        let own = if is_depth { Some(self.depth) } else { self.others };
        match rounding {
            Some(rounding) if rounding > ILL_CONDITIONED => own.map(|t| t.max(self.ill_conditioned)),
            _ => own,
        }
    }
}
