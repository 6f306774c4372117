//! ROS 1 bags, ROS 2 bags and MCAP files: one camera, its calibration, IMU, depth and poses.

use crate::bag_camera::{is_beside, read_calibration, use_facts};
use crate::bag_video;
use crate::convert::facts::{self, Facts};
use crate::draft::{Draft, DraftCamera, DraftDepth};
use crate::error::DatasetError;
use crate::location::locate;
use crate::options::{OpenOptions, PoseUse, RecordingKind};
use crate::source::read_file_up_to;
use crate::topics::{self, ImuTopics, problem};
use crate::transforms::{Frames, rigid};
use nalgebra::Vector3;
use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;
use vidar_bag::{Bag, Header, Message, MessageRef, Role, Topic, role_of};
use vidar_core::{
    AngularRate, BodyFrame, CameraId, ImuNoise, ImuSample, Se3, SpecificForce, StampedPose, TimedVector,
    Timestamp, Trajectory, Warning,
};

/// Largest `metadata.yaml`; a real one has about 1 kB and some hundred bytes per topic.
const MAX_DESCRIPTION_BYTES: u64 = 4 << 20;

/// Looks for a bag in a folder.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let described = read_file_up_to(&path.join("metadata.yaml"), MAX_DESCRIPTION_BYTES);
    let is_bag = |text: Vec<u8>| String::from_utf8_lossy(&text).contains("rosbag2_bagfile_information");
    if described.is_ok_and(is_bag) {
        return Some("metadata.yaml of a ROS 2 bag".into());
    }
    match vidar_bag::bags_in(path).ok()?.as_slice() {
        [] => None,
        [one] => Some(format!("its only bag {}", one.file_name().unwrap_or_default().to_string_lossy())),
        all => Some(format!("{} bags", all.len())),
    }
}

/// Reads the recording's index, calibration, IMU and poses; images stay in it.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    of(Arc::new(Bag::open(path)?), path, reason, options)
}

/// The same of a bag that is open.
pub(crate) fn of(
    bag: Arc<Bag>,
    path: &Path,
    reason: String,
    options: &OpenOptions,
) -> Result<Draft, DatasetError> {
    let mut choice = topics::choose(&bag, options)?;
    // What VIDAR's own conversions leave beside the messages.
    let facts = bag.metadata(facts::NAME).map(Facts::from_map).unwrap_or_default();
    let named = [(&facts.truth_topic, PoseUse::GroundTruth), (&facts.trajectory_topic, PoseUse::Trajectory)];
    if choice.poses.is_empty() {
        let topic = |name: &String| bag.topics().iter().find(|t| t.name == *name && !t.messages.is_empty());
        choice.poses =
            named.into_iter().filter_map(|(name, used)| Some((used, topic(name.as_ref()?)?))).collect();
    }
    let mut reason = format!("{reason}; images of {}", choice.image.name);
    for (number, name) in &choice.others {
        reason.push_str(&format!(", not those of {name} (--camera {number})"));
    }
    let mut draft = Draft::new(RecordingKind::Bag, path, reason);
    draft.warnings.extend(bag.warnings().iter().cloned());
    draft.warnings.extend(choice.warnings.iter().cloned());
    let unused = topics::unused_poses(&bag, &choice);
    if !unused.is_empty() && choice.poses.is_empty() {
        let message = format!("poses of {} are not used", unused.join(", "));
        let way =
            format!("--topic truth={0} compares with them, --topic trajectory={0} maps with them", unused[0]);
        draft.warnings.push(Warning::new("poses-unused", message).at(path.display()).hint(way));
    }
    let mut clock = Clock { bag: &bag, without_stamp: Cell::new(0) };
    draft.cameras = vec![DraftCamera::unknown(choice.camera)];
    let camera_frame = read_images(&mut draft, &bag, &clock, choice.image)?;
    let imu_frame = read_imu(&mut draft, &mut clock, choice.imu, facts.imu_noise)?;
    let frames = read_frames(&mut draft, &bag);
    read_calibration(&mut draft, &bag, &choice, &camera_frame)?;
    use_facts(&mut draft, &facts);
    if let Some(imu_frame) = &imu_frame {
        read_extrinsics(&mut draft, &frames, imu_frame, &camera_frame);
    }
    if let Some(depth) = choice.depth {
        read_depth(&mut draft, &bag, depth, &clock, &frames, imu_frame.as_deref().unwrap_or(&camera_frame))?;
        if let Some(stated) = draft.depth.as_mut() {
            stated.units_per_metre = facts.depth_units_per_metre.or(stated.units_per_metre);
        }
    }
    for (used, topic) in &choice.poses {
        let known = Known { frames: &frames, imu: imu_frame.as_deref(), camera: &camera_frame };
        read_poses(&mut draft, &clock, topic, *used, &known)?;
    }
    let without = clock.without_stamp.get();
    // VIDAR's own conversions stamp every message; zero is a time then.
    if without > 0 && bag.metadata(facts::NAME).is_none() {
        let message =
            format!("{without} messages have no stamp; the times at which they were logged are used");
        draft.warnings.push(Warning::new("stamp-missing", message).at(path.display()));
    }
    draft.media.bag = Some(Arc::clone(&bag));
    Ok(draft)
}

