//! `vidar live`: the same bits as `vidar run` where nothing is left out; a recording at its own rate; a stream; a kill in between.

use crate::odometry::flight;
use crate::support::{ProgramOutput, command, manifest, shared};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// What `vidar run` would find in a first pass over the recording is given, so that both have the same odometry.
const NO_FIRST_PASS: &[&str] =
    &["--set", "odometry.readout_ms=0", "--set", "odometry.estimate_time_offset=false"];

fn mapped(verb: &str, out: &Path, more: &[&str]) -> Command {
    let mut command = command();
    command.arg(verb).arg(flight()).arg("-o").arg(out).args(["--preset", "live", "-q", "--json"]);
    command.args(["--progress", "off", "--set", "input.poses=odometry"]).args(NO_FIRST_PASS).args(more);
    command
}

/// The flight as MCAP.
fn flight_mcap() -> PathBuf {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    let made = MADE.get_or_init(|| {
        let out = shared().root.join("live flight.mcap");
        let converted = command().arg("convert").arg(flight()).arg(&out).arg("-q").output().unwrap();
        assert!(converted.status.success(), "{}", String::from_utf8_lossy(&converted.stderr));
        out
    });
    made.clone()
}

/// `vidar live` of a path, or of standard input for `-`.
fn of(path: &Path, out: &Path, more: &[&str]) -> Command {
    let mut command = command();
    command.arg("live").arg(path).arg("-o").arg(out).args(["-q", "--json", "--progress", "off"]);
    command.args(["--set", "input.poses=odometry"]).args(NO_FIRST_PASS).args(more);
    command
}

/// The command with bytes sent into it, slowly where told so.
fn sent(mut command: Command, bytes: Vec<u8>) -> ProgramOutput {
    use std::process::Stdio;
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut pipe = child.stdin.take().unwrap();
    // A program that refuses the stream closes it.
    let sender = std::thread::spawn(move || drop(pipe.write_all(&bytes)));
    let ended: ProgramOutput = child.wait_with_output().unwrap().into();
    sender.join().unwrap();
    ended
}

fn ended(mut command: Command) -> ProgramOutput {
    ProgramOutput::from(command.output().unwrap()).ends_with(0)
}

/// The folder of a live run that nothing disturbed.
fn undisturbed() -> PathBuf {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    let made = MADE.get_or_init(|| {
        let out = shared().root.join("live");
        ended(mapped("live", &out, &[]));
        out
    });
    made.clone()
}

fn poses(out: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(out.join("trajectory/live.tum")).unwrap();
    text.lines().filter(|l| !l.starts_with('#')).map(str::to_owned).collect()
}

#[test]
fn a_live_map_that_leaves_nothing_out_has_the_bits_of_a_run() {
    let (live, run) = (undisturbed(), shared().root.join("not live"));
    ended(mapped("run", &run, &[]));
    let mesh = |out: &Path| std::fs::read(out.join("map/mesh.ply")).unwrap();
    assert!(mesh(&live) == mesh(&run), "the same bits, though one was tracked on a thread of its own");
    let told = &manifest(&live)["result"]["live"];
    for left_out in ["images_not_tracked", "keyframes_thinned", "keyframes_dropped", "poses_dropped"] {
        assert_eq!(told[left_out], 0, "{left_out}");
    }
    let posed = told["image_to_pose"]["count"].as_u64().unwrap();
    assert_eq!(posed, poses(&live).len() as u64, "a line for every image with a pose");
    assert!(told["keyframe_to_surface"]["count"].as_u64().unwrap() > 0, "the surface grew on the way");
    let listed = manifest(&live)["artifacts"].to_string();
    assert!(listed.contains("trajectory/live.tum"), "{listed}");
}

