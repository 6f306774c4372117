//! `log.jsonl`: every event of a run, one line each.

use crate::events::{EVENT_SCHEMA, Event};
use std::fs::File;
use std::io::Write;
use std::sync::{Mutex, PoisonError};
use vidar_core::Warning;

/// Its name in the run folder.
pub(super) const LOG: &str = "log.jsonl";

/// The open log; none after a failure.
#[derive(Debug)]
pub(super) struct EventLog(Mutex<Option<File>>);

impl EventLog {
    /// Appends to `file`.
    pub fn new(file: File) -> Self {
        Self(Mutex::new(Some(file)))
    }

    /// Appends an event. The first failure is returned as a warning and ends the log: half a line would spoil those after it.
    pub fn append(&self, event: &Event) -> Option<Warning> {
        let mut guard = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let file = guard.as_mut()?;
        let written = serde_json::to_string(&event_line(event))
            .map_err(std::io::Error::from)
            .and_then(|line| writeln!(file, "{}", vidar_core::printable_json(&line)));
        let error = written.err()?;
        *guard = None;
        Some(Warning::degraded("log-incomplete", format!("events from here on are missing: {error}")).at(LOG))
    }
}

/// An event with its schema, as one JSON object.
pub fn event_line(event: &Event) -> serde_json::Value {
    let mut line = serde_json::json!({ "schema": EVENT_SCHEMA });
    if let (Some(object), Ok(serde_json::Value::Object(fields))) =
        (line.as_object_mut(), serde_json::to_value(event))
    {
        object.extend(fields);
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_folder::{OutputLocation, RunFolder};

    #[test]
    fn events_are_lines_with_a_schema() {
        let base = tempfile::tempdir().unwrap();
        let folder =
            RunFolder::create(&OutputLocation::Exact { path: base.path().join("r"), force: false }).unwrap();
        assert_eq!(folder.log(&Event::StageStarted { stage: "stereo", total: 3 }), None);
        let warning = Warning::new("time-gap", "0.5 s without images").at("cam0");
        assert_eq!(folder.log(&Event::Warning { warning }), None);
        let text = std::fs::read_to_string(folder.path().join("log.jsonl")).unwrap();
        let lines: Vec<serde_json::Value> = text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        assert_eq!(
            lines[0],
            serde_json::json!({"schema": EVENT_SCHEMA, "event": "stage-started", "stage": "stereo", "total": 3})
        );
        assert_eq!(lines[1]["kind"], "time-gap");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_log_that_cannot_be_written_is_told_once() {
        // Every write to this device fails as on a full disk.
        let log = EventLog::new(File::options().write(true).open("/dev/full").unwrap());
        let event = Event::StageStarted { stage: "stereo", total: 3 };
        assert_eq!(log.append(&event).map(|w| w.kind), Some("log-incomplete".into()));
        assert_eq!(log.append(&event), None);
    }
}