/// Lists the images of a topic, which stay in the bag; returns the name of their frame.
fn read_images(
    draft: &mut Draft,
    bag: &Arc<Bag>,
    clock: &Clock<'_>,
    topic: &Topic,
) -> Result<String, DatasetError> {
    if role_of(&topic.message_type, topic.encoding) != Some(Role::Video) {
        draft.images = locate(bag, topic, |m| clock.stamp(m))?;
        let first = topic.messages.first().map(|m| bag.header(m)).transpose()?;
        return Ok(first.unwrap_or_default().frame);
    }
    let video = bag_video::open(bag, topic, |header, message| clock.or_logged(header, message))?;
    draft.reason = format!("{} as {}", draft.reason, video.stream.codec_name());
    draft.warnings.extend(video.warnings);
    let mut times = video.times.iter();
    draft.images = locate(bag, topic, |m| Ok(times.next().copied().unwrap_or(m.log_time)))?;
    draft.images.drain(..video.first);
    draft.media.stream = Some((video.topic, Arc::new(video.stream)));
    Ok(video.frame)
}

/// Times of messages: their own stamps, else when they were logged.
struct Clock<'a> {
    bag: &'a Bag,
    without_stamp: Cell<usize>,
}

impl Clock<'_> {
    fn stamp(&self, message: &MessageRef) -> Result<Timestamp, vidar_bag::BagError> {
        Ok(self.or_logged(&self.bag.header(message)?, message))
    }

    fn or_logged(&self, header: &Header, message: &MessageRef) -> Timestamp {
        if header.stamp.nanos() != 0 {
            return header.stamp;
        }
        self.without_stamp.set(self.without_stamp.get() + 1);
        message.log_time
    }
}

/// Reads all samples of the IMU; returns the name of its frame.
fn read_imu(
    draft: &mut Draft,
    clock: &mut Clock<'_>,
    topics: ImuTopics<'_>,
    noise: Option<ImuNoise>,
) -> Result<Option<String>, DatasetError> {
    let (topic, frame) = match topics {
        ImuTopics::None => return Ok(None),
        ImuTopics::One(topic) => {
            let (samples, frame) = read_samples(draft, clock, topic);
            draft.imu = samples;
            (topic, frame)
        }
        ImuTopics::Apart { gyro, accel } => {
            let (rates, frame) = read_samples(draft, clock, gyro);
            let (forces, _) = read_samples(draft, clock, accel);
            draft.imu = vidar_core::merge_imu(
                &in_order(rates.iter().map(|s| (s.time, s.gyro.0))),
                &in_order(forces.iter().map(|s| (s.time, s.accel.0))),
            );
            (gyro, frame)
        }
    };
    draft.imu_noise = noise;
    if noise.is_none() {
        let rate_hz = topic.rate_hz().unwrap_or(ImuNoise::EUROC.rate_hz);
        let place = format!("{} {}", draft.root.display(), topic.name);
        draft.assume_imu_noise("a bag", rate_hz, &place);
    }
    Ok(Some(frame))
}

/// In order of time: messages lie in the order in which they were logged.
fn in_order(samples: impl Iterator<Item = TimedVector>) -> Vec<TimedVector> {
    let mut samples: Vec<TimedVector> = samples.collect();
    samples.sort_by_key(|(time, _)| *time);
    samples
}

