//! Couplings, recorded predictions and interrupted runs: the real program on a simulated network.

use crate::support::{Ran, files_under, run_command, run_on, shared};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use vidar::export_formats::official::{NpyArray, NpyData, NpzLimits, read_npz, write_npz_arrays};

/// Short chunks, so that two and a half seconds have several; poses are ground truth.
const SHORT: [&str; 11] = [
    "-q",
    "--geometry",
    "simulated",
    "--set",
    "geometry.chunk_keyframes=6",
    "--set",
    "geometry.overlap_keyframes=3",
    "--set",
    "input.poses=ground-truth",
    "--set",
    "fusion.voxel_size_m=0.05",
];

fn out(name: &str) -> PathBuf {
    shared().root.join("coupling").join(name)
}

fn simulated(name: &str, more: &[&str]) -> (Ran, PathBuf) {
    let out = out(name);
    let all: Vec<&str> = SHORT.iter().chain(more).copied().collect();
    (run_on(&shared().sequence, &out, &all), out)
}

fn recorded(name: &str, folder: &Path, more: &[&str]) -> (Ran, PathBuf) {
    let source = format!("recorded:{}", folder.display());
    let out = out(name);
    let mut all = SHORT.to_vec();
    all[2] = &source;
    all.extend(more);
    (run_on(&shared().sequence, &out, &all), out)
}

fn manifest(run: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(run.join("manifest.json")).unwrap()).unwrap()
}

fn mesh(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("map/mesh.ply")).unwrap()
}

/// Vertices and triangles, without the comments that name the source.
fn surface(run: &Path) -> Vec<u8> {
    let mesh = mesh(run);
    let end = b"end_header\n";
    let at = mesh.windows(end.len()).position(|w| w == end).unwrap();
    let counts = String::from_utf8_lossy(&mesh[..at]);
    let counts: Vec<&str> = counts.lines().filter(|l| l.starts_with("element")).collect();
    [counts.join("\n").as_bytes(), &mesh[at..]].concat()
}

#[test]
fn every_coupling_makes_a_map_and_says_what_it_is() {
    let mut errors = Vec::new();
    for (mode, is_metric) in [
        ("da3-streaming", false),
        ("pose-free", false),
        ("pose-conditioned", true),
        ("ground-truth", true),
        ("hybrid", true),
        ("coupled", true),
    ] {
        let (ran, run) = simulated(mode, &["--mode", mode, "--set", "eval.mode=auto"]);
        assert!([0, 3].contains(&ran.code), "{mode}: {}", ran.stderr);
        let result = &manifest(&run)["result"];
        assert_eq!(
            (result["coupling"].as_str(), result["is_metric"].as_bool()),
            (Some(mode), Some(is_metric))
        );
        let chunks = result["placement"]["chunks"].as_array().unwrap();
        assert!(chunks.len() >= 3, "{mode}: {chunks:?}");
        let header = String::from_utf8_lossy(&mesh(&run)[..400]).into_owned();
        let unit = if is_metric { "unit: metre" } else { "unit: arbitrary" };
        assert!(header.contains(unit) && header.contains(&format!("coupling: {mode}")), "{header}");
        assert!(!run.join("chunks").exists(), "{mode}: what is done with is removed");
        errors.push((
            mode,
            result["judgement"]["depth"]["pixel_weighted"]["metric"]["abs_rel"].as_f64().unwrap(),
        ));
    }
    // The truth is at hand: metric couplings tell metres, the others cannot.
    for (mode, error) in &errors {
        let is_metric = !["da3-streaming", "pose-free"].contains(mode);
        assert_eq!(*error < 0.1, is_metric, "{errors:?}");
    }
}

#[test]
fn stereo_is_no_pose_free_model() {
    let ran = run_on(&shared().sequence, &out("stereo hybrid"), &["-q", "--mode", "hybrid"]);
    ran.ends_with(2).says(&["stereo is given them", "da3-small", "--mode pose-conditioned"]);
    let ran = run_on(&shared().sequence, &out("no mode"), &["-q", "--mode", "magic"]);
    ran.ends_with(2).says(&["coupling.mode", "magic"]);
}

