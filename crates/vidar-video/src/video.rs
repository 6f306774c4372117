//! An open video: its frames by number, decoded when they are asked for.

use crate::boxes::{self, find};
use crate::codec::{Codec, Parameters};
use crate::error::VideoError;
use crate::gpmf::{self, Telemetry};
use crate::lane::AccessUnits;
use crate::pictures::{Pictures, Unit};
use crate::track::{self, Sample, Track};
use std::fmt;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use vidar_core::{FrameImage, Timestamp, Warning};

/// An open mp4 or mov. Its tables are in memory, its pictures stay in the file until they are asked for.
pub struct Video {
    path: PathBuf,
    tracks: Vec<Track>,
    /// Index of the video track.
    video: usize,
    codec: Codec,
    size: (usize, usize),
    /// Frames in the order of display.
    frames: Vec<Frame>,
    warnings: Vec<Warning>,
    file: Arc<UnitsOfFile>,
    pictures: Pictures,
}

/// Coded pictures where the container's tables say.
struct UnitsOfFile {
    file: Mutex<File>,
    samples: Vec<Sample>,
}

impl AccessUnits for UnitsOfFile {
    fn read(&self, number: usize) -> Result<Vec<u8>, String> {
        let sample = self.samples.get(number).ok_or("the video ends before it")?;
        self.bytes(sample)
    }
}

impl UnitsOfFile {
    fn bytes(&self, sample: &Sample) -> Result<Vec<u8>, String> {
        if sample.size > MAX_SAMPLE_BYTES {
            return Err(format!(
                "a part of {} bytes; at most {MAX_SAMPLE_BYTES} bytes are read",
                sample.size
            ));
        }
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let mut bytes = vec![0; sample.size as usize];
        let read = file.seek(SeekFrom::Start(sample.offset)).and_then(|_| file.read_exact(&mut bytes));
        read.map(|()| bytes).map_err(|e| e.to_string())
    }
}

#[derive(Clone, Copy)]
struct Frame {
    time: Timestamp,
    /// Index into the track's samples, which are in the order of decoding.
    sample: usize,
}

/// Largest table of a movie (`moov`); one of ten hours has about 30 MB.
const MAX_MOOV_BYTES: u64 = 512 << 20;
/// Largest coded picture, bytes; one of 8K at the highest rate has about 4 MB.
const MAX_SAMPLE_BYTES: u32 = 64 << 20;
impl fmt::Debug for Video {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Video")
            .field("path", &self.path)
            .field("frames", &self.frames.len())
            .finish_non_exhaustive()
    }
}

/// Whether a file begins as mp4 and mov do.
pub fn is_video(head: &[u8]) -> bool {
    matches!(head.get(4..8), Some(b"ftyp" | b"moov" | b"mdat" | b"wide" | b"free" | b"skip"))
}

