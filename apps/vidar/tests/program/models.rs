//! `vidar model`, `vidar depth` and a run on a network: the real program with a small checkpoint of synthetic weights.

mod store;

use crate::support::{ProgramOutput, files_under, images_of, run_command, shared, vidar, vidar_in};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use store::command_with_store;
use vidar::da3::config::json::parse;
use vidar::da3::weights::{inventory, synthetic};
use vidar::export_formats::official::{NpzLimits, read_prediction_npz};

/// A network of the family that is small enough for tests.
fn tiny_config() -> String {
    json!({ "model_name": "tiny-any", "config": {
        "net": { "name": "tiny", "embed_dim": 48, "depth": 6, "num_heads": 3, "ffn_layer": "mlp", "ffn_hidden": 112,
                 "position_grid": 9, "out_layers": [1, 3, 4, 5], "alt_start": 2, "qknorm_start": 2, "rope_start": 2 },
        "head": { "dim_in": 96, "features": 16, "out_channels": [8, 12, 16, 20] },
        "cam_enc": { "dim_out": 48, "num_heads": 2, "trunk_depth": 2, "mlp_ratio": 3 }, "cam_dec": { "dim_in": 96 },
    }})
    .to_string()
}

/// A checkpoint with the files of the hub and synthetic weights.
fn write_checkpoint(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join("config.json"), tiny_config()).unwrap();
    let config = parse(&tiny_config(), "config.json").unwrap();
    let (mut header, mut data) = (serde_json::Map::new(), Vec::<u8>::new());
    for parameter in inventory::parameters(&config) {
        let values = synthetic::tensor(&parameter.name, &parameter.shape);
        let from = data.len();
        data.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        let entry = json!({ "dtype": "F32", "shape": parameter.shape, "data_offsets": [from, data.len()] });
        header.insert(parameter.name, entry);
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let bytes = [&(header.len() as u64).to_le_bytes()[..], &header, &data].concat();
    std::fs::write(folder.join("model.safetensors"), bytes).unwrap();
}

/// The small checkpoint, three images, and a place for results.
struct Bench {
    root: PathBuf,
    model: PathBuf,
    images: PathBuf,
}

fn bench() -> &'static Bench {
    static BENCH: OnceLock<Bench> = OnceLock::new();
    BENCH.get_or_init(|| {
        let root = shared().root.join("models bench");
        let (model, images) = (root.join("tiny model"), root.join("images"));
        write_checkpoint(&model);
        std::fs::create_dir_all(&images).unwrap();
        for (i, image) in images_of(&shared().sequence).iter().step_by(6).take(3).enumerate() {
            std::fs::copy(image, images.join(format!("{i}.png"))).unwrap();
        }
        Bench { root, model, images }
    })
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// `vidar depth` on the small checkpoint.
fn depth(out: &str, more: &[&str]) -> (ProgramOutput, PathBuf) {
    let b = bench();
    let out = b.root.join(out);
    let mut args = vec!["depth", text(&b.images), "--model-dir", text(&b.model), "-o", text(&out), "-q"];
    args.extend(["--process-res", "56"]);
    args.extend(more);
    (vidar(&args), out)
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn matrix(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|r| r.as_array().unwrap())
        .map(|v| v.as_f64().unwrap())
        .collect()
}