#[test]
fn what_a_run_kept_is_read_back_as_a_recording_with_the_same_result() {
    let (ran, first) = simulated("kept", &["--mode", "hybrid", "--set", "output.keep_chunks=true"]);
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    let chunks = first.join("chunks");
    assert!(files_under(&chunks).iter().any(|f| f == "000000.npz"));
    let (ran, again) = recorded("replayed", &chunks, &["--mode", "hybrid"]);
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    assert!(surface(&first) == surface(&again));

    // The official API's files carry no times: the chunks' sizes tell which frames they are of.
    let plain = out("plain npz");
    std::fs::create_dir_all(&plain).unwrap();
    for (k, name) in files_under(&chunks).iter().filter(|f| f.ends_with("npz")).enumerate() {
        // A name that is in order only when its number is read as one.
        std::fs::copy(chunks.join(name), plain.join(format!("chunk_{}.npz", k + 8))).unwrap();
    }
    let every = ["--mode", "hybrid", "--set", "keyframes.min_translation_m=1e-6"];
    let (ran, kept) = simulated("kept of all", &[&every[..], &["--set", "output.keep_chunks=true"]].concat());
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    if files_under(&kept.join("chunks")).len() == files_under(&chunks).len() {
        let (ran, by_order) = recorded("by order", &plain, &["--mode", "hybrid"]);
        assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
        assert!(surface(&first) == surface(&by_order));
    }
}

/// Writes what DA3-Streaming leaves: a file per frame and a line of 16 numbers per pose.
fn streaming_folder(chunks: &Path, into: &Path) {
    std::fs::create_dir_all(into.join("results_output")).unwrap();
    let file = std::fs::File::open(chunks.join("000000.npz")).unwrap();
    let arrays = read_npz(file, NpzLimits::default()).unwrap();
    let floats = |name: &str| match &arrays[name].data {
        NpyData::F32(v) => v.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>(),
        NpyData::F64(v) => v.clone(),
        other => panic!("{name}: {other:?}"),
    };
    let (n, h, w) = (arrays["depth"].shape[0], arrays["depth"].shape[1], arrays["depth"].shape[2]);
    let (depth, probability) = (floats("depth"), floats("probability"));
    let (extrinsics, intrinsics) = (floats("extrinsics"), floats("intrinsics"));
    let mut poses = String::new();
    for i in 0..n {
        let image = |v: &[f64]| v[i * h * w..(i + 1) * h * w].iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let conf = image(&probability).iter().map(|p| 1.0 / (1.0 - p.min(0.999))).collect();
        let array = |shape: Vec<usize>, v: Vec<f32>| NpyArray::new(shape, NpyData::F32(v)).unwrap();
        let k = intrinsics[i * 9..i * 9 + 9].iter().map(|v| *v as f32).collect();
        let (depth, conf, k) =
            (array(vec![h, w], image(&depth)), array(vec![h, w], conf), array(vec![3, 3], k));
        let path = into.join(format!("results_output/frame_{i}.npz"));
        let file = std::fs::File::create(path).unwrap();
        write_npz_arrays(file, &[("depth", &depth), ("conf", &conf), ("intrinsics", &k)]).unwrap();
        // world_from_camera: the rotation transposed, the centre −Rᵀt.
        let at = |r: usize, c: usize| extrinsics[i * 12 + r * 4 + c];
        let mut pose = [[0.0, 0.0, 0.0, 1.0]; 4];
        for r in 0..3 {
            let center = -(0..3).map(|k| at(k, r) * at(k, 3)).sum::<f64>();
            pose[r] = [at(0, r), at(1, r), at(2, r), center];
        }
        let row: Vec<String> = pose.as_flattened().iter().map(f64::to_string).collect();
        poses += &format!("{}\n", row.join(" "));
    }
    std::fs::write(into.join("camera_poses.txt"), poses).unwrap();
}

