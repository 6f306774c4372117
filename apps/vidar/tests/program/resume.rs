//! Nothing is lost: a folder is only resumed by the same run, what an earlier attempt left is removed, and the manifest lists what
//! belongs to a run.

use crate::odometry::flight;
use crate::support::{copy_of_sequence, files_under, finished, manifest, run_command, run_on, shared};
use std::path::Path;
use std::time::{Duration, Instant};

const SHORT: &[&str] = &["-q", "--stride", "2"];

fn resumed(sequence: &Path, out: &Path, more: &[&str]) -> crate::support::ProgramOutput {
    run_on(sequence, out, &[SHORT, &["--resume"], more].concat())
}

#[test]
fn a_folder_of_other_settings_another_recording_or_no_run_is_not_resumed() {
    let out = shared().root.join("resume refused");
    run_on(&shared().sequence, &out, SHORT).ends_with(0);
    let before: Vec<_> = files_under(&out);
    let mesh = std::fs::read(out.join("map/mesh.ply")).unwrap();
    resumed(&shared().sequence, &out, &["--set", "fusion.voxel_size_m=0.08"]).ends_with(2).says(&[
        "error[E0107]",
        "voxel_size_m = 0.04",
        "voxel_size_m = 0.08",
        "--force",
    ]);
    // The same images with another calibration are another recording.
    let folder = tempfile::tempdir().unwrap();
    let other = copy_of_sequence(folder.path());
    let yaml = other.join("mav0/cam0/sensor.yaml");
    let text = std::fs::read_to_string(&yaml).unwrap();
    std::fs::write(&yaml, text.replace("rate_hz: 8", "rate_hz: 9")).unwrap();
    resumed(&other, &out, &[]).ends_with(2).says(&["error[E0107]", "another recording"]);
    assert_eq!(files_under(&out), before);
    assert!(std::fs::read(out.join("map/mesh.ply")).unwrap() == mesh, "the finished map is as it was");

    let mine = shared().root.join("resume mine");
    std::fs::create_dir(&mine).unwrap();
    std::fs::write(mine.join("mine.txt"), "precious").unwrap();
    resumed(&shared().sequence, &mine, &[]).ends_with(1).says(&["error[E0207]", "manifest.json"]);
    assert_eq!(files_under(&mine), ["mine.txt"]);
    // The same run may be repeated, and a new folder is as good as an empty one.
    resumed(&shared().sequence, &out, &[]).ends_with(0);
    assert!(std::fs::read(out.join("map/mesh.ply")).unwrap() == mesh);
    resumed(&shared().sequence, &shared().root.join("resume anew"), &[]).ends_with(0);
}

#[test]
fn what_an_attempt_does_not_make_again_goes_and_files_of_others_stay() {
    let out = shared().root.join("resume stale");
    run_on(&shared().sequence, &out, SHORT).ends_with(0);
    // An earlier attempt had drawn a picture and made another depth image; somebody put a note beside them.
    std::fs::create_dir_all(out.join("pictures")).unwrap();
    for name in ["pictures/depth-000099.png", "depth/000099.png", "notes.txt"] {
        std::fs::write(out.join(name), "left").unwrap();
    }
    let mut log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    for name in ["pictures/depth-000099.png", "depth/000099.png"] {
        log += &format!(
            "{{\"schema\":\"vidar.event/1\",\"event\":\"artifact-written\",\"path\":\"{name}\",\"bytes\":4}}\n"
        );
    }
    std::fs::write(out.join("log.jsonl"), log).unwrap();
    resumed(&shared().sequence, &out, &[]).ends_with(0);
    let files = files_under(&out);
    assert!(!files.iter().any(|f| f.contains("000099")), "{files:?}");
    assert!(files.iter().any(|f| f == "notes.txt"));
    let listed = manifest(&out)["artifacts"].clone();
    let listed: Vec<&str> = listed.as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    let own: Vec<&str> = files.iter().map(String::as_str).filter(|f| *f != "notes.txt").collect();
    assert_eq!(listed, own, "the manifest lists what belongs to the run, and nothing else");
}

#[test]
fn a_manifest_lists_every_file_of_a_run_and_is_there_from_the_start() {
    let (out, _) = finished();
    let manifest = manifest(out);
    let listed: Vec<&str> =
        manifest["artifacts"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    assert_eq!(listed, files_under(out));
    assert_eq!(manifest["exit"], 0);
}

#[test]
fn a_run_that_is_killed_before_its_first_chunk_does_not_track_again() {
    const OWN_POSES: &[&str] = &["-q", "--stride", "2", "--set", "input.poses=odometry"];
    let (whole, out) = (shared().root.join("tracked once"), shared().root.join("killed after tracking"));
    let ran = run_on(flight(), &whole, OWN_POSES);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let mut child = run_command(flight(), &out, OWN_POSES).spawn().unwrap();
    let (tracked, clock) = (out.join("odometry/tracked.cbor"), Instant::now());
    while !tracked.exists()
        && child.try_wait().unwrap().is_none()
        && clock.elapsed() < Duration::from_secs(120)
    {
        std::thread::sleep(Duration::from_millis(1));
    }
    // SIGKILL: nothing can be tidied up.
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(
        tracked.exists() && !out.join("chunks/000000.json").exists(),
        "killed between tracking and mapping"
    );
    let before = std::fs::read_to_string(out.join("log.jsonl")).unwrap().len();
    let ran = run_on(flight(), &out, &[OWN_POSES, &["--resume"]].concat());
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap()[before..].to_owned();
    assert!(log.contains("odometry-resumed") && !log.contains("\"stage\":\"odometry\""), "{log}");
    let mesh = |run: &Path| std::fs::read(run.join("map/mesh.ply")).unwrap();
    assert!(mesh(&whole) == mesh(&out), "the same bits");
    assert_eq!(manifest(&whole)["result"]["scale"], manifest(&out)["result"]["scale"]);
    assert!(!tracked.exists(), "the map is made");
}

#[test]
fn a_manifest_lists_chunks_that_are_kept() {
    let out = shared().root.join("kept chunks");
    run_on(&shared().sequence, &out, &[SHORT, &["--set", "output.keep_chunks=true"]].concat()).ends_with(0);
    let manifest = manifest(&out);
    let listed: Vec<&str> =
        manifest["artifacts"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    assert!(listed.contains(&"chunks/000000.npz"), "{listed:?}");
    assert_eq!(listed, files_under(&out));
}
