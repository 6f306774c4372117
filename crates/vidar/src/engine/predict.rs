//! Predict: depth of a chunk's keyframes, kept until the chunk is placed.

use super::events::{MapEvent, MapKeyframe};
use super::setup::{
    GeometrySource, ImageSource, PlaceDescriber, PredictedFrame, Prediction, PredictionId, PredictionStore,
};
use super::stereo_landmarks::StereoLandmarks;
use super::views::{MaskedView, Taken, ViewWindow, blanked};
use crate::chunks::StoredChunk;
use crate::error::Error;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use vidar_align::aligner::{DepthPoint, LoopCandidate};
use vidar_align::chunking::ChunkSpan;
use vidar_align::color_at_size;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, Confidence, FrameId, GeometryPrediction, Image, ModelError,
    RelativeDepth, RigCamera, ViewGeometry, Warning,
};

/// The geometry model with all that it works on.
pub struct Predictor<'a> {
    /// The geometry model.
    pub geometry: &'a mut dyn GeometrySource,
    /// Describes places.
    pub places: &'a dyn PlaceDescriber,
    /// Keeps predictions.
    pub store: &'a dyn PredictionStore,
    /// Asked now and then; `true` stops.
    pub cancelled: &'a (dyn Fn() -> bool + Sync),
    /// Told which share of a prediction is done.
    pub predicting: &'a (dyn Fn(f64) + Sync),
    /// Landmarks by stereo, where chunks are fitted to them.
    pub stereo_landmarks: Option<StereoLandmarks>,
    window: ViewWindow<'a>,
}

impl<'a> Predictor<'a> {
    /// A predictor before the first chunk.
    pub fn new(
        geometry: &'a mut dyn GeometrySource,
        places: &'a dyn PlaceDescriber,
        (images, store): (&'a dyn ImageSource, &'a dyn PredictionStore),
        (camera, view): (&RigCamera, &vidar_core::Pinhole),
        (cancelled, predicting): (&'a (dyn Fn() -> bool + Sync), &'a (dyn Fn(f64) + Sync)),
    ) -> Self {
        let window = ViewWindow::new(images, &camera.model, view);
        Self { geometry, places, store, cancelled, predicting, stereo_landmarks: None, window }
    }

