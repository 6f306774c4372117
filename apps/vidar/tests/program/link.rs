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
mod robots;

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

    /// A port that is free now.
    pub(super) fn endpoint() -> String {
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

    pub(super) fn mesh(run: &Path) -> Vec<u8> {
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
    fn when_the_last_worker_goes_a_live_map_stops_and_poses_go_on() {
        let at = endpoint();
        let mut worker = Worker::start(&at, &[]);
        let mut live = command();
        live.arg("live")
            .arg(flight())
            .args(["--realtime", "-o"])
            .arg(out("left on the way"))
            .args(&SHORT[3..]);
        live.args(["--geometry", "remote:lab/depth", "--set", "remote.model=da3-nano", "--connect", &at]);
        live.args(["--set", "link.patience_secs=0.5", "--set", "input.poses=odometry"]);
        let child = live.stderr(Stdio::piped()).spawn().unwrap();
        worker.told.recv_timeout(Duration::from_secs(120)).unwrap();
        worker.child.kill().unwrap();
        let ran: ProgramOutput = child.wait_with_output().unwrap().into();
        ran.ends_with(4).says(&["error[E0409]", "--resume"]);
        let log = std::fs::read_to_string(out("left on the way").join("log.jsonl")).unwrap();
        assert!(log.contains("map-stopped"), "{log}");
        let lines = std::fs::read_to_string(out("left on the way").join("trajectory/live.tum")).unwrap();
        let times: Vec<f64> = lines
            .lines()
            .filter(|l| !l.starts_with('#'))
            .map(|l| l.split(' ').next().unwrap().parse().unwrap())
            .collect();
        let images = std::fs::read_to_string(flight().join("mav0/cam0/data.csv")).unwrap();
        let last = images.lines().last().unwrap().split(',').next().unwrap().parse::<f64>().unwrap() * 1e-9;
        assert!(
            times.len() > 30 && last - times.last().unwrap() < 0.2,
            "{} of {last}",
            times.last().unwrap()
        );
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
}
