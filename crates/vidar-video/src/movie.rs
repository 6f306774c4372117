//! The tables of an mp4 or mov: its tracks, and the frames of its video in the order of display.

use crate::boxes::{self, find};
use crate::error::VideoError;
use crate::fragments::{Fragments, MAX_MOOF_BYTES};
use crate::lane::AccessUnits;
use crate::pictures::Unit;
use crate::track::{self, Sample, Track};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use vidar_core::{Timestamp, Warning};

/// The tables of a movie. Its pictures stay in the file.
pub(crate) struct Movie {
    pub tracks: Vec<Track>,
    /// Index of the video track.
    pub video: usize,
    /// Frames in the order of display.
    pub frames: Vec<Frame>,
    /// The video's units in the order of decoding.
    pub units: Vec<Unit>,
    pub file: Arc<UnitsOfFile>,
    pub warnings: Vec<Warning>,
}

#[derive(Clone, Copy)]
pub(crate) struct Frame {
    pub time: Timestamp,
    /// Index into the track's samples, which are in the order of decoding.
    pub sample: usize,
}

/// Largest table of a movie (`moov`); one of ten hours has about 30 MB.
const MAX_MOOV_BYTES: u64 = 512 << 20;
/// Largest coded picture, bytes; one of 8K at the highest rate has about 4 MB.
const MAX_SAMPLE_BYTES: u32 = 64 << 20;

/// Coded pictures where the container's tables say.
pub(crate) struct UnitsOfFile {
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
    pub(crate) fn bytes(&self, sample: &Sample) -> Result<Vec<u8>, String> {
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

impl Movie {
    /// Reads the tables.
    pub(crate) fn open(path: &Path) -> Result<Self, VideoError> {
        let failed = |source| VideoError::Io { path: path.to_path_buf(), source };
        let mut file = File::open(path).map_err(failed)?;
        let length = file.metadata().map_err(failed)?.len();
        let (moov, moov_end) = read_moov(&mut file, length, path)?;
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
        let mut warnings = Vec::new();
        if let Some(fragments) = Fragments::announced(&moov, &mut tracks, length) {
            let broken = read_fragments(&mut file, (moov_end, length), fragments).map_err(failed)?;
            warnings
                .extend(broken.map(|message| Warning::degraded("video-cut-off", message).at(path.display())));
        }
        if tracks[video].samples.is_empty() {
            let found = "a video track without pictures";
            return Err(unsupported(path, found.into(), "the recorder stopped before its first picture"));
        }
        let frames = shown_frames(&mut tracks[video], length, path, &mut warnings);
        if frames.is_empty() {
            return Err(malformed(
                "a video of which no picture lies in the file (its end is missing)".into(),
            ));
        }
        let samples = std::mem::take(&mut tracks[video].samples);
        let units = samples.iter().map(|s| Unit { time_ns: s.time_ns, is_sync: s.is_sync }).collect();
        let file = Arc::new(UnitsOfFile { file: Mutex::new(file), samples });
        Ok(Self { tracks, video, frames, units, file, warnings })
    }

    /// The track of the video.
    pub(crate) fn track(&self) -> &Track {
        &self.tracks[self.video]
    }
}

/// Kind, length of the head and end of the box that begins at `at`; `None` where it is not whole.
fn box_at(file: &mut File, at: u64, length: u64) -> std::io::Result<Option<([u8; 4], u64, u64)>> {
    let mut head = [0; 16];
    let held = (length - at).min(16) as usize;
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(&mut head[..held])?;
    let Some((kind, head_bytes, box_bytes)) = boxes::head(&head[..held]) else { return Ok(None) };
    let box_bytes = if box_bytes == 0 { length - at } else { box_bytes };
    let end = at.checked_add(box_bytes).filter(|&end| end <= length && at + head_bytes as u64 <= end);
    Ok(end.map(|end| (kind, head_bytes as u64, end)))
}

/// The bytes from `from` to `end`, of which the caller has checked how many there are.
fn content(file: &mut File, from: u64, end: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = vec![0; (end - from) as usize];
    file.seek(SeekFrom::Start(from))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// The content of the box `moov`, and where it ends.
fn read_moov(file: &mut File, length: u64, path: &Path) -> Result<(Vec<u8>, u64), VideoError> {
    let failed = |source| VideoError::Io { path: path.to_path_buf(), source };
    let mut at = 0;
    while at < length {
        let Some((kind, head_bytes, end)) = box_at(file, at, length).map_err(failed)? else { break };
        if kind == *b"moov" {
            if end - at > MAX_MOOV_BYTES {
                let found = format!("a table of {} bytes", end - at);
                let expected = format!("at most {MAX_MOOV_BYTES} bytes");
                return Err(VideoError::Malformed { path: path.to_path_buf(), found, expected });
            }
            return Ok((content(file, at + head_bytes, end).map_err(failed)?, end));
        }
        at = end;
    }
    let found = "a video without its table (moov), which the camera writes last: the recording was cut off";
    let way = "a program such as untrunc rebuilds the table with another video of the same camera";
    Err(unsupported(path, found.into(), way))
}

/// Takes the fragments from `at` on; gives what is to be said where they end before the file does. Pictures that a fragment lists beyond the
/// end of the file are told apart later.
fn read_fragments(
    file: &mut File,
    (mut at, length): (u64, u64),
    mut fragments: Fragments<'_>,
) -> std::io::Result<Option<String>> {
    while at < length {
        // The pictures of the last fragment may be cut off, which their places show.
        let Some((kind, head_bytes, end)) = box_at(file, at, length)? else {
            let mut kind = [0; 4];
            file.seek(SeekFrom::Start((at + 4).min(length)))?;
            let is_named = file.read_exact(&mut kind).is_ok();
            let lost = format!(
                "the file is cut off in the table of a fragment at byte {at}; it is read up to there"
            );
            return Ok((!is_named || kind == *b"moof").then_some(lost));
        };
        if kind == *b"moof" {
            let added = match end - at {
                bytes if bytes > MAX_MOOF_BYTES => Err(format!("it has {bytes} bytes")),
                _ => fragments.add(&content(file, at + head_bytes, end)?, at),
            };
            if let Err(reason) = added {
                let message = format!(
                    "the table of the fragment at byte {at} is damaged ({reason}); the video is read up to it"
                );
                return Ok(Some(message));
            }
        }
        at = end;
    }
    Ok(None)
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
    if track.edits.is_complex {
        let message =
            "the edit list has several parts or another speed; the video is read as it was recorded";
        warnings.push(Warning::new("video-edits", message).at(path.display()));
    }
    let shown = track.samples.iter().enumerate().filter(|(_, s)| s.time_ns >= track.edits.empty_ns);
    let mut frames: Vec<Frame> =
        shown.map(|(sample, s)| Frame { time: Timestamp::from_nanos(s.time_ns), sample }).collect();
    frames.sort_by_key(|f| f.time);
    frames
}

pub(crate) fn unsupported(path: &Path, found: String, way: &str) -> VideoError {
    VideoError::Unsupported { path: path.to_path_buf(), found, way: way.to_string() }
}
