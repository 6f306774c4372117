//! Predictions and poses that are wrong: every coupling ends with a map and counts what acted, or says what it cannot do.

use crate::support::{ProgramOutput, manifest, run_on, shared};
use std::fs::File;
use std::path::{Path, PathBuf};
use vidar::export_formats::official::{NpyArray, NpyData, NpzLimits, read_npz, write_npz_arrays};

const MODES: [&str; 6] =
    ["da3-streaming", "pose-free", "pose-conditioned", "ground-truth", "hybrid", "coupled"];

fn out(name: &str) -> PathBuf {
    shared().root.join("damage").join(name)
}

fn run(name: &str, source: &str, more: &[&str]) -> (ProgramOutput, PathBuf) {
    let out = out(name);
    let mut all = vec![
        "-q",
        "--geometry",
        source,
        "--set",
        "geometry.chunk_keyframes=6",
        "--set",
        "geometry.overlap_keyframes=3",
        "--set",
        "fusion.voxel_size_m=0.08",
        "--set",
        "output.images=false",
        "--set",
        "output.report=false",
    ];
    if !more.iter().any(|m| m.starts_with("--trajectory")) {
        all.extend(["--set", "input.poses=ground-truth"]);
    }
    all.extend(more);
    (run_on(&shared().sequence, &out, &all), out)
}

/// Predictions of a healthy run, made once.
fn healthy() -> PathBuf {
    static MADE: std::sync::OnceLock<PathBuf> = std::sync::OnceLock::new();
    let make = || {
        let (ran, folder) =
            run("healthy", "simulated", &["--mode", "pose-free", "--set", "output.keep_chunks=true"]);
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        folder.join("chunks")
    };
    MADE.get_or_init(make).clone()
}

/// A copy of the healthy predictions in which `damage` changed the arrays of some chunks.
fn damaged(name: &str, damage: impl Fn(usize, &str, &mut Vec<f64>)) -> String {
    let (from, into) = (healthy(), out(&format!("{name} predictions")));
    std::fs::create_dir_all(&into).unwrap();
    for chunk in 0.. {
        let stem = format!("{chunk:06}");
        let Ok(file) = File::open(from.join(format!("{stem}.npz"))) else { break };
        std::fs::copy(from.join(format!("{stem}.json")), into.join(format!("{stem}.json"))).unwrap();
        let mut arrays = Vec::new();
        for (key, array) in read_npz(file, NpzLimits::default()).unwrap() {
            let shape = array.shape.clone();
            let data = match array.data {
                NpyData::F32(v) => {
                    let mut wide: Vec<f64> = v.into_iter().map(f64::from).collect();
                    damage(chunk, &key, &mut wide);
                    NpyData::F32(wide.into_iter().map(|v| v as f32).collect())
                }
                NpyData::F64(mut v) => {
                    damage(chunk, &key, &mut v);
                    NpyData::F64(v)
                }
                other => other,
            };
            arrays.push((key, NpyArray::new(shape, data).unwrap()));
        }
        let arrays: Vec<(&str, &NpyArray)> = arrays.iter().map(|(k, a)| (k.as_str(), a)).collect();
        write_npz_arrays(File::create(into.join(format!("{stem}.npz"))).unwrap(), &arrays).unwrap();
    }
    format!("recorded:{}", into.display())
}

/// Vertices of a map, all finite, and none far outside of the room (6 m); an empty map has none.
fn vertices(run: &Path) -> usize {
    let bytes = std::fs::read(run.join("map/points.ply")).unwrap();
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(2000)]).into_owned();
    let count = header.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap();
    count.trim().parse().unwrap()
}

