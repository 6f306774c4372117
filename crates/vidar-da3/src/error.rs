//! What can go wrong when a model is opened or run.

use std::path::PathBuf;
use thiserror::Error;
use vidar_nn::{CheckpointError, NnError};

/// A model that cannot be opened, or views that it cannot answer for.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Da3Error {
    /// A file or folder that cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which one.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Neither a safetensors file nor a folder with one.
    #[error("{}: no model here; expected a folder with model.safetensors (and config.json), or a safetensors file", path.display())]
    NoModel {
        /// What was given.
        path: PathBuf,
    },
    /// A description larger than any real one.
    #[error("{place}: description of {bytes} bytes, at most {max} expected")]
    ConfigTooLarge {
        /// The file.
        place: String,
        /// Its size.
        bytes: u64,
        /// The limit.
        max: u64,
    },
    /// A description that is not JSON of the expected form.
    #[error("{place}: not a model description: {reason}")]
    ConfigSyntax {
        /// The file.
        place: String,
        /// The parser's words.
        reason: String,
    },
    /// A description whose sizes no network of the family has.
    #[error("{place}: {field} is {found}, expected {expected}")]
    BadConfig {
        /// The file or model.
        place: String,
        /// The field.
        field: String,
        /// Its value.
        found: String,
        /// What it may be.
        expected: String,
    },
    /// The weights cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The weights are not those of the described network.
    #[error("{origin} is not a checkpoint of {model}:\n{}", problems.join("\n"))]
    ForeignCheckpoint {
        /// The file.
        origin: String,
        /// The network that was expected.
        model: String,
        /// One line a key: missing, wrong shape, unknown.
        problems: Vec<String>,
    },
    /// No description, and keys of no official network.
    #[error("{origin}: no config.json, and the keys fit no official network: {reason}")]
    UnknownNetwork {
        /// The file.
        origin: String,
        /// What does not fit.
        reason: String,
    },
    /// A layer that cannot be put together, or kernels this machine lacks.
    #[error(transparent)]
    Kernels(#[from] NnError),
    /// No view, or more than are allowed.
    #[error("{found} views, expected {expected}")]
    ViewCount {
        /// Views given.
        found: usize,
        /// What is allowed.
        expected: String,
    },
    /// A view that cannot be used.
    #[error("view {view}: {reason}")]
    BadView {
        /// Its index.
        view: usize,
        /// What is wrong.
        reason: String,
    },
    /// Inputs that do not go together, or that this network cannot use.
    #[error("{what}: {reason}")]
    BadInput {
        /// Which input or option.
        what: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// The official code stops here: camera positions that fix no similarity.
    #[error(
        "degenerate covariance rank: {views} camera positions {detail}; no similarity can be fitted to them"
    )]
    DegenerateCameras {
        /// Number of views.
        views: usize,
        /// Why: too few, or on a line.
        detail: String,
    },
    /// The network's output is of no use for the step named.
    #[error("{step}: {reason}")]
    Degenerate {
        /// The step.
        step: &'static str,
        /// Why.
        reason: String,
    },
    /// A reference file that cannot be checked against.
    #[error("{place}: {reason}")]
    BadGolden {
        /// File and tensor.
        place: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A device that this build has no code for.
    #[error(
        "{device}: this program was built without graphics processors; build it with `--features gpu`, or compute on the CPU"
    )]
    NoDeviceSupport {
        /// What was asked for.
        device: crate::Device,
    },
    /// The device is not there, does not suit, or failed.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] vidar_gpu::GpuError),
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
}