impl Video {
    /// Opens a video and reads its tables.
    pub fn open(path: &Path) -> Result<Self, VideoError> {
        let failed = |source| VideoError::Io { path: path.to_path_buf(), source };
        let mut file = File::open(path).map_err(failed)?;
        let length = file.metadata().map_err(failed)?.len();
        let moov = read_moov(&mut file, length, path)?;
        let malformed = |found: String| VideoError::Malformed {
            path: path.to_path_buf(),
            found,
            expected: "a movie with a video track".into(),
        };
        let scale = find(&moov, b"mvhd").and_then(track::time_scale).unwrap_or(1000);
        let (mut tracks, mut problem) = (Vec::new(), None);
        for trak in boxes::atoms(&moov).filter(|a| a.kind == *b"trak") {
            match track::read(trak.content, scale) {
                Ok(track) => tracks.push(track),
                Err(reason) => problem = Some(reason),
            }
        }
        let is_it = |t: &Track| t.handler == *b"vide" && t.codec != *b"jpeg";
        let Some(video) = tracks.iter().position(is_it) else {
            return Err(malformed(problem.unwrap_or_else(|| "a movie without a video track".into())));
        };
        if tracks[video].samples.is_empty() {
            let is_fragmented = find(&moov, b"mvex").is_some();
            let (found, way) = match is_fragmented {
                true => ("a fragmented mp4", "repack it without loss: ffmpeg -i IN -c copy OUT.mp4"),
                false => ("a video track without pictures", "the recorder stopped before its first picture"),
            };
            return Err(unsupported(path, found.into(), way));
        }
        let codec = codec_of(&tracks[video], path)?;
        let mut warnings = Vec::new();
        let frames = shown_frames(&mut tracks[video], length, path, &mut warnings);
        if frames.is_empty() {
            return Err(malformed(
                "a video of which no picture lies in the file (its end is missing)".into(),
            ));
        }
        let units = tracks[video].samples.iter();
        let units = units.map(|s| Unit { time_ns: s.time_ns, is_sync: s.is_sync }).collect();
        let file =
            UnitsOfFile { file: Mutex::new(file), samples: std::mem::take(&mut tracks[video].samples) };
        let file = Arc::new(file);
        let source: Arc<dyn AccessUnits> = Arc::clone(&file) as _;
        let pictures = Pictures::new(codec.clone(), units, source, tracks[video].size);
        let path = path.to_path_buf();
        let mut open = Self { path, tracks, video, codec, size: (0, 0), frames, warnings, file, pictures };
        // The decoder's own size counts; the container's may be that of the display.
        let first = open.frame(0)?;
        open.size = (first.width(), first.height());
        Ok(open)
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Number of frames.
    pub fn frame_count(&self) -> usize {
        self.frames.len()
    }

    /// When each frame is shown, after the movie's beginning.
    pub fn times(&self) -> impl Iterator<Item = Timestamp> + '_ {
        self.frames.iter().map(|f| f.time)
    }

    /// Columns and rows, upright.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Quarter turns clockwise by which frames are turned to be upright, 0 to 3.
    pub fn quarter_turns(&self) -> u8 {
        self.tracks[self.video].quarter_turns
    }

    /// `H.264` or `H.265`.
    pub fn codec_name(&self) -> &'static str {
        self.codec.name()
    }

    /// What was found unusual while opening.
    pub fn warnings(&self) -> &[Warning] {
        &self.warnings
    }

    /// The telemetry of an action camera, where there is any.
    pub fn telemetry(&self) -> Result<Option<Telemetry>, VideoError> {
        let Some(track) = self.tracks.iter().find(|t| t.codec == *b"gpmd") else { return Ok(None) };
        let mut payloads = Vec::new();
        for sample in &track.samples {
            let bytes = self.file.bytes(sample).map_err(|found| VideoError::Malformed {
                path: self.path.clone(),
                found: format!("telemetry: {found}"),
                expected: "telemetry inside of the file".into(),
            })?;
            payloads.push((sample.time_ns, sample.duration_ns, bytes));
        }
        Ok(Some(gpmf::read(&payloads)))
    }

    /// Decodes a frame. Frames in order are decoded once; another order costs decoding from the last picture that stands alone.
    pub fn frame(&self, number: usize) -> Result<FrameImage, VideoError> {
        let Some(&Frame { sample, .. }) = self.frames.get(number) else {
            return Err(self.bad_frame(number, format!("the video has {} frames", self.frames.len())));
        };
        let picture = self.pictures.picture(sample).map_err(|reason| self.bad_frame(number, reason))?;
        Ok(picture.upright(self.tracks[self.video].quarter_turns))
    }

    /// Says which frames will be asked for: what these do not need is not decoded. Others stay readable.
    pub fn expect(&self, frames: impl IntoIterator<Item = usize>) {
        let units = frames.into_iter().filter_map(|number| Some(self.frames.get(number)?.sample));
        self.pictures.expect(units);
    }

    fn bad_frame(&self, number: usize, reason: String) -> VideoError {
        VideoError::BadFrame { path: self.path.clone(), number, reason }
    }
}

