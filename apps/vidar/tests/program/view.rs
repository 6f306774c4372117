//! `vidar view`: a run is played to a viewer, which this file is: a client of Foxglove's websocket protocol.

use crate::support::{command, copy_tree, finished, vidar};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Read;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Stdio};
use std::time::Duration;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// Longest time that a message may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// Opcodes and commands of the protocol.
const MESSAGE_DATA: u8 = 1;
const PLAYBACK_CONTROL: u8 = 3;
const PAUSE: u8 = 1;

/// The program, ended with the test.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ended = self.0.kill().and_then(|()| self.0.wait());
    }
}

/// The first JSON value that the program prints.
fn first_json(out: &mut ChildStdout) -> Value {
    let mut text = Vec::new();
    let mut byte = [0];
    while out.read(&mut byte).unwrap() == 1 {
        text.push(byte[0]);
        if let Ok(value) = serde_json::from_slice(&text) {
            return value;
        }
    }
    panic!("no JSON in {:?}", String::from_utf8_lossy(&text))
}

fn served(path: &Path) -> (Server, Value) {
    let mut command = command();
    command.args(["view", "--port", "0", "--json"]).arg(path);
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let told = first_json(child.stdout.as_mut().unwrap());
    (Server(child), told)
}

struct Viewer(WebSocket<TcpStream>);

impl Viewer {
    fn connect(address: &str) -> Self {
        let stream = TcpStream::connect(address.strip_prefix("ws://").unwrap()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut request = address.into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
        Self(tungstenite::client(request, stream).unwrap().0)
    }

    /// The next JSON message of a kind.
    fn json(&mut self, op: &str) -> Value {
        loop {
            if let Message::Text(text) = self.0.read().unwrap() {
                let value: Value = serde_json::from_str(text.as_str()).unwrap();
                if value["op"] == op {
                    return value;
                }
            }
        }
    }

    fn subscribe(&mut self, channel: &Value) {
        let subscription = json!({ "id": channel["id"], "channelId": channel["id"] });
        let message = json!({ "op": "subscribe", "subscriptions": [subscription] });
        self.0.send(Message::text(message.to_string())).unwrap();
    }

    /// The next message of a subscription: its time, ns, and its bytes.
    fn message(&mut self, channel: &Value) -> (u64, Vec<u8>) {
        loop {
            let Message::Binary(bytes) = self.0.read().unwrap() else { continue };
            if bytes[0] == MESSAGE_DATA
                && u64::from(u32::from_le_bytes(bytes[1..5].try_into().unwrap())) == channel["id"]
            {
                return (u64::from_le_bytes(bytes[5..13].try_into().unwrap()), bytes[13..].to_vec());
            }
        }
    }

    fn pause_at(&mut self, nanos: u64) {
        let request = "here";
        let mut message = vec![PLAYBACK_CONTROL, PAUSE];
        message.extend(1f32.to_le_bytes());
        message.push(1);
        message.extend(nanos.to_le_bytes());
        message.extend((request.len() as u32).to_le_bytes());
        message.extend(request.as_bytes());
        self.0.send(Message::binary(message)).unwrap();
    }
}

#[test]
fn a_run_is_played_to_a_viewer_which_can_jump_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    copy_tree(&finished().0, &run);
    let (server, told) = served(&run);
    assert_eq!(told["schema"], "vidar.view/1");
    assert!(run.join("export/mcap/run.mcap").is_file());
    let mut viewer = Viewer::connect(told["address"].as_str().unwrap());
    let info = viewer.json("serverInfo");
    assert!(info["capabilities"].as_array().unwrap().contains(&json!("playbackControl")), "{info}");

    let advertised = viewer.json("advertise");
    let channels: BTreeMap<&str, &Value> = advertised["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|channel| (channel["topic"].as_str().unwrap(), channel))
        .collect();
    for (topic, schema) in [
        ("/camera/image", "foxglove.CompressedImage"),
        ("/view/depth", "foxglove.RawImage"),
        ("/tf", "foxglove.FrameTransform"),
        ("/trajectory", "foxglove.PosesInFrame"),
        ("/keyframes", "foxglove.SceneUpdate"),
        ("/map/mesh", "foxglove.SceneUpdate"),
        ("/map/points", "foxglove.PointCloud"),
    ] {
        assert_eq!(channels[topic]["schemaName"], schema, "{topic}");
    }

    // Paused at a keyframe in the middle, its depth is shown, also to who asks for it only then.
    let views: Value = serde_json::from_slice(&std::fs::read(run.join("views.json")).unwrap()).unwrap();
    let views = views["views"].as_array().unwrap();
    let middle = views[views.len() / 2]["time_ns"].as_u64().unwrap();
    viewer.pause_at(middle);
    let depth = channels["/view/depth"];
    viewer.subscribe(depth);
    let (mut time, mut bytes) = viewer.message(depth);
    while time != middle {
        (time, bytes) = viewer.message(depth);
    }
    assert!(bytes.len() > 1000, "{} bytes", bytes.len());
    // The surface is there at the end only.
    let last = views.last().unwrap()["time_ns"].as_u64().unwrap();
    viewer.subscribe(channels["/map/points"]);
    viewer.pause_at(last + 10_000_000_000);
    let (_, points) = viewer.message(channels["/map/points"]);
    let count = finished().1["result"]["points"].as_u64().unwrap() as usize;
    assert!(
        (16 * count..16 * count + 1000).contains(&points.len()),
        "{} bytes of {count} points",
        points.len()
    );

    // A second program cannot have the port, and is told so.
    let port = told["address"].as_str().unwrap().rsplit(':').next().unwrap();
    let file = run.join("export/mcap/run.mcap");
    vidar(&["view", file.to_str().unwrap(), "--port", port]).ends_with(2).says(&[port, "--port 0"]);
    drop(server);
}

#[test]
fn what_cannot_be_played_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    vidar(&["view", &path("absent.mcap")]).ends_with(1).says(&["E0207", "absent.mcap", "no such file"]);
    vidar(&["view", folder.path().to_str().unwrap()]).ends_with(1).says(&["E0207"]);
    std::fs::write(path("text.mcap"), "this is a text and nothing else, of some length").unwrap();
    vidar(&["view", &path("text.mcap")]).ends_with(1).says(&["text.mcap", "MCAP"]);
    // One whose writer was killed has no index.
    let run = &finished().0;
    let out = path("out");
    vidar(&["export", run.to_str().unwrap(), "--to", "mcap", "-o", &out]).ends_with(0);
    let whole = std::fs::read(folder.path().join("out/run.mcap")).unwrap();
    std::fs::write(path("half.mcap"), &whole[..whole.len() / 2]).unwrap();
    vidar(&["view", &path("half.mcap")]).ends_with(1).says(&["half.mcap", "index"]);
}
