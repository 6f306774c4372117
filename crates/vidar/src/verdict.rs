//! How far a result may be trusted: the bounds, the reasons, and what is said of the scale. Terminal, JSON and report show
//! the same verdict.

use crate::quality::TrackQuality;
use serde::Serialize;
use vidar_core::Warning;
use vidar_eval::TrajectoryReport;
use vidar_view::{Assessment, AssessmentLevel};

/// Above this σ(ln s) lengths are not metres: glossary, *provisional scale*.
pub const METRIC_SCALE_STD: f64 = 0.03;
/// A good result knows its scale to 2 %, and |ln s| against ground truth is not larger. Health OK has the same bound.
pub const GOOD_SCALE: f64 = 0.02;
/// A good result has states for this share of the recording. Ordinary recordings reach 0.81 to 0.96, the rest is the start.
pub const GOOD_COVERAGE: f64 = 0.8;
/// A good result is of health OK in this share of its states.
pub const GOOD_HEALTH: f64 = 0.9;
/// F of the rigid fit, at the largest threshold, of a good map and of one that has little to do with its reference.
pub const GOOD_F: f64 = 0.5;
/// See [`GOOD_F`].
pub const BAD_F: f64 = 0.1;
/// A map below this precision does not show what the reference shows.
pub const LEAST_PRECISION: f64 = 0.2;
/// A surface smaller than this share of what one view sees is almost no map.
pub const LEAST_AREA: f64 = 0.1;

/// Level of trust, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Level {
    /// Compared, and every bound is met.
    Good,
    /// No bound is missed, but nothing was compared.
    NotEvaluated,
    /// A bound is missed.
    Caution,
    /// Not to be used as it is.
    Bad,
}

/// Level and reasons.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verdict {
    /// The worst level of all reasons.
    pub level: Level,
    /// Why, worst first.
    pub reasons: Vec<String>,
}

/// Collects reasons.
#[derive(Debug, Default)]
pub struct Findings(Vec<(Level, String)>);

impl Findings {
    /// Adds a reason.
    pub fn add(&mut self, level: Level, reason: impl Into<String>) {
        self.0.push((level, reason.into()));
    }

    /// Adds a reason where `holds`.
    pub fn when(&mut self, holds: bool, level: Level, reason: impl FnOnce() -> String) {
        if holds {
            self.add(level, reason());
        }
    }

    /// The verdict: what was compared says how good it is, everything else how far that may be trusted.
    pub fn verdict(mut self, compared: Option<String>) -> Verdict {
        match compared {
            Some(scores) => self.add(Level::Good, scores),
            None => self.add(Level::NotEvaluated, "there was nothing to compare it with"),
        }
        self.0.sort_by_key(|(level, _)| std::cmp::Reverse(*level));
        let level = self.0.first().map_or(Level::NotEvaluated, |(level, _)| *level);
        Verdict { level, reasons: self.0.into_iter().map(|(_, reason)| reason).collect() }
    }

    /// What the odometry says of itself.
    pub fn track(&mut self, quality: &TrackQuality) {
        let segment = quality.mapped_images();
        self.when(quality.covered() < GOOD_COVERAGE, Level::Caution, || {
            format!(
                "{segment} of {} images have a state in one world, {:.0} % of the time",
                quality.images,
                100.0 * quality.covered()
            )
        });
        let contradicted = if quality.is_doubtful() { Level::Bad } else { Level::Caution };
        self.when(quality.contradicts() && !quality.contradictions_are_settled(), contradicted, || {
            let why = quality.why_not_started().unwrap_or_default();
            format!("before it started: {why}")
        });
        if let Some(unexplained) = quality.unexplained() {
            self.add(Level::Caution, unexplained.message);
        }
        self.when(quality.losses > 0, Level::Caution, || format!("tracking was lost {}x", quality.losses));
        self.when(quality.healthy() < GOOD_HEALTH, Level::Caution, || {
            format!("health is OK in {:.0} % of the states", 100.0 * quality.healthy())
        });
    }

