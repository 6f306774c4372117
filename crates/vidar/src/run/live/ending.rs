//! Poses that are found on the odometry's thread, as the engine sees their source.

use crate::engine::{FrameStamp, PoseReport, PoseSource};
use crate::error::Error;
use crate::input::TrajectorySource;
use crate::quality::TrackQuality;
use std::sync::{Arc, OnceLock};
use vidar_core::{SensorEvent, Warning};

/// What the odometry says when the recording has ended.
#[derive(Debug, Default)]
pub(in crate::run) struct Ending {
    /// Images that still waited.
    pub reports: Vec<PoseReport>,
    pub warnings: Vec<Warning>,
    pub why_no_pose: String,
    pub quality: Option<TrackQuality>,
}

impl Ending {
    /// The end of a source.
    pub fn of(poses: &mut dyn PoseSource) -> Self {
        Self {
            reports: poses.finish(),
            warnings: poses.warnings(),
            why_no_pose: poses.why_no_pose(),
            quality: poses.quality().cloned(),
        }
    }
}

/// Where a thread leaves its ending.
pub(in crate::run) type EndingCell = Arc<OnceLock<Ending>>;

/// The source of the poses that come by [`crate::engine::Engine::push_tracked`].
pub(in crate::run) struct TrackedElsewhere {
    source: TrajectorySource,
    ending: EndingCell,
}

impl TrackedElsewhere {
    pub fn new(source: TrajectorySource, ending: EndingCell) -> Self {
        Self { source, ending }
    }
}

impl PoseSource for TrackedElsewhere {
    fn source(&self) -> TrajectorySource {
        self.source.clone()
    }

    fn needs_sensors(&self) -> bool {
        false
    }

    fn push(&mut self, _: SensorEvent) -> Result<Vec<PoseReport>, Error> {
        Ok(Vec::new())
    }

    fn push_stamp(&mut self, _: &FrameStamp) -> Vec<PoseReport> {
        Vec::new()
    }

    fn finish(&mut self) -> Vec<PoseReport> {
        self.ending.get().map_or_else(Vec::new, |e| e.reports.clone())
    }

    fn warnings(&self) -> Vec<Warning> {
        self.ending.get().map_or_else(Vec::new, |e| e.warnings.clone())
    }

    fn why_no_pose(&self) -> String {
        self.ending.get().map_or_else(|| "it did not end".into(), |e| e.why_no_pose.clone())
    }

    fn quality(&self) -> Option<&TrackQuality> {
        self.ending.get()?.quality.as_ref()
    }
}
