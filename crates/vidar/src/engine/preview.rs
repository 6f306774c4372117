//! Keyframes that wait for their chunk, shown in the growing surface by the views that there are.
//!
//! A chunk is predicted when the keyframes after it are there, which takes long where the camera moves slowly. Who watches live sees
//! such keyframes before, by a prediction without those; the chunk replaces it. Where keyframes are few, as after the start, images
//! between them help. Who got no depth is tried again when the camera has moved. The map knows nothing of it.

use super::events::MapKeyframe;
use super::placed::placed_view;
use super::setup::{GeometrySource, ImageSource};
use super::track::{PosedFrame, Segment};
use super::views::{MaskedView, Taken, ViewWindow};
use super::{Engine, Sink};
use crate::error::Error;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;
use vidar_align::aligner::ViewPlacement;
use vidar_align::color_at_size;
use vidar_core::{AlignedView, CameraModel, ChunkId, ChunkViews, Duration, Pinhole, Timestamp, ViewGeometry};

/// Fewest views of a preview. What fewer than three other views check is lost: MH_01's first two keyframes alone got no depth.
const FEWEST_VIEWS: usize = 4;

/// Images that help a keyframe that got no depth before.
const HELP_OF_RETRIES: usize = 2;

/// Least distance between an image that helps and the other views, m: at a depth of 2 m some 2 pixels of parallax in a view 400 wide.
const LEAST_BASELINE_M: f64 = 0.01;

/// Images among which help is looked for: 10 s at 20 Hz. A camera may rest for an hour.
const RECENT: usize = 200;

/// Finds which keyframes are due, and their depth.
pub struct Preview<'a> {
    max_wait: Duration,
    /// Keyframes of a chunk, and those that it sees before them.
    size: usize,
    context: usize,
    /// Its own: what is known by now of how an image's rows were read is less than the chunk will know.
    window: ViewWindow<'a>,
    /// Keyframes before this one were tried, the last time when images up to this time had a pose.
    tried: usize,
    tried_at: Option<Timestamp>,
    /// Whether there is time for it.
    pub has_time: bool,
}

/// What one preview is made of.
#[derive(Debug, PartialEq)]
pub struct Due {
    /// Keyframes to show.
    pub wanted: Range<usize>,
    /// Images of the track that help them, as indices of its frames.
    pub helping: Vec<usize>,
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
        Self { max_wait, size: size.max(1), context, window, tried: 0, tried_at: None, has_time: false }
    }

    /// Goes back before the first keyframe.
    pub fn reset(&mut self) {
        self.window.reset();
        (self.tried, self.tried_at) = (0, None);
    }

    /// Keyframes to show now: those that are not shown yet, once one of them has waited for too long, since it came or since it was
    /// tried. The first `chunks` chunks are predicted. Nothing where the views are too few, or the same as the last time.
    pub fn due(
        &self,
        keyframes: &[MapKeyframe],
        is_shown: impl Fn(&MapKeyframe) -> bool,
        chunks: usize,
        track: &[PosedFrame],
    ) -> Option<Due> {
        let known_until = track.last()?.stamp.time;
        let is_hidden = |k: &usize| !is_shown(&keyframes[*k]);
        let first = (chunks * self.size..keyframes.len()).find(is_hidden)?;
        let is_late_by = |wait: Duration, since: Timestamp| known_until > since + wait;
        let is_late = |since: Timestamp| is_late_by(self.max_wait, since);
        let untried = (self.tried.max(first)..keyframes.len()).find(is_hidden);
        let new = untried.filter(|k| is_late(keyframes[*k].stamp.time));
        // Where keyframes go on coming, the chunk is near.
        let may_retry = first < self.tried && (untried.is_none() || keyframes.len() < FEWEST_VIEWS);
        // Who waited once waits for the camera to move, which may be at any time, and a try that finds nothing is cheap.
        let retry_wait = Duration::from_nanos(self.max_wait.nanos() / 2);
        let is_retried = may_retry && self.tried_at.is_some_and(|since| is_late_by(retry_wait, since));
        let from = if is_retried { Some(first) } else { new }.filter(|_| self.has_time)?;
        let seen = &keyframes[from.saturating_sub(self.context)..];
        let few = FEWEST_VIEWS.saturating_sub(seen.len());
        let since = track.partition_point(|f| f.stamp.time <= keyframes[from].stamp.time);
        let since = since.max(track.len().saturating_sub(RECENT));
        let more = if is_retried { few.max(HELP_OF_RETRIES) } else { few };
        let helping = spread(seen, (track, since), more);
        let is_other = !is_retried || helping.iter().any(|&k| Some(track[k].stamp.time) > self.tried_at);
        (helping.len() >= few && is_other).then_some(Due { wanted: from..keyframes.len(), helping })
    }

    /// The views of these keyframes at the poses and in the metres of their track, each with the chunk that it will be of.
    pub fn predict(
        &mut self,
        geometry: &mut dyn GeometrySource,
        cancelled: &(dyn Fn() -> bool + Sync),
        keyframes: &[MapKeyframe],
        (track, readout): (&Segment, Duration),
        Due { wanted, helping }: Due,
    ) -> Result<Vec<(ChunkId, AlignedView)>, Error> {
        (self.tried, self.tried_at) = (wanted.end, track.frames.last().map(|f| f.stamp.time));
        let seen = wanted.start.saturating_sub(self.context)..wanted.end;
        let mut keyframes = Cow::Borrowed(&keyframes[..wanted.end]);
        for k in seen.clone() {
            if let Some(warp) = track.image_warp(keyframes[k].stamp.frame_id, readout) {
                keyframes.to_mut()[k].warp = Some(warp);
            }
        }
        // The chunk reports images that cannot be read.
        self.window.advance(&keyframes, &seen, &mut Vec::new());
        let chunk_of = |k: usize| ChunkId(u32::try_from(k / self.size).unwrap_or(u32::MAX));
        let helping: Vec<MaskedView> =
            helping.par_iter().filter_map(|&k| self.window.load(&help(track, k, readout)).ok()).collect();
        let Taken { mut views, mut masks, wanted, indices } = self.window.take(&wanted);
        for (view, mask) in helping {
            views.push(view);
            masks.push(mask);
        }
        let mut chunk = ChunkViews { id: chunk_of(seen.start), views };
        let predicted = geometry.predict(&chunk, &masks, wanted, &|_| cancelled());
        let place = |view: ViewGeometry| {
            let at = chunk.views.iter().position(|v| v.frame_id == view.frame_id)?;
            let (image, owner) = (&chunk.views[at], chunk_of(*indices.get(at)?));
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
            // The chunk tells why.
            Err(_) => Ok(Vec::new()),
        };
        chunk.views.truncate(indices.len());
        masks.truncate(indices.len());
        self.window.put_back(chunk.views, masks, indices);
        views
    }
}