    /// How well the scale is known.
    pub fn scale(&mut self, scale: &StatedScale) {
        let is_loose = scale.sigma.or(scale.poses).is_some_and(|sigma| sigma > GOOD_SCALE);
        match (scale.is_metric, scale.source) {
            (false, ScaleSource::Odometry { .. }) => {
                self.add(Level::Bad, format!("lengths are not metres: scale {}", scale.words));
            }
            (false, _) => self.add(Level::Caution, format!("scale {}", scale.words)),
            (true, _) if is_loose => self.add(Level::Caution, format!("scale {}", scale.words)),
            (true, _) => {}
        }
    }

    /// A trajectory against ground truth.
    pub fn trajectory(&mut self, report: &TrajectoryReport, scale: &StatedScale) {
        let Some(error) = report.scale_error else {
            return self.add(Level::Caution, "the motion does not determine ATE and scale error");
        };
        self.when(error > GOOD_SCALE, Level::Caution, || {
            format!("the scale is {:.1} % off ground truth (|ln s| {error:.3})", 100.0 * error)
        });
        let stated = scale.sigma.filter(|sigma| error > 3.0 * sigma && error > 1e-3);
        if let Some(sigma) = stated {
            self.add(
                Level::Caution,
                format!("|ln s| {error:.4} is more than three times the stated σ {sigma:.4}"),
            );
        }
    }
}

impl Verdict {
    /// As the report shows it.
    pub fn assessment(&self) -> Assessment {
        let level = match self.level {
            Level::Good => AssessmentLevel::Good,
            Level::NotEvaluated => AssessmentLevel::NotEvaluated,
            Level::Caution => AssessmentLevel::Caution,
            Level::Bad => AssessmentLevel::Bad,
        };
        Assessment { level, text: self.reasons.join("; ") }
    }

    /// One line for the terminal.
    pub fn line(&self) -> String {
        let word = match self.level {
            Level::Good => "good",
            Level::NotEvaluated => "not evaluated",
            Level::Caution => "with reservations",
            Level::Bad => "not usable as it is",
        };
        format!("{word}: {}", self.reasons.join("; "))
    }
}

/// What is said of a scale: σ(ln s) and its parts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StatedScale {
    /// Whether lengths are metres.
    pub is_metric: bool,
    /// All parts together; null where one of them is not known.
    pub sigma: Option<f64>,
    /// Of a chunk's depth, the median chunk.
    pub chunks: Option<f64>,
    /// Of the metric poses.
    pub poses: Option<f64>,
    /// Of what no estimate sees: the accelerometer's gain and the lever arm.
    pub unseen: Option<f64>,
    /// Of a calibration that nothing has checked: that of a live trajectory.
    pub unchecked: Option<f64>,
    /// All of it in words.
    pub words: String,
    /// Where it comes from.
    #[serde(skip)]
    source: ScaleSource,
}

/// Where a scale comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum ScaleSource {
    /// Odometry, with its σ and that of what it cannot see.
    Odometry {
        /// Its own statement; infinite while the scale is not observed.
        stated: f64,
        /// See [`StatedScale::unseen`].
        unseen: f64,
        /// See [`StatedScale::unchecked`]; `None` where the adjustment estimated the calibration.
        unchecked: Option<f64>,
    },
    /// A trajectory whose scale nobody states.
    Given {
        /// σ of ln s by how its paths differ from those that the images show; `None` where these were not compared. It is a lower bound:
        /// images do not show a scale that is wrong everywhere.
        disagreement: Option<f64>,
    },
    /// Ground truth.
    GroundTruth {
        /// As of a trajectory.
        disagreement: Option<f64>,
    },
    /// None: lengths are arbitrary.
    #[default]
    None,
}

