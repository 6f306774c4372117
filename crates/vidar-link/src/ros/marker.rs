//! Triangles, as ROS 2 has them: `visualization_msgs/MarkerArray`, which RViz and Foxglove draw. ROS has no message for meshes of its own.

use super::cdr::Cdr;
use super::message::CloudPoint;
use vidar_core::Timestamp;

/// The most triangles of a message with more than one marker: 6 MB.
const MOST_TRIANGLES: usize = 50_000;
/// `Marker.TRIANGLE_LIST`.
const TRIANGLE_LIST: u32 = 11;
/// `Marker.ADD`, `Marker.DELETE`.
const ADD: u32 = 0;
const DELETE: u32 = 2;

/// A part of a surface under a name that it keeps; without triangles it is deleted.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshMarker {
    /// Its number, within `surface`.
    pub id: i32,
    /// Corners: position, m, and colour.
    pub triangles: Vec<[CloudPoint; 3]>,
}

/// The markers in `frame`, as messages of bounded size; none for none.
pub fn mesh_markers(stamp: Timestamp, frame: &str, markers: &[MeshMarker]) -> Vec<Vec<u8>> {
    let mut messages = Vec::new();
    let mut rest = markers;
    while !rest.is_empty() {
        let mut triangles = 0;
        let fits = |marker: &&MeshMarker| {
            triangles += marker.triangles.len();
            triangles <= MOST_TRIANGLES
        };
        // One that is larger goes alone.
        let count = rest.iter().take_while(fits).count().max(1);
        let (now, later) = rest.split_at(count);
        messages.push(array(stamp, frame, now));
        rest = later;
    }
    messages
}

fn array(stamp: Timestamp, frame: &str, markers: &[MeshMarker]) -> Vec<u8> {
    let triangles: usize = markers.iter().map(|m| m.triangles.len()).sum();
    let mut out = Cdr::new(64 + 320 * markers.len() + 120 * triangles);
    out.u32(markers.len() as u32);
    for marker in markers {
        write(&mut out, stamp, frame, marker);
    }
    out.finish()
}

/// `visualization_msgs/Marker`, in the order of its definition.
fn write(out: &mut Cdr, stamp: Timestamp, frame: &str, marker: &MeshMarker) {
    let corners = marker.triangles.as_flattened();
    let linear = |c: u8| f32::from(c) / 255.0;
    out.header(stamp, frame);
    out.text("surface");
    out.u32(marker.id as u32);
    out.u32(TRIANGLE_LIST);
    out.u32(if corners.is_empty() { DELETE } else { ADD });
    // Pose: the frame's own; scale; colour of what has none.
    out.f64s(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    out.f64s(&[1.0; 3]);
    out.f32s(&[1.0; 4]);
    // It lives until it is replaced, and does not move with its frame.
    out.u32(0);
    out.u32(0);
    out.u8(0);
    out.u32(corners.len() as u32);
    for (position, _) in corners {
        out.f64s(&position.map(f64::from));
    }
    out.u32(corners.len() as u32);
    for (_, [r, g, b]) in corners {
        out.f32s(&[linear(*r), linear(*g), linear(*b), 1.0]);
    }
    // No texture: resource, image (header, format, bytes), coordinates.
    out.text("");
    out.header(Timestamp::from_nanos(0), "");
    out.text("");
    out.u32(0);
    out.u32(0);
    // No text, no file of a mesh (resource; name and bytes), no materials.
    out.text("");
    out.text("");
    out.text("");
    out.u32(0);
    out.u8(0);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn marker(id: i32, triangles: usize) -> MeshMarker {
        let corner = |x: f32| ([x, 2.0, 3.0], [255, 0, 51]);
        MeshMarker { id, triangles: vec![[corner(1.0), corner(4.0), corner(7.0)]; triangles] }
    }

    #[test]
    fn a_marker_has_the_layout_of_its_definition() {
        let at = Timestamp::from_nanos(2_000_000_003);
        let messages = mesh_markers(at, "map", &[marker(7, 1)]);
        let bytes = &messages[0][4..];
        let u32_at = |i: usize| u32::from_le_bytes(bytes[i..i + 4].try_into().unwrap());
        let f64_at = |i: usize| f64::from_le_bytes(bytes[i..i + 8].try_into().unwrap());
        let f32_at = |i: usize| f32::from_le_bytes(bytes[i..i + 4].try_into().unwrap());
        assert_eq!((messages.len(), u32_at(0), u32_at(4), u32_at(8), u32_at(12)), (1, 1, 2, 3, 4));
        assert_eq!((&bytes[16..20], u32_at(20), &bytes[24..32]), (&b"map\0"[..], 8, &b"surface\0"[..]));
        assert_eq!((u32_at(32), u32_at(36), u32_at(40)), (7, TRIANGLE_LIST, ADD));
        // Numbers of eight bytes follow at 48: pose, scale; then colour, lifetime, a byte, and the points' number at the next four.
        assert_eq!((f64_at(96), f64_at(104), f32_at(128), u32_at(156)), (1.0, 1.0, 1.0, 3));
        assert_eq!((f64_at(160), f64_at(184), f64_at(216)), (1.0, 4.0, 2.0));
        assert_eq!((u32_at(232), f32_at(236), f32_at(244)), (3, 1.0, 0.2));
    }

    #[test]
    fn messages_are_bounded_and_a_marker_without_triangles_is_deleted() {
        let all = [marker(0, 30_000), marker(1, 15_000), marker(2, 10_000), marker(3, 60_000), marker(4, 0)];
        let messages = mesh_markers(Timestamp::from_nanos(0), "map", &all);
        let counts: Vec<u8> = messages.iter().map(|m| m[4]).collect();
        assert_eq!(counts, [2, 1, 1, 1]);
        assert!(messages.iter().all(|m| m.len() < 7_300_000));
        assert_eq!(messages[3][4 + 40], DELETE as u8);
        assert!(mesh_markers(Timestamp::from_nanos(0), "map", &[]).is_empty());
    }
}
