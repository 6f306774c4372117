//! Requests and replies, each checked in full before it is used.

mod reply;

pub use reply::{Outcome, PredictReply};

use super::pixels::{self, DepthFormat, ImageFormat, MAX_SIDE_PX, PixelFormat};
use crate::envelope::{self, MAX_MESSAGE_BYTES, PROTOCOL, within};
use crate::error::WireError;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use vidar_core::{ChunkId, ChunkView, ChunkViews, FrameId, ModelInfo, Pinhole, Se3, Timestamp};

/// The most views of a chunk.
pub(crate) const MAX_VIEWS: usize = 512;
/// The longest text in a header, bytes.
const MAX_TEXT_BYTES: usize = 16 << 10;

/// What a model is and how it computes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFacts {
    /// Name as users choose it.
    pub model: String,
    /// SPDX licence of the weights.
    pub licence: String,
    /// What the model says of itself: hash of the weights, needs.
    pub info: ModelInfo,
    /// Channels of the tokens that places can be told by.
    pub token_channels: Option<u32>,
    /// Precision and device, in words.
    pub arithmetic: String,
}

/// The first question to every worker under a key.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HelloRequest {
    /// Version of the protocol.
    pub protocol: u32,
    /// How the model is to be used, as the model's own settings are written (JSON).
    pub settings: String,
}

/// A worker's answer to it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hello {
    /// Version of the protocol.
    pub protocol: u32,
    /// Version of the program.
    pub program: String,
    /// Name of the worker: the last part of its key.
    pub worker: String,
    /// Requests that wait there or are worked on.
    pub queue: u32,
    /// The model with these settings, or why it cannot be used with them.
    pub model: Result<ModelFacts, String>,
}

/// One chunk to predict.
#[derive(Clone, Debug)]
pub struct PredictRequest {
    /// Random number of the run, repeated in the reply.
    pub run: u64,
    /// Number of the request in the run, repeated in the reply.
    pub number: u64,
    /// How long the sender waits, ms; a request that waited longer is not worked on.
    pub patience_ms: u64,
    /// How the model is to be used (JSON).
    pub settings: String,
    /// Hash of the weights that are expected.
    pub weights_sha256: Option<String>,
    /// Whether the tokens of the views are wanted, too.
    pub wants_tokens: bool,
    /// How the answer's numbers are to travel.
    pub depth: DepthFormat,
    /// The views.
    pub views: ChunkViews,
    /// Which of them are to be predicted.
    pub wanted: Range<usize>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RequestHeader {
    protocol: u32,
    run: u64,
    number: u64,
    patience_ms: u64,
    settings: String,
    weights_sha256: Option<String>,
    wants_tokens: bool,
    depth: DepthFormat,
    chunk: u32,
    wanted: (u32, u32),
    views: Vec<ViewHeader>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewHeader {
    frame: u32,
    time: i64,
    format: PixelFormat,
    width: u32,
    height: u32,
    bytes: u32,
    intrinsics: Pinhole,
    world_from_camera: Option<Se3>,
}

impl HelloRequest {
    /// As bytes.
    ///
    /// # Errors
    /// The settings are too long.
    pub fn encode(&self) -> Result<Vec<u8>, WireError> {
        envelope::begin(self, 0)
    }

    /// From bytes.
    ///
    /// # Errors
    /// They are no such message of this version.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let (this, planes) = envelope::open::<Self>(bytes)?;
        nothing_behind(planes)?;
        same_protocol(this.protocol)?;
        text("settings", &this.settings)?;
        Ok(this)
    }
}

impl Hello {
    /// As bytes.
    ///
    /// # Errors
    /// A text is too long.
    pub fn encode(&self) -> Result<Vec<u8>, WireError> {
        envelope::begin(self, 0)
    }

    /// From bytes.
    ///
    /// # Errors
    /// They are no such message of this version.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let (this, planes) = envelope::open::<Self>(bytes)?;
        nothing_behind(planes)?;
        same_protocol(this.protocol)?;
        text("program", &this.program)?;
        if !is_key_part(&this.worker) {
            return Err(WireError::bad("worker", "1 to 64 letters, digits, `-` or `_` expected"));
        }
        match &this.model {
            Ok(facts) => {
                for (what, found) in [
                    ("model", &facts.model),
                    ("licence", &facts.licence),
                    ("name", &facts.info.name),
                    ("licence", &facts.info.licence),
                ] {
                    text(what, found)?;
                }
                text("arithmetic", &facts.arithmetic)?;
                within("views that it needs", facts.info.min_views, MAX_VIEWS)?;
                if let Some(hash) = &facts.info.weights_sha256
                    && (hash.len() != 64 || !hash.bytes().all(|b| b.is_ascii_hexdigit()))
                {
                    return Err(WireError::bad("weights_sha256", "64 hexadecimal digits expected"));
                }
            }
            Err(reason) => text("reason", reason)?,
        }
        Ok(this)
    }
}

/// Whether it may be one part of a key.
pub(crate) fn is_key_part(text: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=64).contains(&text.len()) && text.chars().all(plain)
}

