//! ROS 2 as `rmw_zenoh` carries it: keys, attachments, and the messages that are published.

mod attachment;
mod cdr;
mod key;
mod marker;
mod message;

pub use attachment::Attachment;
pub use key::{TopicKey, liveliness_token};
pub use marker::{MeshMarker, mesh_markers};
pub use message::{
    CloudPoint, HealthLevel, RosType, health, odometry, point_cloud, pose_stamped, transforms,
};
