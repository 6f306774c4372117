//! `trajectory/live.tum`: the pose of every image as it was known when the image came, written line by line.

use crate::engine::FrameState;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::RunFolder;
use std::fs::File;
use std::io::Write;
use std::path::PathBuf;

/// Relative to the run folder.
pub(super) const FILE: &str = "trajectory/live.tum";

/// The open file. Each line is one write, so that a program that follows it, or a kill, finds whole lines.
pub(super) struct PoseFile<'a> {
    path: PathBuf,
    file: File,
    segment: Option<u32>,
    bytes: u64,
    events: &'a Events,
}

impl<'a> PoseFile<'a> {
    /// Begins it anew.
    pub fn create(folder: &RunFolder, events: &'a Events) -> Result<Self, Error> {
        let path = folder.file(FILE)?;
        let file = File::create(&path).map_err(|e| Error::io("create", &path, e))?;
        // Told before the first pose, so that a run that is killed knows the file as its own.
        events.emit(&Event::ArtifactWritten { path: FILE.into(), bytes: 0 });
        let mut this = Self { path, file, segment: None, bytes: 0, events };
        this.line(
            "# world_from_camera as known when each image came: time (s), position (m), quaternion x y z w",
        )?;
        Ok(this)
    }

    fn line(&mut self, line: &str) -> Result<(), Error> {
        let line = format!("{line}\n");
        self.bytes += line.len() as u64;
        self.file.write_all(line.as_bytes()).map_err(|e| Error::io("write", &self.path, e))
    }

    /// Adds the pose of an image.
    pub fn add(&mut self, state: &FrameState) -> Result<(), Error> {
        if self.segment.replace(state.segment) != Some(state.segment) {
            self.line(&format!(
                "# segment {}: poses of different segments have no common world",
                state.segment
            ))?;
        }
        let (time, pose) = (state.time, &state.world_from_camera);
        let t = &pose.translation;
        let [x, y, z, w] = pose.rotation.quaternion_xyzw();
        self.line(&format!("{time} {} {} {} {x} {y} {z} {w}", t.x, t.y, t.z))
    }

    /// Tells how large it became.
    pub fn finish(self) {
        self.events.emit(&Event::ArtifactWritten { path: FILE.into(), bytes: self.bytes });
    }
}
