//! One table over all recordings of a batch.

use super::Cost;
use super::plan::{Planned, PlannedRecording};
use super::record::{Problem, Stage, Status, TaskRecord};
use super::task::task_key;
use crate::error::Error;
use crate::run::bytes;
use crate::run_folder::pretty;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use vidar_core::printable;
use vidar_store::Store;

/// Schema of `report.json`.
pub const REPORT_SCHEMA: &str = "vidar.batch-report/1";
/// The threshold of the F that the table shows, m.
const F: &str = "f@0.05";

/// The table.
#[derive(Clone, Debug, Serialize)]
pub struct Table {
    /// [`REPORT_SCHEMA`].
    pub schema: &'static str,
    /// The plan.
    pub plan: String,
    /// Where the table lies in the store.
    pub folder: String,
    /// One row for each recording, in the order of the plan.
    pub recordings: Vec<Row>,
    /// Recordings by state.
    pub counts: BTreeMap<&'static str, usize>,
    /// All tasks together.
    pub cost: Cost,
}

/// A recording.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Its name.
    pub recording: String,
    /// Where it lies.
    pub path: String,
    /// `done`, `degraded`, `failed`, or `missing` where a task has no result yet.
    pub state: &'static str,
    /// The first task without a result.
    pub missing: Option<String>,
    /// Why it failed.
    pub problem: Option<Problem>,
    /// Images in it.
    pub images: Option<usize>,
    /// Its length, s.
    pub seconds: Option<f64>,
    /// Folder of the map in the store.
    pub map: Option<String>,
    /// What is known of the map: counts, verdict, scores, and the SHA-256 of its mesh.
    pub result: serde_json::Value,
    /// Warnings of each kind, with their number, of all of its tasks.
    pub warnings: BTreeMap<String, usize>,
    /// All of its tasks together.
    pub cost: Cost,
}

/// Reads every record, and writes the table.
///
/// # Errors
/// The store cannot be used.
pub(super) fn report(planned: &Planned, store: &Store) -> Result<Table, Error> {
    let rows = planned.plan.recordings.iter().map(|r| row(r, planned.plan.parts, store));
    let recordings: Vec<Row> = rows.collect::<Result<_, _>>()?;
    let (mut counts, mut cost) = (BTreeMap::new(), Cost::default());
    for row in &recordings {
        *counts.entry(row.state).or_default() += 1;
        cost.add(&row.cost);
    }
    let plan = planned.uri.rsplit('/').next().unwrap_or_default().trim_end_matches(".json");
    let folder = format!("reports/{plan}");
    let table = Table { schema: REPORT_SCHEMA, plan: planned.uri.clone(), folder, recordings, counts, cost };
    store.put(&format!("{}/report.json", table.folder), pretty(&table)?)?;
    store.put(&format!("{}/report.md", table.folder), table.markdown().into_bytes())?;
    Ok(table)
}

fn row(recording: &PlannedRecording, parts: usize, store: &Store) -> Result<Row, Error> {
    let predict = (0..parts).map(|part| (Stage::Predict, part));
    let tasks = std::iter::once((Stage::Track, 0)).chain(predict).chain([(Stage::Map, 0)]);
    let mut row = Row {
        recording: recording.name.clone(),
        path: recording.path.display().to_string(),
        state: "missing",
        missing: None,
        problem: None,
        images: recording.images,
        seconds: recording.seconds,
        map: None,
        result: serde_json::Value::Null,
        warnings: BTreeMap::new(),
        cost: Cost::default(),
    };
    for (stage, part) in tasks {
        let Some(record) = TaskRecord::find(store, &task_key(recording, stage, part, parts))? else {
            row.missing.get_or_insert_with(|| match stage {
                Stage::Predict => format!("{stage}, part {part}"),
                _ => stage.to_string(),
            });
            continue;
        };
        row.cost.add(&record.cost);
        for (kind, count) in &record.warnings {
            *row.warnings.entry(kind.clone()).or_default() += count;
        }
        row.problem = row.problem.or(record.problem);
        if stage == Stage::Map {
            // Of a map that was made in other parts, these are not missing.
            row.missing = None;
            (row.state, row.result) = (name(record.status), record.result);
            row.map = (record.status != Status::Failed).then_some(record.folder);
        }
    }
    Ok(row)
}

fn name(status: Status) -> &'static str {
    match status {
        Status::Done => "done",
        Status::Degraded => "degraded",
        Status::Failed => "failed",
    }
}

impl Table {
    /// The table for people.
    pub fn markdown(&self) -> String {
        let mut text = String::from(
            "| recording | state | images | keyframes | ATE m | \\|ln s\\| | F 5 cm | processor s | read | written | what |\n\
             |---|---|---:|---:|---:|---:|---:|---:|---:|---:|---|\n",
        );
        for row in &self.recordings {
            // Writing to a string does not fail.
            let _ = writeln!(text, "| {} |", row.cells().join(" | "));
        }
        let counts: Vec<String> = self.counts.iter().map(|(state, n)| format!("{n} {state}")).collect();
        let (cost, processor) = (&self.cost, number(self.cost.processor_seconds, 1));
        let volume = |n: Option<u64>| n.map_or_else(|| "–".to_owned(), bytes);
        let _ = writeln!(
            text,
            "\n{} recordings: {}. In all {processor} processor s, {} read, {} written; {} from the store, {} to it.",
            self.recordings.len(),
            counts.join(", "),
            volume(cost.read_bytes),
            volume(cost.written_bytes),
            bytes(cost.from_store_bytes),
            bytes(cost.to_store_bytes),
        );
        text
    }
}

impl Row {
    fn cells(&self) -> Vec<String> {
        let score = |name: &str| self.result["scores"][name].as_f64();
        let count = |n: Option<u64>| n.map_or_else(|| "–".to_owned(), |n| n.to_string());
        let volume = |n: Option<u64>| n.map_or_else(|| "–".to_owned(), bytes);
        vec![
            cell(&self.recording),
            self.state.to_owned(),
            count(self.images.map(|n| n as u64)),
            count(self.result["keyframes"].as_u64()),
            number(score("ate"), 4),
            number(score("scale"), 4),
            number(score(F), 3),
            number(self.cost.processor_seconds, 1),
            volume(self.cost.read_bytes),
            volume(self.cost.written_bytes),
            cell(&self.what()),
        ]
    }

    /// The error, what is missing, or the verdict.
    fn what(&self) -> String {
        match (&self.problem, &self.missing) {
            (Some(problem), _) => format!("{}: {}", problem.code, problem.message),
            (None, Some(missing)) => format!("no result yet: {missing}"),
            (None, None) => self.result["verdict"]["reasons"][0].as_str().unwrap_or_default().to_owned(),
        }
    }
}

/// Text of a recording in a cell: no line break, no border.
fn cell(text: &str) -> String {
    printable(text).replace('|', "\\|")
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
}