/// Finite samples of a topic and the name of their frame.
fn read_samples(draft: &mut Draft, clock: &mut Clock<'_>, topic: &Topic) -> (Vec<ImuSample>, String) {
    let (mut samples, mut frame, mut unread) = (Vec::new(), String::new(), None);
    for message in &topic.messages {
        match clock.bag.read(message) {
            Ok(Message::Imu(sample)) => {
                let time = clock.or_logged(&sample.header, message);
                let (gyro, accel) = (sample.angular_velocity, sample.linear_acceleration);
                let (gyro, accel) = (AngularRate(Vector3::from(gyro)), SpecificForce(Vector3::from(accel)));
                samples.push(ImuSample { time, gyro, accel });
                frame = sample.header.frame;
            }
            Ok(_) => {}
            Err(e) => unread = Some((unread.map_or(0, |(n, _)| n) + 1, e)),
        }
    }
    let place = format!("{} {}", draft.root.display(), topic.name);
    if let Some((count, first)) = unread {
        let message = format!("{count} IMU samples cannot be read and are left out; the last: {first}");
        draft.warnings.push(Warning::degraded("imu-unreadable", message).at(&place));
    }
    let before = samples.len();
    samples.retain(|s| s.gyro.0.iter().chain(s.accel.0.iter()).all(|v| v.is_finite()));
    if samples.len() < before {
        let message = format!("{} IMU samples are not finite; skipped", before - samples.len());
        draft.warnings.push(Warning::new("sample-not-finite", message).at(&place));
    }
    (samples, frame)
}

/// All fixed transforms: those of `/tf_static`; those of `/tf`, which may move, only where a fixed one is not known.
fn read_frames(draft: &mut Draft, bag: &Bag) -> Frames {
    let mut frames = Frames::default();
    let is_static = |t: &&Topic| t.name.ends_with("tf_static");
    let all: Vec<&Topic> = bag
        .topics()
        .iter()
        .filter(|t| role_of(&t.message_type, t.encoding) == Some(Role::Transforms))
        .filter(|t| t.message_type != "geometry_msgs/TransformStamped")
        .collect();
    // Without /tf_static the first messages of /tf state the mounts along with what moves; writers before tf2 did so.
    let (fixed, moving): (Vec<&Topic>, Vec<&Topic>) = all.into_iter().partition(is_static);
    const FIRST: usize = 100;
    let moving = if fixed.is_empty() { moving } else { Vec::new() };
    let messages = moving.iter().flat_map(|t| t.messages.iter().take(FIRST));
    for message in messages.chain(fixed.iter().flat_map(|t| &t.messages)) {
        match bag.read(message) {
            Ok(Message::Transforms(transforms)) => transforms.iter().for_each(|t| frames.add(t)),
            Ok(_) => {}
            Err(e) => draft.warnings.push(Warning::degraded("transform-unreadable", e.to_string())),
        }
    }
    frames
}

/// The camera's pose on the IMU, from the fixed transforms.
fn read_extrinsics(draft: &mut Draft, frames: &Frames, imu: &str, camera: &str) {
    if let Some(imu_from_camera) = frames.a_from_b(imu, camera).filter(|_| imu != camera) {
        draft.cameras[0].body_from_camera = imu_from_camera * draft.cameras[0].body_from_camera;
        return;
    }
    let message = if imu == camera {
        format!(
            "camera and IMU state the same frame ({camera:?}), so the camera's pose on the IMU is not known"
        )
    } else {
        format!("no fixed transform connects the IMU's frame {imu:?} with the camera's {camera:?}")
    };
    draft.warnings.push(
        Warning::new("extrinsics-missing", message)
            .at(draft.root.display())
            .hint("--calibration camchain.yaml (Kalibr) gives them; `vidar calibrate` finds the rotation"),
    );
}

fn read_depth(
    draft: &mut Draft,
    bag: &Bag,
    topic: &Topic,
    clock: &Clock<'_>,
    frames: &Frames,
    body_frame: &str,
) -> Result<(), DatasetError> {
    draft.depths = locate(bag, topic, |m| clock.stamp(m))?;
    let frame = topic.messages.first().map(|m| bag.header(m)).transpose()?.unwrap_or_default().frame;
    let infos =
        bag.topics().iter().filter(|t| role_of(&t.message_type, t.encoding) == Some(Role::CameraInfo));
    let mut infos = infos.filter(|t| is_beside(&topic.name, &t.name));
    let info = match infos.next().and_then(|t| t.messages.first()).map(|m| bag.read(m)).transpose()? {
        Some(Message::CameraInfo(info)) if info.k[0] != 0.0 => Some(info),
        _ => None,
    };
    // Numbers of 32 bits are metres (REP 118), whose unit nobody needs to state.
    let first = topic.messages.first().map(|m| bag.read(m)).transpose()?;
    let is_metres = matches!(&first, Some(Message::Image(image)) if image.encoding == "32FC1");
    let aligned = ["aligned", "registered"].iter().any(|w| topic.name.contains(w));
    draft.depth = Some(DraftDepth {
        intrinsics: info.map(|i| [i.k[0], i.k[4], i.k[2], i.k[5]]),
        distorted: None,
        units_per_metre: is_metres.then_some(1000.0),
        // REP 118: 16UC1 is millimetres.
        default_units: 1000.0,
        body_from_depth: frames.a_from_b(body_frame, &frame),
        invalid: vec![0, u16::MAX],
        is_registered: aligned,
    });
    Ok(())
}