    /// What a model at work calls.
    fn watch(&self) -> impl Fn(f64) -> bool + Sync + use<'a> {
        let (cancelled, predicting) = (self.cancelled, self.predicting);
        move |share| {
            predicting(share);
            cancelled()
        }
    }

    /// Goes back before the first chunk.
    pub fn reset(&mut self) {
        self.window.reset();
    }

    /// The prediction of a chunk: an earlier run's where there is one. `None` when cancelled.
    pub fn predict(
        &mut self,
        chunk: ChunkId,
        span: &ChunkSpan,
        keyframes: &[MapKeyframe],
        events: &mut Vec<MapEvent>,
    ) -> Result<Option<StoredChunk>, Error> {
        let id = PredictionId::Chunk(chunk);
        let frames = made_of(keyframes, span.core.clone().chain(span.seen.clone()));
        let kept = self.store.find(id, &frames);
        let is_reused = kept.is_some();
        let stored = match kept {
            Some(kept) => kept,
            None => match self.predict_fresh(id, span, keyframes, events)? {
                Some(fresh) => self.store.keep(id, &frames, &fresh)?,
                None => return Ok(None),
            },
        };
        let (wanted, with_depth) = (self.wanted(span).len(), stored.prediction.views.len());
        let pose_std = stored.pose_std.clone();
        events.push(MapEvent::ChunkPredicted { chunk, keyframes: wanted, with_depth, is_reused, pose_std });
        if let Some(reason) = &stored.failure {
            events.push(MapEvent::Warning(Warning::degraded("chunk-failed", reason.clone()).at(id)));
        }
        Ok(Some(stored))
    }

    /// Keyframes whose depth is computed: of overlapping chunks all, so that neighbours can be compared.
    fn wanted(&self, span: &ChunkSpan) -> Range<usize> {
        if self.geometry.overlaps() { span.seen.clone() } else { span.core.clone() }
    }

    fn predict_fresh(
        &mut self,
        id: PredictionId,
        span: &ChunkSpan,
        keyframes: &[MapKeyframe],
        events: &mut Vec<MapEvent>,
    ) -> Result<Option<StoredChunk>, Error> {
        self.window.advance(keyframes, &span.seen, events);
        let wanted = self.wanted(span);
        let Taken { views, masks, wanted, indices } = self.window.take(&wanted);
        let expected = wanted.len();
        let views = ChunkViews { id: id.model_number(), views };
        let watch = self.watch();
        let predicted = match self.geometry.predict(&views, &masks, wanted, &watch) {
            Err(ModelError::Cancelled) => None,
            Err(error @ ModelError::OutOfReach(_)) => return Err(error.into()),
            Err(error) => Some(failed(id, error.to_string())),
            Ok(prediction) if prediction.geometry.views.is_empty() => {
                Some(failed(id, "no keyframe of the chunk got depth".into()))
            }
            Ok(prediction) => {
                let missing = expected.saturating_sub(prediction.geometry.views.len());
                if missing > 0 {
                    let message = format!("{missing} of {expected} keyframes got no depth");
                    let warning = Warning::new("keyframes-without-depth", message).at(id);
                    events.push(MapEvent::Warning(warning));
                }
                let Prediction { geometry, colors, tokens, shapes, pose_std, warnings } = prediction;
                events.extend(warnings.into_iter().map(|w| MapEvent::Warning(w.at(id))));
                let mut stored = StoredChunk { shapes, pose_std, ..colored(geometry, &views.views, colors) };
                mask(&mut stored, &views.views, &masks);
                self.places.describe(&mut stored, &tokens)?;
                Some(stored)
            }
        };
        self.window.put_back(views.views, masks, indices);
        Ok(predicted)
    }

    /// Landmarks of a chunk's views by stereo; the map does without where stereo fails.
    pub fn landmarks(
        &mut self,
        span: &ChunkSpan,
        keyframes: &[MapKeyframe],
        prediction: &GeometryPrediction,
        events: &mut Vec<MapEvent>,
    ) -> BTreeMap<FrameId, Vec<DepthPoint>> {
        let Some(stereo) = &self.stereo_landmarks else { return BTreeMap::new() };
        self.window.advance(keyframes, &span.seen, events);
        let Taken { views, masks, indices, .. } = self.window.take(&span.seen);
        let landmarks = stereo.find(prediction, &views, &masks, &|_| (self.cancelled)());
        self.window.put_back(views, masks, indices);
        landmarks.unwrap_or_else(|error| {
            let place = PredictionId::Chunk(prediction.chunk_id);
            let warning = Warning::degraded("no-stereo-landmarks", error.to_string()).at(place);
            events.push(MapEvent::Warning(warning));
            BTreeMap::new()
        })
    }

    /// The prediction of both ends of a revisit together. `None` when cancelled, or with a degradation where it failed.
    pub fn predict_loop(
        &mut self,
        candidate: &LoopCandidate,
        keyframes: &[MapKeyframe],
        events: &mut Vec<MapEvent>,
    ) -> Result<Option<GeometryPrediction>, Error> {
        let id = PredictionId::Loop { later: candidate.later, earlier: candidate.earlier };
        let frames = candidate.earlier_window.iter().chain(&candidate.later_window);
        let place = |id| keyframes.iter().position(|k| k.stamp.frame_id == id);
        let seen: Vec<usize> = frames.filter_map(|id| place(*id)).collect();
        let made_of = made_of(keyframes, seen.iter().copied());
        if let Some(kept) = self.store.find(id, &made_of) {
            return Ok(Some(kept.prediction));
        }
        let mut not_predicted = |reason: String| {
            let hint = "the geometry that is stored of the two chunks is compared instead";
            events.push(MapEvent::Warning(Warning::degraded("loop-not-predicted", reason).at(id).hint(hint)));
        };
        let views: Result<Vec<MaskedView>, Warning> =
            seen.iter().map(|k| self.window.load(&keyframes[*k])).collect();
        let (views, masks): (_, Vec<_>) = match views {
            Ok(views) => {
                let (views, masks) = views.into_iter().unzip();
                (ChunkViews { id: id.model_number(), views }, masks)
            }
            Err(warning) => {
                not_predicted(warning.to_string());
                return Ok(None);
            }
        };
        let watch = self.watch();
        let geometry = match self.geometry.predict(&views, &masks, 0..seen.len(), &watch) {
            Ok(prediction) => prediction.geometry,
            Err(ModelError::Cancelled) => return Ok(None),
            Err(error @ ModelError::OutOfReach(_)) => return Err(error.into()),
            Err(error) => {
                not_predicted(error.to_string());
                return Ok(None);
            }
        };
        let mut stored = StoredChunk {
            times: geometry.views.iter().map(|_| Default::default()).collect(),
            ..StoredChunk::of(geometry)
        };
        mask(&mut stored, &views.views, &masks);
        Ok(Some(self.store.keep(id, &made_of, &stored)?.prediction))
    }
}

