//! The map while it grows: `map/so_far.ply` after every chunk, with `output.live_map`.
//!
//! Each chunk is a volume of its own, placed where the aligner believes it to be; when a loop moves chunks, their volumes
//! move with them. Volumes of older chunks wait on disk, so that memory stays flat. The final map is fused from the
//! predictions at their last places, each keyframe once; this one is for whoever watches.

use crate::config::Config;
use crate::error::Error;
use crate::events::{Event, Events};
use crate::run_folder::RunFolder;
use std::collections::BTreeMap;
use std::path::PathBuf;
use vidar_align::Placement;
use vidar_core::{AlignedView, ChunkId, FrameId, Se3, Warning};
use vidar_fusion::{RevisedView, SubVolumeConfig, SubVolumes};

/// File of the growing map.
const SO_FAR: &str = "map/so_far.ply";
/// Chunks whose volumes are kept in memory.
const IN_MEMORY: usize = 2;

/// A growing map and the file that shows it.
pub(super) struct LiveMap {
    volumes: SubVolumes,
    /// Depth scale that each keyframe was fused with.
    fused: BTreeMap<FrameId, f64>,
    /// Chunks in memory, oldest first.
    fresh: Vec<ChunkId>,
    aside: PathBuf,
}

impl LiveMap {
    /// A map without chunks; volumes that are set aside go to `volumes/` in the run folder.
    pub(super) fn new(config: &Config, folder: &RunFolder) -> Result<Self, Error> {
        let config = SubVolumeConfig { fusion: config.fusion.clone(), ..SubVolumeConfig::default() };
        Ok(Self {
            volumes: SubVolumes::new(&config)?,
            fused: BTreeMap::new(),
            fresh: Vec::new(),
            aside: folder.path().join("volumes"),
        })
    }

    /// Adds a chunk's views, moves the others to where they are now, and writes the map so far.
    pub(super) fn grow(
        &mut self,
        chunk: ChunkId,
        views: &[AlignedView],
        placement: &Placement,
        folder: &RunFolder,
        events: &Events,
    ) -> Result<(), Error> {
        for view in views {
            if self.fused.contains_key(&view.frame_id()) {
                continue;
            }
            match self.volumes.integrate(chunk, view) {
                Ok(_) => {
                    let scale = placement.view(view.frame_id()).map_or(1.0, |p| p.metres_per_unit);
                    self.fused.insert(view.frame_id(), scale);
                }
                // The final map names what it lacks; this one goes without.
                Err(error) => events.warn(&Warning::new("live-map", error.to_string())),
            }
        }
        self.follow(placement)?;
        self.fresh.push(chunk);
        while self.fresh.len() > IN_MEMORY {
            let oldest = self.fresh.remove(0);
            if self.volumes.chunks().any(|c| c == oldest) {
                let bytes = self.volumes.set_aside(oldest)?;
                vidar_export::atomic::write_file_atomically(&self.made(oldest)?, &bytes)?;
            }
        }
        self.write(folder, events)
    }

    /// Moves every chunk with its keyframes.
    fn follow(&mut self, placement: &Placement) -> Result<(), Error> {
        let chunks: Vec<ChunkId> = self.volumes.chunks().collect();
        for chunk in chunks {
            let moved: Vec<RevisedView> = self
                .fused
                .iter()
                .filter(|(frame, _)| self.volumes.owner(**frame) == Some(chunk))
                .filter_map(|(frame, scale)| {
                    let now = placement.view(*frame)?;
                    let (frame_id, world_from_camera): (FrameId, Se3) = (*frame, now.world_from_camera);
                    // A frame whose depth comes from another chunk by now still tells where this one lies.
                    let factor = if now.owner == chunk { now.metres_per_unit / scale } else { 1.0 };
                    Some(RevisedView { frame_id, world_from_camera, depth_factor: factor })
                })
                .collect();
            if !moved.is_empty() {
                self.volumes.revise(chunk, &moved)?;
            }
        }
        Ok(())
    }

    fn write(&self, folder: &RunFolder, events: &Events) -> Result<(), Error> {
        let merged = self.volumes.merged_with(|chunk| {
            let path = self.path(chunk);
            std::fs::read(&path).map_err(|e| Error::io("read", &path, e))
        })?;
        let mesh = merged.extract_mesh();
        let target = folder.file(SO_FAR)?;
        let comments = vec!["VIDAR map so far: provisional places".to_owned()];
        vidar_export::atomic::write_atomically(&target, |w| {
            vidar_export::write_ply_mesh(w, &mesh, &comments)
        })?;
        let bytes = std::fs::metadata(&target).map_or(0, |m| m.len());
        events.emit(&Event::MapGrew { path: SO_FAR.to_owned(), bytes, triangles: mesh.triangles.len() });
        Ok(())
    }

    /// Removes what was only for watching.
    pub(super) fn clear(&self, folder: &RunFolder) {
        // What cannot be removed is only left behind.
        let _ = std::fs::remove_file(folder.path().join(SO_FAR));
        for chunk in self.volumes.chunks() {
            let _ = std::fs::remove_file(self.path(chunk));
        }
        let _ = std::fs::remove_dir(&self.aside);
    }

    fn path(&self, chunk: ChunkId) -> PathBuf {
        self.aside.join(format!("{:06}.volume", chunk.0))
    }

    fn made(&self, chunk: ChunkId) -> Result<PathBuf, Error> {
        std::fs::create_dir_all(&self.aside).map_err(|e| Error::io("create", &self.aside, e))?;
        Ok(self.path(chunk))
    }
}
