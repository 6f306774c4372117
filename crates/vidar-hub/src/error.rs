//! Errors of finding, fetching and verifying checkpoints: file or address, found value, expected value.

use crate::licence::Licence;
use std::io;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why something about a checkpoint failed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum HubError {
    /// No checkpoint of that name.
    #[error("{name:?} is not a known checkpoint; known: {known}")]
    UnknownModel {
        /// The name as given.
        name: String,
        /// All names.
        known: String,
    },
    /// The checkpoint is not on this machine.
    #[error("{name} is not on this machine (looked in {looked})", looked = looked.display())]
    NotInstalled {
        /// Which checkpoint.
        name: String,
        /// Where it would be.
        looked: PathBuf,
    },
    /// Non-commercial weights without an acceptance of their licence.
    #[error("{name} is licensed under {licence}, which forbids commercial use and has not been accepted yet")]
    LicenceNotAccepted {
        /// Which checkpoint.
        name: String,
        /// Its licence.
        licence: Licence,
    },
    /// A licence was accepted that is not the one of the checkpoint.
    #[error("{name} is licensed under {licence}, the accepted licence is {given:?}")]
    WrongLicence {
        /// Which checkpoint.
        name: String,
        /// Its licence.
        licence: Licence,
        /// What was accepted.
        given: String,
    },
    /// Network use is disabled.
    #[error("{what} must be fetched, but network use is disabled")]
    Offline {
        /// What is missing.
        what: String,
    },
    /// A setting cannot be used.
    #[error("{name} is {found:?}, expected {expected}")]
    BadSetting {
        /// Which variable.
        name: &'static str,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// 401 or 403.
    #[error("{url}: status {status}, no access{}", detail_of(detail))]
    NoAccess {
        /// The requested address.
        url: String,
        /// The status.
        status: u16,
        /// The hub's explanation.
        detail: String,
        /// The page of the repository, where access can be requested.
        page: String,
        /// Whether a token was sent.
        with_token: bool,
    },
    /// 404.
    #[error("{url}: status 404, no such file")]
    NotFound {
        /// The requested address.
        url: String,
    },
    /// 429, after all waiting that was allowed.
    #[error("{url}: status 429, too many requests{}", retry_of(*retry_after_secs))]
    RateLimited {
        /// The requested address.
        url: String,
        /// The wait that the server requests, seconds.
        retry_after_secs: Option<u64>,
    },
    /// Any other status that is not a success, after all retries that were allowed.
    #[error("{url}: status {status}")]
    Status {
        /// The requested address.
        url: String,
        /// The status.
        status: u16,
    },
    /// No connection could be established.
    #[error("no connection to {url}: {reason}")]
    NoConnection {
        /// The requested address.
        url: String,
        /// What went wrong.
        reason: String,
    },
    /// The connection failed, after all retries.
    #[error("{url}: {reason}")]
    Network {
        /// The requested address.
        url: String,
        /// What went wrong.
        reason: String,
    },
    /// A file took longer than a transfer may take.
    #[error("{url}: not complete after {secs} s")]
    TooSlow {
        /// The requested address.
        url: String,
        /// The limit, s.
        secs: u64,
    },
    /// A redirect is invalid, in a loop, or from https to http.
    #[error("{url}: {reason}")]
    Redirect {
        /// The first address.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The response contradicts itself or the request.
    #[error("{url}: {what} is {found}, expected {expected}")]
    BadResponse {
        /// The requested address.
        url: String,
        /// Which part of the response.
        what: &'static str,
        /// The value found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The file has another length than the official one.
    #[error("{what} has {found} bytes, expected {expected}")]
    WrongSize {
        /// Which file or address.
        what: String,
        /// Bytes found.
        found: u64,
        /// Bytes expected.
        expected: u64,
    },
    /// The file has another SHA-256 than the official one.
    #[error("{what} has SHA-256 {found}, expected {expected}")]
    WrongHash {
        /// Which file or address.
        what: String,
        /// Hash found.
        found: String,
        /// Hash expected.
        expected: String,
    },
    /// The disk is too small.
    #[error("{path} has {available} bytes free, {needed} are needed", path = path.display())]
    NoSpace {
        /// Which folder.
        path: PathBuf,
        /// Bytes free.
        available: u64,
        /// Bytes needed.
        needed: u64,
    },
    /// Another process fetches the same checkpoint.
    #[error("{path} is being written by another process", path = path.display())]
    Busy {
        /// Which folder.
        path: PathBuf,
    },
    /// A file next to the weights was not written by this program.
    #[error("{path}: {reason}", path = path.display())]
    BadRecord {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A given file is not a checkpoint.
    #[error("{path} is not a checkpoint: {reason}", path = path.display())]
    NotACheckpoint {
        /// Which file or folder.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// The file system reported an error.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// The action that failed.
        action: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The caller asked to stop.
    #[error("stopped; what was fetched is kept and continued next time")]
    Cancelled,
}

impl HubError {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    /// The next step, where one is known.
    pub fn hint(&self) -> Option<String> {
        let text = match self {
            Self::UnknownModel { .. } => "`vidar model list` describes them".to_owned(),
            Self::NotInstalled { name, .. } => {
                format!("`vidar model pull {name}` fetches it; `vidar model import FILE` copies a local file")
            }
            Self::LicenceNotAccepted { licence, .. } => format!(
                "read {}; if you agree, add --accept-licence {}; it is recorded next to the weights",
                licence.text_url(),
                licence.spdx()
            ),
            Self::WrongLicence { licence, .. } => format!("write --accept-licence {}", licence.spdx()),
            Self::Offline { .. } => {
                "unset --offline, VIDAR_OFFLINE and HF_HUB_OFFLINE, or bring the files with `vidar model import`"
                    .to_owned()
            }
            Self::NoAccess { page, with_token: false, .. } => {
                format!("log in at {page}, accept its terms if asked, and set HF_TOKEN to a token with read access")
            }
            Self::NoAccess { page, with_token: true, .. } => {
                format!("the token in HF_TOKEN has no read access; request access at {page}, or create a new token")
            }
            Self::NotFound { .. } => "check HF_ENDPOINT and --revision".to_owned(),
            Self::RateLimited { .. } => "wait, or set HF_TOKEN: the hub allows more requests with a token".to_owned(),
            Self::NoConnection { .. } => {
                "check the network connection; HF_ENDPOINT names a mirror, HTTPS_PROXY a proxy; `vidar model import FILE` copies \
                 a local file"
                    .to_owned()
            }
            Self::Status { .. } | Self::Network { .. } | Self::TooSlow { .. } => {
                "try again: what was fetched is kept; HF_ENDPOINT names a mirror, HTTPS_PROXY a proxy".to_owned()
            }
            Self::WrongSize { .. } | Self::WrongHash { .. } => {
                "the file is damaged or not the official one; fetch it again with `vidar model pull --again`"
                    .to_owned()
            }
            Self::NoSpace { .. } => "free space, or set VIDAR_MODELS to a folder on another disk".to_owned(),
            Self::NotACheckpoint { .. } => {
                "a checkpoint is model.safetensors with config.json next to it, as on the hub".to_owned()
            }
            Self::Busy { .. } => "wait for it to finish".to_owned(),
            Self::BadRecord { .. } => "`vidar model import` or `vidar model pull --again` rewrites it".to_owned(),
            _ => return None,
        };
        Some(text)
    }
}

fn detail_of(detail: &str) -> String {
    if detail.is_empty() { String::new() } else { format!(" ({detail})") }
}

fn retry_of(secs: Option<u64>) -> String {
    secs.map_or_else(String::new, |s| format!("; the server requests a wait of {s} s"))
}
