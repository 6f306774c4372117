//! Every setting has an effect: each one of the dense pipeline changes a stated part of what a run leaves, and how it ends is stated.

use crate::support::{ProgramOutput, files_under, run_command, shared, vidar};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock};

/// Additional settings that are needed for a setting to have an effect.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum ExtraSettings {
    Nothing,
    /// The map is evaluated.
    Evaluated,
    /// It is evaluated, and a coarse surface lets the similarity be refused.
    Refused,
    /// The mesh is written as GLB too.
    Pictures,
    /// The poses come from a trajectory of low rate, which is evaluated against ground truth.
    Odometry,
    /// Chunks are short.
    Chunked,
    /// A simulated network in short chunks.
    Simulated,
    /// The built-in network.
    Learned,
    /// Stereo, completed.
    Completed,
    /// No poses are known beforehand.
    Unposed,
    /// Voxels are so small that the map is large.
    Fine,
    /// Only turning makes a keyframe.
    Turning,
    /// Only moving makes a keyframe.
    Moving,
}

impl ExtraSettings {
    fn arguments(self) -> Vec<String> {
        let settings: &[&str] = match self {
            Self::Nothing => &[],
            Self::Evaluated => &["eval.mode=auto"],
            Self::Odometry => &["eval.mode=auto", "input.poses=external"],
            Self::Refused => &[
                "eval.mode=auto",
                "eval.surface.scale_bounds.min=0.9999999",
                "eval.surface.scale_bounds.max=1.0000001",
            ],
            Self::Pictures => &["output.mesh_glb=true"],
            Self::Fine => &["fusion.voxel_size_m=0.01"],
            Self::Chunked => &["geometry.chunk_keyframes=3"],
            Self::Simulated => {
                &["geometry.source=simulated", "geometry.chunk_keyframes=4", "geometry.overlap_keyframes=2"]
            }
            Self::Learned => &["geometry.source=da3-nano"],
            Self::Completed => &["geometry.source=auto"],
            Self::Unposed => &[
                "geometry.source=simulated",
                "coupling.mode=pose-free",
                "input.poses=external",
                "keyframes.max_count=4",
            ],
            Self::Turning => &["keyframes.min_translation_m=100.0"],
            Self::Moving => &["keyframes.min_rotation_deg=180.0"],
        };
        let set = settings.iter().flat_map(|s| ["--set".to_owned(), (*s).to_owned()]);
        let trajectory: Vec<String> = match self {
            Self::Odometry => {
                vec!["--trajectory".into(), sparse_truth(), "--trajectory-body".into(), "imu".into()]
            }
            _ => Vec::new(),
        };
        set.chain(trajectory).collect()
    }
}

use ExtraSettings::{
    Chunked, Completed, Evaluated, Fine, Learned, Moving, Nothing, Odometry, Pictures, Refused, Simulated,
    Turning, Unposed,
};

/// Ground truth at 10 Hz, 2 cm off on the way: a trajectory that must be interpolated and differs from ground truth.
fn sparse_truth() -> String {
    static FILE: OnceLock<String> = OnceLock::new();
    FILE.get_or_init(|| {
        let csv = shared().sequence.join("mav0/state_groundtruth_estimate0/data.csv");
        let path = shared().root.join("sparse.tum");
        let text = std::fs::read_to_string(csv).unwrap();
        let rows = text.lines().filter(|l| !l.starts_with('#')).step_by(20).enumerate();
        let lines: Vec<String> = rows
            .map(|(i, row)| {
                let v: Vec<f64> = row.split(',').map(|n| n.parse().unwrap()).collect();
                let x = v[1] + 0.02 * (i as f64).sin();
                format!("{:.9} {x} {} {} {} {} {} {}", v[0] * 1e-9, v[2], v[3], v[5], v[6], v[7], v[4])
            })
            .collect();
        std::fs::write(&path, lines.join("\n")).unwrap();
        path.to_str().unwrap().to_owned()
    })
    .clone()
}