#[test]
fn at_its_own_rate_a_recording_takes_its_own_time_and_latencies_are_told() {
    let out = shared().root.join("live realtime");
    let clock = Instant::now();
    let ran = ProgramOutput::from(mapped("live", &out, &["--realtime"]).output().unwrap());
    let told = &manifest(&out)["result"]["live"];
    assert_eq!(told["is_realtime"], true);
    // How fast this machine is decides whether something was left out; whoever reads only the status learns of it.
    let left_out = ["images_not_tracked", "keyframes_dropped", "poses_dropped"];
    let left_out: u64 = left_out.iter().map(|key| told[*key].as_u64().unwrap()).sum();
    assert!(left_out == 0 || ran.code == 3, "{left_out} left out: {}", ran.stderr);
    assert_eq!(manifest(&out)["exit"], ran.code, "{}", ran.stderr);
    let images = told["images"].as_u64().unwrap();
    // Images are never earlier than they were filmed.
    let film_secs = (images - 1) as f64 / 20.0;
    assert!(clock.elapsed() > Duration::from_secs_f64(0.9 * film_secs), "{film_secs} s of film");
    let latency = &told["image_to_pose"];
    let at = |key: &str| latency[key].as_f64().unwrap();
    assert!(0.0 < at("median") && at("median") <= at("p95") && at("p95") <= at("max"), "{latency}");
    let late = told["images_not_tracked"].as_u64().unwrap();
    assert!(poses(&out).len() as u64 + late <= images);
}

/// Looks at the niceness of a program's threads: the map's have a higher one, the odometry's that of the program.
#[cfg(target_os = "linux")]
fn the_odometry_goes_before_the_map(process: u32) {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let threads: Vec<(String, i32)> = tasks
        .filter_map(|task| {
            let task = task.ok()?.path();
            let name = std::fs::read_to_string(task.join("comm")).ok()?;
            let stat = std::fs::read_to_string(task.join("stat")).ok()?;
            // The 19th value; the second one is the name in parentheses.
            let nice = stat.rsplit_once(')')?.1.split_whitespace().nth(16)?.parse().ok()?;
            Some((name.trim().to_owned(), nice))
        })
        .collect();
    let (odometry, others): (Vec<_>, Vec<_>) =
        threads.iter().partition(|(name, _)| name.starts_with("odometry"));
    let of_program = others.iter().map(|(_, nice)| *nice).min();
    let highest = others.iter().map(|(_, nice)| *nice).max();
    assert!(
        !odometry.is_empty() && odometry.iter().all(|(_, nice)| Some(*nice) == of_program),
        "{threads:?}"
    );
    assert!(highest >= Some(9), "{threads:?}");
}

