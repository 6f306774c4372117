//! `--geometry auto`: stereo completed by the map, planes and another source's shapes.

use crate::support::{files_under, run_on, shared};
use serde_json::Value;
use std::path::{Path, PathBuf};

const SHORT: &[&str] = &["-q", "--json", "--stride", "2", "--set", "eval.mode=auto"];
const BY_NANO: &[&str] = &["--geometry", "auto", "--set", "geometry.fill_network=da3-nano"];

fn run(name: &str, more: &[&str]) -> (PathBuf, Value) {
    let out = shared().root.join(name);
    let json = run_on(&shared().sequence, &out, &[SHORT, more].concat()).ends_with(0).json();
    (out, json["result"]["evaluation"]["depth"].clone())
}

fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("no {path} in {value}"))
}

/// Share of the sensor's pixels that have depth of a source.
fn share(depth: &Value, source: &str) -> f64 {
    let scores = depth["by_source"].as_array().unwrap();
    scores.iter().find(|s| s["source"] == source).map_or(0.0, |s| number(s, "/share"))
}

/// Files whose bytes depend on the result alone.
fn results(out: &Path) -> Vec<(String, Vec<u8>)> {
    let is_result = |name: &String| ["depth", "map/", "images/"].iter().any(|start| name.starts_with(start));
    files_under(out)
        .into_iter()
        .filter(is_result)
        .map(|n| (n.clone(), std::fs::read(out.join(n)).unwrap()))
        .collect()
}

#[test]
fn every_pixel_gets_depth_with_its_source_and_the_measured_ones_are_more_than_stereos() {
    let (_, stereo) = run("auto stereo", &["--geometry", "stereo"]);
    let (out, auto) = run("auto whole", BY_NANO);
    let all = ["stereo", "map", "plane", "network", "interpolation"].map(|s| share(&auto, s));
    let complete = all.iter().sum::<f64>();
    assert!(complete > 0.99, "{all:?}");
    assert!(all[3] > 0.0 && all[4] == 0.0, "the built-in network fills what is left: {all:?}");
    let (measured, own) =
        (number(&auto, "/pixel_weighted/completeness"), number(&stereo, "/pixel_weighted/completeness"));
    assert!(measured > own + 0.01, "{measured} of the pixels are measured, by stereo alone {own}");
    assert!((measured - all[..3].iter().sum::<f64>()).abs() < 1e-9);
    let files = files_under(&out);
    let count = |folder: &str| files.iter().filter(|f| f.starts_with(folder) && f.ends_with(".png")).count();
    assert!(count("depth/") > 3);
    assert_eq!((count("depth_source/"), count("depth_std/")), (count("depth/"), count("depth/")));
    let readme = std::fs::read_to_string(out.join("README.txt")).unwrap();
    assert!(readme.contains("depth_source/*.png"), "{readme}");
}

#[test]
fn the_completed_result_has_the_same_bits_for_any_threads_and_when_it_is_resumed() {
    let keep = ["--set", "output.keep_chunks=true", "--set", "geometry.chunk_keyframes=3"];
    let auto = [BY_NANO, &keep[..]].concat();
    let (one, _) = run("auto threads 1", &[&auto[..], &["--threads", "1"]].concat());
    let (four, _) = run("auto threads 4", &[&auto[..], &["--threads", "4"]].concat());
    let first = results(&one);
    assert!(first.len() > 10 && first.iter().any(|(name, _)| name == "map/mesh.ply"));
    assert!(first == results(&four), "1 and 4 threads");
    // The predictions that were kept, with the network's shapes, are read again.
    let (again, _) = run("auto threads 1", &[&auto[..], &["--threads", "1", "--resume"]].concat());
    assert!(first == results(&again), "resumed");
    let log = std::fs::read_to_string(again.join("log.jsonl")).unwrap();
    assert!(log.contains("\"is_reused\":true"), "{log}");
}

#[test]
fn shapes_come_from_a_network_a_recording_or_nowhere() {
    let keep = ["--geometry", "da3-nano", "--set", "output.keep_chunks=true"];
    let (recorded, _) = run("auto recorded", &keep);
    let fill = format!("geometry.fill_network=recorded:{}", recorded.join("chunks").display());
    let (_, with) = run("auto of recorded", &["--geometry", "auto", "--set", &fill]);
    let (_, without) = run("auto interpolated", &["--geometry", "auto"]);
    assert!(share(&with, "network") > 0.0, "{with}");
    assert!(share(&without, "network") == 0.0 && share(&without, "interpolation") > 0.0, "{without}");
    // Guesses join no map and change no measured pixel.
    assert_eq!(
        number(&with, "/pixel_weighted/completeness"),
        number(&without, "/pixel_weighted/completeness")
    );
    let out = shared().root.join("auto magic");
    let magic = ["--geometry", "auto", "--set", "geometry.fill_network=magic"];
    run_on(&shared().sequence, &out, &magic).ends_with(2).says(&["geometry.fill_network", "magic"]);
    run_on(&shared().sequence, &out, &["--geometry", "auto", "--mode", "pose-free"])
        .ends_with(2)
        .says(&["stereo"]);
}