impl PredictRequest {
    /// As bytes, with its images in a format.
    ///
    /// # Errors
    /// It is beyond a bound.
    pub fn encode(&self, images: ImageFormat) -> Result<Vec<u8>, WireError> {
        within("number of views", self.views.views.len(), MAX_VIEWS)?;
        let (mut headers, mut planes) = (Vec::new(), Vec::new());
        for view in &self.views.views {
            let (format, bytes) = pixels::encode(&view.image, images)?;
            headers.push(ViewHeader {
                frame: view.frame_id.0,
                time: view.time.nanos(),
                format,
                width: view.image.width() as u32,
                height: view.image.height() as u32,
                bytes: bytes.len() as u32,
                intrinsics: view.intrinsics,
                world_from_camera: view.world_from_camera,
            });
            planes.push(bytes);
        }
        let header = RequestHeader {
            protocol: PROTOCOL,
            run: self.run,
            number: self.number,
            patience_ms: self.patience_ms,
            settings: self.settings.clone(),
            weights_sha256: self.weights_sha256.clone(),
            wants_tokens: self.wants_tokens,
            depth: self.depth,
            chunk: self.views.id.0,
            wanted: (self.wanted.start as u32, self.wanted.end as u32),
            views: headers,
        };
        let mut message = envelope::begin(&header, planes.iter().map(Vec::len).sum())?;
        planes.iter().for_each(|p| message.extend(p));
        Ok(message)
    }

    /// Run and number alone, without a look at the images.
    #[cfg(feature = "zenoh")]
    pub(crate) fn decode_numbers(bytes: &[u8]) -> Result<(u64, u64), WireError> {
        let (header, _) = envelope::open::<RequestHeader>(bytes)?;
        Ok((header.run, header.number))
    }

    /// How long the sender waits, ms, without a look at the images.
    #[cfg(feature = "zenoh")]
    pub(crate) fn decode_patience_ms(bytes: &[u8]) -> Result<u64, WireError> {
        let (header, _) = envelope::open::<RequestHeader>(bytes)?;
        Ok(header.patience_ms)
    }

    /// From bytes.
    ///
    /// # Errors
    /// They are no such message, beyond a bound, or hold what no camera gives.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let (header, mut planes) = envelope::open::<RequestHeader>(bytes)?;
        same_protocol(header.protocol)?;
        within("number of views", header.views.len(), MAX_VIEWS)?;
        text("settings", &header.settings)?;
        let (from, to) = (header.wanted.0 as usize, header.wanted.1 as usize);
        if from > to || to > header.views.len() {
            let reason = format!("{from}..{to} of {} views", header.views.len());
            return Err(WireError::bad("wanted views", reason));
        }
        let announced: u64 = header.views.iter().map(|v| u64::from(v.bytes)).sum();
        if announced != planes.len() as u64 {
            let (found, expected) = (planes.len(), announced.min(MAX_MESSAGE_BYTES as u64) as usize);
            return Err(WireError::Length { what: "images", found, expected });
        }
        // What they are when unpacked is bounded, too: a JPEG of a kilobyte may announce gigabytes.
        let pixels: u64 = header.views.iter().map(|v| u64::from(v.width) * u64::from(v.height)).sum();
        within("pixels of all views", pixels as usize, MAX_MESSAGE_BYTES)?;
        let mut views = Vec::with_capacity(header.views.len());
        for view in &header.views {
            let (width, height) = size(view.width as usize, view.height as usize)?;
            pinhole(&view.intrinsics, width, height)?;
            if let Some(pose) = &view.world_from_camera {
                rigid(pose)?;
            }
            let (mine, rest) = planes.split_at(view.bytes as usize);
            planes = rest;
            views.push(ChunkView {
                frame_id: FrameId(view.frame),
                time: Timestamp::from_nanos(view.time),
                image: pixels::decode(view.format, (width, height), mine)?,
                intrinsics: view.intrinsics,
                world_from_camera: view.world_from_camera,
            });
        }
        Ok(Self {
            run: header.run,
            number: header.number,
            patience_ms: header.patience_ms,
            settings: header.settings,
            weights_sha256: header.weights_sha256,
            wants_tokens: header.wants_tokens,
            depth: header.depth,
            views: ChunkViews { id: ChunkId(header.chunk), views },
            wanted: from..to,
        })
    }
}

fn nothing_behind(planes: &[u8]) -> Result<(), WireError> {
    match planes.len() {
        0 => Ok(()),
        found => Err(WireError::Length { what: "planes", found, expected: 0 }),
    }
}

fn same_protocol(found: u32) -> Result<(), WireError> {
    if found == PROTOCOL { Ok(()) } else { Err(WireError::OtherProtocol { expected: PROTOCOL }) }
}

fn text(what: &'static str, text: &str) -> Result<(), WireError> {
    within(what, text.len(), MAX_TEXT_BYTES)
}

/// The beginning of a text that may be anybody's.
fn cut(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(500).collect()
}

fn size(width: usize, height: usize) -> Result<(usize, usize), WireError> {
    within("width of an image", width, MAX_SIDE_PX)?;
    within("height of an image", height, MAX_SIDE_PX)?;
    Ok((width, height))
}

fn pinhole(found: &Pinhole, width: usize, height: usize) -> Result<(), WireError> {
    let Pinhole { fx, fy, cx, cy, .. } = *found;
    let made = Pinhole::new(fx, fy, cx, cy, width, height).map_err(|e| WireError::bad("intrinsics", e))?;
    match made == *found {
        true => Ok(()),
        false => Err(WireError::bad("intrinsics", "of another size than the image")),
    }
}

/// A pose as it came keeps its bits, so it must be a rotation as it is.
fn rigid(pose: &Se3) -> Result<(), WireError> {
    let [x, y, z, w] = pose.rotation.quaternion_xyzw();
    let norm = (x * x + y * y + z * z + w * w).sqrt();
    match pose.is_finite() && (norm - 1.0).abs() < 1e-6 {
        true => Ok(()),
        false => Err(WireError::bad("pose", "finite numbers and a rotation expected")),
    }
}
