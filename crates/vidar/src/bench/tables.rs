//! Tables I, II and III, with the paper's values in brackets.

use super::{BenchKind, BenchRequest, BenchRow, OdometryRow, paper};
use std::fmt::Write as _;
use vidar_align::CouplingMode;

/// One table as text cells; used for the report and the Markdown file.
#[derive(Clone, Debug)]
pub(super) struct Grid {
    pub caption: String,
    pub columns: Vec<String>,
    pub rows: Vec<Vec<String>>,
}

/// Every table of a bench.
#[derive(Clone, Debug)]
pub struct Cells {
    pub(super) grids: Vec<Grid>,
    pub(super) notes: Vec<String>,
    title: String,
}

impl Cells {
    pub(super) fn new(
        request: &BenchRequest,
        sequences: &[String],
        rows: &[BenchRow],
        odometry: &[OdometryRow],
    ) -> Self {
        let table = Table { request, sequences, rows, odometry };
        let name = match request.kind {
            BenchKind::Euroc => "EuRoC MAV",
            BenchKind::Tum => "TUM RGB-D",
            BenchKind::TumVi => "TUM-VI",
            BenchKind::SevenScenes => "7-Scenes",
        };
        let rendered = if request.synthetic.is_some() { ", rendered" } else { "" };
        let mut grids = vec![table.trajectories()];
        for (threshold_m, fit) in
            [(0.10, Fit::Rigid), (0.05, Fit::Rigid), (0.10, Fit::Bounded), (0.05, Fit::Bounded)]
        {
            grids.push(table.dense(threshold_m, fit));
        }
        if request.kind == BenchKind::Euroc {
            grids.push(table.metricness());
        }
        if request.kind == BenchKind::Euroc {
            grids.extend(table.orderings());
        }
        grids.push(table.cost());
        grids.extend(table.failures());
        Self { grids, notes: notes(request), title: format!("{name}{rendered}") }
    }

    /// All tables as one Markdown text.
    pub fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n", self.title);
        self.notes.iter().for_each(|n| {
            let _ = writeln!(text, "- {n}");
        });
        for grid in &self.grids {
            let _ = writeln!(text, "\n## {}\n", grid.caption);
            let _ = writeln!(text, "| {} |", grid.columns.join(" | "));
            let line: Vec<&str> =
                grid.columns.iter().enumerate().map(|(i, _)| if i == 0 { "---" } else { "--:" }).collect();
            let _ = writeln!(text, "|{}|", line.join("|"));
            for row in &grid.rows {
                let cells: Vec<String> = row.iter().map(|c| c.replace('|', "\\|")).collect();
                let _ = writeln!(text, "| {} |", cells.join(" | "));
            }
        }
        text
    }
}

fn notes(request: &BenchRequest) -> Vec<String> {
    let mut notes = vec![
        "F of the rigid fit evaluates the map with its own scale. The paper's bounded placement (section IV-B) refines the scale \
         within 0.85 to 1.15; numbers in brackets are the paper's and compare with it."
            .to_owned(),
        "Means are over valid runs; failed ones are counted and listed with their reason.".to_owned(),
    ];
    if request.synthetic.is_some() {
        notes.push(
            "Rendered sequences: easier than real ones and not comparable with the paper's numbers, which are given for orientation only.".to_owned(),
        );
    }
    notes
}

/// Placement under which F is taken.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fit {
    Rigid,
    Bounded,
}

impl Fit {
    fn words(self) -> &'static str {
        match self {
            Self::Rigid => "rigid fit: scale as it is",
            Self::Bounded => "scale refined (the paper's bounded placement)",
        }
    }
}

pub(super) struct Table<'a> {
    pub request: &'a BenchRequest,
    pub sequences: &'a [String],
    pub rows: &'a [BenchRow],
    pub odometry: &'a [OdometryRow],
}