/// Runs every coupling on damaged predictions, which ends with `code`; what acted must be among `acted` in each that is named in `counted_by`.
fn survives((name, source): (&str, &str), code: i32, acted: &[&str], counted_by: &[&str]) {
    for mode in MODES {
        let (ran, folder) = run(&format!("{name} {mode}"), source, &["--mode", mode]);
        assert_eq!(ran.code, code, "{name}, {mode}: {}", ran.stderr);
        let result = &manifest(&folder)["result"];
        assert!(vertices(&folder) > 100, "{name}, {mode}");
        let rejections = result["placement"]["rejections"].as_object().unwrap();
        let counted = acted.iter().any(|g| rejections.contains_key(*g));
        assert!(counted || !counted_by.contains(&mode), "{name}, {mode}: {rejections:?}");
    }
}

#[test]
fn numbers_that_are_none_are_left_out_and_counted_in_every_coupling() {
    let source = damaged("nan", |chunk, key, values| {
        let n = values.len();
        if key == "depth" && chunk == 1 {
            // One view of six without a number, and infinities in another.
            values[..n / 6].fill(f64::NAN);
            values[n / 6..n / 4].fill(f64::INFINITY);
        }
        if key == "probability" && chunk == 2 {
            values[..n / 12].fill(f64::NAN);
        }
    });
    survives(("nan", &source), 0, &["view-not-finite"], &MODES);
}

#[test]
fn an_inconsistent_chunk_is_left_out_where_anything_contradicts_it() {
    let source = damaged("inconsistent", |chunk, key, values| {
        if chunk == 1 && key == "depth" {
            let n = values.len();
            values
                .iter_mut()
                .enumerate()
                .for_each(|(i, v)| *v *= 0.2 + 3.0 * ((i * 7919) % n) as f64 / n as f64);
        }
        if chunk == 1 && key == "extrinsics" {
            // Every camera somewhere else, its turn reversed.
            for (i, v) in values.iter_mut().enumerate() {
                if i % 4 == 3 {
                    *v += ((i * 37) % 11) as f64 - 5.0;
                }
            }
        }
    });
    // `pose-conditioned` divides by one scale and has no neighbour to ask: it sees centres far from their pose priors.
    let acted = ["inconsistent-chunk", "no-overlap", "scale-out-of-range", "rank-deficient"];
    survives(("inconsistent", &source), 3, &acted, &["pose-free", "hybrid", "coupled"]);
}

#[test]
fn a_unit_that_jumps_by_a_third_changes_no_metric_map() {
    let scaled = |factor: f64| {
        move |chunk: usize, key: &str, values: &mut Vec<f64>| {
            let translation = |i: usize| i % 4 == 3;
            if chunk % 2 == 1 {
                let scale = |i: usize| {
                    if key == "depth" || (key == "extrinsics" && translation(i)) { factor } else { 1.0 }
                };
                values.iter_mut().enumerate().for_each(|(i, v)| *v *= scale(i));
            }
        }
    };
    for (name, factor) in [("a third more", 1.3), ("a third less", 0.7)] {
        let source = damaged(name, scaled(factor));
        for mode in ["pose-conditioned", "ground-truth", "hybrid", "coupled"] {
            let (ran, folder) =
                run(&format!("{name} {mode}"), &source, &["--mode", mode, "--set", "eval.mode=auto"]);
            assert_eq!(ran.code, 0, "{name}, {mode}: {}", ran.stderr);
            let result = &manifest(&folder)["result"];
            let error =
                result["evaluation"]["depth"]["pixel_weighted"]["metric"]["abs_rel"].as_f64().unwrap();
            assert!(error < 0.12, "{name}, {mode}: {error}");
        }
    }
}

#[test]
fn one_frame_and_one_chunk_are_answered_by_every_coupling() {
    for mode in MODES {
        let all = ["--mode", mode, "--set", "geometry.chunk_keyframes=60"];
        let (ran, folder) = run(&format!("one chunk {mode}"), "simulated", &all);
        assert_eq!(ran.code, 0, "{mode}: {}", ran.stderr);
        assert_eq!(manifest(&folder)["result"]["placement"]["chunks"].as_array().unwrap().len(), 1);
        let one = ["--mode", mode, "--set", "keyframes.max_count=1"];
        let (ran, folder) = run(&format!("one frame {mode}"), "simulated", &one);
        // A map of one view, which says what is missing.
        assert_eq!(ran.code, 3, "{mode}: {} {}", ran.code, ran.stderr);
        assert!(folder.join("manifest.json").exists());
    }
}

