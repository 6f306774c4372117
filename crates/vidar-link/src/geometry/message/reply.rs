//! A worker's answer to a request.

use super::{PredictRequest, cut, nothing_behind, pinhole, rigid, size};
use crate::envelope::{self, within};
use crate::error::WireError;
use crate::geometry::pixels::DepthFormat;
use serde::{Deserialize, Serialize};
use vidar_core::model::ChunkFrame;
use vidar_core::{Confidence, FrameId, GeometryPrediction, Image, Pinhole, RelativeDepth, Se3, ViewGeometry};

/// The most numbers of a view's tokens: 8192 patches of 2048 channels.
const MAX_TOKENS: usize = 16 << 20;

/// A worker's answer to a request.
#[derive(Clone, Debug)]
pub struct PredictReply {
    /// As in the request.
    pub run: u64,
    /// As in the request.
    pub number: u64,
    /// Requests that wait at the worker now.
    pub queue: u32,
    /// What came out.
    pub outcome: Outcome,
}

/// What came out of a request.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// Geometry, and the tokens of its views where they were wanted.
    Predicted(GeometryPrediction, Vec<Vec<f32>>),
    /// The model's own error; another worker would say the same.
    ModelFailed(String),
    /// The worker does not answer such a request: its form, its model, its state.
    Refused(String),
    /// Too many requests wait there.
    Busy,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReplyHeader {
    run: u64,
    number: u64,
    queue: u32,
    outcome: OutcomeHeader,
}

#[derive(Serialize, Deserialize)]
enum OutcomeHeader {
    Predicted(PredictionHeader),
    ModelFailed(String),
    Refused(String),
    Busy,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PredictionHeader {
    frame: ChunkFrame,
    depth: DepthFormat,
    views: Vec<PredictedHeader>,
    /// Numbers per view; 0 where there are no tokens.
    tokens: u32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PredictedHeader {
    frame: u32,
    chunk_from_camera: Se3,
    intrinsics: Pinhole,
}

impl PredictReply {
    /// As bytes; numbers in a format.
    ///
    /// # Errors
    /// It is beyond a bound, or its tokens differ in number.
    pub fn encode(&self, depth: DepthFormat) -> Result<Vec<u8>, WireError> {
        let header = |outcome| ReplyHeader { run: self.run, number: self.number, queue: self.queue, outcome };
        let (prediction, tokens) = match &self.outcome {
            Outcome::Busy => return envelope::begin(&header(OutcomeHeader::Busy), 0),
            Outcome::Refused(why) => return envelope::begin(&header(OutcomeHeader::Refused(cut(why))), 0),
            Outcome::ModelFailed(why) => {
                return envelope::begin(&header(OutcomeHeader::ModelFailed(cut(why))), 0);
            }
            Outcome::Predicted(prediction, tokens) => (prediction, tokens),
        };
        let per_view = tokens.first().map_or(0, Vec::len);
        if per_view > 0
            && (tokens.len() != prediction.views.len() || tokens.iter().any(|t| t.len() != per_view))
        {
            return Err(WireError::bad("tokens", "as many for each view expected"));
        }
        let views: Vec<PredictedHeader> = prediction
            .views
            .iter()
            .map(|v| PredictedHeader {
                frame: v.frame_id.0,
                chunk_from_camera: v.chunk_from_camera,
                intrinsics: v.intrinsics,
            })
            .collect();
        let numbers = |v: &ViewGeometry| 2 * v.intrinsics.width * v.intrinsics.height + per_view;
        let plane_bytes = depth.bytes() * prediction.views.iter().map(numbers).sum::<usize>();
        let described = PredictionHeader { frame: prediction.frame, depth, views, tokens: per_view as u32 };
        let mut message = envelope::begin(&header(OutcomeHeader::Predicted(described)), plane_bytes)?;
        for (i, view) in prediction.views.iter().enumerate() {
            depth.put(view.depth.image().data(), &mut message);
            depth.put(view.confidence.image().data(), &mut message);
            depth.put(tokens.get(i).map_or(&[], Vec::as_slice), &mut message);
        }
        Ok(message)
    }

    /// From bytes. A prediction is checked against what was asked: its frames are among those, in their order, once each.
    ///
    /// # Errors
    /// They are no such message, beyond a bound, answer another request, or hold what no model gives.
    pub fn decode(bytes: &[u8], request: &PredictRequest) -> Result<Self, WireError> {
        let (header, planes) = envelope::open::<ReplyHeader>(bytes)?;
        if (header.run, header.number) != (request.run, request.number) {
            return Err(WireError::bad("reply", "it answers another request"));
        }
        let outcome = match header.outcome {
            OutcomeHeader::Predicted(described) => predicted(&described, planes, request)?,
            other => {
                nothing_behind(planes)?;
                match other {
                    OutcomeHeader::ModelFailed(why) => Outcome::ModelFailed(cut(&why)),
                    OutcomeHeader::Refused(why) => Outcome::Refused(cut(&why)),
                    _ => Outcome::Busy,
                }
            }
        };
        Ok(Self { run: header.run, number: header.number, queue: header.queue, outcome })
    }
}

fn predicted(
    described: &PredictionHeader,
    mut planes: &[u8],
    request: &PredictRequest,
) -> Result<Outcome, WireError> {
    let asked = &request.views.views[request.wanted.clone()];
    if described.depth != request.depth {
        return Err(WireError::bad("numbers", "in another format than asked for"));
    }
    let tokens = described.tokens as usize;
    within("tokens of a view", tokens, MAX_TOKENS)?;
    if tokens > 0 && !request.wants_tokens {
        return Err(WireError::bad("tokens", "nobody asked for them"));
    }
    let per_number = described.depth.bytes();
    let mut expected = 0_usize;
    for view in &described.views {
        let (width, height) = size(view.intrinsics.width, view.intrinsics.height)?;
        expected = expected.saturating_add((2 * width * height + tokens) * per_number);
    }
    if expected != planes.len() {
        return Err(WireError::Length { what: "planes", found: planes.len(), expected });
    }
    let (mut views, mut all_tokens, mut at) = (Vec::new(), Vec::new(), 0);
    for view in &described.views {
        let Some(found) = asked[at..].iter().position(|v| v.frame_id.0 == view.frame) else {
            return Err(WireError::bad("views", format!("frame {} was not asked for, or twice", view.frame)));
        };
        at += found + 1;
        let Pinhole { width, height, .. } = view.intrinsics;
        pinhole(&view.intrinsics, width, height)?;
        rigid(&view.chunk_from_camera)?;
        let mut take = |numbers: usize| {
            let (mine, rest) = planes.split_at(numbers * per_number);
            planes = rest;
            described.depth.take(mine)
        };
        let mut plane =
            || Image::from_vec(width, height, take(width * height)).map_err(|e| WireError::bad("plane", e));
        let (depth, confidence) = (RelativeDepth::new(plane()?), Confidence::new(plane()?));
        if tokens > 0 {
            all_tokens.push(take(tokens).into_iter().map(|v| if v.is_finite() { v } else { 0.0 }).collect());
        }
        views.push(ViewGeometry {
            frame_id: FrameId(view.frame),
            chunk_from_camera: view.chunk_from_camera,
            intrinsics: view.intrinsics,
            depth,
            confidence,
        });
    }
    let geometry = GeometryPrediction { chunk_id: request.views.id, frame: described.frame, views };
    Ok(Outcome::Predicted(geometry, all_tokens))
}
