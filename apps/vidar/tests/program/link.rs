//! Geometry elsewhere, on this computer's loopback: the bits of a local run, whatever happens to workers.

use crate::support::{ProgramOutput, command, run_command, shared};
use std::path::PathBuf;
use std::process::Command;

/// Small chunks of small images; poses are ground truth.
const SHORT: &[&str] = &[
    "-q",
    "--mode",
    "pose-conditioned",
    "--set",
    "geometry.chunk_keyframes=4",
    "--set",
    "geometry.overlap_keyframes=1",
    "--set",
    "keyframes.min_translation_m=0.02",
];

fn out(name: &str) -> PathBuf {
    shared().root.join("link").join(name)
}

fn run(name: &str, geometry: &str, more: &[&str]) -> Command {
    let mut all = SHORT.to_vec();
    all.extend(["--geometry", geometry, "--set", "remote.model=da3-nano"]);
    all.extend(more);
    run_command(&shared().sequence, &out(name), &all)
}

fn ended(mut command: Command) -> ProgramOutput {
    command.output().unwrap().into()
}

#[cfg(not(feature = "link"))]
#[test]
fn a_program_without_links_says_so() {
    let ran = ended(run("not built", "remote:vidar/geometry", &[])).ends_with(4);
    ran.says(&["error[E0408]", "--features link"]);
    let mut worker = command();
    worker.args(["worker", "--model", "da3-nano"]);
    ended(worker).ends_with(4).says(&["error[E0408]", "--features link"]);
    let mut doctor = command();
    doctor.arg("doctor");
    assert!(ended(doctor).ends_with(0).stdout.contains("without links to other machines"));
}

#[cfg(feature = "link")]
mod built {
    use super::*;
    use crate::odometry::flight;
    use crate::support::manifest;
    use std::io::{BufRead, BufReader, Read};
    use std::net::TcpListener;
    use std::path::Path;
    use std::process::{Child, Stdio};
    use std::sync::mpsc::{Receiver, sync_channel};
    use std::time::Duration;
    use vidar::link::ros::Attachment;
    use vidar::link::{Delivery, Link, LinkOptions, Role};
    use vidar_bag::{Bag, write::encode};

