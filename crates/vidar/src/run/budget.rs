//! A time budget: how far stereo is cut down so that a run ends in time.
//!
//! What a run costs is a fixed model of what is known before depth is computed: keyframes, size of the images, neighbours. It is never
//! measured while running: the same command makes the same map on every machine, resumed or in parts, and with any number of threads.
//! A slower or faster machine is told by `budget.speed`; after a run the value that would have been right is said.

use super::Plan;
use crate::config::Config;
use crate::engine::{FrameStamp, Selection, chunk_rule, longest_posed};
use crate::error::Error;
use crate::input;
use crate::models::geometry::{self, SourceChoice};
use crate::odometry::TrackedPoses;
use serde::Serialize;
use vidar_core::{Duration, Warning};
use vidar_dataset::Recording;

/// What was chosen, in the run folder.
pub(super) const FILE: &str = "budget.json";

/// What stereo may take, best first: width of its images, and keyframes as a share of those that there would be. Chosen on HoloLens,
/// which would lose keyframes first, and redkitchen, which would lose pixels first; fewer neighbours save little. Figures: docs/benchmark/maps.md, *Within a time
/// budget*.
const LADDER: [Rung; 8] = [
    Rung { width_px: usize::MAX, share: 1.0 },
    Rung { width_px: 400, share: 0.75 },
    Rung { width_px: 400, share: 0.5 },
    Rung { width_px: 320, share: 0.5 },
    Rung { width_px: 256, share: 0.5 },
    Rung { width_px: 256, share: 0.33 },
    Rung { width_px: 256, share: 0.2 },
    Rung { width_px: 200, share: 0.15 },
];
/// Fewest keyframes that a budget leaves: with fewer each has hardly a neighbour.
const MIN_KEYFRAMES: usize = 6;

/// One step of the ladder.
#[derive(Clone, Copy, Debug)]
struct Rung {
    width_px: usize,
    share: f64,
}

/// Settings of stereo that a budget decides, and the keyframes that they leave.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct BudgetChoice {
    /// Keyframes at most: `keyframes.max_count`.
    pub keyframes: usize,
    /// `stereo.max_width_px`.
    pub width_px: usize,
}

/// A budget with what was chosen for it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Budget {
    /// Wall time that the run should take at most, s.
    pub seconds: f64,
    /// How fast the machine was said to be.
    pub speed: f64,
    /// What the run is expected to take, s.
    pub expected_seconds: f64,
    /// What it would take without a budget, s.
    pub expected_seconds_unlimited: f64,
    /// What was chosen.
    pub chosen: BudgetChoice,
    /// What would be without a budget.
    pub unlimited: BudgetChoice,
}

impl Budget {
    /// Whether the run is expected to end in time.
    pub fn is_met(&self) -> bool {
        self.expected_seconds <= self.seconds
    }

    /// The speed of a machine on which the run took `seconds`.
    pub fn found_speed(&self, seconds: f64) -> f64 {
        self.speed * self.expected_seconds / seconds.max(1e-3)
    }

    /// In words.
    pub fn words(&self) -> String {
        let BudgetChoice { keyframes, width_px } = self.chosen;
        let all = self.unlimited;
        let chosen = match self.chosen == all {
            true => "nothing is cut down".to_owned(),
            false => {
                format!("{keyframes} of {} keyframes, {width_px} of {} px", all.keyframes, all.width_px)
            }
        };
        format!("{:.1} s; {chosen}; expected {:.1} s", self.seconds, self.expected_seconds)
    }

    /// Where even the cheapest choice is too slow.
    pub(super) fn warning(&self) -> Option<Warning> {
        let text = format!(
            "the cheapest map of this recording is expected to take {:.1} s, the budget is {:.1} s",
            self.expected_seconds, self.seconds
        );
        let hint = "allow more time, leave files out (output.*, eval.mode=off), or take a part of the recording (--start, --end, --stride)";
        (!self.is_met()).then(|| Warning::new("over-budget", text).hint(hint))
    }

