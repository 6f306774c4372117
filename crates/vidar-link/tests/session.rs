//! The unit tests of a session's settings, as a target that can be built by its name: `cargo test --lib` with the feature `zenoh`
//! would build the unit tests of the whole workspace once more.

#![cfg(feature = "zenoh")]
#![allow(clippy::unwrap_used)] // tests

use vidar_link::{DEFAULT_ENDPOINT, LinkOptions, Role};

mod envelope {
    pub use vidar_link::MAX_MESSAGE_BYTES;
}

mod error {
    pub use vidar_link::LinkError;
}

#[path = "../src/session/settings.rs"]
mod settings;
