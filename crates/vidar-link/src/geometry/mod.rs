//! Geometry elsewhere: chunks of views to a worker, predictions back.

mod client;
mod message;
mod pixels;
mod reach;
mod report;
mod server;

pub use client::{Expected, RemoteModel, RemoteOptions};
pub use message::{Hello, HelloRequest, ModelFacts, Outcome, PredictReply, PredictRequest};
pub use pixels::{DepthFormat, ImageFormat};
pub use reach::{AskError, Reach};
pub use report::RemoteReport;
pub use server::{Answer, Predicted, Served, answer_hello, answer_predict};
#[cfg(feature = "zenoh")]
pub(crate) use server::{busy, patience_of};