    /// Makes it the configuration.
    fn apply(&self, config: &mut Config) {
        if self.chosen == self.unlimited {
            return;
        }
        config.stereo.max_width_px = self.chosen.width_px;
        if self.chosen.keyframes < self.unlimited.keyframes {
            config.keyframes.max_count = self.chosen.keyframes;
        }
    }
}

/// Decides what the budget of `config` leaves, and makes it the configuration; none without a limit. `tracked` are the odometry's poses.
///
/// # Errors
/// The cost of this run cannot be planned.
pub(super) fn settle(
    dataset: &Recording,
    config: &mut Config,
    plan: &Plan,
    tracked: Option<&TrackedPoses>,
) -> Result<Option<Budget>, Error> {
    if !config.budget.is_limited() {
        return Ok(None);
    }
    let seconds = budget_seconds(dataset, config)?;
    require_plannable(config, plan, tracked.is_some())?;
    let keyframes = keyframes(dataset, config, plan, tracked);
    let work = Work::of(dataset, config, plan);
    let unlimited = BudgetChoice { keyframes, width_px: config.stereo.max_width_px.min(plan.view.width) };
    let expected = |choice: &BudgetChoice| work.reference_secs(choice) / config.budget.speed;
    let chosen = choose(&unlimited, |choice| expected(choice) <= seconds);
    let budget = Budget {
        seconds,
        speed: config.budget.speed,
        expected_seconds: expected(&chosen),
        expected_seconds_unlimited: expected(&unlimited),
        chosen,
        unlimited,
    };
    budget.apply(config);
    Ok(Some(budget))
}

/// The first choice of the ladder that fits, with as many keyframes as fit; else the cheapest.
fn choose(unlimited: &BudgetChoice, fits: impl Fn(&BudgetChoice) -> bool) -> BudgetChoice {
    let least = MIN_KEYFRAMES.min(unlimited.keyframes);
    let at = |rung: &Rung| BudgetChoice {
        keyframes: ((unlimited.keyframes as f64 * rung.share).ceil() as usize).max(least),
        width_px: unlimited.width_px.min(rung.width_px),
    };
    for (i, rung) in LADDER.iter().enumerate() {
        let choice = at(rung);
        if !fits(&choice) {
            continue;
        }
        // Between two steps of equal images as many keyframes as there is time for.
        let most = i.checked_sub(1).map_or(choice.keyframes, |before| at(&LADDER[before]).keyframes);
        let more = (choice.keyframes..=most).map(|keyframes| BudgetChoice { keyframes, ..choice });
        return more.take_while(&fits).last().unwrap_or(choice);
    }
    at(&LADDER[LADDER.len() - 1])
}

/// Seconds of the budget.
fn budget_seconds(dataset: &Recording, config: &Config) -> Result<f64, Error> {
    if !config.budget.realtime {
        return Ok(config.budget.seconds);
    }
    let images = &dataset.images;
    let length = images.first().zip(images.last()).map_or(Duration::ZERO, |(a, b)| b.time - a.time);
    match dataset.times_are_invented || length <= Duration::ZERO {
        true => Err(Error::Usage {
            what: format!("{} has no image times, so it has no duration to keep to", dataset.name),
            hint: "give the budget in seconds (--time-budget), or the times (--timestamps FILE)".into(),
        }),
        false => Ok(length.as_secs_f64()),
    }
}

