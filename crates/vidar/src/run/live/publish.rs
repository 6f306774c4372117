//! What a live run tells a ROS 2 system while it goes: a reader of poses and of the engine's events. Who does not keep up loses messages;
//! the run never waits.

use crate::config::Config;
use crate::engine::{FrameState, MapEvent};
use crate::error::Error;
use crate::run_folder::now_ns;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use vidar_align::covariance::covariance_in_camera;
use vidar_core::{OdometryKeyframe, PoseCovariance, RigCamera, Se3, Severity, Timestamp};
use vidar_export::{SurfacePatch, SurfacePatches, thinned_vertices};
use vidar_link::ros::{Attachment, CloudPoint, HealthLevel, MeshMarker, RosType, TopicKey, liveliness_token};
use vidar_link::ros::{health, mesh_markers, odometry, point_cloud, pose_stamped, transforms};
use vidar_link::{Delivery, Link, LinkError, Publisher, Role};

/// The world; further segments, which have no common world with the first, are `map_1`, `map_2`, ….
const WORLD: &str = "map";
/// The camera: x right, y down, z forward.
const CAMERA: &str = "camera";
/// The most points of a cloud: 3 MB.
const MOST_POINTS: usize = 200_000;
/// How often health is told.
const HEALTH_EVERY: Duration = Duration::from_secs(1);

/// What is published, and under which name.
const TOPICS: [(Topic, &str, RosType); 7] = [
    (Topic::Pose, "pose", RosType::PoseStamped),
    (Topic::Odometry, "odometry", RosType::Odometry),
    (Topic::Keyframe, "keyframe", RosType::PoseStamped),
    (Topic::Cloud, "cloud", RosType::PointCloud),
    (Topic::Mesh, "mesh", RosType::Markers),
    (Topic::Health, "health", RosType::Diagnostics),
    (Topic::Transforms, "/tf", RosType::Transforms),
];

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Topic {
    Pose,
    Odometry,
    Keyframe,
    Cloud,
    Mesh,
    Health,
    Transforms,
}

/// Publishers of one run.
pub(in crate::run) struct LivePublisher {
    publishers: BTreeMap<Topic, (Publisher, AtomicI64)>,
    id: [u8; 16],
    body_from_camera: Se3,
    /// Row by row, position then rotation, in the world's axes; none before the first keyframe.
    covariance: Mutex<Option<[f64; 36]>>,
    patches: Mutex<SurfacePatches>,
    /// The segment that is mapped.
    segment: AtomicU32,
    has_pose: AtomicBool,
    /// What was left out when health was last told.
    left_out: AtomicUsize,
    images: AtomicU64,
    keyframes: AtomicU64,
    last: AtomicI64,
    told: Mutex<Option<Instant>>,
    _link: Link,
}

/// The name of a segment's world.
fn world_of(segment: u32) -> String {
    match segment {
        0 => WORLD.to_owned(),
        n => format!("{WORLD}_{n}"),
    }
}

/// A patch as ROS has it, each triangle with corners of its own.
fn marker(SurfacePatch { id, mesh }: SurfacePatch) -> MeshMarker {
    let corner = |v: u32| (mesh.positions[v as usize], mesh.colors[v as usize]);
    MeshMarker { id: id as i32, triangles: mesh.triangles.iter().map(|t| t.map(corner)).collect() }
}

/// `DOMAIN/NAMESPACE`, as in `0/vidar`.
fn prefix(text: &str) -> Result<(u32, String), Error> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_/".contains(c);
    let parsed = text.split_once('/').and_then(|(domain, name)| {
        let is_name = !name.is_empty() && name.chars().all(plain) && !name.contains("//");
        Some((domain.parse().ok()?, name.trim_matches('/').to_owned())).filter(|_| is_name)
    });
    parsed.ok_or_else(|| Error::Usage {
        what: format!("--publish {text:?} is no place in a ROS 2 system"),
        hint: "write the domain and a namespace, as in --publish 0/vidar".into(),
    })
}