#[test]
fn a_kill_leaves_whole_lines_and_a_resume_goes_on() {
    let out = shared().root.join("live killed");
    // Not at its own rate, at which a busy machine leaves images out, and may never start.
    let mut child = mapped("live", &out, &[]).spawn().unwrap();
    let (file, clock) = (out.join("trajectory/live.tum"), Instant::now());
    while child.try_wait().unwrap().is_none() && clock.elapsed() < Duration::from_secs(120) {
        if std::fs::read_to_string(&file).is_ok_and(|t| t.lines().count() > 5) {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(child.try_wait().unwrap().is_none(), "killed while images came");
    #[cfg(target_os = "linux")]
    the_odometry_goes_before_the_map(child.id());
    child.kill().unwrap();
    child.wait().unwrap();
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.ends_with('\n'));
    assert!(poses(&out).iter().all(|line| line.split(' ').count() == 8), "{text}");
    ended(mapped("live", &out, &["--resume"]));
    let whole = undisturbed();
    let mesh = |out: &Path| std::fs::read(out.join("map/mesh.ply")).unwrap();
    assert!(mesh(&whole) == mesh(&out), "the same bits as without the kill");
    assert_eq!(poses(&whole), poses(&out));
}

#[test]
fn a_stream_on_standard_input_has_the_bits_of_its_file_and_is_kept() {
    let (file, stream) = (shared().root.join("live file"), shared().root.join("live stream"));
    let bytes = std::fs::read(flight_mcap()).unwrap();
    ended(of(&flight_mcap(), &file, &[]));
    let ran = sent(of(Path::new("-"), &stream, &[]), bytes.clone());
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let mesh = |out: &Path| std::fs::read(out.join("map/mesh.ply")).unwrap();
    assert!(mesh(&file) == mesh(&stream), "the same bits, though nothing was known of it before it came");
    assert_eq!(poses(&file), poses(&stream));
    assert!(std::fs::read(stream.join("recording.mcap")).unwrap() == bytes, "kept as it came");
    let (of_file, of_stream) = (manifest(&file), manifest(&stream));
    assert_eq!(of_stream["result"]["live"]["images"], of_file["result"]["live"]["images"]);
    assert!(of_stream["artifacts"].to_string().contains("recording.mcap"), "{}", of_stream["artifacts"]);
    // Ground truth of the recording, which comes with it, is compared with at the end.
    let ate = |m: &serde_json::Value| m["result"]["scores"].to_string();
    assert_eq!(ate(&of_stream), ate(&of_file));
}

#[test]
fn what_came_of_a_stream_that_breaks_is_mapped_and_a_killed_one_goes_on_with_what_was_kept() {
    let bytes = std::fs::read(flight_mcap()).unwrap();
    let cut = bytes[..bytes.len() * 2 / 3].to_vec();
    let out = shared().root.join("live cut stream");
    let ran = sent(of(Path::new("-"), &out, &[]), cut.clone());
    assert_eq!(ran.code, 3, "{}", ran.stderr);
    assert!(
        manifest(&out)["warnings"]["stream-cut-off"].as_u64() == Some(1),
        "{}",
        manifest(&out)["warnings"]
    );
    // Killed while it waits for more of the stream.
    let killed = shared().root.join("live killed stream");
    let mut command = of(Path::new("-"), &killed, &[]);
    let mut child = command.stdin(std::process::Stdio::piped()).spawn().unwrap();
    let mut pipe = child.stdin.take().unwrap();
    let part = cut.clone();
    let sender = std::thread::spawn(move || {
        let written = pipe.write_all(&part);
        (pipe, written)
    });
    let (file, clock) = (killed.join("trajectory/live.tum"), Instant::now());
    let has_poses = || std::fs::read_to_string(&file).is_ok_and(|t| t.lines().count() > 5);
    let has_all =
        || std::fs::metadata(killed.join("recording.mcap")).is_ok_and(|f| f.len() == cut.len() as u64);
    while !(has_poses() && has_all()) {
        assert!(
            clock.elapsed() < Duration::from_secs(240) && child.try_wait().unwrap().is_none(),
            "it waits"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    let (pipe, written) = sender.join().unwrap();
    written.unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
    drop(pipe);
    let ran = of(Path::new("-"), &killed, &["--resume"]).output().unwrap();
    assert!([0, 3].contains(&ran.status.code().unwrap()), "{}", String::from_utf8_lossy(&ran.stderr));
    assert!(killed.join("map/mesh.ply").is_file() && killed.join("recording.mcap").is_file());
    assert!(std::fs::read(killed.join("recording.mcap")).unwrap() == cut, "what came, whole");
    let mesh = |out: &Path| std::fs::read(out.join("map/mesh.ply")).unwrap();
    assert!(mesh(&killed) == mesh(&out), "the same bits as without the kill");
}

#[test]
fn what_cannot_be_a_stream_is_refused_and_leaves_nothing() {
    let out = shared().root.join("live no stream");
    let ran = sent(of(Path::new("-"), &out, &[]), b"#ROSBAG V2.0\n and so on".to_vec());
    assert_eq!(ran.code, 1, "{}", ran.stderr);
    assert!(ran.stderr.contains("MCAP"), "{}", ran.stderr);
    assert!(!out.exists(), "no folder of a run that never was");
    let ran = sent(of(Path::new("-"), &out, &["--realtime"]), Vec::new());
    assert!(ran.code == 2 && ran.stderr.contains("its own rate"), "{}", ran.stderr);
    let ran = sent(of(Path::new("-"), &out, &["--resume"]), Vec::new());
    assert!(ran.code == 2 && ran.stderr.contains("recording.mcap"), "{}", ran.stderr);
}
