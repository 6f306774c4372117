//! Which topics of a bag are used, and as what.

use crate::error::DatasetError;
use crate::location::pixels;
use crate::options::{OpenOptions, PoseUse};
use vidar_bag::{Bag, Message, Pixels, Role, Topic, role_of};
use vidar_core::{FrameImage, Warning};

/// The topics that are used.
pub(crate) struct Choice<'a> {
    pub image: &'a Topic,
    /// Number of the camera.
    pub camera: u32,
    /// Numbers and topics of the rig's other cameras.
    pub others: Vec<(usize, &'a str)>,
    pub depth: Option<&'a Topic>,
    pub imu: ImuTopics<'a>,
    pub poses: Vec<(PoseUse, &'a Topic)>,
    pub warnings: Vec<Warning>,
}

/// Where IMU samples come from.
#[derive(Clone, Copy, Debug)]
pub(crate) enum ImuTopics<'a> {
    None,
    One(&'a Topic),
    /// Gyroscope and accelerometer apart, each with zeros for the other, as RealSense cameras publish them.
    Apart {
        gyro: &'a Topic,
        accel: &'a Topic,
    },
}

/// Chooses the topics: those that the user names, else the only one of a kind.
pub(crate) fn choose<'a>(bag: &'a Bag, options: &OpenOptions) -> Result<Choice<'a>, DatasetError> {
    for flag in &options.topics {
        let known = bag.topics().iter().any(|t| t.name == flag.name && is_used(t));
        if !known {
            let exists = bag.topics().iter().any(|t| t.name == flag.name);
            let why = if exists { "is of a type that is not read" } else { "is not in it" };
            return Err(problem(bag, format!("the topic {} {why}", vidar_core::printable(&flag.name))));
        }
    }
    let named = |topic: &Topic| options.topics.iter().any(|f| f.name == topic.name);
    let of = |role: Role| -> Vec<&Topic> { bag.topics().iter().filter(|t| role_is(t, role)).collect() };
    let (depth, images): (Vec<_>, Vec<_>) = of(Role::Image).into_iter().partition(|t| is_depth(bag, t));
    let videos = of(Role::Video);
    let mut warnings = Vec::new();
    let (image, camera, others) = match images.iter().chain(&videos).find(|t| named(t)) {
        Some(topic) => (*topic, options.camera.0, Vec::new()),
        // Compressed video beside images is a copy of them.
        None => choose_image(bag, if images.is_empty() { &videos } else { &images }, options)?,
    };
    let imu = choose_imu(bag, of(Role::Imu), named)
        .map_err(|several| problem(bag, format!("{several} IMUs; name one with --topic")))?;
    let depth = choose_one(without_twins(depth), named).unwrap_or_else(|several| {
        let names: Vec<_> = several.iter().map(|t| t.name.as_str()).collect();
        let message = format!("several topics of depth ({}); none is used", names.join(", "));
        warnings.push(Warning::new("topics", message).at(bag.path().display()).hint("--topic NAME"));
        None
    });
    let mut poses = Vec::new();
    for flag in &options.topics {
        let topic = bag.topics().iter().find(|t| t.name == flag.name && has_poses(t));
        match (topic, flag.poses) {
            (Some(topic), Some(used)) => poses.push((used, topic)),
            (Some(topic), None) => {
                let name = &topic.name;
                let what = format!(
                    "the poses of {name} can be reference or input: --topic truth={name} or --topic trajectory={name}"
                );
                return Err(problem(bag, what));
            }
            (None, Some(_)) => return Err(problem(bag, format!("{} holds no poses", flag.name))),
            (None, None) => {}
        }
    }
    Ok(Choice { image, camera, others, depth, imu, poses, warnings })
}

fn role_is(topic: &Topic, role: Role) -> bool {
    !topic.messages.is_empty() && role_of(&topic.message_type, topic.encoding) == Some(role)
}

/// Poses of a body: also a topic of one transform, as motion capture writes it.
fn has_poses(topic: &Topic) -> bool {
    role_is(topic, Role::Poses)
        || topic.message_type == "geometry_msgs/TransformStamped" && !topic.messages.is_empty()
}

fn is_used(topic: &Topic) -> bool {
    has_poses(topic) || [Role::Image, Role::Video, Role::Imu].iter().any(|role| role_is(topic, *role))
}

/// Topics of poses that nothing names, for a notice.
pub(crate) fn unused_poses<'a>(bag: &'a Bag, choice: &Choice<'_>) -> Vec<&'a str> {
    let is_used = |t: &Topic| choice.poses.iter().any(|(_, p)| p.name == t.name);
    bag.topics().iter().filter(|t| has_poses(t) && !is_used(t)).map(|t| t.name.as_str()).collect()
}

/// The only one, or the one that the user names; else all of them.
fn choose_one(all: Vec<&Topic>, named: impl Fn(&Topic) -> bool) -> Result<Option<&Topic>, Vec<&Topic>> {
    match (all.iter().find(|t| named(t)), all.as_slice()) {
        (Some(named), _) => Ok(Some(named)),
        (None, []) => Ok(None),
        (None, [one]) => Ok(Some(one)),
        (None, _) => Err(all),
    }
}

