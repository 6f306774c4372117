//! Keyframes as the model sees them: read, undistorted, with their prior pose.

use crate::events::Events;
use crate::keyframes::Keyframe;
use rayon::prelude::*;
use std::ops::Range;
use vidar_core::remap::RemapTable;
use vidar_core::{ChunkView, Warning};
use vidar_dataset::Dataset;

/// A window of undistorted keyframes that moves forward through the sequence; each image is read once.
pub struct ViewWindow<'a> {
    dataset: &'a Dataset,
    keyframes: &'a [Keyframe],
    remap: &'a RemapTable,
    /// Keyframe index with its view, ascending. Unreadable images are missing.
    views: Vec<(usize, ChunkView)>,
    next: usize,
}

impl<'a> ViewWindow<'a> {
    /// An empty window before the first keyframe.
    pub fn new(dataset: &'a Dataset, keyframes: &'a [Keyframe], remap: &'a RemapTable) -> Self {
        Self { dataset, keyframes, remap, views: Vec::new(), next: 0 }
    }

    /// Moves the window to the keyframes `seen`, reading what is new. Unreadable images are warned of and left out.
    pub fn advance(&mut self, seen: &Range<usize>, events: &Events) {
        self.views.retain(|(index, _)| seen.contains(index));
        let fresh: Vec<usize> = (self.next.max(seen.start)..seen.end).collect();
        let loaded: Vec<_> = fresh.par_iter().map(|&index| (index, self.load(index))).collect();
        for (index, result) in loaded {
            match result {
                Ok(view) => self.views.push((index, view)),
                Err(warning) => events.warn(&warning),
            }
        }
        self.next = self.next.max(seen.end);
    }

    /// Hands the views out and, beside them, which of them lie in `core`.
    pub fn take(&mut self, core: &Range<usize>) -> (Vec<ChunkView>, Range<usize>, Vec<usize>) {
        let (indices, views): (Vec<usize>, Vec<ChunkView>) =
            std::mem::take(&mut self.views).into_iter().unzip();
        let start = indices.partition_point(|&i| i < core.start);
        let end = indices.partition_point(|&i| i < core.end);
        (views, start..end, indices)
    }

    /// Takes the views back.
    pub fn put_back(&mut self, views: Vec<ChunkView>, indices: Vec<usize>) {
        self.views = indices.into_iter().zip(views).collect();
    }

    /// Reads one keyframe, wherever it lies.
    pub fn load(&self, index: usize) -> Result<ChunkView, Warning> {
        let keyframe = &self.keyframes[index];
        let place = || keyframe.image.path.display().to_string();
        let image = self
            .dataset
            .load_image(&keyframe.image)
            .map_err(|e| Warning::new("image-unreadable", e.to_string()).at(place()))?;
        Ok(ChunkView {
            frame_id: keyframe.image.frame_id,
            time: keyframe.image.time,
            image: self.remap.apply(&image),
            intrinsics: *self.remap.target(),
            world_from_camera: keyframe.world_from_camera,
        })
    }
}
