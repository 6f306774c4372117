//! Video without a container: one access unit after the other, each a byte stream that starts with its parameter sets where it stands
//! alone (Annex B of ITU-T H.264 and H.265), as robots send it.

use crate::codec::Codec;
use crate::lane::AccessUnits;
use crate::pictures::{Pictures, Unit};
use crate::unit::Parameters;
use std::fmt;
use std::sync::Arc;
use vidar_core::{FrameImage, Timestamp};

/// Codecs of streams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamCodec {
    /// ITU-T H.264.
    H264,
    /// ITU-T H.265.
    H265,
}

/// What is known of an access unit of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StreamUnit {
    /// When its picture was taken; only the order counts.
    pub time: Timestamp,
    /// Whether it can be decoded without the units before it.
    pub stands_alone: bool,
}

/// What the parts of a unit are.
enum Part {
    Parameters,
    /// A slice of a picture that stands alone.
    Alone,
    Other,
}

impl StreamCodec {
    /// By the name that messages state (`foxglove.CompressedVideo`: `h264`, `h265`); `None` for others.
    pub fn from_name(name: &str) -> Option<Self> {
        match name.to_ascii_lowercase().as_str() {
            "h264" | "avc" => Some(Self::H264),
            "h265" | "hevc" => Some(Self::H265),
            _ => None,
        }
    }

    /// Whether a unit can be decoded without the units before it.
    pub fn stands_alone(self, unit: &[u8]) -> bool {
        parts(unit).any(|part| matches!(self.part(part), Part::Alone))
    }

    /// The parameter sets of a unit, as a byte stream; empty where it holds none.
    pub fn parameter_sets(self, unit: &[u8]) -> Vec<u8> {
        let sets = parts(unit).filter(|part| matches!(self.part(part), Part::Parameters));
        sets.flat_map(|part| [&[0, 0, 0, 1], part].concat()).collect()
    }

    /// `nal_unit_type` (H.264, table 7-1; H.265, table 7-1: 16 to 23 are pictures at which decoding can begin).
    fn part(self, nal: &[u8]) -> Part {
        let head = nal.first().copied().unwrap_or(0);
        match (self, head & 0x1f, head >> 1 & 0x3f) {
            (Self::H264, 7 | 8, _) | (Self::H265, _, 32..=34) => Part::Parameters,
            (Self::H264, 5, _) | (Self::H265, _, 16..=23) => Part::Alone,
            _ => Part::Other,
        }
    }
}

/// The parts of a byte stream: what lies between start codes `00 00 01`.
fn parts(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let after_code = |from: usize| {
        let rest = bytes.get(from..)?;
        Some(from + rest.windows(3).position(|w| w == [0, 0, 1])? + 3)
    };
    let mut start = after_code(0);
    std::iter::from_fn(move || {
        let from = start?;
        start = after_code(from);
        let end = start.map_or(bytes.len(), |next| next - 3);
        bytes.get(from..end)
    })
}

/// The pictures of a stream by number, decoded when they are asked for.
pub struct VideoStream {
    codec: Codec,
    pictures: Pictures,
    count: usize,
    size: (usize, usize),
}

impl fmt::Debug for VideoStream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let codec = self.codec.name();
        f.debug_struct("VideoStream")
            .field("codec", &codec)
            .field("count", &self.count)
            .finish_non_exhaustive()
    }
}

impl VideoStream {
    /// Opens a stream and decodes its first picture that can be decoded. `parameter_sets` are used until a unit brings its own. The
    /// error is the reason as text.
    pub fn open(
        codec: StreamCodec,
        units: &[StreamUnit],
        parameter_sets: Vec<u8>,
        source: Arc<dyn AccessUnits>,
    ) -> Result<Self, String> {
        let parameters = Parameters::InStream(parameter_sets);
        let codec = match codec {
            StreamCodec::H264 => Codec::H264(parameters),
            #[cfg(feature = "h265")]
            StreamCodec::H265 => Codec::H265(parameters),
            #[cfg(not(feature = "h265"))]
            StreamCodec::H265 => {
                return Err("the video is H.265, and this build lacks the feature h265".into());
            }
        };
        let listed =
            units.iter().map(|u| Unit { time_ns: u.time.nanos(), is_sync: u.stands_alone }).collect();
        let pictures = Pictures::new(codec.clone(), listed, source, (0, 0));
        let mut open = Self { codec, pictures, count: units.len(), size: (0, 0) };
        let first = units.iter().position(|u| u.stands_alone).unwrap_or(0);
        let picture = open.frame(first)?;
        open.size = (picture.width(), picture.height());
        Ok(open)
    }

    /// `H.264` or `H.265`.
    pub fn codec_name(&self) -> &'static str {
        self.codec.name()
    }

    /// Number of pictures.
    pub fn frame_count(&self) -> usize {
        self.count
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Decodes the picture of a unit, as `Video::frame` does.
    pub fn frame(&self, number: usize) -> Result<FrameImage, String> {
        if number >= self.count {
            return Err(format!("the stream has {} pictures", self.count));
        }
        Ok(self.pictures.picture(number)?.upright(0))
    }

    /// Says which pictures will be asked for, as `Video::expect` does.
    pub fn expect(&self, numbers: impl IntoIterator<Item = usize>) {
        self.pictures.expect(numbers.into_iter());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_found_and_told_apart() {
        let unit = [0, 0, 0, 1, 0x67, 1, 2, 0, 0, 1, 0x68, 3, 0, 0, 1, 0x65, 0, 0, 3, 1];
        let found: Vec<&[u8]> = parts(&unit).collect();
        // A zero before a start code of four bytes belongs to the code; as a trailing zero it changes nothing.
        assert_eq!(found, [&[0x67, 1, 2][..], &[0x68, 3], &[0x65, 0, 0, 3, 1]]);
        assert!(StreamCodec::H264.stands_alone(&unit) && !StreamCodec::H264.stands_alone(&unit[..12]));
        assert_eq!(StreamCodec::H264.parameter_sets(&unit), [0, 0, 0, 1, 0x67, 1, 2, 0, 0, 0, 1, 0x68, 3]);
        assert!(StreamCodec::H265.stands_alone(&[0, 0, 1, 19 << 1, 1, 7]));
        assert!(!StreamCodec::H265.stands_alone(&[0, 0, 1, 1 << 1, 1, 7]));
        assert!(parts(&[]).next().is_none() && parts(&[0, 0]).next().is_none());
    }
}