/// The IMU: those that the user names, else all of them. The only one; of several the only one that measures both; else the only
/// gyroscope with the only accelerometer. The error is how many there are.
fn choose_imu<'a>(
    bag: &Bag,
    all: Vec<&'a Topic>,
    named: impl Fn(&Topic) -> bool,
) -> Result<ImuTopics<'a>, usize> {
    let wanted: Vec<&Topic> = all.iter().copied().filter(|t| named(t)).collect();
    let topics = if wanted.is_empty() { all } else { wanted };
    match topics.as_slice() {
        [] => return Ok(ImuTopics::None),
        [one] => return Ok(ImuTopics::One(one)),
        _ => {}
    }
    let measured: Vec<(&Topic, [bool; 2])> = topics.iter().map(|t| (*t, measures(bag, t))).collect();
    let only = |what: [bool; 2]| -> Vec<&'a Topic> {
        measured.iter().filter(|(_, m)| *m == what).map(|(t, _)| *t).collect()
    };
    match (only([true, true]).as_slice(), only([true, false]).as_slice(), only([false, true]).as_slice()) {
        ([both], _, _) => Ok(ImuTopics::One(both)),
        ([], [gyro], [accel]) => Ok(ImuTopics::Apart { gyro, accel }),
        _ => Err(topics.len()),
    }
}

/// Whether the first messages hold rates, and whether they hold specific forces: what a driver does not measure it leaves zero.
fn measures(bag: &Bag, topic: &Topic) -> [bool; 2] {
    const FIRST: usize = 20;
    let read = topic.messages.iter().take(FIRST).filter_map(|m| bag.read(m).ok());
    read.fold([false, false], |[gyro, accel], message| match message {
        Message::Imu(sample) => {
            let is_measured = |v: [f64; 3]| v.iter().any(|x| *x != 0.0);
            [gyro || is_measured(sample.angular_velocity), accel || is_measured(sample.linear_acceleration)]
        }
        _ => [gyro, accel],
    })
}

/// The topic of images, the camera's number, and the rig's other cameras.
type Chosen<'a> = (&'a Topic, u32, Vec<(usize, &'a str)>);

fn choose_image<'a>(
    bag: &Bag,
    images: &[&'a Topic],
    options: &OpenOptions,
) -> Result<Chosen<'a>, DatasetError> {
    let mut cameras = without_twins(images.to_vec());
    if cameras.is_empty() {
        return Err(problem(bag, "no topic of images or compressed video".into()));
    }
    // Topics that differ in a number or in left and right only are the cameras of one rig.
    let is_rig = cameras.windows(2).all(|w| without_number(&w[0].name) == without_number(&w[1].name));
    if cameras.len() > 1 && !is_rig {
        return Err(problem(bag, format!("{} topics of images; name one with --topic", cameras.len())));
    }
    cameras.sort_by_key(|t| (t.name.len(), t.name.clone()));
    let wanted = options.camera;
    match cameras.get(wanted.index()) {
        Some(camera) => {
            let others = cameras.iter().enumerate().filter(|(number, _)| *number != wanted.index());
            Ok((camera, wanted.0, others.map(|(number, t)| (number, t.name.as_str())).collect()))
        }
        None => Err(DatasetError::MissingCamera {
            path: bag.path().to_path_buf(),
            camera: wanted,
            found: cameras.iter().map(|t| t.name.as_str()).collect::<Vec<_>>().join(", "),
        }),
    }
}

/// Leaves out compressed copies of topics that are there without compression.
fn without_twins(topics: Vec<&Topic>) -> Vec<&Topic> {
    let base = |name: &str| {
        name.rsplit_once('/').filter(|(_, end)| end.starts_with("compressed")).map(|(b, _)| b.to_string())
    };
    let names: Vec<String> = topics.iter().map(|t| t.name.clone()).collect();
    topics.into_iter().filter(|t| base(&t.name).is_none_or(|b| !names.contains(&b))).collect()
}

fn without_number(name: &str) -> String {
    let same = name.replace("left", "#").replace("right", "#");
    same.split(|c: char| c.is_ascii_digit()).filter(|s| !s.is_empty()).collect::<Vec<_>>().join("#")
}

/// Whether a topic of images holds depth, by its first message that can be decoded.
fn is_depth(bag: &Bag, topic: &Topic) -> bool {
    // A damaged first image must not turn colour into depth.
    let first = topic.messages.iter().take(3).find_map(|m| bag.read(m).ok());
    let is_named = topic.name.to_ascii_lowercase().contains("depth");
    match &first {
        Some(Message::Image(image)) => match image.encoding.as_str() {
            "16UC1" | "32FC1" => true,
            "mono16" => is_named,
            _ => false,
        },
        Some(message @ Message::CompressedImage(image)) => {
            image.format.contains("compressedDepth")
                || is_named && matches!(pixels(message), Ok(Pixels::Image(FrameImage::Gray16(_))))
        }
        _ => false,
    }
}

/// An error with the list of topics.
pub(crate) fn problem(bag: &Bag, problem: String) -> DatasetError {
    // A list longer than a screen helps nobody.
    const SHOWN: usize = 40;
    let mut lines: Vec<String> = bag
        .topics()
        .iter()
        .filter(|t| !t.messages.is_empty())
        .map(|t| {
            let name = vidar_core::printable(&t.name);
            let kind = vidar_core::printable(&t.message_type);
            format!("  {name}  {kind}  {}", t.messages.len())
        })
        .collect();
    if lines.len() > SHOWN {
        let more = lines.len() - SHOWN;
        lines.truncate(SHOWN);
        lines.push(format!("  and {more} more"));
    }
    DatasetError::Topics { path: bag.path().to_path_buf(), problem, topics: lines.join("\n") }
}

#[cfg(test)]
mod tests {
    use super::without_number;

    #[test]
    fn cameras_of_a_rig_differ_in_a_number_or_a_side() {
        let same = |a: &str, b: &str| without_number(a) == without_number(b);
        assert!(same("/cam0/image_raw", "/cam1/image_raw"));
        assert!(same("/stereo/left/image", "/stereo/right/image"));
        assert!(!same("/front/image_raw", "/rear/image_raw"));
        assert!(!same("/cam0/image_raw", "/cam0/image_rect"));
    }
}
