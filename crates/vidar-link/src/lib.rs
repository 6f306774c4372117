#![doc = include_str!("../README.md")]

mod envelope;
mod error;
pub mod geometry;
pub mod ros;
mod session;

pub use envelope::{MAX_HEADER_BYTES, MAX_MESSAGE_BYTES, PROTOCOL};
pub use error::{LinkError, WireError};
pub use session::{DEFAULT_ENDPOINT, Delivery, Sample};
pub use session::{Link, LinkOptions, Publisher, Role, Serving, Subscription, is_built};