#[test]
fn the_folder_of_da3_streaming_is_read() {
    // One chunk of every image, in one gauge, as the official program leaves it.
    let every = [
        "--set",
        "keyframes.min_translation_m=1e-9",
        "--set",
        "geometry.chunk_keyframes=60",
        "--mode",
        "hybrid",
    ];
    let (ran, first) = simulated("one chunk", &[&every[..], &["--set", "output.keep_chunks=true"]].concat());
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    let folder = out("official streaming");
    streaming_folder(&first.join("chunks"), &folder);
    let judged = ["--mode", "hybrid", "--set", "geometry.chunk_keyframes=60", "--set", "eval.mode=auto"];
    let (ran, run) = recorded("from streaming", &folder, &judged);
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    let result = &manifest(&run)["result"];
    let abs_rel = result["judgement"]["depth"]["pixel_weighted"]["metric"]["abs_rel"].as_f64().unwrap();
    assert!(abs_rel < 0.1, "{result}");
}

#[test]
fn recordings_that_do_not_fit_are_refused_with_their_reason() {
    let (ran, _) = recorded("r1", Path::new("/no/such/folder"), &[]);
    ran.ends_with(4).says(&["E0401", "/no/such/folder"]);
    let empty = out("empty recording");
    std::fs::create_dir_all(&empty).unwrap();
    let (ran, _) = recorded("r2", &empty, &[]);
    ran.ends_with(1).says(&["E0210", "it holds no chunks"]);
    std::fs::write(empty.join("000000.npz"), b"PK\x03\x04 cut off").unwrap();
    let (ran, _) = recorded("r3", &empty, &[]);
    ran.ends_with(1).says(&["000000.npz"]);
    std::fs::write(
        empty.join("000000.json"),
        br#"{"schema":"vidar.chunk/9","id":0,"frame":"model-native","frames":[],"times_ns":[]}"#,
    )
    .unwrap();
    let (ran, _) = recorded("r4", &empty, &[]);
    ran.ends_with(1).says(&["E0210", "vidar.chunk/9"]);
    std::fs::write(
        empty.join("000000.json"),
        br#"{"schema":"vidar.chunk/1","id":0,"frame":"model-native","frames":[3],"times_ns":[17]}"#,
    )
    .unwrap();
    let (ran, _) = recorded("r5", &empty, &[]);
    ran.ends_with(1).says(&["E0210", "17 ns"]);
}

#[test]
fn a_killed_run_goes_on_and_ends_with_the_same_bits() {
    let (ran, whole) = simulated("uninterrupted", &[]);
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    for chunk in [0, 2] {
        let out = out(&format!("killed after {chunk}"));
        let mut child = run_command(&shared().sequence, &out, &SHORT).spawn().unwrap();
        let written = out.join(format!("chunks/{chunk:06}.json"));
        let clock = Instant::now();
        while !written.exists()
            && child.try_wait().unwrap().is_none()
            && clock.elapsed() < Duration::from_secs(60)
        {
            std::thread::sleep(Duration::from_millis(1));
        }
        // SIGKILL: nothing can be tidied up.
        let _ = child.kill();
        child.wait().unwrap();
        let ran = run_on(&shared().sequence, &out, &[&SHORT[..], &["--resume"]].concat());
        assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
        assert!(mesh(&whole) == mesh(&out), "killed after chunk {chunk}");
        assert_eq!(manifest(&whole)["result"]["placement"], manifest(&out)["result"]["placement"]);
    }
    // Other settings are no reason to go on from the old numbers.
    let out = out("killed after 0");
    let mut other = SHORT.to_vec();
    other[4] = "geometry.chunk_keyframes=5";
    let ran = run_on(&shared().sequence, &out, &[&other[..], &["--resume"]].concat());
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    assert!(mesh(&whole) != mesh(&out));
}

#[test]
fn poses_are_not_needed_where_no_metres_are_asked_for() {
    let (ran, run) = simulated("unposed", &["--mode", "pose-free", "--set", "input.poses=external"]);
    assert!([0, 3].contains(&ran.code), "{}", ran.stderr);
    let manifest = manifest(&run);
    assert!(manifest["poses"].is_null() && manifest["result"]["is_metric"] == false, "{manifest}");
    assert!(!run.join("trajectory/anchor_camera.tum").exists());
    assert!(run.join("trajectory/keyframes_camera.tum").exists());
    let (ran, _) = simulated("unposed hybrid", &["--mode", "hybrid", "--set", "input.poses=external"]);
    ran.ends_with(1).says(&["E0202"]);
}
