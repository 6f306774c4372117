//! Couplings, recorded predictions and interrupted runs: the real program on a simulated network.

use crate::support::{ProgramOutput, files_under, manifest, run_command, run_on, shared};
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

fn with_geometry(source: &str, name: &str, more: &[&str]) -> (ProgramOutput, PathBuf) {
    let out = out(name);
    let mut all = SHORT.to_vec();
    all[2] = source;
    all.extend(more);
    (run_on(&shared().sequence, &out, &all), out)
}

fn simulated(name: &str, more: &[&str]) -> (ProgramOutput, PathBuf) {
    with_geometry("simulated", name, more)
}

fn recorded(name: &str, folder: &Path, more: &[&str]) -> (ProgramOutput, PathBuf) {
    with_geometry(&format!("recorded:{}", folder.display()), name, more)
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
        assert_eq!(ran.code, 0, "{mode}: {}", ran.stderr);
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
            result["evaluation"]["depth"]["pixel_weighted"]["metric"]["abs_rel"].as_f64().unwrap(),
        ));
    }
    // The truth is at hand: metric couplings tell metres, the others cannot.
    for (mode, error) in &errors {
        let is_metric = !["da3-streaming", "pose-free"].contains(mode);
        assert_eq!(*error < 0.1, is_metric, "{errors:?}");
    }
}

