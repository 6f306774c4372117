//! An open video: its frames by number, decoded when they are asked for.

use crate::boxes::find;
use crate::codec::Codec;
use crate::error::VideoError;
use crate::ffmpeg::{self, Ffmpeg, VideoDecoder};
use crate::gpmf::{self, Telemetry};
use crate::movie::{Frame, Movie, unsupported};
use crate::pictures::Pictures;
use crate::track::Track;
use crate::unit::Parameters;
use std::fmt;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{FrameImage, Timestamp, Warning};

/// An open mp4 or mov. Its tables are in memory, its pictures stay in the file until they are asked for.
pub struct Video {
    path: PathBuf,
    /// The tables; `None` of a container that only the user's program reads.
    movie: Option<Movie>,
    size: (usize, usize),
    /// Frames in the order of display.
    frames: Vec<Frame>,
    decoder: Decoder,
}

enum Decoder {
    BuiltIn { codec: &'static str, pictures: Box<Pictures> },
    Program(Ffmpeg),
}

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
    /// Opens an mp4 or mov for the built-in decoders and reads its tables.
    pub fn open(path: &Path) -> Result<Self, VideoError> {
        let mut movie = Movie::open(path)?;
        let codec = codec_of(movie.track(), path)?;
        let (name, units) = (codec.name(), std::mem::take(&mut movie.units));
        let pictures = Pictures::new(codec, units, Arc::clone(&movie.file) as _, movie.track().size);
        let frames = std::mem::take(&mut movie.frames);
        Self::of(path, Some(movie), frames, Decoder::BuiltIn { codec: name, pictures: Box::new(pictures) })
    }

    /// Opens a video for a decoder. With the user's `ffmpeg` it may be of any codec and container that this program reads; the tables
    /// of mp4 and mov are read here in any case, for times, rotation and telemetry.
    pub fn open_with(path: &Path, decoder: VideoDecoder) -> Result<Self, VideoError> {
        if decoder == VideoDecoder::BuiltIn {
            return Self::open(path);
        }
        let failed = |source| VideoError::Io { path: path.to_path_buf(), source };
        let mut head = [0; 8];
        let read = std::fs::File::open(path).and_then(|mut f| f.read(&mut head)).map_err(failed)?;
        // The program does without tables that are missing or damaged.
        let mut movie = if is_video(&head[..read]) { Movie::open(path).ok() } else { None };
        let frames = match &mut movie {
            Some(movie) => std::mem::take(&mut movie.frames),
            None => ffmpeg::times(path)?.into_iter().map(|time| Frame { time, sample: 0 }).collect(),
        };
        let times = frames.iter().map(|f| f.time).collect();
        Self::of(path, movie, frames, Decoder::Program(Ffmpeg::new(path, times)))
    }

    fn of(
        path: &Path,
        movie: Option<Movie>,
        frames: Vec<Frame>,
        decoder: Decoder,
    ) -> Result<Self, VideoError> {
        let mut open = Self { path: path.to_path_buf(), movie, size: (0, 0), frames, decoder };
        // The decoder's own size counts; the container's may be that of the display.
        let first = open.frame(0).map_err(|error| match (error, &open.decoder) {
            (VideoError::BadFrame { path, number, reason }, Decoder::BuiltIn { .. }) => {
                let way = "if it plays elsewhere, --decoder ffmpeg lets that program decode it, or convert it: \
                           ffmpeg -i IN -c:v libx264 -crf 16 -pix_fmt yuv420p OUT.mp4";
                VideoError::BadFrame { path, number, reason: format!("{reason}; {way}") }
            }
            (error, _) => error,
        })?;
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
        self.movie.as_ref().map_or(0, |movie| movie.track().quarter_turns)
    }

    /// `H.264`, `H.265`, or by which program it is decoded.
    pub fn codec_name(&self) -> &'static str {
        match self.decoder {
            Decoder::BuiltIn { codec, .. } => codec,
            Decoder::Program(_) => "decoded by ffmpeg",
        }
    }

    /// What was found unusual while opening.
    pub fn warnings(&self) -> &[Warning] {
        self.movie.as_ref().map_or(&[], |movie| &movie.warnings)
    }

    /// The telemetry of an action camera, where there is any.
    pub fn telemetry(&self) -> Result<Option<Telemetry>, VideoError> {
        let Some(movie) = &self.movie else { return Ok(None) };
        let Some(track) = movie.tracks.iter().find(|t| t.codec == *b"gpmd") else { return Ok(None) };
        let mut payloads = Vec::new();
        for sample in &track.samples {
            let bytes = movie.file.bytes(sample).map_err(|found| VideoError::Malformed {
                path: self.path.clone(),
                found: format!("telemetry: {found}"),
                expected: "telemetry inside of the file".into(),
            })?;
            payloads.push((sample.time_ns, sample.duration_ns, bytes));
        }
        Ok(Some(gpmf::read(&payloads)))
    }

    /// Decodes a frame. Frames in order are decoded once, ahead and beside who asks; another order costs decoding from the last
    /// picture that stands alone.
    pub fn frame(&self, number: usize) -> Result<FrameImage, VideoError> {
        let Some(&Frame { sample, .. }) = self.frames.get(number) else {
            return Err(self.bad_frame(number, format!("the video has {} frames", self.frames.len())));
        };
        let decoded = match &self.decoder {
            Decoder::BuiltIn { pictures, .. } => {
                pictures.picture(sample).map(|picture| picture.upright(self.quarter_turns()))
            }
            Decoder::Program(program) => program.frame(number),
        };
        decoded.map_err(|reason| self.bad_frame(number, reason))
    }

    /// Says which frames will be asked for: what these do not need is not decoded. Others stay readable.
    pub fn expect(&self, frames: impl IntoIterator<Item = usize>) {
        if let Decoder::BuiltIn { pictures, .. } = &self.decoder {
            pictures.expect(frames.into_iter().filter_map(|number| Some(self.frames.get(number)?.sample)));
        }
    }

    fn bad_frame(&self, number: usize, reason: String) -> VideoError {
        VideoError::BadFrame { path: self.path.clone(), number, reason }
    }
}

fn codec_of(track: &Track, path: &Path) -> Result<Codec, VideoError> {
    let described = |kind: &[u8; 4]| {
        find(&track.entry, kind).map(<[u8]>::to_vec).ok_or_else(|| VideoError::Malformed {
            path: path.to_path_buf(),
            found: format!("a video track without {}", String::from_utf8_lossy(kind)),
            expected: "the description of its codec".into(),
        })
    };
    let way = "convert it: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4, or let that program decode it: --decoder ffmpeg";
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