#[test]
fn depth_writes_every_format_and_records_how_it_was_made() {
    let (ran, out) = depth("all", &["--format", "npz-mini_npz-glb-depth_vis-colmap-ply-depth_png", "--json"]);
    let json = ran.ends_with(0).json();
    assert_eq!(json["schema"], "vidar.depth-run/1");
    assert_eq!((json["views"].as_u64(), json["unit"].as_str()), (Some(3), Some("arbitrary")));
    let files = files_under(&out);
    for file in [
        "colmap/cameras.bin",
        "colmap/frames.bin",
        "colmap/images.bin",
        "colmap/points3D.bin",
        "colmap/rigs.bin",
        "depth/0000.png",
        "depth/0002.png",
        "depth_vis/0001.jpg",
        "exports/mini_npz/results.npz",
        "exports/npz/results.npz",
        "manifest.json",
        "points.ply",
        "predictions.json",
        "scene.glb",
        "scene.jpg",
    ] {
        assert!(files.iter().any(|f| f == file), "{file} is missing in {files:?}");
    }
    let npz = std::fs::File::open(out.join("exports/npz/results.npz")).unwrap();
    let prediction = read_prediction_npz(npz, NpzLimits::default()).unwrap();
    // 160x104 becomes 56x36 and then the nearest multiples of 14.
    assert_eq!((prediction.views.len(), prediction.size()), (3, (56, 42)));
    let document = read_json(&out.join("predictions.json"));
    assert_eq!((&document["width"], &document["height"]), (&json!(56), &json!(42)));
    for (stored, view) in document["views"].as_array().unwrap().iter().zip(&prediction.views) {
        // The same camera in both conventions: inverse pose, half a pixel.
        let k = view.intrinsics.unwrap();
        assert!((stored["intrinsics"]["cx"].as_f64().unwrap() + 0.5 - f64::from(k[0][2])).abs() < 1e-4);
        let w = matrix(&stored["world_from_camera"]);
        let e = view.extrinsics.unwrap();
        for r in 0..3 {
            let back: f64 =
                (0..3).map(|c| f64::from(e[r][c]) * w[c * 4 + 3]).sum::<f64>() + f64::from(e[r][3]);
            assert!(back.abs() < 1e-3, "the centre of a camera is its own origin: {back}");
        }
    }
    let manifest = read_json(&out.join("manifest.json"));
    let model = &manifest["model"];
    assert_eq!(model["weights_sha256"].as_str().unwrap().len(), 64);
    assert_eq!((&model["licence"], &model["acceptance"]), (&json!("unknown"), &Value::Null));
    assert!(
        manifest["artifacts"].as_array().unwrap().iter().all(|a| out.join(a.as_str().unwrap()).is_file())
    );
    let ply = std::fs::read(out.join("points.ply")).unwrap();
    assert!(vidar::export_formats::read_ply(&ply).unwrap().cloud.len() > 100);
    assert!(vidar::export_formats::read_colmap(&out.join("colmap")).unwrap().views.len() == 3);
}

#[test]
fn known_cameras_give_the_unit_of_depth() {
    // Three cameras that stand apart, not on a line.
    let b = bench();
    let frame = |i: usize, t: [f64; 3]| {
        json!({ "file_path": format!("images/{i}.png"), "fl_x": 120.0, "fl_y": 120.0, "cx": 80.0, "cy": 52.0, "w": 160, "h": 104,
                "transform_matrix": [[1, 0, 0, t[0]], [0, 1, 0, t[1]], [0, 0, 1, t[2]], [0, 0, 0, 1]] })
    };
    let frames = vec![frame(0, [0.0; 3]), frame(1, [0.5, 0.0, 0.1]), frame(2, [0.2, 0.4, 0.0])];
    let poses = b.root.join("transforms.json");
    std::fs::write(&poses, json!({ "camera_model": "OPENCV", "frames": frames }).to_string()).unwrap();
    let more = ["--poses", text(&poses), "--resolution", "input", "--format", "depth_png,ply", "--json"];
    let (ran, out) = depth("posed", &more);
    assert_eq!(ran.ends_with(0).json()["unit"], "given-cameras");
    let document = read_json(&out.join("predictions.json"));
    let second = matrix(&document["views"][1]["world_from_camera"]);
    assert!((second[3] - 0.5).abs() < 1e-9 && (second[11] - 0.1).abs() < 1e-9, "{second:?}");
    let image = std::fs::read(out.join("depth/0001.png")).unwrap();
    let depth_png = vidar::export_formats::read_depth_png(&image, 1000.0).unwrap();
    assert_eq!((depth_png.image().width(), depth_png.image().height()), (160, 104));
    // One image more than cameras.
    std::fs::write(&poses, json!({ "camera_model": "OPENCV", "frames": &frames[..2] }).to_string()).unwrap();
    let (ran, out) = depth("too few cameras", &more);
    ran.ends_with(2).says(&["no camera for", "2.png"]);
    assert!(!out.exists(), "a refused run left a folder");
}