/// Refuses what the model of the cost does not know.
fn require_plannable(config: &Config, plan: &Plan, is_tracked: bool) -> Result<(), Error> {
    let refuse = |what: &str, hint: &str| {
        Err(Error::Usage { what: format!("a time budget {what}"), hint: hint.into() })
    };
    match geometry::source(config)? {
        SourceChoice::Stereo | SourceChoice::Auto(None) => {}
        _ => {
            return refuse(
                "is kept by stereo, and this run has a network or recorded predictions",
                "--geometry auto without geometry.fill_network, or --geometry stereo",
            );
        }
    }
    if plan.poses.is_odometry() && !is_tracked {
        return refuse(
            "is planned when all poses are known, and odometry.adjust=false tracks while it maps",
            "leave odometry.adjust as it is by default",
        );
    }
    Ok(())
}

/// Keyframes without a budget.
fn keyframes(dataset: &Recording, config: &Config, plan: &Plan, tracked: Option<&TrackedPoses>) -> usize {
    if let Some(expected) = &plan.expected {
        return expected.keyframes;
    }
    let stamps: Vec<FrameStamp> = input::strided(dataset, config).iter().map(input::stamp_of).collect();
    let max_gap = Duration::from_secs_f64(config.input.max_pose_gap_secs);
    let mut posed = tracked.map_or_else(Vec::new, |t| longest_posed(&mut t.clone(), &stamps, max_gap));
    if posed.is_empty()
        && let Some(mut fallback) = plan.poses.fallback(dataset, config)
    {
        posed = longest_posed(&mut fallback, &stamps, max_gap);
    }
    let rule = chunk_rule(config, false, None);
    Selection::new(&config.keyframes, false).among_posed(&posed, &rule, true).len()
}

/// What the cost of a run depends on besides what is chosen.
#[derive(Clone, Copy, Debug)]
struct Work {
    /// Images that the odometry tracks.
    tracked: usize,
    /// Megapixels of a captured image, and of a view; rows over columns of a view.
    captured_mpx: f64,
    view_mpx: f64,
    aspect: f64,
    /// Views that each view is matched against.
    neighbours: usize,
    completes: bool,
    evaluates: bool,
    writes: bool,
}

/// Processor seconds that two quiet cores do in a second of wall time, where all of it is shared out: 1.75 on redkitchen and HoloLens as
/// they are, 1.6 with half of their keyframes.
const PROCESSOR_SECS_PER_SEC: f64 = 1.6;
/// Processor seconds on the machine of BENCHMARK.md, fitted by hand to runs of redkitchen, HoloLens and MH_01 as they are, at widths of
/// 256 to 480 and with a quarter to all of the keyframes: 5 to 14 s, met to 15 %. Of every run:
const RUN_SECS: f64 = 0.5;
/// Of each image that is tracked, with the adjustment; one image follows the other, so this is wall time, too.
const TRACKED_SECS: f64 = 0.0185;
/// Of each keyframe: by its captured megapixels (read, undistorted), ...
const CAPTURED_SECS_PER_MPX: f64 = 0.06;
/// ... by the megapixels of its depth: stereo, with each of its neighbours, and what completes it, ...
const STEREO_SECS_PER_MPX: f64 = 0.45;
const NEIGHBOUR_SECS_PER_MPX: f64 = 0.09;
const COMPLETION_SECS_PER_MPX: f64 = 0.25;
/// ... by the megapixels of the view that is written, and the rest.
const FILES_SECS_PER_MPX: f64 = 0.07;
const KEYFRAME_SECS: f64 = 0.015;
/// Of the evaluation, and of each keyframe whose sensor image it reads.
const EVALUATION_SECS: f64 = 2.0;
const EVALUATED_SECS: f64 = 0.02;

impl Work {
    fn of(dataset: &Recording, config: &Config, plan: &Plan) -> Self {
        let mpx = |width: usize, height: usize| (width * height) as f64 * 1e-6;
        let output = &config.output;
        Self {
            tracked: if plan.poses.is_odometry() { dataset.images.len() } else { 0 },
            captured_mpx: mpx(plan.camera.width(), plan.camera.height()),
            view_mpx: mpx(plan.view.width, plan.view.height),
            aspect: plan.view.height as f64 / plan.view.width as f64,
            neighbours: config.stereo.neighbours,
            completes: config.geometry.source == geometry::AUTO,
            evaluates: plan.reference != super::plan::ReferenceSource::None,
            writes: output.depth_png || output.images || output.report,
        }
    }