#[test]
fn what_stereo_is_sure_of_straightens_a_small_networks_depth_and_leaves_a_good_ones() {
    let run = |name: &str, source: &str, landmarks: &str| {
        let landmarks = format!("coupling.landmarks={landmarks}");
        let (ran, out) = with_geometry(source, name, &["--set", &landmarks, "--set", "eval.mode=auto"]);
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        out
    };
    let error = |run: &Path| {
        let depth = &manifest(run)["result"]["evaluation"]["depth"]["pixel_weighted"];
        depth["metric"]["abs_rel"].as_f64().unwrap()
    };
    // Poses are true and come without landmarks.
    let held = error(&run("small held", "da3-nano", "both"));
    let free = error(&run("small free", "da3-nano", "odometry"));
    assert!(held < 0.8 * free, "{held} {free}");
    let (held, free) = (run("good held", "simulated", "both"), run("good free", "simulated", "odometry"));
    assert!(mesh(&held) == mesh(&free), "{} {}", error(&held), error(&free));
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
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let chunks = first.join("chunks");
    assert!(files_under(&chunks).iter().any(|f| f == "000000.npz"));
    let (ran, again) = recorded("replayed", &chunks, &["--mode", "hybrid"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
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
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    assert_eq!(files_under(&kept.join("chunks")).len(), files_under(&chunks).len());
    let (ran, by_order) = recorded("by order", &plain, &["--mode", "hybrid"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    assert!(surface(&first) == surface(&by_order));
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
        // DA3-Streaming takes 1 off the head's confidence.
        let conf = image(&probability).iter().map(|p| 1.0 / (1.0 - p.min(0.999)) - 1.0).collect();
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
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let folder = out("official streaming");
    streaming_folder(&first.join("chunks"), &folder);
    let evaluated = ["--mode", "hybrid", "--set", "geometry.chunk_keyframes=60", "--set", "eval.mode=auto"];
    let (ran, run) = recorded("from streaming", &folder, &evaluated);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let result = &manifest(&run)["result"];
    let abs_rel = result["evaluation"]["depth"]["pixel_weighted"]["metric"]["abs_rel"].as_f64().unwrap();
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
    assert_eq!(ran.code, 0, "{}", ran.stderr);
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
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        assert!(mesh(&whole) == mesh(&out), "killed after chunk {chunk}");
        assert_eq!(manifest(&whole)["result"]["placement"], manifest(&out)["result"]["placement"]);
    }
    // Other settings are no reason to go on from the old numbers.
    let out = out("killed after 0");
    let mut other = SHORT.to_vec();
    other[4] = "geometry.chunk_keyframes=5";
    let ran = run_on(&shared().sequence, &out, &[&other[..], &["--resume"]].concat());
    ran.ends_with(2).says(&["E0107", "geometry.chunk_keyframes = 5"]);
    assert!(mesh(&whole) == mesh(&out));
}

#[test]
fn the_map_grows_while_chunks_come_and_ends_as_it_would_have() {
    let (ran, plain) = simulated("not watched", &["--mode", "coupled"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let (ran, watched) = simulated("watched", &["--mode", "coupled", "--set", "output.live_map=true"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let log = std::fs::read_to_string(watched.join("log.jsonl")).unwrap();
    let grown: Vec<u64> = log
        .lines()
        .filter_map(|l| serde_json::from_str::<Value>(l).ok())
        .filter(|e| e["event"] == "surface-changed" && e["is_final"] == false)
        .map(|e| e["triangles"].as_u64().unwrap())
        .collect();
    assert!(grown.len() >= 3 && grown[0] > 1000 && grown.last() > grown.first(), "{grown:?}");
    assert!(surface(&plain) == surface(&watched));
    assert!(!watched.join("map/so_far.ply").exists() && !watched.join("volumes").exists());
}

#[test]
fn a_revisit_is_found_measured_and_reported() {
    // More than one lap round a room: the last keyframes see what the first ones saw.
    let sequence = shared().root.join("round and round");
    let world = shared().root.join("back.toml");
    let settings = "flight = \"orbit\"\nduration_secs = 24.0\ncamera_rate_hz = 3.0\nwidth = 160\nheight = 104\n\
        blur_samples = 1\nexposure_secs = 0.0\ndepth = false\nscan_spacing_m = 0.1\n";
    std::fs::write(&world, settings).unwrap();
    let (sequence_arg, world_arg) = (sequence.to_str().unwrap(), world.to_str().unwrap());
    crate::support::vidar(&["synth", sequence_arg, "--world-config", world_arg, "-q"]).ends_with(0);
    let mut found = Vec::new();
    for more in [
        &["--set", "coupling.loop_chunks=true"][..],
        &["--set", "coupling.loops=false"],
        &["--set", "align.loops.min_similarity=1.0"],
    ] {
        let out = out(&format!("loops {}", found.len()));
        let settings = [&SHORT[..], more, &["--set", "align.loops.min_similarity=0.7"]].concat();
        let settings = if more.len() == 2 && more[1].contains("similarity") {
            [&SHORT[..], more].concat()
        } else {
            settings
        };
        let ran = run_on(&sequence, &out, &settings);
        assert_eq!(ran.code, 0, "{}", ran.stderr);
        let loops = manifest(&out)["result"]["placement"]["loops"].as_array().unwrap().clone();
        let accepted = loops.iter().filter(|l| l["rejection"].is_null()).count();
        found.push((loops.len(), accepted));
    }
    assert!(found[0].1 > 0, "a loop chunk ties the two visits: {found:?}");
    assert_eq!(found[1], (0, 0), "none was looked for: {found:?}");
    assert_eq!(found[2], (0, 0), "nothing looks exactly alike: {found:?}");
}

#[test]
fn poses_are_not_needed_where_no_metres_are_asked_for() {
    let (ran, run) = simulated("unposed", &["--mode", "pose-free", "--set", "input.poses=external"]);
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let manifest = manifest(&run);
    assert!(manifest["poses"].is_null() && manifest["result"]["is_metric"] == false, "{manifest}");
    assert!(!run.join("trajectory/metric_camera.tum").exists());
    assert!(run.join("trajectory/keyframes_camera.tum").exists());
    let (ran, _) = simulated("unposed hybrid", &["--mode", "hybrid", "--set", "input.poses=external"]);
    ran.ends_with(1).says(&["E0202"]);
}

#[test]
fn a_memory_budget_is_planned_with_and_refused_when_nothing_fits() {
    let plan = |size: &str| {
        let more = ["--memory-budget", size, "--dry-run", "--json"];
        let all: Vec<&str> = SHORT.iter().chain(&more).copied().collect();
        run_on(&shared().sequence, &out("planned"), &all)
    };
    let json = plan("200MB").ends_with(0).json();
    // (200 MB − 96 MiB − a chunk) · 2/5
    let map = json["plan"]["memory_of_the_map"].as_str().unwrap();
    assert!(map.contains("MiB") && !map.contains("2.00 GiB"), "{map}");
    let json = plan("64GiB").ends_with(0).json();
    assert_eq!(json["plan"]["memory_of_the_map"], "at most 2.00 GiB");
    plan("100MB").ends_with(2).says(&["limits.memory_bytes", "chunk of", "lower geometry.chunk_keyframes"]);
    plan("much").ends_with(2).says(&["--memory-budget", "4GiB"]);
}
