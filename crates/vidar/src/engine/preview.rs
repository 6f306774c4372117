//! Keyframes that wait for their chunk, shown in the growing surface by the views that there are.
//!
//! A chunk is predicted when the keyframes after it are there, which takes long where the camera moves slowly. Who watches live sees
//! such keyframes before, by a prediction without those; the chunk replaces it. The map knows nothing of it.

use super::events::MapKeyframe;
use super::placed::placed_view;
use super::setup::{GeometrySource, ImageSource};
use super::track::Segment;
use super::views::{Taken, ViewWindow};
use super::{Engine, Sink};
use crate::error::Error;
use std::borrow::Cow;
use std::ops::Range;
use vidar_align::aligner::ViewPlacement;
use vidar_align::color_at_size;
use vidar_core::{
    AlignedView, CameraModel, ChunkId, ChunkViews, Duration, ModelError, Pinhole, Timestamp, ViewGeometry,
};

/// Fewest views of a preview. What fewer than three other views check is lost: MH_01's first two keyframes alone got no depth.
const FEWEST_VIEWS: usize = 4;

/// Finds which keyframes are due, and their depth.
pub struct Preview<'a> {
    max_wait: Duration,
    /// Keyframes of a chunk, and those that it sees before them.
    size: usize,
    context: usize,
    /// Its own: what is known by now of how an image's rows were read is less than the chunk will know.
    window: ViewWindow<'a>,
    /// Keyframes before this one had their preview.
    done: usize,
    /// Whether there is time for it.
    pub has_time: bool,
}

impl<'a> Preview<'a> {
    /// None is due yet. A chunk has `size` keyframes and sees `context` before them.
    pub fn new(
        max_wait: Duration,
        (size, context): (usize, usize),
        images: &'a dyn ImageSource,
        (camera, view): (&CameraModel, &Pinhole),
    ) -> Self {
        let window = ViewWindow::new(images, camera, view);
        Self { max_wait, size: size.max(1), context, window, done: 0, has_time: false }
    }

    /// Goes back before the first keyframe.
    pub fn reset(&mut self) {
        self.window.reset();
        self.done = 0;
    }

    /// Keyframes to show now: those without a preview, once the first of them has waited for too long. The first `chunks` chunks are
    /// predicted; images up to `known_until` are keyframes or not.
    pub fn due(
        &self,
        mut times: impl ExactSizeIterator<Item = Timestamp>,
        chunks: usize,
        known_until: Timestamp,
    ) -> Option<Range<usize>> {
        let (first, end) = (self.done.max(chunks * self.size), times.len());
        let is_late = known_until > times.nth(first)? + self.max_wait;
        let enough = end - first.saturating_sub(self.context) >= FEWEST_VIEWS;
        (self.has_time && is_late && enough).then_some(first..end)
    }

    /// The views of these keyframes at the poses and in the metres of their track, each with the chunk that it will be of.
    pub fn predict(
        &mut self,
        geometry: &mut dyn GeometrySource,
        cancelled: &(dyn Fn() -> bool + Sync),
        keyframes: &[MapKeyframe],
        (track, readout): (&Segment, Duration),
        wanted: Range<usize>,
    ) -> Result<Vec<(ChunkId, AlignedView)>, Error> {
        self.done = wanted.end;
        let seen = wanted.start.saturating_sub(self.context)..wanted.end;
        let mut keyframes = Cow::Borrowed(&keyframes[..wanted.end]);
        if readout > Duration::ZERO {
            for keyframe in &mut keyframes.to_mut()[seen.clone()] {
                keyframe.row_motion = track.row_motion(keyframe.stamp.frame_id, readout);
            }
        }
        // The chunk reports images that cannot be read.
        self.window.advance(&keyframes, &seen, &mut Vec::new());
        let chunk_of = |k: usize| ChunkId(u32::try_from(k / self.size).unwrap_or(u32::MAX));
        let Taken { views, masks, wanted, indices } = self.window.take(&wanted);
        let chunk = ChunkViews { id: chunk_of(seen.start), views };
        let predicted = geometry.predict(&chunk, &masks, wanted, &|_| cancelled());
        let place = |view: ViewGeometry| {
            let at = chunk.views.iter().position(|v| v.frame_id == view.frame_id)?;
            let (image, owner) = (&chunk.views[at], chunk_of(indices[at]));
            let place = ViewPlacement {
                frame_id: view.frame_id,
                owner,
                world_from_camera: view.chunk_from_camera,
                metres_per_unit: 1.0,
                field: None,
            };
            let color = color_at_size(&image.image, view.intrinsics.width, view.intrinsics.height);
            Some(placed_view(view, image.time, &place, Some(color)).map(|placed| (owner, placed)))
        };
        let views = match predicted {
            Ok(prediction) => prediction.geometry.views.into_iter().filter_map(place).collect(),
            Err(error @ ModelError::OutOfReach(_)) => Err(error.into()),
            // The chunk tells why.
            Err(_) => Ok(Vec::new()),
        };
        self.window.put_back(chunk.views, masks, indices);
        views
    }
}

impl Engine<'_> {
    /// Shows keyframes in the growing surface that would wait too long for their chunk.
    pub(super) fn preview(&mut self, sink: &mut Sink<'_>) -> Result<(), Error> {
        let (Some(preview), Some(growing)) = (&mut self.preview, &mut self.growing) else { return Ok(()) };
        let (Some(world), Some(track)) = (&self.world, self.track.longest()) else { return Ok(()) };
        let Some(known_until) = track.frames.last().map(|f| f.stamp.time) else { return Ok(()) };
        let stamps = world.keyframes.iter().map(|k| k.stamp.time);
        let Some(wanted) = preview.due(stamps, world.chunks, known_until) else { return Ok(()) };
        let seen = (track, self.readout);
        let (geometry, keyframes) = (&mut *self.predictor.geometry, &world.keyframes);
        let views = preview.predict(geometry, self.cancelled, keyframes, seen, wanted)?;
        growing.preview(views, self.predictor.store)?.into_iter().try_for_each(&mut *sink)
    }
}