    /// A port that is free now.
    fn endpoint() -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        format!("tcp/{}", listener.local_addr().unwrap())
    }

    /// A worker process; it ends with the test.
    struct Worker {
        child: Child,
        /// A line for each request that it answered.
        told: Receiver<String>,
    }

    impl Worker {
        fn start(endpoint: &str, more: &[&str]) -> Self {
            let mut command = command();
            command.args([
                "worker",
                "--model",
                "da3-nano",
                "--key",
                "lab/depth",
                "--listen",
                endpoint,
                "--json",
            ]);
            let mut child = command.args(more).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
            let words = serde_json::Deserializer::from_reader(child.stdout.take().unwrap());
            let Some(Ok(ready)) = words.into_iter::<serde_json::Value>().next() else {
                let mut said = String::new();
                child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
                panic!("no worker: {said}");
            };
            assert_eq!((&ready["schema"], &ready["key"]), (&"vidar.worker/1".into(), &"lab/depth".into()));
            let (sender, told) = sync_channel(1000);
            let lines = BufReader::new(child.stderr.take().unwrap());
            std::thread::spawn(move || {
                lines.lines().map_while(Result::ok).for_each(|l| drop(sender.send(l)))
            });
            Self { child, told }
        }
    }

    impl Drop for Worker {
        fn drop(&mut self) {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }

    fn mesh(run: &Path) -> Vec<u8> {
        let mesh = std::fs::read(run.join("map/mesh.ply")).unwrap();
        assert!(mesh.len() > 10_000);
        mesh
    }

    /// The same run with the network in the same process.
    fn local() -> &'static [u8] {
        static LOCAL: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
        LOCAL.get_or_init(|| {
            let ran = ended(run("local", "da3-nano", &[]));
            assert_eq!(ran.code, 0, "{}", ran.stderr);
            mesh(&out("local"))
        })
    }

    fn mapped(name: &str, connect: &[&str], more: &[&str]) -> serde_json::Value {
        let mut all: Vec<&str> = connect.iter().flat_map(|c| ["--connect", c]).collect();
        all.extend(more);
        let ran = ended(run(name, "remote:lab/depth", &all));
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        manifest(&out(name))["result"]["remote"].clone()
    }

    #[test]
    fn a_worker_gives_the_bits_of_the_same_network_here_and_bytes_are_told() {
        let at = endpoint();
        let _worker = Worker::start(&at, &[]);
        let told = mapped("raw", &[&at], &[]);
        assert!(mesh(&out("raw")) == local(), "the same bits");
        assert_eq!((&told["images"], &told["depth"]), (&"raw".into(), &"f32".into()));
        assert_eq!((&told["retries"], &told["invalid_replies"]), (&0.into(), &0.into()));
        let number = |told: &serde_json::Value, key: &str| told[key].as_u64().unwrap();
        assert!(number(&told, "chunks") >= 3, "{told}");
        // A keyframe of 160x104 grey pixels takes 16.6 kB as it is.
        assert!(number(&told, "bytes_sent") > 16_600 * number(&told, "keyframes"), "{told}");
        let small = ["--set", "remote.images=jpeg", "--set", "remote.depth=f16"];
        let smaller = mapped("jpeg", &[&at], &small);
        let ratio =
            number(&smaller, "bytes_per_keyframe") as f64 / number(&told, "bytes_per_keyframe") as f64;
        assert!(ratio < 0.6, "{ratio}: {smaller}");
    }

    #[test]
    fn a_worker_that_dies_and_one_that_hangs_cost_a_retry_and_nothing_else() {
        let (at, other, third) = (endpoint(), endpoint(), endpoint());
        let (mut dies, hangs, _lives) =
            (Worker::start(&at, &[]), Worker::start(&other, &[]), Worker::start(&third, &[]));
        let connect = ["--connect", &at, "--connect", &other, "--connect", &third];
        let more = [&connect[..], &["--set", "link.timeout_secs=20"]].concat();
        let mut child = run("killed", "remote:lab/depth", &more).stderr(Stdio::piped()).spawn().unwrap();
        // Both have answered a chunk each when they go: one for good, the other stands still.
        dies.told.recv_timeout(Duration::from_secs(120)).unwrap();
        dies.child.kill().unwrap();
        hangs.told.recv_timeout(Duration::from_secs(120)).unwrap();
        let stop = Command::new("kill").args(["-STOP", &hangs.child.id().to_string()]).status().unwrap();
        assert!(stop.success());
        let status = child.wait().unwrap();
        assert!([Some(0), Some(3)].contains(&status.code()), "{status}");
        assert!(mesh(&out("killed")) == local(), "the same bits");
        let told = &manifest(&out("killed"))["result"]["remote"];
        let answered: u64 = told["workers"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
        assert_eq!(told["chunks"].as_u64(), Some(answered));
        assert!(told["workers"].as_object().unwrap().len() >= 2, "{told}");
    }

    #[test]
    fn another_model_and_nobody_at_all_are_refused_before_the_first_chunk() {
        let at = endpoint();
        let nobody = ["--connect", &at, "--set", "link.patience_secs=0.3"];
        ended(run("nobody", "remote:lab/depth", &nobody))
            .ends_with(4)
            .says(&["error[E0409]", "vidar worker"]);
        let _worker = Worker::start(&at, &[]);
        let other = ["--connect", &at, "--set", "remote.model=da3-small"];
        let ran = ended(run("other", "remote:lab/depth", &other)).ends_with(4);
        ran.says(&["error[E0410]", "asked for was da3-small", "has da3-nano (MIT OR Apache-2.0"]);
        let any = ["--connect", &at, "--set", "remote.model="];
        ended(run("any", "remote:lab/depth", &any))
            .ends_with(4)
            .says(&["error[E0410]", "remote.model=da3-nano"]);
        let bad = ["--connect", &at];
        ended(run("bad key", "remote:lab depth/*", &bad)).ends_with(2).says(&["error[E0105]"]);
        let bad = ["--connect", "nonsense"];
        ended(run("bad endpoint", "remote:lab/depth", &bad)).ends_with(2).says(&["error[E0105]"]);
    }

    #[test]
    fn when_the_last_worker_goes_the_run_ends_and_a_resume_goes_on_with_another() {
        let at = endpoint();
        let mut worker = Worker::start(&at, &[]);
        let more = ["--connect", &at, "--set", "link.patience_secs=0.5"];
        let child = run("left alone", "remote:lab/depth", &more).stderr(Stdio::piped()).spawn().unwrap();
        worker.told.recv_timeout(Duration::from_secs(120)).unwrap();
        worker.child.kill().unwrap();
        let ran: ProgramOutput = child.wait_with_output().unwrap().into();
        ran.ends_with(4).says(&["error[E0409]", "--resume"]);
        let next = endpoint();
        let _next = Worker::start(&next, &[]);
        let told = mapped("left alone", &[&next], &["--resume"]);
        assert!(mesh(&out("left alone")) == local(), "the same bits");
        let first = manifest(&out("left alone"));
        assert!(told["chunks"].as_u64().unwrap() >= 1, "{first}");
    }

    #[test]
    fn the_doctor_tells_that_links_are_built_in() {
        let mut doctor = command();
        doctor.arg("doctor");
        assert!(ended(doctor).ends_with(0).stdout.contains("Zenoh is built in"));
        let mut worker = command();
        worker.args(["worker", "--model", "stereo"]);
        ended(worker).ends_with(2).says(&["error[E0105]", "\"stereo\" is none"]);
    }

    /// `vidar receive` in a process of its own, which waits for messages when this returns.
    fn receiving(at: &str, file: &Path, idle: &str) -> Child {
        let mut receive = command();
        receive.args([
            "receive",
            "0/**",
            "--listen",
            at,
            "--idle",
            idle,
            "--duration",
            "120",
            "--json",
            "-o",
        ]);
        let mut child = receive.arg(file).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap());
        let mut line = String::new();
        lines.read_line(&mut line).unwrap();
        assert!(line.contains("waiting for messages"), "{line}");
        child
    }

    fn received(child: Child) -> serde_json::Value {
        let ran: ProgramOutput = child.wait_with_output().unwrap().into();
        ran.ends_with(0).json()["received"].clone()
    }

    /// Sends what a recording holds, as a robot does, each message twice, as fast as it goes or in the rhythm of the recording; how many
    /// there are.
    fn drives(recording: &Path, at: String, is_paced: bool) -> u64 {
        let options = LinkOptions { connect: vec![at], ..LinkOptions::default() };
        let link = Link::open(&options, Role::Client).unwrap();
        let bag = Bag::open(recording).unwrap();
        let mut messages = Vec::new();
        for topic in bag.topics().iter().filter(|t| t.message_type != "nav_msgs/Odometry") {
            let kind = topic.message_type.replacen('/', "::msg::dds_::", 1);
            let publisher =
                link.publisher(&format!("0{}/{kind}_/RIHS01_0", topic.name), None, Delivery::Wait).unwrap();
            let publisher = std::rc::Rc::new(publisher);
            for (i, message) in topic.messages.iter().enumerate() {
                messages.push((message.log_time, i, publisher.clone(), bag.read(message).unwrap()));
            }
        }
        messages.sort_by_key(|(time, ..)| *time);
        std::thread::sleep(Duration::from_secs(2));
        let (clock, first) = (std::time::Instant::now(), messages.first().unwrap().0);
        for (time, i, publisher, message) in &messages {
            if is_paced {
                let after = Duration::from_nanos((*time - first).nanos() as u64);
                std::thread::sleep(after.saturating_sub(clock.elapsed()));
            }
            let attached = Attachment { sequence: *i as i64, sent_ns: time.nanos(), sender: [7; 16] };
            let (_, payload) = encode(message).unwrap();
            // Everything comes twice.
            for _ in 0..2 {
                publisher.put(payload.clone(), attached.encode()).unwrap();
            }
            std::thread::sleep(Duration::from_micros(if is_paced { 0 } else { 200 }));
        }
        // A session that is closed takes what is on its way with it.
        std::thread::sleep(Duration::from_secs(1));
        messages.len() as u64
    }

    #[test]
    fn a_robot_is_mapped_while_it_drives() {
        let folder = out("driving");
        std::fs::create_dir_all(&folder).unwrap();
        let (drive, map) = (folder.join("drive.mcap"), folder.join("map"));
        let mut convert = command();
        convert.arg("convert").arg(flight()).arg(&drive).arg("-q");
        ended(convert).ends_with(0);
        let at = endpoint();
        let mut live = command();
        live.args(["live", "zenoh:0/**", "--listen", &at, "--idle", "3", "--duration", "200", "-o"])
            .arg(&map);
        let child =
            live.args(["-q", "--set", "input.poses=odometry"]).stderr(Stdio::piped()).spawn().unwrap();
        std::thread::sleep(Duration::from_secs(2));
        drives(&drive, at, true);
        let ran: ProgramOutput = child.wait_with_output().unwrap().into();
        let made = manifest(&map);
        let told = &made["result"]["live"];
        let left_out = ["images_not_tracked", "keyframes_dropped", "poses_dropped"];
        let left_out: u64 = left_out.iter().map(|key| told[*key].as_u64().unwrap()).sum();
        assert!(left_out == 0 || ran.code == 3, "{left_out} left out: {}", ran.stderr);
        assert_eq!(made["exit"], ran.code, "{}", ran.stderr);
        let lines = std::fs::read_to_string(map.join("trajectory/live.tum")).unwrap();
        assert!(lines.lines().filter(|l| !l.starts_with('#')).count() > 10, "{lines}");
        let kept = Bag::open(&map.join("recording.mcap")).unwrap();
        let images = |bag: &Bag| bag.topics().iter().map(|t| t.messages.len()).sum::<usize>();
        assert!(images(&kept) > images(&Bag::open(&drive).unwrap()) / 2, "what came is kept");
        assert!(mesh(&map).len() > 10_000);
        // Opening the stream takes 2.5 s of it. Who caught up has poses as images come; who did not has each of them that late.
        let latency = &told["image_to_pose"];
        assert!(latency["median"].as_f64().unwrap() < 1.25, "{latency}");
    }

    #[test]
    fn a_robot_that_is_received_leaves_the_recording_that_it_sent() {
        let folder = out("robot");
        std::fs::create_dir_all(&folder).unwrap();
        let (drive, file) = (folder.join("drive.mcap"), folder.join("received.mcap"));
        let mut convert = command();
        convert.arg("convert").arg(&shared().sequence).arg(&drive).arg("-q");
        ended(convert).ends_with(0);
        let at = endpoint();
        let child = receiving(&at, &file, "3");
        let known = drives(&drive, at, false);
        let told = received(child);
        let count: u64 = told["topics"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
        assert_eq!(
            (count + told["ignored"].as_u64().unwrap() / 2, &told["dropped"]),
            (known, &0.into()),
            "{told}"
        );
        assert_eq!(told["repeated"].as_u64(), Some(count), "{told}");
        let (kept, bag) = (Bag::open(&file).unwrap(), Bag::open(&drive).unwrap());
        for topic in kept.topics() {
            let sent = bag.topics().iter().find(|t| t.name == topic.name).unwrap();
            assert_eq!(topic.messages.len(), sent.messages.len(), "{}", topic.name);
            for (came, went) in topic.messages.iter().zip(&sent.messages) {
                assert!(kept.read(came).unwrap() == bag.read(went).unwrap(), "{}", topic.name);
            }
        }
    }

    #[test]
    fn a_live_run_tells_ros_where_it_is() {
        let folder = out("told");
        std::fs::create_dir_all(&folder).unwrap();
        let (at, file, map) = (endpoint(), folder.join("tf.mcap"), folder.join("map"));
        let child = receiving(&at, &file, "20");
        let mut live = command();
        live.arg("live").arg(flight()).arg("-o").arg(&map).args(["-q", "--set", "input.poses=odometry"]);
        live.args(["--publish", "0/vidar", "--connect", &at]);
        let ran = ended(live);
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        let told = received(child);
        let lines = std::fs::read_to_string(map.join("trajectory/live.tum")).unwrap();
        let poses = lines.lines().filter(|l| !l.starts_with('#')).count() as u64;
        let transforms = told["topics"]["/tf"].as_u64().unwrap();
        assert!(transforms <= poses && transforms > poses / 2, "{transforms} of {poses}: {told}");
        // Poses, odometry, keyframes, clouds and health are of types that no map needs.
        assert!(told["ignored"].as_u64().unwrap() > poses, "{told}");
        let mut wrong = command();
        wrong.arg("live").arg(flight()).args(["--publish", "vidar", "-o"]).arg(folder.join("wrong"));
        ended(wrong).ends_with(2).says(&["error[E0105]", "--publish 0/vidar"]);
    }
}