    /// Wall time on two quiet cores of the machine of BENCHMARK.md, s.
    fn reference_secs(&self, choice: &BudgetChoice) -> f64 {
        let mpx = choice.width_px as f64 * choice.width_px as f64 * self.aspect * 1e-6;
        let stereo = STEREO_SECS_PER_MPX + NEIGHBOUR_SECS_PER_MPX * self.neighbours as f64;
        let if_so = |yes: bool, secs: f64| if yes { secs } else { 0.0 };
        let keyframe = KEYFRAME_SECS
            + self.captured_mpx * CAPTURED_SECS_PER_MPX
            + mpx * (stereo + if_so(self.completes, COMPLETION_SECS_PER_MPX))
            + self.view_mpx * if_so(self.writes, FILES_SECS_PER_MPX)
            + if_so(self.evaluates, EVALUATED_SECS);
        let processor =
            RUN_SECS + choice.keyframes as f64 * keyframe + if_so(self.evaluates, EVALUATION_SECS);
        self.tracked as f64 * TRACKED_SECS + processor / PROCESSOR_SECS_PER_SEC
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As redkitchen: 35 keyframes of 640×480, evaluated.
    const WORK: Work = Work {
        tracked: 0,
        captured_mpx: 0.307,
        view_mpx: 0.307,
        aspect: 0.75,
        neighbours: 5,
        completes: true,
        evaluates: true,
        writes: true,
    };
    const ALL: BudgetChoice = BudgetChoice { keyframes: 35, width_px: 480 };

    fn chosen(seconds: f64) -> BudgetChoice {
        choose(&ALL, |choice| WORK.reference_secs(choice) <= seconds)
    }

    #[test]
    fn what_there_is_time_for_is_not_cut_down() {
        assert_eq!(chosen(1e6), ALL);
        assert_eq!(chosen(WORK.reference_secs(&ALL)), ALL);
        let tiny = BudgetChoice { keyframes: 3, width_px: 160 };
        assert_eq!(choose(&tiny, |_| false), tiny, "nothing is left to cut");
    }

    #[test]
    fn a_choice_ends_in_time_or_is_the_cheapest_and_more_time_never_makes_a_cheaper_one() {
        let cheapest = WORK.reference_secs(&chosen(0.0));
        let mut last = 0.0;
        let mut different = std::collections::BTreeSet::new();
        for seconds in (1..100).map(|i| 0.1 * f64::from(i)) {
            let choice = chosen(seconds);
            let cost = WORK.reference_secs(&choice);
            assert!(cost <= seconds || cost == cheapest, "{seconds} s: {choice:?} takes {cost} s");
            assert!(cost >= last, "{seconds} s: {choice:?} takes {cost} s, with less time it was {last} s");
            assert!(choice.keyframes >= MIN_KEYFRAMES && choice.keyframes <= ALL.keyframes);
            last = cost;
            different.insert((choice.width_px, choice.keyframes));
        }
        assert!(different.len() > 12, "{different:?}");
    }

    #[test]
    fn the_cost_is_that_of_the_runs_it_was_fitted_to() {
        // Keyframes, width, processor seconds of redkitchen on the machine of BENCHMARK.md.
        for (keyframes, width_px, measured) in
            [(35, 480, 12.25), (35, 320, 7.75), (26, 400, 7.97), (17, 256, 5.15)]
        {
            let cost = WORK.reference_secs(&BudgetChoice { keyframes, width_px }) * PROCESSOR_SECS_PER_SEC;
            assert!((cost / measured - 1.0).abs() < 0.15, "{keyframes}, {width_px} px: {cost} of {measured}");
        }
    }
}
