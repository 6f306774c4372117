//! Many recordings into maps and one table, by as many processes on as many machines as there are.
//!
//! ```text
//! plan ─▶ track (each recording) ─▶ predict (each part of its chunks) ─▶ map (each recording) ─▶ report
//! ```
//!
//! [`plan`] writes a [`BatchPlan`] into a store, and [`work`] does one task of it: stage and number are all that a scheduler
//! has to hand over. A task reads recordings, and results of the stage before, and writes its own under the hash of all that they
//! depend on; the record that makes them valid comes last. So a task that is there is not done again, one that was killed left
//! nothing that counts, and tasks may run anywhere, in any order within a stage, and twice. A map has the same bits as that of
//! `vidar run` on the same recording with the same settings.

mod cost;
mod plan;
mod record;
mod report;
mod stages;
mod task;
mod work;

pub use cost::Cost;
pub use plan::{
    BatchPlan, PLAN_SCHEMA, PlanRequest, Planned, PlannedRecording, PlannedStage, plan, read_plan,
};
pub use record::{Problem, RECORD_SCHEMA, Stage, Status, StoredFile, TaskRecord};
pub use report::{REPORT_SCHEMA, Row, Table};
pub use task::WorkRequest;
pub use work::{WorkOutcome, work};

/// Largest plan or record that is read, bytes: a plan has some 400 bytes a recording.
const MAX_JSON_BYTES: u64 = 64 << 20;