#[test]
fn poses_that_fly_away_half_way_are_counted_and_do_not_take_the_coupled_map_along() {
    let truth =
        std::fs::read_to_string(shared().sequence.join("mav0/state_groundtruth_estimate0/data.csv")).unwrap();
    let rows: Vec<Vec<f64>> = truth
        .lines()
        .filter(|l| !l.starts_with('#'))
        .map(|l| l.split(',').map(|v| v.trim().parse().unwrap()).collect())
        .collect();
    let mut tum = String::new();
    for (k, row) in rows.iter().enumerate() {
        // From the middle on it accelerates away.
        let late = (k as f64 / rows.len() as f64 - 0.5).max(0.0);
        let away = 8.0 * late * late;
        let (w, x, y, z) = (row[4], row[5], row[6], row[7]);
        tum +=
            &format!("{:.9} {} {} {} {x} {y} {z} {w}\n", row[0] * 1e-9, row[1] + away, row[2] + away, row[3]);
    }
    let path = out("away.tum");
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, tum).unwrap();
    let trajectory = format!("--trajectory={}", path.display());
    for (mode, code) in [("pose-conditioned", 3), ("hybrid", 3), ("coupled", 0)] {
        let all = [trajectory.as_str(), "--mode", mode, "--set", "eval.mode=auto"];
        let (ran, folder) = run(&format!("away {mode}"), "simulated", &all);
        assert_eq!(ran.code, code, "{mode}: {}", ran.stderr);
        assert!(vertices(&folder) > 100);
        let placement = &manifest(&folder)["result"]["placement"];
        let named = placement["rejections"].as_object().is_some_and(|g| !g.is_empty());
        let off = placement["drift"]["center_rms_m"].as_f64().is_none_or(|m| m > 0.02);
        assert!(mode != "coupled" || named || off, "{placement}");
    }
}

#[test]
fn the_place_recognition_descriptor_is_selectable_and_recorded_in_the_manifest() {
    let salad =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../../crates/vidar-da3/tests/data/salad_tiny.safetensors");
    let checkpoint = format!("coupling.salad_checkpoint={salad}");
    let kept = ["--mode", "hybrid", "--set", "output.keep_chunks=true", "--set"];
    for (name, more, expected, length) in [
        ("pictures", &[&kept[..], &["coupling.place_recognition=image"]].concat(), "image", None),
        ("salad", &[&kept[..], &[checkpoint.as_str()]].concat(), "salad", Some(5 + 6 * 4)),
    ] {
        let (ran, folder) = run(&format!("places {name}"), "simulated", more);
        assert_eq!(ran.code, 0, "{name}: {}", ran.stderr);
        assert_eq!(manifest(&folder)["result"]["place_recognition"], expected);
        let arrays =
            read_npz(File::open(folder.join("chunks/000000.npz")).unwrap(), NpzLimits::default()).unwrap();
        assert_eq!(arrays.get("place").map(|a| a.shape[1]), length, "{name}");
    }
    let (ran, _) = run("places model", "simulated", &["--set", "coupling.place_recognition=model"]);
    ran.ends_with(2).says(&["is no network", "coupling.place_recognition"]);
    let (ran, _) = run("places nothing", "simulated", &["--set", "coupling.place_recognition=salad"]);
    ran.ends_with(2).says(&["coupling.salad_checkpoint"]);
    let wrong =
        format!("coupling.salad_checkpoint={}", shared().sequence.join("mav0/cam0/sensor.yaml").display());
    let (ran, _) = run("places wrong", "simulated", &["--set", wrong.as_str()]);
    ran.ends_with(2).says(&["is not a SALAD checkpoint", "salad_to_safetensors.py"]);
}