/// How far images and given poses agree, in words.
fn by_images(disagreement: Option<f64>) -> String {
    disagreement.map_or_else(String::new, |d| format!(", images and its paths differ by {:.1} %", 100.0 * d))
}

impl StatedScale {
    /// Combines the parts.
    pub fn new(source: ScaleSource, chunks: Option<f64>) -> Self {
        let of_chunks = chunks.map_or_else(String::new, |c| format!(", chunks {:.1} %", 100.0 * c));
        let known = chunks.unwrap_or(0.0);
        let empty = Self {
            is_metric: true,
            sigma: None,
            chunks,
            poses: None,
            unseen: None,
            unchecked: None,
            words: String::new(),
            source,
        };
        match source {
            ScaleSource::None => {
                Self { is_metric: false, words: "arbitrary: nothing metric takes part".into(), ..empty }
            }
            ScaleSource::Given { disagreement } => Self {
                poses: disagreement,
                words: format!(
                    "as metric as the trajectory given, whose σ is not known{}{of_chunks}",
                    by_images(disagreement)
                ),
                ..empty
            },
            ScaleSource::GroundTruth { disagreement } => Self {
                sigma: Some(known.hypot(disagreement.unwrap_or(0.0))),
                poses: Some(disagreement.unwrap_or(0.0)),
                words: format!("metric by ground truth{}{of_chunks}", by_images(disagreement)),
                ..empty
            },
            ScaleSource::Odometry { stated, .. } if !stated.is_finite() => {
                Self { is_metric: false, words: "unknown: the odometry does not observe it".into(), ..empty }
            }
            ScaleSource::Odometry { stated, unseen, unchecked } => {
                let parts = [stated, unseen, unchecked.unwrap_or(0.0), known];
                let sigma = parts.map(|part| part.powi(2)).iter().sum::<f64>().sqrt();
                let of_calibration = unchecked
                    .map_or_else(String::new, |c| format!(", calibration not checked {:.1} %", 100.0 * c));
                Self {
                    // What sensors and calibration add is a matter of their class; what the motion shows decides.
                    is_metric: stated <= METRIC_SCALE_STD,
                    sigma: Some(sigma),
                    poses: Some(stated),
                    unseen: Some(unseen),
                    unchecked,
                    words: format!(
                        "known to {:.1} % (1 σ): odometry {:.1} %, accelerometer gain and lever arm {:.1} %{of_calibration}{of_chunks}",
                        100.0 * sigma,
                        100.0 * stated,
                        100.0 * unseen
                    ),
                    ..empty
                }
            }
        }
    }