/// How a run ends, with the code of its warning or error.
#[derive(Clone, Copy, Debug)]
enum Ends {
    /// Status 0.
    Well,
    /// Status 3.
    Degraded(&'static str),
    /// Status 1.
    Denied(&'static str),
}

/// What becomes of a file that a run leaves.
#[derive(Clone, Copy, Debug)]
enum Effect {
    Changes(&'static str),
    Adds(&'static str),
    Removes(&'static str),
}

use Effect::{Adds, Changes, Removes};
use Ends::{Degraded, Denied, Well};

/// Every setting of the dense pipeline, another value for it, the additional settings that it needs, how the run ends, and a file that
/// shows the effect.
const SETTINGS: &[(&str, &str, ExtraSettings, Ends, Effect)] = &[
    ("align.max_center_rms_m", "1e-12", Simulated, Denied("chunk-not-placed"), Removes("map/mesh.ply")),
    ("budget.realtime", "true", Nothing, Well, Adds("budget.json")),
    ("budget.seconds", "0.01", Nothing, Well, Adds("budget.json")),
    ("coupling.mode", "hybrid", Simulated, Well, Changes("trajectory/keyframes_camera.tum")),
    ("coupling.landmarks", "none", Learned, Well, Changes("map/mesh.ply")),
    ("eval.mode", "auto", Nothing, Well, Changes("eval/metrics.json")),
    ("eval.surface.crop_margin_m", "0.1", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.on_rejection", "refine_rigid", Refused, Well, Changes("eval/metrics.json")),
    ("eval.surface.thresholds_m", "[0.07]", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.voxel_size_m", "0.2", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.icp.keep_ratio", "0.5", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.icp.max_iterations", "1", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.icp.max_points", "100", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.icp.tolerance_m", "0.1", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.scale_bounds.max", "1.000001", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.surface.scale_bounds.min", "0.999999", Evaluated, Well, Changes("eval/metrics.json")),
    ("eval.trajectory.coverage_gap_ms", "1.0", Odometry, Well, Changes("eval/metrics.json")),
    ("eval.trajectory.max_time_difference_ms", "0.000001", Odometry, Well, Changes("eval/metrics.json")),
    ("eval.trajectory.rpe_distance_m", "0.2", Odometry, Well, Changes("eval/metrics.json")),
    ("eval.trajectory.rpe_frames", "2", Odometry, Well, Changes("eval/metrics.json")),
    ("fusion.carve_range_m", "0.5", Nothing, Well, Changes("map/coverage.json")),
    ("fusion.max_depth_m", "2.0", Nothing, Degraded("map-almost-empty"), Changes("map/mesh.ply")),
    ("fusion.max_incidence_deg", "40.0", Nothing, Well, Changes("map/mesh.ply")),
    (
        "fusion.memory_budget_bytes",
        "1500000",
        Nothing,
        Degraded("fusion-memory-budget"),
        Changes("map/mesh.ply"),
    ),
    ("fusion.min_component_triangles", "400", Nothing, Well, Changes("map/mesh.ply")),
    ("fusion.min_confidence", "0.9", Nothing, Well, Changes("map/mesh.ply")),
    ("fusion.min_observations", "5", Nothing, Well, Changes("map/mesh.ply")),
    ("fusion.truncation_voxels", "6.0", Nothing, Well, Changes("map/mesh.ply")),
    ("fusion.voxel_size_m", "0.06", Nothing, Well, Changes("map/mesh.ply")),
    ("geometry.chunk_keyframes", "3", Nothing, Well, Changes("map/mesh.ply")),
    ("geometry.context_keyframes", "2", Chunked, Well, Changes("map/mesh.ply")),
    ("geometry.overlap_keyframes", "1", Simulated, Well, Changes("map/mesh.ply")),
    ("geometry.fill_network", "da3-nano", Completed, Well, Changes("map/mesh.ply")),
    ("geometry.max_width_px", "80", Nothing, Well, Changes("views.json")),
    ("input.end_secs", "1.5", Nothing, Well, Changes("trajectory/keyframes_camera.tum")),
    ("input.max_pose_gap_secs", "0.05", Odometry, Well, Changes("trajectory/keyframes_camera.tum")),
    ("input.start_secs", "1.0", Nothing, Well, Changes("trajectory/keyframes_camera.tum")),
    ("input.stride", "3", Nothing, Well, Changes("trajectory/keyframes_camera.tum")),
    ("keyframes.max_count", "4", Nothing, Well, Changes("trajectory/keyframes_camera.tum")),
    ("keyframes.unposed_interval_secs", "1.0", Unposed, Well, Changes("trajectory/keyframes_camera.tum")),
    ("keyframes.min_rotation_deg", "25.0", Turning, Well, Changes("trajectory/keyframes_camera.tum")),
    ("keyframes.min_translation_m", "0.5", Moving, Well, Changes("trajectory/keyframes_camera.tum")),
    ("output.keep_chunks", "true", Nothing, Well, Adds("chunks/000000.npz")),
    ("limits.memory_bytes", "165000000", Fine, Degraded("fusion-memory-budget"), Changes("map/mesh.ply")),
    ("output.depth_png", "false", Nothing, Well, Removes("depth/depth.json")),
    ("output.depth_units_per_metre", "500.0", Nothing, Well, Changes("depth/depth.json")),
    ("output.images", "false", Nothing, Well, Removes("images/000000.png")),
    ("output.mesh_glb", "false", Pictures, Well, Removes("map/mesh.glb")),
    ("output.report", "true", Nothing, Well, Adds("report.html")),
];

/// Settings that are shown to matter elsewhere, with the place.
const ELSEWHERE: &[(&str, &str)] = &[
    ("remote.model", "it needs a worker; link.rs has some"),
    ("remote.images", "it needs a worker; link.rs has some"),
    ("remote.depth", "it needs a worker; link.rs has some"),
    ("link.connect", "it needs a worker; link.rs has some"),
    ("link.listen", "it needs a worker; link.rs has some"),
    ("link.config", "it needs certificates; vidar-link's test tls has some"),
    ("link.publish", "it needs somebody who listens; link.rs does"),
    ("link.timeout_secs", "it needs a worker; link.rs has one that hangs"),
    ("link.patience_secs", "it needs no worker; link.rs has none"),
    ("budget.speed", "it needs a limit; budget.rs has one"),
    ("input.camera", "there is one camera here; faults.rs asks for another"),
    ("output.live_map", "it leaves nothing; coupling.rs watches it grow"),
    ("output.live_map_wait_secs", "it leaves nothing; the tests of the engine watch what it shows"),
    ("coupling.loops", "they need a revisit; coupling.rs has one"),
    ("coupling.loop_chunks", "it needs a revisit; coupling.rs has one"),
    ("coupling.place_recognition", "damage.rs has a run of each"),
    ("coupling.salad_checkpoint", "damage.rs has a small one"),
    ("input.imu_scale_std", "trust.rs compares what is stated with it"),
    ("input.calibration_scale_std", "trust.rs compares what is stated with it"),
    ("input.masks", "masks.rs masks a part of every image"),
    ("input.map", "map.rs finds a recording in the map of another one"),
    ("input.poses", "verbs.rs runs with another trajectory"),
    ("eval.trajectory.low_coverage_ratio", "it decides a warning; vidar-eval's tests"),
    ("geometry.source", "one source needs no weights"),
    ("align.", "the aligner's own tests"),
    ("stereo.", "the model's own tests"),
    ("odometry.", "the odometry's own tests"),
    ("model.", "the model's own tests"),
];

/// What a run left.
struct Left {
    exit: i32,
    /// Everything but what the clock or the command line decides.
    files: BTreeMap<String, Vec<u8>>,
    /// The error stream and the log.
    said: String,
}

impl Left {
    fn ends(&self, ends: Ends) -> bool {
        match ends {
            Well => self.exit == 0,
            Degraded(code) => self.exit == 3 && self.said.contains(code),
            Denied(code) => self.exit == 1 && self.said.contains(code),
        }
    }

    fn shows(&self, effect: Effect, base: &Self) -> bool {
        let (Changes(name) | Adds(name) | Removes(name)) = effect;
        match (effect, base.files.get(name), self.files.get(name)) {
            (Changes(_), Some(before), Some(now)) => before != now,
            (Adds(_), None, Some(_)) | (Removes(_), Some(_), None) => true,
            _ => false,
        }
    }
}

fn files(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let clocked = ["manifest.json", "log.jsonl", "README.txt", "config.resolved.toml", "report.html"];
    files_under(out)
        .into_iter()
        .map(|name| {
            let keep = !clocked.contains(&name.as_str());
            let bytes = if keep { std::fs::read(out.join(&name)).unwrap() } else { Vec::new() };
            (name, bytes)
        })
        .collect()
}

fn run(name: &str, arguments: &[String]) -> Left {
    let out: PathBuf = shared().root.join("keys").join(name);
    let small = ["-q", "--threads", "1", "--set", "input.stride=2"];
    let mut command = run_command(&shared().sequence, &out, &small);
    let ran: ProgramOutput = command.args(arguments).output().unwrap().into();
    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap_or_default();
    let left = Left { exit: ran.code, files: files(&out), said: ran.stderr + &log };
    std::fs::remove_dir_all(&out).unwrap_or(());
    left
}

#[test]
fn every_setting_of_the_dense_pipeline_is_in_the_list() {
    let json = vidar(&["config", "show", "--json"]).ends_with(0).json();
    for row in json["settings"].as_array().unwrap() {
        let key = row["key"].as_str().unwrap();
        let listed = SETTINGS.iter().any(|(k, ..)| *k == key);
        let elsewhere = ELSEWHERE.iter().any(|(k, _)| *k == key || (k.ends_with('.') && key.starts_with(k)));
        assert!(
            listed || elsewhere,
            "{key}: give it another value in SETTINGS, so that its effect is tested"
        );
    }
}

#[test]
fn every_setting_changes_what_a_run_leaves() {
    let all = [
        Fine, Nothing, Evaluated, Refused, Pictures, Odometry, Chunked, Simulated, Learned, Completed,
        Unposed, Turning, Moving,
    ];
    let bases: BTreeMap<ExtraSettings, Left> = all
        .into_iter()
        .map(|beside| (beside, run(&format!("base {beside:?}"), &beside.arguments())))
        .collect();
    for (beside, base) in &bases {
        assert!(base.ends(Well), "{beside:?}: {} {}", base.exit, base.said);
    }
    let (next, wrong) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some((key, value, beside, ends, effect)) =
                    SETTINGS.get(next.fetch_add(1, Ordering::Relaxed))
                {
                    let setting = format!("{key}={value}");
                    let with = [beside.arguments(), vec!["--set".into(), setting.clone()]].concat();
                    let left = run(key, &with);
                    if !left.ends(*ends) {
                        let told = format!("{setting} ends with {} and not {ends:?}", left.exit);
                        wrong.lock().unwrap().push(told);
                    }
                    if !left.shows(*effect, &bases[beside]) {
                        wrong.lock().unwrap().push(format!("{setting} has not the effect {effect:?}"));
                    }
                }
            });
        }
    });
    assert!(wrong.lock().unwrap().is_empty(), "{:#?}", wrong.lock().unwrap());
}
