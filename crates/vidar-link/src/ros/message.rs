//! Messages that are published, as CDR.

use super::cdr::Cdr;
use vidar_core::{Se3, Timestamp};

/// A type that is published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RosType {
    /// `geometry_msgs/PoseStamped`.
    PoseStamped,
    /// `nav_msgs/Odometry`.
    Odometry,
    /// `tf2_msgs/TFMessage`.
    Transforms,
    /// `sensor_msgs/PointCloud2`.
    PointCloud,
    /// `visualization_msgs/MarkerArray`.
    Markers,
    /// `diagnostic_msgs/DiagnosticArray`.
    Diagnostics,
}

impl RosType {
    /// Its name as keys have it.
    pub fn dds_name(self) -> &'static str {
        match self {
            Self::PoseStamped => "geometry_msgs::msg::dds_::PoseStamped_",
            Self::Odometry => "nav_msgs::msg::dds_::Odometry_",
            Self::Transforms => "tf2_msgs::msg::dds_::TFMessage_",
            Self::PointCloud => "sensor_msgs::msg::dds_::PointCloud2_",
            Self::Markers => "visualization_msgs::msg::dds_::MarkerArray_",
            Self::Diagnostics => "diagnostic_msgs::msg::dds_::DiagnosticArray_",
        }
    }

    /// Hash of its definition (REP 2016), the same in every release of ROS 2 since Iron.
    pub fn hash(self) -> &'static str {
        match self {
            Self::PoseStamped => "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
            Self::Odometry => "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
            Self::Transforms => "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
            Self::PointCloud => "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
            Self::Markers => "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
            Self::Diagnostics => "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
        }
    }
}

/// A pose: maps points in the body to `frame`, m.
pub fn pose_stamped(stamp: Timestamp, frame: &str, pose: &Se3) -> Vec<u8> {
    let mut out = Cdr::new(128);
    out.header(stamp, frame);
    out.pose(pose);
    out.finish()
}

/// A pose with its covariance (row by row; position in m², then rotation in rad²); velocities are not known and zero.
pub fn odometry(
    stamp: Timestamp,
    (frame, child): (&str, &str),
    pose: &Se3,
    covariance: &[f64; 36],
) -> Vec<u8> {
    let mut out = Cdr::new(768);
    out.header(stamp, frame);
    out.text(child);
    out.pose(pose);
    out.f64s(covariance);
    out.f64s(&[0.0; 6 + 36]);
    out.finish()
}

/// One transform: maps points in `child` to `frame`, m.
pub fn transforms(stamp: Timestamp, (frame, child): (&str, &str), pose: &Se3) -> Vec<u8> {
    let mut out = Cdr::new(192);
    out.u32(1);
    out.header(stamp, frame);
    out.text(child);
    out.pose(pose);
    out.finish()
}

/// A point of a cloud: position, m, and colour.
pub type CloudPoint = ([f32; 3], [u8; 3]);

/// A cloud in `frame`: fields x, y, z and rgb, as RViz and Foxglove read them.
pub fn point_cloud(stamp: Timestamp, frame: &str, points: &[CloudPoint]) -> Vec<u8> {
    const FLOAT32: u8 = 7;
    const STEP: u32 = 16;
    let mut out = Cdr::new(256 + points.len() * STEP as usize);
    out.header(stamp, frame);
    let count = points.len() as u32;
    out.u32(1);
    out.u32(count);
    out.u32(4);
    for (name, offset) in [("x", 0), ("y", 4), ("z", 8), ("rgb", 12)] {
        out.text(name);
        out.u32(offset);
        out.u8(FLOAT32);
        out.u32(1);
    }
    out.u8(0);
    out.u32(STEP);
    out.u32(STEP * count);
    out.u32(STEP * count);
    for (position, [r, g, b]) in points {
        position.iter().for_each(|v| out.raw(v.to_le_bytes()));
        out.raw([*b, *g, *r, 0]);
    }
    out.u8(1);
    out.finish()
}

/// Level of a diagnostic status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HealthLevel {
    /// All is well.
    Ok = 0,
    /// Something is degraded.
    Warn = 1,
    /// It does not work.
    Error = 2,
}

/// One diagnostic status with named values.
pub fn health(
    stamp: Timestamp,
    (name, message): (&str, &str),
    level: HealthLevel,
    values: &[(&str, String)],
) -> Vec<u8> {
    let mut out = Cdr::new(256);
    out.header(stamp, "");
    out.u32(1);
    out.u8(level as u8);
    out.text(name);
    out.text(message);
    out.text("vidar");
    out.u32(values.len() as u32);
    for (key, value) in values {
        out.text(key);
        out.text(value);
    }
    out.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cloud_has_the_layout_of_its_definition() {
        let cloud = point_cloud(Timestamp::from_nanos(2_000_000_003), "map", &[([1.0, 2.0, 3.0], [9, 8, 7])]);
        let at = |i: usize| u32::from_le_bytes(cloud[i..i + 4].try_into().unwrap());
        assert_eq!((&cloud[..4], at(4), at(8), at(12)), (&[0, 1, 0, 0][..], 2, 3, 4));
        // "map\0", then height, width, number of fields.
        assert_eq!((&cloud[16..20], at(20), at(24), at(28)), (&b"map\0"[..], 1, 1, 4));
        let end = cloud.len();
        assert_eq!(cloud[end - 1], 1, "no point is invalid");
        assert_eq!(&cloud[end - 5..end - 1], &[7, 8, 9, 0], "b, g, r");
        assert_eq!(f32::from_le_bytes(cloud[end - 17..end - 13].try_into().unwrap()), 1.0);
    }
}
