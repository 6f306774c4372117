//! `vidar live`: the same bits as `vidar run` where nothing is left out; a recording at its own rate; a kill in between.

use crate::odometry::flight;
use crate::support::{ProgramOutput, command, manifest, shared};
use std::path::Path;
use std::process::Command;
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

fn ended(mut command: Command) -> ProgramOutput {
    let ran: ProgramOutput = command.output().unwrap().into();
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    ran
}

fn poses(out: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(out.join("trajectory/live.tum")).unwrap();
    text.lines().filter(|l| !l.starts_with('#')).map(str::to_owned).collect()
}

#[test]
fn a_live_map_that_leaves_nothing_out_has_the_bits_of_a_run() {
    let (live, run) = (shared().root.join("live"), shared().root.join("not live"));
    ended(mapped("live", &live, &[]));
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
    ended(mapped("live", &out, &["--realtime"]));
    let told = &manifest(&out)["result"]["live"];
    assert_eq!(told["is_realtime"], true);
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

#[test]
fn a_kill_leaves_whole_lines_and_a_resume_goes_on() {
    let out = shared().root.join("live killed");
    let mut child = mapped("live", &out, &["--realtime"]).spawn().unwrap();
    let (file, clock) = (out.join("trajectory/live.tum"), Instant::now());
    while child.try_wait().unwrap().is_none() && clock.elapsed() < Duration::from_secs(120) {
        if std::fs::read_to_string(&file).is_ok_and(|t| t.lines().count() > 5) {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(child.try_wait().unwrap().is_none(), "killed while images came");
    child.kill().unwrap();
    child.wait().unwrap();
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.ends_with('\n'));
    assert!(poses(&out).iter().all(|line| line.split(' ').count() == 8), "{text}");
    ended(mapped("live", &out, &["--resume"]));
    let whole = shared().root.join("live whole");
    ended(mapped("live", &whole, &[]));
    let mesh = |out: &Path| std::fs::read(out.join("map/mesh.ply")).unwrap();
    assert!(mesh(&whole) == mesh(&out), "the same bits as without the kill");
    assert_eq!(poses(&whole), poses(&out));
}
