//! Keys: `<domain>/<topic>/<type>/<hash>`, as in `0/cam0/image_raw/sensor_msgs::msg::dds_::Image_/RIHS01_…`.

use super::message::RosType;
use crate::envelope::within;
use crate::error::WireError;

/// The longest key that is looked at, bytes.
const MAX_BYTES: usize = 1024;

/// What a key says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicKey {
    /// ROS domain.
    pub domain: u32,
    /// Name of the topic, with its first `/`.
    pub topic: String,
    /// Type as bags name it: `sensor_msgs/Image`.
    pub message_type: String,
    /// Hash of the type's definition.
    pub hash: String,
}

impl TopicKey {
    /// Reads a key.
    ///
    /// # Errors
    /// It is not that of a topic.
    pub fn parse(key: &str) -> Result<Self, WireError> {
        within("length of a key", key.len(), MAX_BYTES)?;
        let bad = || WireError::bad("key", "DOMAIN/TOPIC/PACKAGE::msg::dds_::TYPE_/HASH expected");
        let (rest, hash) = key.rsplit_once('/').ok_or_else(bad)?;
        let (rest, message_type) = rest.rsplit_once('/').ok_or_else(bad)?;
        let (domain, topic) = rest.split_once('/').ok_or_else(bad)?;
        let (package, name) = message_type.split_once("::msg::dds_::").ok_or_else(bad)?;
        let name = name.strip_suffix('_').ok_or_else(bad)?;
        let plain =
            |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if !(plain(package) && plain(name) && plain(hash)) || topic.is_empty() {
            return Err(bad());
        }
        Ok(Self {
            domain: domain.parse().map_err(|_| bad())?,
            topic: format!("/{topic}"),
            message_type: format!("{package}/{name}"),
            hash: hash.to_owned(),
        })
    }

    /// The key of a topic that is published.
    pub fn of(domain: u32, topic: &str, kind: RosType) -> String {
        format!("{domain}/{}/{}/{}", topic.trim_start_matches('/'), kind.dds_name(), kind.hash())
    }
}

/// The token by which ROS 2 lists a publisher (`ros2 topic list`): of node `node`, number `number` of the session `session`.
pub fn liveliness_token(
    (domain, node): (u32, &str),
    session: &str,
    number: usize,
    topic: &str,
    kind: RosType,
) -> String {
    let topic = topic.replace('/', "%");
    // Quality of service: the defaults but for a history of ten messages.
    format!(
        "@ros2_lv/{domain}/{session}/0/{number}/MP/%/%/{node}/{topic}/{}/{}/::,10:,:,:,,",
        kind.dds_name(),
        kind.hash()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_read_as_they_are_written() {
        let key = TopicKey::of(3, "/vidar/pose", RosType::PoseStamped);
        assert!(key.starts_with("3/vidar/pose/geometry_msgs::msg::dds_::PoseStamped_/RIHS01_"), "{key}");
        let read = TopicKey::parse(&key).unwrap();
        assert_eq!((read.domain, read.topic.as_str()), (3, "/vidar/pose"));
        assert_eq!(read.message_type, "geometry_msgs/PoseStamped");
        for bad in
            ["", "0", "0/a", "x/a/p::msg::dds_::T_/h", "0/a/p::msg::dds_::T/h", "0/a/p::srv::dds_::T_/h"]
        {
            assert!(TopicKey::parse(bad).is_err(), "{bad}");
        }
        assert!(TopicKey::parse(&format!("0/{}/p::msg::dds_::T_/h", "a".repeat(2000))).is_err());
    }
}
