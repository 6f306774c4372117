//! The tables: rows are couplings, columns measurements, cells the median over recordings with least and greatest.

use super::{AblationRow, Measurements, PredictionKind};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use vidar_align::CouplingMode;
use vidar_solve::statistics::median;

/// What a table shows of a row.
struct Quantity {
    caption: &'static str,
    of: fn(&AblationRow) -> Option<f64>,
    digits: usize,
}

const QUANTITIES: [Quantity; 4] = [
    Quantity { caption: "F@0.05 at the scale as it is", of: |r| r.f05.or(Some(0.0)), digits: 3 },
    Quantity { caption: "F@0.10 at the scale as it is", of: |r| r.f10.or(Some(0.0)), digits: 3 },
    Quantity { caption: "ATE of the placed keyframes after an SE(3) fit, m", of: |r| r.ate_se3_m, digits: 4 },
    Quantity { caption: "|ln s| of the placed keyframes", of: |r| r.log_scale.map(f64::abs), digits: 4 },
];

/// All tables and the graph's own share.
pub fn markdown(source: &str, rows: &[AblationRow], failures: &[(String, u64, String)]) -> String {
    let mut seeds: Vec<u64> = rows.iter().map(|r| r.seed).collect();
    seeds.sort_unstable();
    seeds.dedup();
    let seeds = seeds.len();
    let mut flights: Vec<&str> = rows.iter().map(|r| r.sequence.as_str()).collect();
    flights.sort_unstable();
    flights.dedup();
    let mut text = format!("# Ablation of the couplings, {source}\n\n");
    let _ = writeln!(
        text,
        "Median over {} recordings (least to greatest): flights {}, {seeds} of each; every recording has a room, noise and \
         network of its own. Keyframes, predictions, overlap estimator and measurements are the same in each column; a map \
         that could not be made counts as F 0.",
        recordings(rows).len(),
        flights.join(", "),
    );
    for quantity in &QUANTITIES {
        let _ = writeln!(text, "\n## {}\n", quantity.caption);
        head(&mut text, "Predictions, coupling");
        for kind in PredictionKind::ALL {
            for &coupling in kind.couplings() {
                let cell = |m| spread(values(rows, kind, coupling, m, quantity.of).values(), quantity.digits);
                line(&mut text, &format!("{}, {coupling}", name(kind)), cell);
            }
        }
    }
    let _ = writeln!(
        text,
        "\n## What the graph itself adds: F@0.05 of coupled less that of the other coupling, recording by recording\n"
    );
    head(&mut text, "Predictions, other coupling");
    for kind in PredictionKind::ALL {
        for &other in kind.couplings().iter().filter(|c| **c != CouplingMode::Coupled) {
            let cell = |m| spread(gains(rows, kind, other, m).iter(), 3);
            line(&mut text, &format!("{}, {other}", name(kind)), cell);
        }
    }
    let _ = writeln!(text, "\nLoops accepted and keyframes placed, all recordings:\n");
    head(&mut text, "Predictions, coupling");
    for kind in PredictionKind::ALL {
        for &coupling in kind.couplings() {
            let cell = |m| {
                let of = rows.iter().filter(|r| is_case(r, kind, coupling, m));
                let (loops, placed, offered, n) = of.fold((0, 0, 0, 0), |(l, p, o, n), r| {
                    (l + r.loops, p + r.keyframes, o + r.offered, n + 1)
                });
                if n == 0 { "–".to_owned() } else { format!("{loops}; {placed} of {offered}") }
            };
            line(&mut text, &format!("{}, {coupling}", name(kind)), cell);
        }
    }
    for (sequence, seed, why) in failures {
        let _ = writeln!(text, "\nNot mapped: {sequence}, seed {seed}: {why}");
    }
    text
}

fn name(kind: PredictionKind) -> &'static str {
    match kind {
        PredictionKind::PoseFree => "pose-free",
        PredictionKind::PoseConditioned => "given poses",
    }
}

