//! Every setting has an effect: each one of the dense pipeline changes the result of a run.

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

/// Every setting of the dense pipeline, another value for it, and the additional settings that it needs.
const SETTINGS: &[(&str, &str, ExtraSettings)] = &[
    ("align.max_center_rms_m", "1e-12", Simulated),
    ("budget.realtime", "true", Nothing),
    ("budget.seconds", "0.01", Nothing),
    ("coupling.mode", "hybrid", Simulated),
    ("coupling.landmarks", "none", Learned),
    ("eval.mode", "auto", Nothing),
    ("eval.surface.crop_margin_m", "0.1", Evaluated),
    ("eval.surface.on_rejection", "refine_rigid", Refused),
    ("eval.surface.thresholds_m", "[0.07]", Evaluated),
    ("eval.surface.voxel_size_m", "0.2", Evaluated),
    ("eval.surface.icp.keep_ratio", "0.5", Evaluated),
    ("eval.surface.icp.max_iterations", "1", Evaluated),
    ("eval.surface.icp.max_points", "100", Evaluated),
    ("eval.surface.icp.tolerance_m", "0.1", Evaluated),
    ("eval.surface.scale_bounds.max", "1.000001", Evaluated),
    ("eval.surface.scale_bounds.min", "0.999999", Evaluated),
    ("eval.trajectory.coverage_gap_ms", "1.0", Odometry),
    ("eval.trajectory.max_time_difference_ms", "0.000001", Odometry),
    ("eval.trajectory.rpe_distance_m", "0.2", Odometry),
    ("eval.trajectory.rpe_frames", "2", Odometry),
    ("fusion.carve_range_m", "0.5", Nothing),
    ("fusion.max_depth_m", "2.0", Nothing),
    ("fusion.max_incidence_deg", "40.0", Nothing),
    ("fusion.memory_budget_bytes", "1500000", Nothing),
    ("fusion.min_component_triangles", "400", Nothing),
    ("fusion.min_confidence", "0.9", Nothing),
    ("fusion.min_observations", "5", Nothing),
    ("fusion.truncation_voxels", "6.0", Nothing),
    ("fusion.voxel_size_m", "0.06", Nothing),
    ("geometry.chunk_keyframes", "3", Nothing),
    ("geometry.context_keyframes", "2", Chunked),
    ("geometry.overlap_keyframes", "1", Simulated),
    ("geometry.fill_network", "da3-nano", Completed),
    ("geometry.max_width_px", "80", Nothing),
    ("input.end_secs", "1.5", Nothing),
    ("input.max_pose_gap_secs", "0.05", Odometry),
    ("input.start_secs", "1.0", Nothing),
    ("input.stride", "3", Nothing),
    ("keyframes.max_count", "4", Nothing),
    ("keyframes.unposed_interval_secs", "1.0", Unposed),
    ("keyframes.min_rotation_deg", "60.0", Turning),
    ("keyframes.min_translation_m", "1.0", Moving),
    ("output.keep_chunks", "true", Nothing),
    ("limits.memory_bytes", "165000000", Fine),
    ("output.depth_png", "false", Nothing),
    ("output.depth_units_per_metre", "500.0", Nothing),
    ("output.images", "false", Nothing),
    ("output.mesh_glb", "false", Pictures),
    ("output.report", "true", Nothing),
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

/// Everything a run leaves but what the clock or the command line decides.
fn leavings(out: &Path, ran: &ProgramOutput) -> BTreeMap<String, Vec<u8>> {
    let clocked = ["manifest.json", "log.jsonl", "README.txt", "config.resolved.toml", "report.html"];
    let mut found: BTreeMap<String, Vec<u8>> = files_under(out)
        .into_iter()
        .map(|name| {
            let keep = !clocked.contains(&name.as_str());
            let bytes = if keep { std::fs::read(out.join(&name)).unwrap() } else { Vec::new() };
            (name, bytes)
        })
        .collect();
    found.insert("exit".into(), vec![ran.code as u8]);
    found
}

fn run(name: &str, arguments: &[String]) -> BTreeMap<String, Vec<u8>> {
    let out: PathBuf = shared().root.join("keys").join(name);
    let small = ["-q", "--threads", "1", "--set", "input.stride=2"];
    let mut command = run_command(&shared().sequence, &out, &small);
    let ran: ProgramOutput = command.args(arguments).output().unwrap().into();
    assert!([0, 1, 3].contains(&ran.code), "{name}: {} {}", ran.code, ran.stderr);
    let left = leavings(&out, &ran);
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
    let bases: BTreeMap<ExtraSettings, BTreeMap<String, Vec<u8>>> = all
        .into_iter()
        .map(|beside| (beside, run(&format!("base {beside:?}"), &beside.arguments())))
        .collect();
    let (next, dead) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some((key, value, beside)) = SETTINGS.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let setting = format!("{key}={value}");
                    let with = [beside.arguments(), vec!["--set".into(), setting.clone()]].concat();
                    if run(key, &with) == bases[beside] {
                        dead.lock().unwrap().push(setting);
                    }
                }
            });
        }
    });
    assert!(dead.lock().unwrap().is_empty(), "no effect: {:?}", dead.lock().unwrap());
}
