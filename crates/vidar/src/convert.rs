//! `vidar convert`: a recording in another layout.

use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use std::path::Path;
use vidar_dataset::convert::{ConvertFormat, Converted};
use vidar_dataset::{OpenOptions, Recording};

/// Opens the recording at `path` and writes it to `out`, telling of its progress; returns the recording, too.
///
/// # Errors
/// What opening gives; an `out` that exists; [`Error::Interrupted`].
pub fn convert(
    path: &Path,
    open: &OpenOptions,
    out: &Path,
    format: ConvertFormat,
    events: &Events,
    cancel: &CancelToken,
) -> Result<(Recording, Converted), Error> {
    if out.symlink_metadata().is_ok() {
        let hint = "choose a new name; nothing is overwritten".to_owned();
        return Err(Error::Usage { what: format!("{} exists", out.display()), hint });
    }
    let dataset = vidar_dataset::open(path, open)?;
    events
        .stage("convert", dataset.images.len(), || {
            let progress = |done: usize, total: usize| {
                events.emit(&Event::Progress { stage: "convert", done, total });
                !cancel.is_cancelled()
            };
            match vidar_dataset::convert::convert(&dataset, out, format, &progress) {
                Err(_) if cancel.is_cancelled() => Err(Error::Interrupted { path: out.to_owned() }),
                other => Ok(other?),
            }
        })
        .map(|converted| (dataset, converted))
}
