//! Damaged recordings give errors or fewer messages, never a panic.

use proptest::prelude::*;
use std::path::Path;
use vidar_bag::message::decode;
use vidar_bag::{Bag, Encoding};

const NAMES: [&str; 6] = [
    "ros1_lz4.bag",
    "ros1_bz2.bag",
    "mcap_ros2_zstd.mcap",
    "mcap_ros2_plain.mcap",
    "foxglove_json.mcap",
    "ros2_sqlite/ros2_sqlite.db3",
];

fn read_everything(path: &Path) {
    let Ok(bag) = Bag::open(path) else { return };
    for topic in bag.topics() {
        topic.messages.iter().for_each(|m| drop(bag.read(m)));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn of_a_file_with_changed_bytes(
        which in 0..NAMES.len(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..24),
        keep in any::<prop::sample::Index>(),
    ) {
        let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
        let mut bytes = std::fs::read(fixtures.join(NAMES[which])).unwrap();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        bytes.truncate(bytes.len() / 2 + keep.index(bytes.len() / 2 + 1));
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), &bytes).unwrap();
        read_everything(file.path());
    }

    #[test]
    fn of_a_message_of_any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400), which in 0..12usize) {
        let names = [
            "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/Imu", "sensor_msgs/CameraInfo",
            "tf2_msgs/TFMessage", "nav_msgs/Odometry", "nav_msgs/Path", "geometry_msgs/PoseStamped",
            "foxglove.RawImage", "foxglove.CameraCalibration", "foxglove.FrameTransforms", "foxglove.PosesInFrame",
        ];
        for encoding in [Encoding::Ros1, Encoding::Cdr, Encoding::Protobuf, Encoding::Json] {
            let mut with_head = vec![0, bytes.first().copied().unwrap_or(0) % 8, 0, 0];
            with_head.extend(&bytes);
            drop(decode(names[which], encoding, &bytes));
            drop(decode(names[which], encoding, &with_head));
        }
    }
}
