//! `--mcap`: the file that shows a run in robotics viewers, read by another program's reader.

use crate::support::{run_on, shared};
use foxglove::messages::{
    CameraCalibration, CompressedImage, FrameTransform, PointCloud, PoseInFrame, PosesInFrame, RawImage,
    SceneUpdate,
};
use foxglove::{Decode, Encode};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// Messages of each topic: time, ns, and bytes; and the schema's name.
type Topics = BTreeMap<String, (String, Vec<(u64, Vec<u8>)>)>;

fn topics(file: &Path) -> Topics {
    let bytes = std::fs::read(file).unwrap();
    let mut topics = Topics::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().map_or_else(String::new, |s| s.name.clone());
        let topic = topics.entry(message.channel.topic.clone()).or_insert((schema, Vec::new()));
        topic.1.push((message.log_time, message.data.to_vec()));
    }
    topics
}

fn read<T: Decode + Encode>(topics: &Topics, topic: &str) -> Vec<(u64, T)> {
    let (schema, messages) = topics.get(topic).unwrap_or_else(|| panic!("no {topic} in {:?}", topics.keys()));
    assert_eq!(*schema, T::get_schema().unwrap().name, "{topic}");
    messages.iter().map(|(time, bytes)| (*time, T::decode(&bytes[..]).ok().unwrap())).collect()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_run_is_shown_to_viewers_as_it_was_made() {
    let (file, out) = (shared().root.join("shown.mcap"), shared().root.join("shown"));
    let mcap = ["--mcap", file.to_str().unwrap(), "-q", "--stride", "2", "--json"];
    let result = run_on(&shared().sequence, &out, &mcap).ends_with(0).json();
    let topics = topics(&file);

    let first = topics["/camera/image"].1[0].0;
    let earliest = topics.values().filter_map(|(_, messages)| messages.first()).map(|(time, _)| *time).min();
    assert!(
        earliest.is_some_and(|t| t + 5_000_000_000 > first),
        "times are the recording's: {earliest:?}, {first}"
    );

    let views = json(&out.join("views.json"));
    let views = views["views"].as_array().unwrap();
    let stored: Vec<u64> = views.iter().map(|v| v["time_ns"].as_u64().unwrap()).collect();
    let depth = read::<RawImage>(&topics, "/view/depth");
    assert_eq!(depth.iter().map(|(t, _)| *t).collect::<Vec<_>>(), stored);
    let first = &depth[0].1;
    let millimetres: Vec<u16> =
        first.data.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    assert_eq!(
        (first.encoding.as_str(), millimetres.len()),
        ("16UC1", (first.width * first.height) as usize)
    );
    let known = millimetres.iter().filter(|z| (300..20_000).contains(*z)).count();
    assert!(2 * known > millimetres.len(), "{known} of {} pixels have depth", millimetres.len());
    let calibration = read::<CameraCalibration>(&topics, "/view/calibration");
    assert_eq!((calibration[0].1.width, calibration[0].1.height), (first.width, first.height));
    assert_eq!(calibration[0].1.k[0], views[0]["intrinsics"]["fx"].as_f64().unwrap());

    // Every view has its pose in the tree of frames, and the same in the folder.
    let transforms = read::<FrameTransform>(&topics, "/tf");
    let of_views: Vec<_> = transforms.iter().filter(|(_, t)| t.child_frame_id == "view").collect();
    assert_eq!(of_views.len(), views.len());
    for ((time, transform), view) in of_views.iter().zip(views) {
        assert_eq!(*time, view["time_ns"].as_u64().unwrap());
        let place = transform.translation.unwrap();
        let wanted = [0, 1, 2].map(|row| view["world_from_camera"][row][3].as_f64().unwrap());
        assert_eq!([place.x, place.y, place.z], wanted);
    }

    // The images are the files' own bytes.
    let images = read::<CompressedImage>(&topics, "/camera/image");
    let source = views[0]["source"].as_str().unwrap();
    let taken = images.iter().find(|(time, _)| *time == stored[0]).unwrap();
    assert!(taken.1.data[..] == std::fs::read(source).unwrap()[..], "{source}");

    let trajectory = read::<PosesInFrame>(&topics, "/trajectory");
    assert_eq!(
        trajectory.last().unwrap().1.poses.len(),
        result["result"]["keyframes"].as_u64().unwrap() as usize
    );
    let frusta = read::<SceneUpdate>(&topics, "/keyframes");
    assert_eq!(frusta.last().unwrap().1.entities.len(), trajectory.last().unwrap().1.poses.len());
    assert_eq!(frusta[0].1.entities[0].lines[0].indices.len(), 16);

    let surface = read::<SceneUpdate>(&topics, "/map/mesh");
    let last = &surface.last().unwrap().1;
    assert_eq!(last.deletions.len(), 1, "the last message is the whole surface, whatever was told before");
    let patches: Vec<_> = last.entities.iter().map(|entity| &entity.triangles[0]).collect();
    assert!(
        patches.len() > 10 && patches.iter().all(|p| p.points.len() >= 3 && p.colors.len() == p.points.len())
    );
    let triangles: usize = patches.iter().map(|p| p.indices.len() / 3).sum();
    assert_eq!(triangles as u64, result["result"]["mesh_triangles"].as_u64().unwrap());
    let points = &read::<PointCloud>(&topics, "/map/points").pop().unwrap().1;
    assert_eq!(points.data.len() as u64, 16 * result["result"]["points"].as_u64().unwrap());
    let stages: Vec<Value> =
        topics["/stages"].1.iter().map(|(_, json)| serde_json::from_slice(json).unwrap()).collect();
    assert!(stages.iter().any(|s| s["stage"] == "map" && s["seconds"].as_f64().unwrap() > 0.0), "{stages:?}");

    let again = run_on(&shared().sequence, &shared().root.join("shown again"), &mcap[..3]);
    again.ends_with(2).says(&["E0106", "shown.mcap"]);
}

#[test]
fn what_the_odometry_said_of_each_image_is_shown_with_its_landmarks() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("live.mcap");
    let out = folder.path().join("run");
    let more = ["-q", "--mcap", file.to_str().unwrap(), "--set", "input.poses=odometry"];
    run_on(crate::odometry::flight(), &out, &more).ends_with(0);
    let topics = topics(&file);
    let live = read::<PoseInFrame>(&topics, "/odometry/live");
    let status: Vec<Value> =
        topics["/odometry/status"].1.iter().map(|(_, json)| serde_json::from_slice(json).unwrap()).collect();
    assert!(live.len() > 20 && status.len() == live.len(), "{} and {}", live.len(), status.len());
    assert_eq!(status[0]["time_ns"].as_u64().unwrap(), live[0].0);
    let last = status.last().unwrap();
    assert!(last["scale_std"].as_f64().unwrap() > 0.0 && last["health"].is_string(), "{last}");
    let landmarks = read::<PointCloud>(&topics, "/landmarks");
    assert!(landmarks.iter().any(|(_, cloud)| cloud.data.len() > 16 * 10));
}
