//! Frames of ROS and the fixed transforms between them.

use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet};
use vidar_bag::{FrameTransform, Pose};
use vidar_core::{LieGroup, Se3, So3};

/// A graph of frames: neighbours of each with the transform to them.
#[derive(Default)]
pub(crate) struct Frames {
    /// From a frame to its neighbours: `frame_from_neighbour`.
    edges: BTreeMap<String, Vec<(String, Se3)>>,
}

/// Most frames that are kept; a humanoid robot has some hundred.
const MAX_FRAMES: usize = 20_000;

impl Frames {
    /// Adds a transform; those that are no rigid motion are left out.
    pub(crate) fn add(&mut self, transform: &FrameTransform) {
        let (parent, child) = (plain(&transform.parent.frame), plain(&transform.child));
        let Some(parent_from_child) = rigid(&transform.pose) else { return };
        if self.edges.len() >= MAX_FRAMES || parent == child {
            return;
        }
        for (from, to, motion) in
            [(parent, child, parent_from_child), (child, parent, parent_from_child.inverse())]
        {
            let neighbours = self.edges.entry(from.to_string()).or_default();
            // The newest statement of a transform holds.
            neighbours.retain(|(name, _)| name != to);
            neighbours.push((to.to_string(), motion));
        }
    }

    /// `a_from_b`, along the fewest transforms; `None` where nothing connects them.
    pub(crate) fn a_from_b(&self, a: &str, b: &str) -> Option<Se3> {
        let (a, b) = (plain(a), plain(b));
        let mut seen = BTreeSet::from([a.to_string()]);
        let mut front = vec![(a.to_string(), Se3::IDENTITY)];
        while !front.is_empty() {
            if let Some((_, found)) = front.iter().find(|(name, _)| name == b) {
                return Some(*found);
            }
            let mut next = Vec::new();
            for (name, a_from_name) in front {
                for (neighbour, name_from_neighbour) in self.edges.get(&name).into_iter().flatten() {
                    if seen.insert(neighbour.clone()) {
                        next.push((neighbour.clone(), a_from_name * *name_from_neighbour));
                    }
                }
            }
            front = next;
        }
        None
    }
}

/// Old recordings of ROS 1 begin names of frames with a slash.
fn plain(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

/// Largest deviation of a quaternion's length from 1: numbers of 32 bits, written with three digits.
const QUATERNION_TOLERANCE: f64 = 1e-2;

/// The rigid motion of a pose; `None` where it is none.
pub(crate) fn rigid(pose: &Pose) -> Option<Se3> {
    let [x, y, z, w] = pose.orientation;
    let norm = pose.orientation.iter().map(|c| c * c).sum::<f64>().sqrt();
    if !((norm - 1.0).abs() <= QUATERNION_TOLERANCE) || !pose.position.iter().all(|c| c.is_finite()) {
        return None;
    }
    So3::from_quaternion(x, y, z, w).map(|rotation| Se3::new(rotation, Vector3::from(pose.position)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_bag::Header;

    fn transform(parent: &str, child: &str, x: f64, z_angle: f64) -> FrameTransform {
        let half = 0.5 * z_angle;
        FrameTransform {
            parent: Header { frame: parent.into(), ..Header::default() },
            child: child.into(),
            pose: Pose { position: [x, 0.0, 0.0], orientation: [0.0, 0.0, half.sin(), half.cos()] },
        }
    }

    #[test]
    fn transforms_chain_in_both_directions() {
        let mut frames = Frames::default();
        frames.add(&transform("base", "imu", 1.0, 0.0));
        frames.add(&transform("/base", "mount", 0.0, std::f64::consts::FRAC_PI_2));
        frames.add(&transform("mount", "camera", 2.0, 0.0));
        let imu_from_camera = frames.a_from_b("imu", "/camera").unwrap();
        // The mount looks left: its x axis is the base's y axis.
        assert!((imu_from_camera.translation - Vector3::new(-1.0, 2.0, 0.0)).norm() < 1e-12);
        let back = frames.a_from_b("camera", "imu").unwrap();
        assert!(((back * imu_from_camera).translation).norm() < 1e-12);
        assert!(frames.a_from_b("imu", "elsewhere").is_none());
        assert_eq!(frames.a_from_b("imu", "imu"), Some(Se3::IDENTITY));
    }

    #[test]
    fn what_is_no_rotation_is_left_out() {
        let mut frames = Frames::default();
        let mut bad = transform("a", "b", 1.0, 0.0);
        bad.pose.orientation = [0.0; 4];
        frames.add(&bad);
        assert!(frames.a_from_b("a", "b").is_none());
    }
}
