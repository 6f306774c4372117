#![doc = include_str!("../README.md")]

mod bag;
mod bytes;
mod compression;
mod db3;
mod error;
mod file;
mod index;
mod mcap;
pub mod message;
mod metadata;
mod ros1;
mod sqlite;
pub mod write;

pub use bag::{Bag, BagFormat, bags_in};
pub use error::BagError;
pub use index::{Encoding, MessageRef, Topic};
pub use message::{
    CameraInfo, CompressedImage, FramePose, FrameTransform, Header, ImuMessage, Message, Pixels, Pose,
    RawImage, Role, role_of,
};