fn head(text: &mut String, first: &str) {
    let columns: Vec<&str> = Measurements::COLUMNS.iter().map(|c| c.0).collect();
    let _ = writeln!(text, "| {first} | {} |\n|---|{}", columns.join(" | "), "--:|".repeat(columns.len()));
}

fn line(text: &mut String, first: &str, cell: impl Fn(Measurements) -> String) {
    let cells: Vec<String> = Measurements::COLUMNS.iter().map(|c| cell(c.1)).collect();
    let _ = writeln!(text, "| {first} | {} |", cells.join(" | "));
}

/// A recording: flight and seed.
type FlightKey<'a> = (&'a str, u64);

fn recordings(rows: &[AblationRow]) -> BTreeSet<FlightKey<'_>> {
    rows.iter().map(|r| (r.sequence.as_str(), r.seed)).collect()
}

fn is_case(row: &AblationRow, kind: PredictionKind, coupling: CouplingMode, m: Measurements) -> bool {
    (row.prediction, row.coupling, row.measurements) == (kind, coupling, m)
}

/// A quantity of a case, by recording.
fn values(
    rows: &[AblationRow],
    kind: PredictionKind,
    coupling: CouplingMode,
    m: Measurements,
    of: fn(&AblationRow) -> Option<f64>,
) -> BTreeMap<FlightKey<'_>, f64> {
    let of_case = rows.iter().filter(|r| is_case(r, kind, coupling, m));
    of_case.filter_map(|r| Some(((r.sequence.as_str(), r.seed), of(r)?))).collect()
}

/// Per recording how much more F@0.05 the coupled graph has on the same input.
fn gains(rows: &[AblationRow], kind: PredictionKind, other: CouplingMode, m: Measurements) -> Vec<f64> {
    let of = |coupling| values(rows, kind, coupling, m, |r| r.f05.or(Some(0.0)));
    let (graph, other) = (of(CouplingMode::Coupled), of(other));
    graph.iter().filter_map(|(recording, f)| Some(f - other.get(recording)?)).collect()
}

/// `0.853 (0.841 to 0.860)`.
fn spread<'a>(values: impl Iterator<Item = &'a f64>, digits: usize) -> String {
    let mut values: Vec<f64> = values.copied().collect();
    values.sort_unstable_by(f64::total_cmp);
    let Some((least, greatest)) = values.first().copied().zip(values.last().copied()) else {
        return "–".to_owned();
    };
    let middle = median(&mut values).unwrap_or(f64::NAN);
    format!("{middle:.digits$} ({least:.digits$} to {greatest:.digits$})")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_medians_over_recordings_and_gains_are_paired() {
        let row = |sequence: &str, seed, coupling, f05| AblationRow {
            sequence: sequence.into(),
            seed,
            coupling,
            f05: Some(f05),
            ..AblationRow::default()
        };
        let (hybrid, coupled) = (CouplingMode::Hybrid, CouplingMode::Coupled);
        let mut rows = vec![row("a", 0, hybrid, 0.2), row("b", 0, hybrid, 0.4), row("a", 1, hybrid, 0.6)];
        rows.extend([row("b", 0, coupled, 0.7), row("a", 0, coupled, 0.3), row("a", 1, coupled, 0.7)]);
        let text = markdown("simulated", &rows, &[("b".into(), 1, "E0305 nothing".into())]);
        assert!(
            text.contains("Median over 3 recordings (least to greatest): flights a, b, 2 of each"),
            "{text}"
        );
        assert!(text.contains("| pose-free, hybrid | 0.400 (0.200 to 0.600) | – |"), "{text}");
        // 0.1, 0.3 and 0.1 recording by recording; the difference of the medians would be 0.3.
        assert!(text.contains("| pose-free, hybrid | 0.100 (0.100 to 0.300) | – |"), "{text}");
        assert!(text.contains("Not mapped: b, seed 1: E0305 nothing"), "{text}");
    }
}