/// At most `count` frames from `since` on, each far from the views that there are and from those chosen before: the farthest first.
fn spread(seen: &[MapKeyframe], (track, since): (&[PosedFrame], usize), count: usize) -> Vec<usize> {
    let position = |k: usize| track[k].world_from_camera.translation;
    let mut taken: Vec<Vector3<f64>> =
        seen.iter().filter_map(|k| k.world_from_camera).map(|pose| pose.translation).collect();
    let mut chosen = Vec::new();
    while chosen.len() < count {
        let nearest = |k: usize| taken.iter().map(|p| (p - position(k)).norm()).fold(f64::INFINITY, f64::min);
        let farthest = (since..track.len()).map(|k| (nearest(k), k)).max_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, k)) = farthest.filter(|(distance, _)| *distance >= LEAST_BASELINE_M) else { break };
        taken.push(position(k));
        chosen.push(k);
    }
    chosen.sort_unstable();
    chosen
}

/// A frame of the track as if it were a keyframe.
fn help(track: &Segment, k: usize, readout: Duration) -> MapKeyframe {
    let PosedFrame { stamp, world_from_camera, .. } = track.frames[k];
    MapKeyframe {
        stamp,
        world_from_camera: Some(world_from_camera),
        warp: track.image_warp(stamp.frame_id, readout),
        odometry: None,
    }
}

impl Engine<'_> {
    /// Shows keyframes in the growing surface that would wait too long for their chunk.
    pub(super) fn preview(&mut self, sink: &mut Sink<'_>) -> Result<(), Error> {
        let (Some(preview), Some(growing)) = (&mut self.preview, &mut self.growing) else { return Ok(()) };
        let (Some(world), Some(track)) = (&self.world, self.track.longest()) else { return Ok(()) };
        let is_shown = |k: &MapKeyframe| growing.shows(k.stamp.frame_id);
        let due = preview.due(&world.keyframes, is_shown, world.chunks, &track.frames);
        let Some(due) = due else { return Ok(()) };
        let seen = (track, self.readout);
        let (geometry, keyframes) = (&mut *self.predictor.geometry, &world.keyframes);
        let views = preview.predict(geometry, self.cancelled, keyframes, seen, due)?;
        growing.preview(views, self.predictor.store)?.into_iter().try_for_each(&mut *sink)
    }
}