impl LivePublisher {
    /// Opens the link that `link.publish` asks for; none where nothing is published.
    ///
    /// # Errors
    /// A name that cannot be used, or no link.
    pub fn open(config: &Config, camera: &RigCamera) -> Result<Option<Self>, Error> {
        if config.link.publish.is_empty() {
            return Ok(None);
        }
        let (domain, namespace) = prefix(&config.link.publish)?;
        let link = Link::open(&config.link.options(), Role::Client)?;
        let id = link.id();
        let session: String = id.iter().map(|b| format!("{b:02x}")).collect();
        let mut publishers = BTreeMap::new();
        for (number, (topic, name, kind)) in TOPICS.into_iter().enumerate() {
            let name = if name.starts_with('/') { name.to_owned() } else { format!("/{namespace}/{name}") };
            let token = liveliness_token((domain, "vidar"), &session, number, &name, kind);
            let publisher =
                link.publisher(&TopicKey::of(domain, &name, kind), Some(&token), Delivery::Drop)?;
            publishers.insert(topic, (publisher, AtomicI64::new(0)));
        }
        Ok(Some(Self {
            publishers,
            id,
            body_from_camera: camera.body_from_camera,
            covariance: Mutex::default(),
            patches: Mutex::default(),
            segment: AtomicU32::new(0),
            has_pose: AtomicBool::new(false),
            left_out: AtomicUsize::new(0),
            images: AtomicU64::new(0),
            keyframes: AtomicU64::new(0),
            last: AtomicI64::new(0),
            told: Mutex::default(),
            _link: link,
        }))
    }

    fn put(&self, topic: Topic, message: Vec<u8>) {
        let Some((publisher, sequence)) = self.publishers.get(&topic) else { return };
        let attachment = Attachment {
            sequence: sequence.fetch_add(1, Ordering::Relaxed),
            sent_ns: i64::try_from(now_ns()).unwrap_or(i64::MAX),
            sender: self.id,
        };
        // A link that broke is made again in the background; what is said meanwhile is lost, as to everybody who does not listen.
        let _: Result<(), LinkError> = publisher.put(message, attachment.encode());
    }

    /// The pose of an image, as it is found.
    pub fn pose(&self, state: &FrameState, keyframe: Option<&OdometryKeyframe>) {
        let world = world_of(state.segment);
        let mut known = self.covariance.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(keyframe) = keyframe {
            let OdometryKeyframe { pose_covariance, world_from_camera, .. } = keyframe;
            *known = Some(in_world(pose_covariance, world_from_camera, &self.body_from_camera));
        }
        // A first element of -1 says that it is not known.
        let covariance = known.unwrap_or_else(|| std::array::from_fn(|i| if i == 0 { -1.0 } else { 0.0 }));
        drop(known);
        let (time, pose) = (state.time, &state.world_from_camera);
        self.put(Topic::Pose, pose_stamped(time, &world, pose));
        self.put(Topic::Odometry, odometry(time, (&world, CAMERA), pose, &covariance));
        self.put(Topic::Transforms, transforms(time, (&world, CAMERA), pose));
        self.images.fetch_add(1, Ordering::Relaxed);
        self.last.store(time.nanos(), Ordering::Relaxed);
        self.has_pose.store(true, Ordering::Relaxed);
    }

    /// An image got no pose.
    pub fn no_pose(&self) {
        self.has_pose.store(false, Ordering::Relaxed);
    }

    /// How the run is doing, once a second at most.
    pub fn health(&self, (waiting, left_out): (usize, usize)) {
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        if told.is_some_and(|at| at.elapsed() < HEALTH_EVERY) {
            return;
        }
        *told = Some(Instant::now());
        drop(told);
        let (images, before) =
            (self.images.load(Ordering::Relaxed), self.left_out.swap(left_out, Ordering::Relaxed));
        let (level, message) = match (self.has_pose.load(Ordering::Relaxed), left_out > before) {
            (true, false) => (HealthLevel::Ok, "tracking and mapping"),
            (true, true) => (HealthLevel::Warn, "the map is behind: keyframes or images are left out"),
            (false, _) if images == 0 => (HealthLevel::Warn, "no image has a pose yet"),
            (false, _) => (HealthLevel::Warn, "tracking is lost"),
        };
        let values = [
            ("images with a pose", images.to_string()),
            ("keyframes", self.keyframes.load(Ordering::Relaxed).to_string()),
            ("images that wait for the map", waiting.to_string()),
            ("left out", left_out.to_string()),
        ];
        self.put(Topic::Health, health(self.time(), ("vidar: live", message), level, &values));
    }

    /// The world of the map.
    fn world(&self) -> String {
        world_of(self.segment.load(Ordering::Relaxed))
    }

    fn time(&self) -> Timestamp {
        Timestamp::from_nanos(self.last.load(Ordering::Relaxed))
    }

