#![doc = include_str!("../README.md")]

mod bag;
mod bytes;
mod chunks;
mod compression;
mod db3;
mod error;
mod file;
mod index;
mod mcap;
pub mod message;
mod metadata;
mod parts;
mod ros1;
mod sqlite;
mod stream;
pub mod write;

pub use bag::{Bag, BagFormat};
pub use chunks::CHUNK_THREAD;
pub use error::BagError;
pub use index::{Encoding, MessageRef, Topic};
pub use message::{
    CameraInfo, CompressedImage, FramePose, FrameTransform, Header, ImuMessage, Message, Pixels, Pose,
    RawImage, Role, role_of,
};
pub use parts::bags_in;
pub use stream::{KeptStream, McapStream, StreamEnd, StreamMessage, StreamPlace, StreamTopic};