/// The content of the box `moov`.
fn read_moov(file: &mut File, length: u64, path: &Path) -> Result<Vec<u8>, VideoError> {
    let failed = |source| VideoError::Io { path: path.to_path_buf(), source };
    let mut at = 0;
    while at < length {
        let mut head = [0; 16];
        let held = (length - at).min(16) as usize;
        file.seek(SeekFrom::Start(at)).map_err(failed)?;
        file.read_exact(&mut head[..held]).map_err(failed)?;
        let Some((kind, head_bytes, box_bytes)) = boxes::head(&head[..held]) else { break };
        let box_bytes = if box_bytes == 0 { length - at } else { box_bytes };
        let Some(end) = at.checked_add(box_bytes).filter(|&e| e <= length) else { break };
        if kind == *b"moov" {
            if box_bytes > MAX_MOOV_BYTES {
                let found = format!("a table of {box_bytes} bytes");
                let expected = format!("at most {MAX_MOOV_BYTES} bytes");
                return Err(VideoError::Malformed { path: path.to_path_buf(), found, expected });
            }
            file.seek(SeekFrom::Start(at + head_bytes as u64)).map_err(failed)?;
            let mut moov = vec![0; box_bytes as usize - head_bytes];
            file.read_exact(&mut moov).map_err(failed)?;
            return Ok(moov);
        }
        at = end;
    }
    let found = "a video without its table (moov), which the camera writes last: the recording was cut off";
    let way = "a program such as untrunc rebuilds the table with another video of the same camera";
    Err(unsupported(path, found.into(), way))
}

fn codec_of(track: &Track, path: &Path) -> Result<Codec, VideoError> {
    let described = |kind: &[u8; 4]| {
        find(&track.entry, kind).map(<[u8]>::to_vec).ok_or_else(|| VideoError::Malformed {
            path: path.to_path_buf(),
            found: format!("a video track without {}", String::from_utf8_lossy(kind)),
            expected: "the description of its codec".into(),
        })
    };
    let way = "convert it: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4";
    match &track.codec {
        b"avc1" | b"avc3" => described(b"avcC").map(|b| Codec::H264(Parameters::Described(b))),
        #[cfg(feature = "h265")]
        b"hvc1" | b"hev1" => described(b"hvcC").map(|b| Codec::H265(Parameters::Described(b))),
        #[cfg(not(feature = "h265"))]
        b"hvc1" | b"hev1" => {
            let found = "the video is H.265, and this build lacks the feature h265";
            Err(unsupported(
                path,
                found.into(),
                "build with --features h265, or convert: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4",
            ))
        }
        b"encv" => Err(unsupported(path, "the video is encrypted".into(), "export it without protection")),
        other => {
            let name = String::from_utf8_lossy(other).into_owned();
            let name = vidar_core::printable(&name).into_owned();
            Err(unsupported(path, format!("the video's codec is {name:?}; H.264 and H.265 are decoded"), way))
        }
    }
}

/// The frames that are shown, in the order of display. Pictures outside of the file are left out, with a warning.
fn shown_frames(track: &mut Track, length: u64, path: &Path, warnings: &mut Vec<Warning>) -> Vec<Frame> {
    let inside = |s: &Sample| s.offset.checked_add(u64::from(s.size)).is_some_and(|end| end <= length);
    let whole = track.samples.iter().take_while(|s| inside(s)).count();
    if whole < track.samples.len() {
        let message = format!("the file is cut off: {} of {} pictures are in it", whole, track.samples.len());
        warnings.push(Warning::degraded("video-cut-off", message).at(path.display()));
        track.samples.truncate(whole);
    }
    if track.has_complex_edits {
        let message =
            "the edit list has several parts or another speed; the video is read as it was recorded";
        warnings.push(Warning::new("video-edits", message).at(path.display()));
    }
    let shown = track.samples.iter().enumerate().filter(|(_, s)| s.time_ns >= track.shown_from_ns);
    let mut frames: Vec<Frame> =
        shown.map(|(sample, s)| Frame { time: Timestamp::from_nanos(s.time_ns), sample }).collect();
    frames.sort_by_key(|f| f.time);
    frames
}

fn unsupported(path: &Path, found: String, way: &str) -> VideoError {
    VideoError::Unsupported { path: path.to_path_buf(), found, way: way.to_string() }
}
