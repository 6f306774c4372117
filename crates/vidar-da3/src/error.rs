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
    /// A file that is not SALAD's converted checkpoint.
    #[error("{} is not a SALAD checkpoint: {reason}", path.display())]
    NotSalad {
        /// The file.
        path: PathBuf,
        /// What is missing or wrong.
        reason: String,
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
    #[error("device {device}: this program was built without graphics processors")]
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

impl Da3Error {
    /// What to do about a device that cannot be used; `None` when the trouble is not with a device.
    pub fn device_advice(&self) -> Option<&'static str> {
        #[cfg(feature = "gpu")]
        if let Self::Gpu(error) = self {
            return Some(gpu_advice(error));
        }
        let is_absent = matches!(self, Self::NoDeviceSupport { .. });
        is_absent.then_some("take --device cpu, or build the program with `--features gpu`")
    }
}

#[cfg(feature = "gpu")]
fn gpu_advice(error: &vidar_gpu::GpuError) -> &'static str {
    use vidar_gpu::GpuError as G;
    match error {
        G::NoAdapter { .. } => "`vidar doctor` lists the graphics processors; --device cpu needs none",
        G::NotOpened { .. } | G::Unsuitable { .. } => {
            "update the graphics driver, name another device (`vidar doctor` lists them), or take --device cpu"
        }
        G::BufferTooLarge { .. } | G::OutOfMemory { .. } | G::OverBudget { .. } => {
            "take fewer views at once, a smaller size or a smaller network, or --device cpu; --dry-run shows what each takes"
        }
        G::Shape { .. } => "no official network has such sizes; --device cpu runs every size",
        _ => {
            "try again; if it recurs, update the graphics driver, take fewer views at once, or take --device cpu"
        }
    }
}