    /// A degradation where lengths that should be metres are not.
    pub fn warning(&self) -> Option<Warning> {
        let ScaleSource::Odometry { stated, .. } = self.source else { return None };
        (!self.is_metric).then(|| {
            let found = match stated.is_finite() {
                true => format!("σ(ln s) is {stated:.2}, above {METRIC_SCALE_STD}"),
                false => "the motion does not show the scale".to_owned(),
            };
            Warning::degraded("scale-not-converged", format!("lengths are not metres: {found}"))
                .hint("the scale needs accelerations: start and stop, move to and fro; turning alone does not show it")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_a_scale_add_up_and_unknown_ones_are_said() {
        let odometry = |stated| ScaleSource::Odometry { stated, unseen: 0.01, unchecked: None };
        let all = StatedScale::new(odometry(0.02), Some(0.02));
        assert!((all.sigma.unwrap() - 0.03).abs() < 1e-12 && all.is_metric);
        assert!(
            all.words.contains("known to 3.0 %") && all.words.contains("odometry 2.0 %"),
            "{}",
            all.words
        );
        let live = ScaleSource::Odometry { stated: 0.02, unseen: 0.01, unchecked: Some(0.02) };
        let live = StatedScale::new(live, None);
        assert!((live.sigma.unwrap() - 0.03).abs() < 1e-12 && live.is_metric, "{live:?}");
        assert!(live.words.contains("calibration not checked 2.0 %"), "{}", live.words);
        let loose = StatedScale::new(odometry(0.108), Some(0.005));
        assert!(!loose.is_metric && loose.warning().unwrap().message.contains("0.11"));
        let given = StatedScale::new(ScaleSource::Given { disagreement: None }, Some(0.005));
        assert_eq!((given.sigma, given.warning()), (None, None));
        assert!(given.words.contains("not known"), "{}", given.words);
        assert!(StatedScale::new(odometry(f64::INFINITY), None).warning().is_some());
        for (disagreement, level) in [(0.002, Level::NotEvaluated), (0.07, Level::Caution)] {
            let disagreement = Some(disagreement);
            for source in [ScaleSource::Given { disagreement }, ScaleSource::GroundTruth { disagreement }] {
                let stated = StatedScale::new(source, Some(0.005));
                let mut findings = Findings::default();
                findings.scale(&stated);
                assert_eq!((findings.verdict(None).level, stated.poses), (level, disagreement), "{stated:?}");
                assert!(
                    stated.words.contains("images and its paths differ by") && stated.is_metric,
                    "{}",
                    stated.words
                );
            }
        }
    }

    #[test]
    fn the_worst_reason_decides_and_nothing_compared_is_never_good() {
        assert_eq!(Findings::default().verdict(None).level, Level::NotEvaluated);
        assert_eq!(Findings::default().verdict(Some("F 0.9".into())).level, Level::Good);
        let mut findings = Findings::default();
        findings.add(Level::Caution, "a");
        findings.add(Level::Bad, "b");
        let verdict = findings.verdict(Some("F 0.9".into()));
        assert_eq!((verdict.level, verdict.reasons.join(" ")), (Level::Bad, "b a F 0.9".to_owned()));
    }

    #[test]
    fn contradictions_that_nothing_checked_are_bad_and_settled_ones_are_not_told() {
        let time = |secs: i64| {
            serde_json::to_value(vidar_core::Timestamp::from_nanos(secs * 1_000_000_000)).unwrap()
        };
        let verdict = |adjusted: Option<(f64, bool, f64)>, health: vidar_core::Health| {
            let mut quality = serde_json::to_value(TrackQuality::default()).unwrap();
            (quality["contradictions"], quality["waits"]) = (48.into(), 78.into());
            quality["times"] = serde_json::json!([time(0), time(10)]);
            quality["segments"] = serde_json::json!({ "0": {
                "images": 100, "health": { health.as_str(): 100 }, "first": time(0), "last": time(10),
                "last_position": [0.0, 0.0, 0.0], "last_scale_std": 0.01, "weighted": [0.0, 0.0]
            } });
            quality["adjusted"] = serde_json::json!(adjusted.map(|(inertial_chi2, contradicts_given, noise_ratio)| serde_json::json!({
                "images": 100, "first": time(0), "last": time(10), "scale_std": 0.01, "inertial_chi2": inertial_chi2,
                "contradicts_given": contradicts_given, "noise_ratio": noise_ratio
            })));
            let mut findings = Findings::default();
            findings.track(&serde_json::from_value(quality).unwrap());
            findings.verdict(Some("ATE".into()))
        };
        let level = |adjusted, health| verdict(adjusted, health).level;
        use vidar_core::Health::{Degraded, Ok};
        assert_eq!(level(None, Degraded), Level::Bad);
        assert_eq!(level(None, Ok), Level::Caution);
        assert_eq!(level(Some((1.5, false, 1.0)), Ok), Level::Caution);
        assert_eq!(level(Some((0.1, true, 1.0)), Ok), Level::Caution);
        assert_eq!(level(Some((0.1, false, 1.3)), Ok), Level::Good);
        let unexplained = verdict(Some((0.1, false, 4.0)), Ok);
        assert_eq!(unexplained.level, Level::Caution);
        assert!(unexplained.reasons[0].contains("4.0 times the IMU's own noise"), "{unexplained:?}");
    }
}