/// The frames that poses can be related to.
struct Known<'a> {
    frames: &'a Frames,
    imu: Option<&'a str>,
    camera: &'a str,
}

/// Reads the poses of a topic as ground truth or as the trajectory of the map.
fn read_poses(
    draft: &mut Draft,
    clock: &Clock<'_>,
    topic: &Topic,
    used: PoseUse,
    known: &Known<'_>,
) -> Result<(), DatasetError> {
    let (mut poses, mut invalid, mut child) = (Vec::new(), 0usize, String::new());
    for message in &topic.messages {
        let stamped: Vec<(Header, String, vidar_bag::Pose)> = match clock.bag.read(message)? {
            Message::Poses(found) => found.into_iter().map(|p| (p.header, p.child, p.pose)).collect(),
            Message::Transforms(found) => found.into_iter().map(|t| (t.parent, t.child, t.pose)).collect(),
            _ => Vec::new(),
        };
        for (header, name, pose) in stamped {
            match rigid(&pose) {
                Some(world_from_body) => {
                    let time = clock.or_logged(&header, message);
                    poses.push(StampedPose { time, world_from_body });
                }
                None => invalid += 1,
            }
            child = name;
        }
    }
    let place = draft.root.join(topic.name.trim_start_matches('/'));
    if invalid > 0 {
        let message = format!("{invalid} poses are not finite or no rotations; skipped");
        draft.warnings.push(Warning::new("pose-not-finite", message).at(place.display()));
    }
    poses.sort_by_key(|p| p.time);
    let listed = poses.len();
    // A path that is published anew with every pose repeats the earlier ones.
    poses.dedup_by_key(|p| p.time);
    if listed > poses.len() {
        let message = format!("{} poses repeat a time; the first of each is used", listed - poses.len());
        draft.warnings.push(Warning::new("time-duplicate", message).at(place.display()));
    }
    let (body, body_from_known) = body_of(draft, known, &child, topic);
    for pose in &mut poses {
        pose.world_from_body = pose.world_from_body * body_from_known;
    }
    let trajectory = Trajectory::new(body, poses)
        .map_err(|e| DatasetError::NoPoses { path: place.clone(), found: e.to_string() })?;
    if trajectory.poses().is_empty() {
        return Err(problem(clock.bag, format!("{} holds no valid pose", topic.name)));
    }
    match used {
        PoseUse::GroundTruth => draft.ground_truth = Some((trajectory, place)),
        PoseUse::Trajectory => draft.trajectory = Some((trajectory, place)),
    }
    Ok(())
}

/// The body that poses of frame `child` are used as, and `child_from_body`.
fn body_of(draft: &mut Draft, known: &Known<'_>, child: &str, topic: &Topic) -> (BodyFrame, Se3) {
    let camera = BodyFrame::Camera(CameraId(0));
    let (body, frame) = known.imu.map_or((camera, known.camera), |imu| (BodyFrame::Imu, imu));
    if !child.is_empty() {
        if let Some(child_from_body) = known.frames.a_from_b(child, frame) {
            return (body, child_from_body);
        }
        if child == known.camera {
            return (camera, Se3::IDENTITY);
        }
    }
    let stated = if child.is_empty() { "does not say".into() } else { format!("calls {child:?}") };
    let message = format!("{} {stated} which body its poses are of; assumed: {body}", topic.name);
    draft.warnings.push(
        Warning::new("trajectory-body", message)
            .at(draft.root.display())
            .hint("a fixed transform from this body to the IMU in /tf_static settles it"),
    );
    (body, Se3::IDENTITY)
}