impl Table<'_> {
    pub fn of(&self, sequence: &str, mode: CouplingMode) -> Option<&BenchRow> {
        self.rows.iter().find(|r| r.sequence == sequence && r.mode == mode)
    }

    fn modes(&self) -> impl Iterator<Item = CouplingMode> {
        self.request.modes.clone().into_iter()
    }

    /// Table I: method, valid sequences, mean and median Sim(3) RMSE.
    fn trajectories(&self) -> Grid {
        let mut rows = Vec::new();
        let mut add = |name: String, ates: Vec<Option<f64>>, papers: Option<(&str, f64, f64)>| {
            let valid: Vec<f64> = ates.iter().flatten().copied().collect();
            if ates.is_empty() {
                return;
            }
            let beside = |ours: Option<f64>, paper: Option<f64>| with_paper(ours, paper, 3);
            rows.push(vec![
                name,
                format!(
                    "{}/{}{}",
                    valid.len(),
                    ates.len(),
                    papers.map_or_else(String::new, |p| format!(" [{}]", p.0))
                ),
                beside(mean(&valid), papers.map(|p| p.1)),
                beside(median(&valid), papers.map(|p| p.2)),
            ]);
        };
        let euroc = self.request.kind == BenchKind::Euroc;
        for (with_imu, name, k) in
            [(false, "odometry, camera only", 0), (true, "odometry, camera and IMU", 1)]
        {
            let of: Vec<_> = self
                .odometry
                .iter()
                .filter(|r| r.with_imu == with_imu)
                .map(|r| r.trajectory.ate_sim3_m)
                .collect();
            let p = paper::EUROC_TRAJECTORY[k];
            add(name.to_owned(), of, euroc.then_some((p.1, p.2, p.3)));
        }
        for mode in self.modes().filter(|m| m.chains()) {
            let of: Vec<_> = self
                .sequences
                .iter()
                .filter_map(|s| self.of(s, mode))
                .map(|r| r.trajectory.ate_sim3_m)
                .collect();
            let p = match (euroc, mode) {
                (true, CouplingMode::Da3Streaming) => Some(paper::EUROC_TRAJECTORY[2]),
                (false, CouplingMode::PoseFree) if self.request.kind == BenchKind::Tum => {
                    Some(paper::TUM_TRAJECTORY[1])
                }
                _ => None,
            };
            add(format!("map, {mode}"), of, p.map(|p| (p.1, p.2, p.3)));
        }
        Grid {
            caption: "Table I: trajectories, Sim(3)-aligned RMSE (odometry: every image with a pose; map: its keyframes)".into(),
            columns: ["Method", "Valid", "Mean, m", "Median, m"].map(String::from).to_vec(),
            rows,
        }
    }

    /// Table II: F per sequence and coupling. The paper's values stand beside those of its placement.
    fn dense(&self, threshold_m: f64, fit: Fit) -> Grid {
        let is_fine = threshold_m < 0.075;
        let score = |r: &BenchRow| match (fit, is_fine) {
            (Fit::Rigid, true) => r.f05_rigid,
            (Fit::Rigid, false) => r.f10_rigid,
            (Fit::Bounded, true) => r.f05,
            (Fit::Bounded, false) => r.f10,
        };
        let paper_of = |row: &paper::DenseRow, mode| {
            if fit == Fit::Rigid {
                return None;
            }
            let values = if threshold_m < 0.075 { row.2 } else { row.1 };
            paper_column(mode).and_then(|k| values[k])
        };
        let mut rows: Vec<Vec<String>> = self
            .sequences
            .iter()
            .map(|sequence| {
                let known = paper::DENSE.iter().find(|row| row.0 == sequence);
                let cell = |mode| {
                    let row = self.of(sequence, mode);
                    match row.and_then(|r| r.failure.as_ref()) {
                        Some(_) => "failed".to_owned(),
                        None => with_paper(row.and_then(score), known.and_then(|k| paper_of(k, mode)), 3),
                    }
                };
                std::iter::once(sequence.clone()).chain(self.modes().map(cell)).collect()
            })
            .collect();
        let euroc = self.request.kind == BenchKind::Euroc;
        let average = |mode| {
            let values: Vec<f64> = self.sequences.iter().filter_map(|s| score(self.of(s, mode)?)).collect();
            let paper = match (euroc, mode) {
                (false, _) => None,
                (true, CouplingMode::Hybrid) if !is_fine && fit == Fit::Bounded => Some(paper::HYBRID_F10),
                (true, mode) => paper_of(&paper::DENSE_MEAN, mode),
            };
            format!("{} ({}/{})", with_paper(mean(&values), paper, 3), values.len(), self.sequences.len())
        };
        rows.push(std::iter::once("mean (valid)".to_owned()).chain(self.modes().map(average)).collect());
        Grid {
            caption: format!(
                "Table II: F@{threshold_m:.2} against {}, {}",
                if euroc { "the scan" } else { "the depth sensor" },
                fit.words()
            ),
            columns: std::iter::once("Sequence".to_owned())
                .chain(self.modes().map(|m| m.to_string()))
                .collect(),
            rows,
        }
    }

    /// Table III: how metric each coupling is.
    fn metricness(&self) -> Grid {
        let values = |mode, value: fn(&BenchRow) -> Option<f64>| -> Vec<f64> {
            self.sequences.iter().filter_map(|s| value(self.of(s, mode)?)).collect()
        };
        let statistic = |name: &str, mode| -> Option<f64> {
            let logs = values(mode, |r| r.trajectory.log_scale);
            match name {
                "mean |ln s|" => mean(&logs.iter().map(|s| s.abs()).collect::<Vec<_>>()),
                "std(ln s)" => deviation(&logs),
                "F@0.10 native" => mean(&values(mode, |r| r.f10)),
                "F@0.10 free" => mean(&values(mode, |r| r.f10_free)),
                _ => mean(&values(mode, |r| Some(r.f10_free? - r.f10?))),
            }
        };
        let rigid = |mode| number(mean(&values(mode, |r| r.f10_rigid)), 4);
        let rigid = std::iter::once("F@0.10 rigid".to_owned()).chain(self.modes().map(rigid)).collect();
        let rows = paper::METRICNESS.iter().map(|(name, papers)| {
            let cell = |mode| with_paper(statistic(name, mode), paper_column(mode).map(|k| papers[k]), 4);
            std::iter::once((*name).to_owned()).chain(self.modes().map(cell)).collect()
        });
        let rows = std::iter::once(rigid).chain(rows);
        Grid {
            caption: "Table III: how metric the result is (keyframes as placed in the map against ground truth; F of the map of the same keyframes)".into(),
            columns: std::iter::once("Metric".to_owned())
                .chain(self.modes().map(|m| m.to_string()))
                .collect(),
            rows: rows.collect(),
        }
    }

    fn cost(&self) -> Grid {
        let row = |mode: CouplingMode| {
            let of: Vec<&BenchRow> = self
                .sequences
                .iter()
                .filter_map(|s| self.of(s, mode))
                .filter(|r| r.failure.is_none() && r.keyframes > 0)
                .collect();
            let per: Vec<f64> = of.iter().map(|r| r.seconds / r.keyframes as f64).collect();
            let peak = of.iter().filter_map(|r| r.peak_memory_bytes).max();
            let device = of.iter().filter_map(|r| r.device_peak_bytes).max();
            vec![
                mode.to_string(),
                of.iter().map(|r| r.keyframes).sum::<usize>().to_string(),
                number(median(&per), 3),
                peak.map_or_else(|| "–".into(), crate::run::bytes),
                device.map_or_else(|| "none used".into(), crate::run::bytes),
            ]
        };
        Grid {
            caption: format!("Cost (the paper's GPU memory: {:.1} GB at most)", paper::GPU_BYTES / 1e9),
            columns: [
                "Coupling",
                "Keyframes",
                "Seconds per keyframe, median",
                "CPU memory, peak",
                "GPU memory, peak",
            ]
            .map(String::from)
            .to_vec(),
            rows: self.modes().map(row).collect(),
        }
    }

    fn failures(&self) -> Option<Grid> {
        let runs =
            self.rows.iter().filter_map(|r| Some((&r.sequence, r.mode.to_string(), r.failure.clone()?)));
        let odometry = self.odometry.iter().filter_map(|r| {
            let name = if r.with_imu { "odometry" } else { "odometry, camera only" };
            Some((&r.sequence, name.to_owned(), r.failure.clone()?))
        });
        let rows: Vec<_> = runs.chain(odometry).map(|(s, m, why)| vec![s.clone(), m, why]).collect();
        (!rows.is_empty()).then(|| Grid {
            caption: "Failed".into(),
            columns: ["Sequence", "What", "Why"].map(String::from).to_vec(),
            rows,
        })
    }
}

/// Which of the paper's columns PF, VIO, GT a coupling is.
fn paper_column(mode: CouplingMode) -> Option<usize> {
    match mode {
        CouplingMode::PoseFree => Some(0),
        CouplingMode::PoseConditioned => Some(1),
        CouplingMode::GroundTruth => Some(2),
        _ => None,
    }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
}

fn with_paper(ours: Option<f64>, paper: Option<f64>, digits: usize) -> String {
    match paper {
        Some(paper) => format!("{} [{paper:.3}]", number(ours, digits)),
        None => number(ours, digits),
    }
}

pub(super) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

fn median(values: &[f64]) -> Option<f64> {
    vidar_solve::statistics::median(&mut values.to_vec())
}

/// Standard deviation over sequences (of the sample).
fn deviation(values: &[f64]) -> Option<f64> {
    let middle = mean(values)?;
    let squares: f64 = values.iter().map(|v| (v - middle).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

#[cfg(test)]
pub(super) mod tests;
