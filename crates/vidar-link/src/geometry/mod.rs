//! Geometry elsewhere: chunks of views to a worker, predictions back.

mod client;
mod message;
mod pixels;
mod server;

pub use client::{AskError, Expected, Reach, RemoteModel, RemoteOptions, RemoteReport};
pub use message::{Hello, HelloRequest, ModelFacts, Outcome, PredictReply, PredictRequest};
pub use pixels::{DepthFormat, ImageFormat};
pub use server::{Answer, Predicted, Served, answer_hello, answer_predict};
#[cfg(feature = "zenoh")]
pub(crate) use server::{busy, patience_of};
