#![doc = include_str!("../README.md")]

mod boxes;
mod decoder;
mod error;
mod gpmf;
#[cfg(feature = "h265")]
mod h265;
mod picture;
mod track;
mod video;

pub use decoder::DECODER_THREAD;
pub use error::VideoError;
pub use gpmf::Telemetry;
pub use video::{Video, is_video};