fn made_of(keyframes: &[MapKeyframe], indices: impl Iterator<Item = usize>) -> Vec<PredictedFrame> {
    indices.map(|k| (keyframes[k].stamp.time, keyframes[k].world_from_camera)).collect()
}

fn failed(id: PredictionId, reason: String) -> StoredChunk {
    let (chunk_id, frame) = (id.model_number(), ChunkFrame::ModelNative);
    let nothing = GeometryPrediction { chunk_id, frame, views: Vec::new() };
    StoredChunk { failure: Some(reason), ..StoredChunk::of(nothing) }
}

/// A prediction with the times and images of its views; the model's own `colors` are preferred to those of the input.
fn colored(prediction: GeometryPrediction, views: &[ChunkView], colors: Vec<Image<[u8; 3]>>) -> StoredChunk {
    let of = |id| views.iter().find(|v| v.frame_id == id);
    let times =
        prediction.views.iter().map(|v| of(v.frame_id).map_or_else(Default::default, |v| v.time)).collect();
    let resized = |v: &ViewGeometry| {
        of(v.frame_id).map(|image| color_at_size(&image.image, v.intrinsics.width, v.intrinsics.height))
    };
    let colors = match colors.len() == prediction.views.len() && !colors.is_empty() {
        true => colors,
        false => prediction.views.par_iter().map(resized).collect::<Option<_>>().unwrap_or_default(),
    };
    StoredChunk { times, colors, ..StoredChunk::of(prediction) }
}

/// Takes out of a prediction what is not to be used of its views, and notes it.
fn mask(stored: &mut StoredChunk, views: &[ChunkView], masks: &[Option<Image<bool>>]) {
    if masks.iter().all(Option::is_none) {
        return;
    }
    let of = |id| views.iter().zip(masks).find(|(v, _)| v.frame_id == id).and_then(|(_, mask)| mask.as_ref());
    stored.masks = stored
        .prediction
        .views
        .iter_mut()
        .map(|view| {
            let (width, height) = (view.intrinsics.width, view.intrinsics.height);
            let mask = at_size(of(view.frame_id)?, width, height);
            view.depth = RelativeDepth::new(blanked(view.depth.image(), &mask, f32::NAN));
            view.confidence = Confidence::new(blanked(view.confidence.image(), &mask, 0.0));
            Some(mask)
        })
        .collect();
}

/// A mask at another size: `true` where the pixel covers a `true` one.
fn at_size(mask: &Image<bool>, width: usize, height: usize) -> Image<bool> {
    let span = |at: usize, size: usize, of: usize| at * of / size..((at + 1) * of).div_ceil(size).min(of);
    Image::from_fn(width, height, |x, y| {
        let columns = span(x, width, mask.width());
        span(y, height, mask.height()).any(|row| mask.row(row)[columns.clone()].contains(&true))
    })
}
