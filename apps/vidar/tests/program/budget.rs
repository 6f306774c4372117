//! A time budget: what is cut down, and that it is the same every time.

use crate::support::{files_under, run_on, shared};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn run(name: &str, more: &[&str]) -> (PathBuf, Value) {
    let out = shared().root.join(name);
    let json = run_on(&shared().sequence, &out, &[&["-q", "--json"], more].concat()).ends_with(0).json();
    (out, json["result"].clone())
}

fn surface(out: &Path) -> Vec<(String, Vec<u8>)> {
    let is_result = |name: &String| ["depth", "map/"].iter().any(|start| name.starts_with(start));
    let files = files_under(out).into_iter().filter(is_result);
    files.map(|n| (n.clone(), std::fs::read(out.join(n)).unwrap())).collect()
}

#[test]
fn a_budget_that_suffices_changes_no_bit_and_a_short_one_leaves_fewer_keyframes() {
    let (without, all) = run("budget none", &[]);
    let (ample, same) = run("budget ample", &["--time-budget", "600"]);
    assert!(all["budget"].is_null());
    assert!(surface(&without) == surface(&ample));
    assert_eq!(same["budget"]["chosen"], same["budget"]["unlimited"]);
    let (short, few) = run("budget short", &["--time-budget", "0.01"]);
    let (before, after) = (all["keyframes"].as_u64().unwrap(), few["keyframes"].as_u64().unwrap());
    assert!(after < before && after >= 2, "{after} of {before} keyframes");
    let budget = &few["budget"];
    assert_eq!(budget["unlimited"]["keyframes"], before);
    assert!(budget["chosen"]["keyframes"].as_u64().unwrap() >= after);
    // The choice is in the folder, in words for people and as numbers for programs.
    let kept: Value = serde_json::from_slice(&std::fs::read(short.join("budget.json")).unwrap()).unwrap();
    assert_eq!(&kept, budget);
    let readme = std::fs::read_to_string(short.join("README.txt")).unwrap();
    assert!(readme.contains("time budget") && readme.contains("keyframes, "), "{readme}");
    let log = std::fs::read_to_string(short.join("log.jsonl")).unwrap();
    assert!(log.contains("over-budget"), "not even the cheapest map takes a hundredth of a second");
}

#[test]
fn a_budget_gives_the_same_bits_for_any_threads_and_when_it_is_resumed() {
    let budget = ["--realtime", "--set", "budget.speed=0.2", "--set", "output.keep_chunks=true"];
    let (one, result) = run("budget threads 1", &[&budget[..], &["--threads", "1"]].concat());
    assert!(result["budget"]["chosen"] != result["budget"]["unlimited"], "{}", result["budget"]);
    // The recording's own duration: 20 images at 8 Hz.
    let seconds = result["budget"]["seconds"].as_f64().unwrap();
    assert!((2.0..2.6).contains(&seconds), "{seconds}");
    let (two, _) = run("budget threads 2", &[&budget[..], &["--threads", "2"]].concat());
    let first = surface(&one);
    assert!(first.len() > 3 && first == surface(&two), "1 and 2 threads");
    let (again, resumed) = run("budget threads 1", &[&budget[..], &["--threads", "1", "--resume"]].concat());
    assert!(first == surface(&again), "resumed");
    assert_eq!(resumed["budget"], result["budget"]);
    let log = std::fs::read_to_string(again.join("log.jsonl")).unwrap();
    assert!(log.contains("\"is_reused\":true"), "{log}");
    // The settings that were chosen make the same map without a budget.
    let chosen = |key: &str| result["budget"]["chosen"][key].to_string();
    let (width, most) = (
        format!("stereo.max_width_px={}", chosen("width_px")),
        format!("keyframes.max_count={}", chosen("keyframes")),
    );
    let (by_hand, _) = run("budget by hand", &["--set", &width, "--set", &most]);
    assert!(first == surface(&by_hand), "{width} {most}");
}

#[test]
fn budgets_that_cannot_be_planned_are_refused_with_the_reason() {
    let refused = |name: &str, args: &[&str], words: &[&str]| {
        run_on(&shared().sequence, &shared().root.join(name), args).ends_with(2).says(words);
    };
    refused("budget two", &["--realtime", "--time-budget", "3"], &["--time-budget", "cannot be used with"]);
    refused("budget negative", &["--time-budget=-3"], &["--time-budget", "positive"]);
    refused("budget nano", &["--realtime", "--geometry", "da3-nano"], &["kept by stereo", "--geometry auto"]);
    refused("budget speed", &["--realtime", "--set", "budget.speed=0"], &["budget.speed", "0.01"]);
}
