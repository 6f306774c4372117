//! Keyframes of a recording as a file can hold them, so that another recording of the place finds itself in them.

use super::{Descriptor, KeyframeMap, MapKeyframe, MapPoint};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use vidar_core::{Se3, So3, Timestamp};

/// Changes with the layout and with the descriptors.
const VERSION: u32 = 1;

/// Largest map that is taken: what [`KeyframeMap`] keeps, with as many landmarks as an image may have.
const MAX_KEYFRAMES: usize = 4000;
const MAX_POINTS: usize = 1000;

/// Keyframes of one world with the descriptors of their landmarks (`vidar odometry --map`).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SavedMap {
    version: u32,
    keyframes: Vec<SavedKeyframe>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedKeyframe {
    /// Pose `world_from_camera`: x y z, m, and quaternion x y z w.
    pose: [f64; 7],
    points: Vec<SavedPoint>,
}

/// Place in the camera's frame, m, and descriptor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct SavedPoint([f32; 3], [u64; 4]);

impl SavedMap {
    /// The segment of an odometry that was given a map: poses in it are in the world of the map.
    pub const SEGMENT: u32 = 0;

    /// Keyframes of one world.
    pub(crate) fn new<'a>(keyframes: impl Iterator<Item = &'a MapKeyframe>) -> Self {
        let saved = |keyframe: &MapKeyframe| {
            let pose = keyframe.world_from_camera;
            let (t, [i, j, k, w]) = (pose.translation, pose.rotation.quaternion_xyzw());
            SavedKeyframe {
                pose: [t.x, t.y, t.z, i, j, k, w],
                points: keyframe.points.iter().map(saved_point).collect(),
            }
        };
        Self { version: VERSION, keyframes: keyframes.map(saved).collect() }
    }

    /// Number of keyframes.
    pub fn len(&self) -> usize {
        self.keyframes.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.keyframes.is_empty()
    }

    /// Why a map that was read cannot be used; `None` where it can.
    pub fn fault(&self) -> Option<String> {
        if self.version != VERSION {
            return Some(format!("it has version {}, this program reads {VERSION}", self.version));
        }
        if self.keyframes.len() > MAX_KEYFRAMES {
            return Some(format!("it has {} keyframes, {MAX_KEYFRAMES} are possible", self.keyframes.len()));
        }
        let is_sound = |k: &SavedKeyframe| {
            let turn: f64 = k.pose[3..].iter().map(|v| v * v).sum();
            k.pose.iter().all(|v| v.is_finite() && v.abs() < 1e6)
                && (0.9..1.1).contains(&turn)
                && k.points.len() <= MAX_POINTS
                && k.points.iter().all(|p| p.0.iter().all(|v| v.is_finite() && v.abs() < 1e6))
        };
        let broken = self.keyframes.iter().position(|k| !is_sound(k))?;
        Some(format!("keyframe {broken} has a pose or a landmark that is none"))
    }

    /// As keyframes of `segment`.
    pub(crate) fn as_segment(&self, segment: u32) -> KeyframeMap {
        let mut map = KeyframeMap::default();
        for saved in &self.keyframes {
            let [x, y, z, i, j, k, w] = saved.pose;
            let Some(turn) = So3::from_quaternion(i, j, k, w) else { continue };
            map.add(MapKeyframe {
                own: None,
                time: Timestamp::from_nanos(0),
                segment,
                world_from_camera: Se3::new(turn, Vector3::new(x, y, z)),
                points: saved.points.iter().map(point).collect(),
            });
        }
        map
    }
}

fn saved_point(point: &MapPoint) -> SavedPoint {
    SavedPoint(point.in_camera.cast::<f32>().into(), point.descriptor.words())
}

fn point(saved: &SavedPoint) -> MapPoint {
    let in_camera = Vector3::from(saved.0).cast::<f64>();
    MapPoint { key: None, in_camera, descriptor: Descriptor::from_words(saved.1), at_octaves: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_whose_poses_or_landmarks_are_none_is_refused_with_its_keyframe() {
        let sound = SavedKeyframe {
            pose: [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0],
            points: vec![SavedPoint([0.1, 0.2, 3.0], [1, 2, 3, 4]); 3],
        };
        let map =
            |keyframe: SavedKeyframe| SavedMap { version: VERSION, keyframes: vec![sound.clone(), keyframe] };
        assert_eq!(map(sound.clone()).fault(), None);
        let mut turned = sound.clone();
        turned.pose[3] = 7.0;
        let mut far = sound.clone();
        far.points[1].0[2] = f32::NAN;
        let crowded =
            SavedKeyframe { points: vec![sound.points[0].clone(); MAX_POINTS + 1], ..sound.clone() };
        for broken in [turned, far, crowded] {
            let fault = map(broken).fault().unwrap();
            assert!(fault.contains("keyframe 1"), "{fault}");
        }
        let crowd = SavedMap { version: VERSION, keyframes: vec![sound; MAX_KEYFRAMES + 1] };
        assert!(crowd.fault().unwrap().contains("keyframes"));
    }
}
