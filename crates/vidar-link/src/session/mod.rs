//! Sessions with other machines, by Zenoh; without the feature `zenoh` none can be opened.

#[cfg(feature = "zenoh")]
mod built;
#[cfg(feature = "zenoh")]
mod settings;
#[cfg(not(feature = "zenoh"))]
mod unbuilt;
#[cfg(any(test, feature = "zenoh"))]
mod waiting;

#[cfg(feature = "zenoh")]
pub use built::{Link, Publisher, Subscription};
#[cfg(not(feature = "zenoh"))]
pub use unbuilt::{Link, Publisher, Subscription};

use std::path::PathBuf;
use std::time::Duration;

/// Where a server listens and a client looks for it, unless told otherwise: this computer alone.
pub const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";

/// How a session is opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LinkOptions {
    /// Endpoints to listen at, such as `tcp/0.0.0.0:7447`.
    pub listen: Vec<String>,
    /// Endpoints to connect to, such as `tls/server:7447`.
    pub connect: Vec<String>,
    /// A file of Zenoh's settings (JSON5): TLS, certificates, access control.
    pub config: Option<PathBuf>,
}

/// What happens to a message while its receivers do not keep up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// It is lost; the one that publishes never waits.
    Drop,
    /// The one that publishes waits.
    Wait,
}

/// What a session is for where no endpoint is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Listens.
    Server,
    /// Connects.
    Client,
}

/// What a worker tells while it serves.
#[derive(Clone, Debug, PartialEq)]
pub enum Serving {
    /// It answers from now on, at these endpoints.
    Ready {
        /// Its name: the part of its keys behind the common one.
        worker: String,
        /// Where it listens.
        endpoints: Vec<String>,
    },
    /// It answered a request.
    Answered {
        /// Keyframes with geometry.
        keyframes: usize,
        /// How long it took.
        took: Duration,
        /// Bytes of the request.
        received: usize,
        /// Bytes of the answer.
        sent: usize,
        /// Why there is no geometry.
        problem: Option<String>,
    },
    /// It did not answer: the sender no longer waits.
    TooLate,
}

/// A message that came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Its key.
    pub key: String,
    /// Its bytes.
    pub payload: Vec<u8>,
    /// What was attached.
    pub attachment: Option<Vec<u8>>,
}

/// Whether the program was built with links to other machines.
pub const fn is_built() -> bool {
    cfg!(feature = "zenoh")
}
