#![doc = include_str!("../README.md")]

mod boxes;
mod codec;
mod error;
mod ffmpeg;
mod fragments;
mod gpmf;
#[cfg(feature = "h265")]
mod h265;
mod lane;
mod movie;
mod picture;
mod pictures;
mod stream;
mod track;
mod unit;
mod video;

pub use error::VideoError;
pub use ffmpeg::VideoDecoder;
pub use gpmf::{StatedTurns, Telemetry};
pub use lane::{AccessUnits, DECODER_THREAD};
pub use stream::{StreamCodec, StreamUnit, VideoStream};
pub use video::{Video, is_video};
