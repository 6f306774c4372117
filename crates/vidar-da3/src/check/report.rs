//! What a check says.

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
    /// Which difference rows are judged by.
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
    /// Allowed difference over deviation, of the `measure`; infinite where nothing is promised.
    pub tolerance: f64,
    /// Which difference is judged.
    pub measure: Measure,
    /// Whether it holds.
    pub verdict: Verdict,
    /// What else there is to say.
    pub note: String,
}

/// Which difference a tolerance is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Measure {
    /// The largest one.
    Largest,
    /// The root of the mean square: what is promised where rounding is not guarded ([`crate::Arithmetic`]). (The official
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
pub enum Verdict {
    /// Within tolerance.
    Holds,
    /// Outside.
    Departs,
    /// Nothing is promised of it in this precision.
    Noted,
}

impl Row {
    /// The judged difference over deviation.
    pub fn ratio(&self) -> f64 {
        match self.measure {
            Measure::Largest => self.max_difference / self.deviation,
            Measure::RootMeanSquare => self.rms_difference / self.deviation,
        }
    }
}

impl CheckReport {
    /// Whether no row departs.
    pub fn holds(&self) -> bool {
        self.rows.iter().all(|row| row.verdict != Verdict::Departs)
    }

    /// The first tensor, in the order of computation, that departs.
    pub fn first_departure(&self) -> Option<&Row> {
        self.rows.iter().find(|row| row.verdict == Verdict::Departs)
    }

    /// The row with the largest ratio among those that are judged.
    pub fn worst(&self) -> Option<&Row> {
        let judged = self.rows.iter().filter(|row| row.verdict != Verdict::Noted);
        judged.max_by(|a, b| a.ratio().total_cmp(&b.ratio()))
    }
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} · {} · {}", self.file.display(), self.model, self.compute)?;
        writeln!(f, "judged by {} over the standard deviation", self.measure)?;
        let width = self.rows.iter().map(|row| row.tensor.len()).max().unwrap_or(0).max(6);
        writeln!(
            f,
            "{:width$}  {:>9}  {:>9}  {:>9}  {:>9}  {:>9}  verdict",
            "tensor", "max|d|", "/std", "99.9%/std", "rms/std", "allowed"
        )?;
        for row in &self.rows {
            let verdict = match row.verdict {
                Verdict::Holds => "holds",
                Verdict::Departs => "DEPARTS",
                Verdict::Noted => "noted",
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
                "{name:width$}  {worst:9.2e}  {largest:9.2e}  {high:9.2e}  {rms:9.2e}  {allowed}  {verdict}"
            )?;
            if row.note.is_empty() { writeln!(f)? } else { writeln!(f, " ({})", row.note)? }
        }
        match self.first_departure() {
            Some(row) => writeln!(f, "first departure: {}", row.tensor),
            None => writeln!(f, "all {} rows hold", self.rows.len()),
        }
    }
}

/// What is promised of a model's outputs, as difference over standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerances {
    /// Of which difference.
    pub measure: Measure,
    /// Depth.
    pub depth: f64,
    /// Everything else; `None` promises nothing.
    pub others: Option<f64>,
    /// Outputs that the manifest calls ill-conditioned.
    pub ill_conditioned: f64,
}

/// Half the tight tolerance: an output that the official code itself rounds this far is ill-conditioned.
const ILL_CONDITIONED: f64 = 1e-4;

impl Tolerances {
    /// Those of a model's precision and size.
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
        let measure = if arithmetic.is_guarded() { Measure::Largest } else { Measure::RootMeanSquare };
        Self { measure, depth: 2e-2, others: None, ill_conditioned: 2e-2 }
    }

    /// Allowed for a tensor, given how far the official code itself rounds it.
    pub(super) fn of_output(&self, name: &str, rounding: Option<f64>) -> Option<f64> {
        let is_depth = matches!(name, "out.depth" | "any.depth");
        let own = if is_depth { Some(self.depth) } else { self.others };
        match rounding {
            Some(rounding) if rounding > ILL_CONDITIONED => own.map(|t| t.max(self.ill_conditioned)),
            _ => own,
        }
    }
}
