//! Geometry elsewhere, on this computer's loopback: the bits of a local run, whatever happens to workers.

use crate::support::{ProgramOutput, command, manifest, run_command, shared};
use std::io::{BufRead, BufReader, Read};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

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
    all.extend(["--geometry", geometry]);
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
            let mut ready = String::new();
            BufReader::new(child.stdout.take().unwrap()).read_line(&mut ready).unwrap();
            if ready.is_empty() {
                let mut said = String::new();
                child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
                panic!("no worker: {said}");
            }
            let ready: serde_json::Value = serde_json::from_str(&ready).unwrap();
            assert_eq!((&ready["schema"], &ready["key"]), (&"vidar.worker/1".into(), &"lab/depth".into()));
            let (sender, told) = channel();
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
            assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
            mesh(&out("local"))
        })
    }

    fn mapped(name: &str, connect: &[&str], more: &[&str]) -> serde_json::Value {
        let mut all: Vec<&str> = connect.iter().flat_map(|c| ["--connect", c]).collect();
        all.extend(more);
        let ran = ended(run(name, "remote:lab/depth", &all));
        assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
        manifest(&out(name))["result"]["remote"].clone()
    }

    #[test]
    fn a_worker_gives_the_bits_of_the_same_network_here_and_bytes_are_told() {
        let at = endpoint();
        let _worker = Worker::start(&at, &[]);
        let told = mapped("raw", &[&at], &["--set", "remote.model=da3-nano"]);
        assert!(mesh(&out("raw")) == local(), "the same bits");
        assert_eq!((&told["images"], &told["depth"]), (&"raw".into(), &"f32".into()));
        assert_eq!((&told["retries"], &told["invalid_replies"]), (&0.into(), &0.into()));
        let number = |told: &serde_json::Value, key: &str| told[key].as_u64().unwrap();
        assert!(number(&told, "chunks") >= 3, "{told}");
        // A keyframe of 160x104 pixels takes 50 kB as it is.
        assert!(number(&told, "bytes_sent") > 40_000 * number(&told, "keyframes"), "{told}");
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
}
