//! A live run of a stream, which is kept in the run folder while it comes.

use crate::config::Config;
use crate::engine::{FrameStamp, ImageSource};
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::imu_noise;
use crate::input::{self, Measurement};
use crate::run::RunRequest;
use crate::run_folder::{OutputLocation, RunFolder};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use vidar_core::{Frame, FrameImage, Image, SensorEvent, Warning};
use vidar_dataset::{Arrived, ArrivingRecording, Recording};

/// Where the stream is kept, in the run folder.
pub const RECORDING: &str = "recording.mcap";

/// Bytes that tell one stream from another: its header, and most of its topics.
const HEAD_BYTES: u64 = 1024;

/// MCAP as it comes.
pub type LiveInput = Box<dyn Read + Send>;

/// A stream with the folder of its run.
pub(in crate::run) struct Incoming {
    pub folder: Arc<RunFolder>,
    pub input: LiveInput,
}

impl Incoming {
    /// Opens the stream. A folder of a stream that cannot be used is left without it.
    pub fn open(
        self,
        request: &RunRequest,
        config: &Config,
        cancel: &CancelToken,
    ) -> Result<(LiveStream, Recording), Error> {
        if !config.input.masks.is_empty() {
            let what = "masks belong to images that are known, and those of a stream are not yet".to_owned();
            return Err(Error::Usage { what, hint: "write the stream to a file and map that".into() });
        }
        let options = input::options_of(&request.open, config);
        let (cancelled, path) = (cancel.clone(), self.folder.path().join(RECORDING));
        let opened = ArrivingRecording::open(self.input, &path, &options, &|| !cancelled.is_cancelled());
        match opened {
            Ok((arriving, mut facts)) => {
                imu_noise::settle(&mut facts);
                Ok((LiveStream { arriving }, facts))
            }
            Err(error) => {
                // What cannot be removed is only left behind; a folder with other files stays.
                for name in [RECORDING, "log.jsonl"] {
                    let _ = std::fs::remove_file(self.folder.path().join(name));
                }
                let _ = std::fs::remove_dir(self.folder.path());
                if cancel.is_cancelled() {
                    return Err(Error::Interrupted { path: self.folder.path().to_owned() });
                }
                Err(error.into())
            }
        }
    }
}

/// A stream that is mapped.
pub(in crate::run) struct LiveStream {
    arriving: ArrivingRecording,
}

impl LiveStream {
    /// The measurements as they come, with when each came, once. `go_on` is asked while nothing comes.
    pub fn measurements<'a>(
        &self,
        sensors: bool,
        go_on: &'a dyn Fn() -> bool,
    ) -> impl Iterator<Item = (Measurement, Option<Instant>)> + 'a {
        let mut arrivals = self.arriving.arrivals();
        std::iter::from_fn(move || {
            let arrivals = arrivals.as_mut()?;
            loop {
                let arrival = arrivals.next(go_on)?;
                let measurement = match arrival.what {
                    Arrived::Imu(_) if !sensors => continue,
                    Arrived::Imu(sample) => Measurement::Event(SensorEvent::Imu(sample)),
                    Arrived::Image(entry, image) => {
                        let stamp = input::stamp_of(&entry);
                        let FrameStamp { frame_id: id, time, camera } = stamp;
                        match *image {
                            _ if !sensors => Measurement::Stamp(stamp),
                            Ok(image) => {
                                Measurement::Event(SensorEvent::Image(Frame { id, time, camera, image }))
                            }
                            Err(error) => Measurement::Unreadable(stamp, error),
                        }
                    }
                };
                return Some((measurement, Some(arrival.came)));
            }
        })
    }

    /// Tells what was noticed of the stream.
    pub fn tell(&self, events: &Events) {
        self.arriving.take_warnings().iter().for_each(|w| events.warn(w));
    }

    /// The recording as it was kept, with the rig that was used.
    pub fn whole(&self, facts: &Recording) -> Result<Recording, Error> {
        let mut whole = self.arriving.whole()?;
        (whole.rig, whole.calibration, whole.readout) =
            (facts.rig.clone(), facts.calibration.clone(), facts.readout);
        Ok(whole)
    }
}

impl ImageSource for LiveStream {
    fn image(&self, stamp: &FrameStamp) -> Result<FrameImage, Warning> {
        let loaded = self.arriving.load_image(stamp.frame_id, stamp.time);
        loaded.map_err(|e| Warning::degraded("image-unreadable", e.to_string()))
    }

    fn mask(&self, _: &FrameStamp) -> Result<Option<Image<bool>>, Warning> {
        Ok(None)
    }
}

/// The stream that an earlier attempt kept in the folder that the run goes on in.
pub(in crate::run) fn kept(request: &RunRequest) -> Option<PathBuf> {
    let OutputLocation::Resumed { path } = &request.place else { return None };
    let kept = path.join(RECORDING);
    (kept == request.path && kept.is_file()).then_some(kept)
}

/// What tells a stream from others by its first bytes, the only ones that an attempt knows before it has ended.
pub(in crate::run) fn fingerprint(kept: &Path) -> Result<String, Error> {
    let failed = |e| Error::io("read", kept, e);
    let mut head = Vec::new();
    let file = std::fs::File::open(kept).map_err(failed)?;
    file.take(HEAD_BYTES).read_to_end(&mut head).map_err(failed)?;
    Ok(vidar_hub::sha256_hex(&[b"vidar-stream 1 ".as_slice(), &head].concat()))
}

/// Lists the kept stream among the files of the run.
pub(in crate::run) fn list(folder: &RunFolder, events: &Events) {
    if let Ok(file) = std::fs::metadata(folder.path().join(RECORDING)) {
        events.emit(&Event::ArtifactWritten { path: RECORDING.into(), bytes: file.len() });
    }
}
