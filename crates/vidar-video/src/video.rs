//! An open video: its frames by number, decoded when they are asked for.

use crate::boxes::{self, find};
use crate::decoder::{Codec, Decoder};
use crate::error::VideoError;
use crate::gpmf::{self, Telemetry};
use crate::picture::Picture;
use crate::track::{self, Sample, Track};
use std::collections::{HashSet, VecDeque};
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
    file: Mutex<File>,
    state: Mutex<State>,
}

#[derive(Clone, Copy)]
struct Frame {
    time: Timestamp,
    /// Index into the track's samples, which are in the order of decoding.
    sample: usize,
}

/// The decoder, the sample that it takes next, and the pictures that came out last.
#[derive(Default)]
struct State {
    decoder: Option<Decoder>,
    next: usize,
    /// Samples whose pictures came out since the decoder was started at the sample `start`.
    start: usize,
    out: HashSet<usize>,
    recent: VecDeque<(usize, Arc<Picture>)>,
}

/// Decoded pictures that are kept, bytes: twenty of 1080p. The newest stays even when it is larger.
const RECENT_BYTES: usize = 64 << 20;
/// Largest table of a movie (`moov`); one of ten hours has about 30 MB.
const MAX_MOOV_BYTES: u64 = 512 << 20;
/// Largest coded picture, bytes; one of 8K at the highest rate has about 4 MB.
const MAX_SAMPLE_BYTES: u32 = 64 << 20;
/// Pictures that a decoder may hold back to bring them in order: 16 in both standards.
const MOST_HELD_BACK: usize = 17;

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
        let mut open = Self {
            path: path.to_path_buf(),
            tracks,
            video,
            codec,
            size: (0, 0),
            frames,
            warnings,
            file: Mutex::new(file),
            state: Mutex::default(),
        };
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
        match self.codec {
            Codec::H264(_) => "H.264",
            #[cfg(feature = "h265")]
            Codec::H265(_) => "H.265",
        }
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
            payloads.push((sample.time_ns, sample.duration_ns, self.read(sample)?));
        }
        Ok(Some(gpmf::read(&payloads)))
    }

    /// Decodes a frame. Frames in order are decoded once; another order costs decoding from the last picture that stands alone.
    pub fn frame(&self, number: usize) -> Result<FrameImage, VideoError> {
        let Some(&Frame { sample, .. }) = self.frames.get(number) else {
            return Err(self.bad_frame(number, format!("the video has {} frames", self.frames.len())));
        };
        let picture = self.picture(sample).map_err(|reason| self.bad_frame(number, reason))?;
        Ok(picture.upright(self.tracks[self.video].quarter_turns))
    }

    fn picture(&self, wanted: usize) -> Result<Arc<Picture>, String> {
        let samples = &self.tracks[self.video].samples;
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, picture)) = state.recent.iter().find(|(sample, _)| *sample == wanted) {
            return Ok(Arc::clone(picture));
        }
        // A picture that is shown before the one that stands alone, and stored after it, needs the pictures before both.
        let stands_before = |i: &usize| samples[*i].is_sync && samples[*i].time_ns <= samples[wanted].time_ns;
        let start = (0..=wanted).rev().find(stands_before).unwrap_or(0);
        // On from where the decoder is, unless a picture that stands alone lies between. A picture that it was given and that
        // has not come out is still held back.
        let is_ahead = (start..=wanted).contains(&state.next);
        let is_inside = state.start <= wanted && wanted < state.next && !state.out.contains(&wanted);
        if state.decoder.is_none() || !is_ahead && !is_inside {
            state.decoder = Some(Decoder::start(&self.codec)?);
            (state.start, state.next) = (start, start);
            state.out.clear();
        }
        let mut reason = "the decoder gave no picture for it".to_string();
        let last = samples.len().min(wanted + 1 + MOST_HELD_BACK);
        while state.next < last {
            let at = state.next;
            state.next += 1;
            let bytes = self.read(&samples[at]).map_err(|e| e.to_string())?;
            let Some(decoder) = &state.decoder else { break };
            match decoder.decode(at, bytes, at + 1 == samples.len()) {
                Ok(pictures) => {
                    let came = pictures.iter().any(|(sample, _)| *sample == wanted);
                    for (sample, picture) in pictures {
                        let picture = picture.without_filling(self.tracks[self.video].size);
                        state.out.insert(sample);
                        state.recent.push_back((sample, Arc::new(picture)));
                    }
                    state.keep_few();
                    if came && let Some((_, picture)) = state.recent.iter().rfind(|(s, _)| *s == wanted) {
                        return Ok(Arc::clone(picture));
                    }
                }
                Err(failure) => {
                    if failure.is_fatal {
                        state.decoder = None;
                        return Err(failure.reason);
                    }
                    if at == wanted {
                        reason = failure.reason;
                    }
                }
            }
            // Only H.265's decoder holds pictures back.
            if at >= wanted && matches!(self.codec, Codec::H264(_)) {
                break;
            }
        }
        Err(reason)
    }

    fn read(&self, sample: &Sample) -> Result<Vec<u8>, VideoError> {
        let failed = |source| VideoError::Io { path: self.path.clone(), source };
        if sample.size > MAX_SAMPLE_BYTES {
            let found = format!("a coded picture of {} bytes", sample.size);
            let expected = format!("at most {MAX_SAMPLE_BYTES} bytes");
            return Err(VideoError::Malformed { path: self.path.clone(), found, expected });
        }
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(sample.offset)).map_err(failed)?;
        let mut bytes = vec![0; sample.size as usize];
        file.read_exact(&mut bytes).map_err(failed)?;
        Ok(bytes)
    }

    fn bad_frame(&self, number: usize, reason: String) -> VideoError {
        VideoError::BadFrame { path: self.path.clone(), number, reason }
    }
}

impl State {
    fn keep_few(&mut self) {
        let mut held: usize = self.recent.iter().map(|(_, p)| p.bytes()).sum();
        while held > RECENT_BYTES && self.recent.len() > 1 {
            held -= self.recent.pop_front().map_or(0, |(_, p)| p.bytes());
        }
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
        b"avc1" | b"avc3" => described(b"avcC").map(Codec::H264),
        #[cfg(feature = "h265")]
        b"hvc1" | b"hev1" => described(b"hvcC").map(Codec::H265),
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
