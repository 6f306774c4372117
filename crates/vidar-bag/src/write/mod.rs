//! Writing of recordings as MCAP with messages of ROS 2.

mod cdr;
mod mcap;
mod schemas;

pub use cdr::encode;
pub use mcap::{ChannelId, McapWriter};