#[test]
fn two_cameras_are_scaled_by_their_distance_and_compat_refuses_them_as_the_official_program_does() {
    let b = bench();
    let frame = |i: usize| {
        json!({ "file_path": format!("{i}.png"), "fl_x": 120.0, "fl_y": 120.0, "cx": 80.0, "cy": 52.0, "w": 160, "h": 104,
                "transform_matrix": [[1, 0, 0, i as f64 * 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] })
    };
    let poses = b.root.join("two.json");
    std::fs::write(&poses, json!({ "camera_model": "OPENCV", "frames": [frame(0), frame(1)] }).to_string())
        .unwrap();
    let (one, two) = (b.images.join("0.png"), b.images.join("1.png"));
    let run = |out: &str, more: &[&str]| {
        let out = b.root.join(out);
        let mut args =
            vec!["depth", text(&one), text(&two), "--model-dir", text(&b.model), "--process-res", "56", "-q"];
        args.extend(["--poses", text(&poses), "--format", "mini_npz", "-o", text(&out), "--json"]);
        args.extend(more);
        vidar(&args)
    };
    let json = run("two", &[]).ends_with(0).json();
    assert_eq!(json["unit"], "given-cameras");
    assert!(json["unit_reason"].as_str().unwrap().contains("LengthAlongLine"), "{}", json["unit_reason"]);
    run("two compat", &["--compat"]).ends_with(1).says(&["error[E0309]"]);
}

#[test]
fn a_dry_run_of_depth_plans_memory_and_writes_nothing() {
    let b = bench();
    let folder = tempfile::tempdir().unwrap();
    let images = text(&b.images);
    let ran = vidar_in(folder.path(), &["depth", images, "--model", "da3-giant-untrained", "--dry-run"])
        .ends_with(0);
    for word in ["3", "504x322", "da3-giant-untrained", "memory", "weights", "writes"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    // Missing weights are reported, and the plan is made anyway.
    let mut command = command_with_store(folder.path());
    let ran: ProgramOutput = command.args(["depth", images, "--dry-run", "--json"]).output().unwrap().into();
    let json = ran.ends_with(0).json();
    assert!(json["plan"]["licence"].as_str().unwrap().contains("not on this machine"), "{json}");
    assert!(json["memory"]["weights"].as_u64().unwrap() > 100 << 20);
    assert_eq!(files_under(folder.path()), Vec::<String>::new());
}

#[test]
fn what_depth_cannot_do_is_refused_with_the_next_step() {
    let (ran, _) = depth("x", &["--format", "dwg"]);
    ran.ends_with(2).says(&["dwg", "depth_png"]);
    let (ran, _) = depth("x", &["--conf-percentile", "101"]);
    ran.ends_with(2);
    let b = bench();
    let small = ["depth", text(&b.images), "--model", "da3-small-untrained", "--process-res", "5"];
    vidar(&small).ends_with(1).says(&["E0309", "14 to 4096"]);
    vidar(&["depth", text(&b.images), "--model", "da3-huge"]).ends_with(2).says(&["da3-huge", "da3-small"]);
    vidar(&["depth", "no/such/image.png", "--model", "da3-small-untrained"])
        .ends_with(1)
        .says(&["no/such/image.png"]);
    let folder = tempfile::tempdir().unwrap();
    let mut command = command_with_store(folder.path());
    let ran: ProgramOutput = command.args(["depth", text(&b.images)]).output().unwrap().into();
    ran.ends_with(4).says(&["error[E0403]", "vidar model pull da3-small", "--model da3-nano"]);
    // A damaged checkpoint is named key by key.
    let broken = b.root.join("broken");
    write_checkpoint(&broken);
    std::fs::write(
        broken.join("config.json"),
        tiny_config().replace("\"ffn_hidden\":112", "\"ffn_hidden\":96"),
    )
    .unwrap();
    vidar(&["depth", text(&b.images), "--model-dir", text(&broken)]).ends_with(1).says(&[
        "error[E0309]",
        "blocks.0.mlp.fc1.weight",
        "[96, 48]",
    ]);
}

#[test]
fn a_model_is_checked_against_references_and_a_difference_ends_with_5() {
    let references = concat!(env!("CARGO_MANIFEST_DIR"), "/../../crates/vidar-da3/tests/data");
    let ran = vidar(&["model", "check", references, "-q"]).ends_with(0);
    assert!(ran.stdout.lines().count() >= 3 && ran.stdout.contains("tensors match"), "{}", ran.stdout);
    let one = format!("{references}/tiny_free_v3.safetensors");
    let json = vidar(&["model", "check", &one, "-q", "--json"]).ends_with(0).json();
    assert_eq!((&json["schema"], &json["holds"]), (&json!("vidar.check/1"), &json!(true)));
    // The same weights from a file match, too; weights with one changed tensor do not.
    let b = bench();
    vidar(&["model", "check", &one, "--model-dir", text(&b.model), "-q"]).ends_with(0);
    let corrupted = b.root.join("corrupted");
    write_checkpoint(&corrupted);
    let weights = corrupted.join("model.safetensors");
    let mut bytes = std::fs::read(&weights).unwrap();
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let document: Value = serde_json::from_slice(&bytes[8..header]).unwrap();
    let at = document["model.backbone.pretrained.patch_embed.proj.bias"]["data_offsets"][0].as_u64().unwrap()
        as usize;
    bytes[header + at..header + at + 4].copy_from_slice(&5.0_f32.to_le_bytes());
    std::fs::write(&weights, bytes).unwrap();
    let ran = vidar(&["model", "check", &one, "--model-dir", text(&corrupted), "-q"]).ends_with(5);
    assert!(ran.stdout.contains("first failure: patch_embed"), "{}", ran.stdout);
    vidar(&["model", "check", "/no/such/folder/x.safetensors"]).ends_with(1);
}

/// `vidar run` on the small checkpoint.
fn run_on_network(out: &str, more: &[&str]) -> (ProgramOutput, PathBuf) {
    let b = bench();
    let out = b.root.join(out);
    let small = "model.network.preprocess.process_size_px=56";
    let fixed = ["--model-dir", text(&b.model), "--stride", "2", "-q", "--set", small];
    let mut command = run_command(&shared().sequence, &out, &fixed);
    (command.args(more).output().unwrap().into(), out)
}

#[test]
fn a_run_uses_a_network_with_and_without_poses_and_names_it_in_the_manifest() {
    // With cameras given, predictions are in their world; the geometry of these weights is meaningless, the pipeline is tested.
    let (ran, out) = run_on_network("run conditioned", &["--set", "model.network.mode=conditioned"]);
    assert_eq!(ran.code, 0, "{}\n{}", ran.stdout, ran.stderr);
    let manifest = read_json(&out.join("manifest.json"));
    let network = &manifest["model"]["network"];
    assert_eq!(manifest["model"]["name"], "tiny-any");
    assert_eq!(network["weights_sha256"].as_str().unwrap().len(), 64);
    assert_eq!((&network["licence"], &network["acceptance"]), (&json!("unknown"), &Value::Null));
    assert!(network["memory"]["working"].as_u64().unwrap() > 0);
    assert!(files_under(&out).iter().any(|f| f.starts_with("depth/") && f.ends_with(".png")));
    // Without, one similarity aligns each chunk to the trajectory, or reports why it cannot, as for these weights: no map is left.
    let settings = ["--set", "align.max_center_rms_m=100"];
    let (ran, out) = run_on_network("run free", &settings);
    assert_eq!(ran.code, 1, "{}\n{}", ran.stdout, ran.stderr);
    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    let aligned: Vec<Value> = log
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .filter(|e: &Value| e["event"] == "chunk-placed")
        .collect();
    assert!(!aligned.is_empty(), "{log}");
    assert!(aligned.iter().all(|e| e["status"] != "prior-world"), "{aligned:?}");
}

#[test]
fn a_dry_run_shows_the_network_its_terms_and_its_memory() {
    let sequence = text(&shared().sequence);
    let ran = vidar(&["run", sequence, "--geometry", "da3-small-untrained", "--dry-run"]).ends_with(0);
    for word in ["da3-small", "memory of the network", "views at once"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    assert!(ran.stderr.contains("this geometry is meaningless"), "{}", ran.stderr);
    vidar(&["run", sequence, "--geometry", "magic", "--dry-run"]).ends_with(2).says(&["magic", "da3-small"]);
    let folder = tempfile::tempdir().unwrap();
    let mut command = command_with_store(folder.path());
    let ran: ProgramOutput =
        command.args(["run", sequence, "--geometry", "da3-giant-1.1", "--dry-run"]).output().unwrap().into();
    ran.ends_with(4).says(&["error[E0403]"]);
}

#[test]
fn a_device_that_this_program_or_machine_lacks_is_refused_with_the_next_step() {
    let b = bench();
    let references = concat!(env!("CARGO_MANIFEST_DIR"), "/../../crates/vidar-da3/tests/data");
    let one = format!("{references}/tiny_free_v3.safetensors");
    // No machine has that many, and a program without the feature has none.
    let absent = "gpu:999";
    let (images, model, sequence) = (text(&b.images), text(&b.model), text(&shared().sequence));
    let out = b.root.join("absent device");
    let commands: [&[&str]; 5] = [
        &["model", "check", &one, "--device", absent, "-q"],
        &["depth", images, "--model-dir", model, "--device", absent, "-q", "-o", text(&out)],
        &["depth", images, "--model", "da3-small-untrained", "--device", absent, "--dry-run"],
        &["run", sequence, "--model-dir", model, "--device", absent, "--dry-run"],
        &["run", sequence, "--model-dir", model, "--set", "model.device=gpu:999", "-q", "-o", text(&out)],
    ];
    let reason = if cfg!(feature = "gpu") { "number 999" } else { "built without graphics processors" };
    for command in commands {
        vidar(command).ends_with(4).says(&["error[E0311]", reason, "--device cpu"]);
    }
    assert!(!out.exists(), "a refused run left a folder");
    vidar(&["model", "check", &one, "--device", "cuda"]).ends_with(2).says(&["cuda", "cpu, gpu, gpu:N"]);
    vidar(&["run", sequence, "--set", "model.device=gpu:-1", "--dry-run"])
        .ends_with(2)
        .says(&["error[E0102]", "cpu, gpu, gpu:N"]);
    vidar(&["explain", "E0311"]).ends_with(0);
}

#[test]
fn the_device_of_a_network_is_recorded_in_plans_and_manifests() {
    let (ran, out) = depth("on the cpu", &["--device", "cpu", "--format", "mini_npz"]);
    ran.ends_with(0);
    let options = &read_json(&out.join("manifest.json"))["options"];
    assert_eq!(options["device"], "cpu", "{options}");
    // Whatever there is: a graphics processor, or the CPU.
    let auto = ["run", text(&shared().sequence), "--geometry", "da3-small-untrained", "--device", "auto"];
    let ran = vidar(&[&auto[..], &["--dry-run"]].concat()).ends_with(0);
    assert!(ran.stdout.contains("computes"), "{}", ran.stdout);
}

#[test]
fn a_coupled_run_on_synthetic_weights_fails_with_a_hint_to_trained_ones() {
    let out = bench().root.join("coupled untrained");
    let small = "model.network.preprocess.process_size_px=56";
    let network = ["--geometry", "da3-small-untrained", "--mode", "coupled", "--stride", "2", "--set", small];
    let mut command = run_command(&shared().sequence, &out, &[&network[..], &["-q"]].concat());
    let ran: ProgramOutput = command.output().unwrap().into();
    let words = ["error[E0305]", "da3-small-untrained has synthetic weights", "vidar model pull da3-small"];
    ran.ends_with(1).says(&words);
}