    /// Takes an event of the engine.
    pub fn read(&self, event: &MapEvent) {
        match event {
            MapEvent::World { segment, .. } => self.segment.store(*segment, Ordering::Relaxed),
            MapEvent::Keyframe(keyframe) => {
                self.keyframes.fetch_add(1, Ordering::Relaxed);
                if let Some(pose) = &keyframe.world_from_camera {
                    self.put(Topic::Keyframe, pose_stamped(keyframe.stamp.time, &self.world(), pose));
                }
            }
            MapEvent::SurfaceChanged { surface, is_final, .. } => {
                let (mesh, world) = (&surface.mesh, self.world());
                let cloud = thinned_vertices(mesh, MOST_POINTS);
                let points: Vec<CloudPoint> = cloud.positions.into_iter().zip(cloud.colors).collect();
                self.put(Topic::Cloud, point_cloud(self.time(), &world, &points));
                let mut patches = self.patches.lock().unwrap_or_else(PoisonError::into_inner);
                let markers: Vec<MeshMarker> =
                    patches.change(mesh, *is_final).patches.into_iter().map(marker).collect();
                for message in mesh_markers(self.time(), &world, &markers) {
                    self.put(Topic::Mesh, message);
                }
            }
            MapEvent::Warning(warning) => {
                let level =
                    if warning.severity == Severity::Degraded { HealthLevel::Warn } else { HealthLevel::Ok };
                let name = format!("vidar: {}", warning.kind);
                self.put(Topic::Health, health(self.time(), (&name, &warning.message), level, &[]));
            }
            _ => {}
        }
    }
}

/// The covariance of a keyframe's camera in the world's axes: position, then rotation.
fn in_world(in_body: &PoseCovariance, world_from_camera: &Se3, body_from_camera: &Se3) -> [f64; 36] {
    let covariance = covariance_in_camera(in_body, body_from_camera);
    let turn = world_from_camera.rotation.matrix();
    // Rotation comes first in a tangent, position in a message.
    let block = |row: usize, column: usize| {
        let part = covariance.fixed_view::<3, 3>(3 * (1 - row), 3 * (1 - column));
        turn * part * turn.transpose()
    };
    std::array::from_fn(|i| {
        let (row, column) = (i / 6, i % 6);
        block(row / 3, column / 3)[(row % 3, column % 3)]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_bag::message::decode;
    use vidar_bag::{Encoding, FramePose, FrameTransform, Header, Message, Pose};
    use vidar_core::So3;

    #[test]
    fn a_place_in_a_ros_system_is_a_domain_and_a_namespace() {
        assert_eq!(prefix("0/vidar").unwrap(), (0, "vidar".into()));
        assert_eq!(prefix("42/robot1/vidar").unwrap(), (42, "robot1/vidar".into()));
        for bad in ["", "vidar", "x/vidar", "0/", "0/a b", "0/a//b", "0/*"] {
            assert_eq!(prefix(bad).unwrap_err().code(), "E0105", "{bad}");
        }
    }

    #[test]
    fn what_is_published_is_read_by_the_reader_of_bags() {
        let (frames, at) = (("map", CAMERA), Timestamp::from_nanos(1_700_000_000_000_000_001));
        let turn = So3::from_quaternion(0.1, 0.2, -0.3, 0.9).unwrap();
        let pose = Se3::new(turn, [1.0, -2.0, 3.5].into());
        let stated = Pose { position: [1.0, -2.0, 3.5], orientation: turn.quaternion_xyzw() };
        let header = Header { stamp: at, frame: "map".into() };
        let read = |name: &str, bytes: &[u8]| decode(name, Encoding::Cdr, bytes).unwrap();
        let one = |child: &str| FramePose { header: header.clone(), child: child.into(), pose: stated };
        let covariance = std::array::from_fn(|i| i as f64);
        let found = read("nav_msgs/Odometry", &odometry(at, frames, &pose, &covariance));
        assert_eq!(found, Message::Poses(vec![one(CAMERA)]));
        let found = read("geometry_msgs/PoseStamped", &pose_stamped(at, "map", &pose));
        assert_eq!(found, Message::Poses(vec![one("")]));
        let found = read("tf2_msgs/TFMessage", &transforms(at, frames, &pose));
        let transform = FrameTransform { parent: header, child: CAMERA.into(), pose: stated };
        assert_eq!(found, Message::Transforms(vec![transform]));
    }

    #[test]
    fn a_covariance_is_in_the_axes_of_the_world_position_first() {
        // Half a turn less a quarter: the camera's x is the world's y, its y the world's -x.
        let turn = So3::from_quaternion(0.0, 0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()).unwrap();
        let pose = Se3::new(turn, [7.0, 8.0, 9.0].into());
        let covariance = PoseCovariance::from_diagonal(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0].into());
        let found = in_world(&covariance, &pose, &Se3::IDENTITY);
        let diagonal: Vec<f64> = (0..6).map(|i| (1e9 * found[7 * i]).round() / 1e9).collect();
        assert_eq!(diagonal, [5.0, 4.0, 6.0, 2.0, 1.0, 3.0]);
    }
}
