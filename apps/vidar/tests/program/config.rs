//! Settings: layers, origins, refusals.

use crate::support::{ProgramOutput, command, files_under, keys, run_on, shared, vidar};
use serde_json::Value;

fn value_of(args: &[&str], key: &str) -> (String, String) {
    let all: Vec<&str> = ["config", "show", "--json"].into_iter().chain(args.iter().copied()).collect();
    let json = vidar(&all).ends_with(0).json();
    let row = json["settings"].as_array().unwrap().iter().find(|r| r["key"] == key).unwrap().clone();
    (row["value"].as_str().unwrap().to_owned(), row["origin"].as_str().unwrap().to_owned())
}

#[test]
fn each_layer_beats_the_one_before_and_is_named_as_the_origin() {
    let key = "fusion.voxel_size_m";
    let file = shared().settings.to_str().unwrap();
    assert_eq!(value_of(&[], key).1, "default");
    assert_eq!(value_of(&["--preset", "fast"], key).1, "preset fast");
    let (value, origin) = value_of(&["--preset", "fast", "--config", file], key);
    assert_eq!((value.as_str(), origin), ("0.04", format!("file {file}")));
    let (value, origin) =
        value_of(&["--preset", "fast", "--config", file, "--set", "fusion.voxel_size_m=0.07"], key);
    assert_eq!((value.as_str(), origin.as_str()), ("0.07", "--set"));
    let from_environment = command()
        .args(["config", "show", "--json", "--config", file])
        .env("VIDAR_FUSION__VOXEL_SIZE_M", "0.06")
        .output()
        .unwrap();
    let json: Value = serde_json::from_slice(&from_environment.stdout).unwrap();
    let row = json["settings"].as_array().unwrap().iter().find(|r| r["key"] == key).unwrap();
    assert_eq!(keys(row, 1), ["key", "value", "origin"]);
    assert_eq!(row["value"], "0.06");
    assert_eq!(row["origin"], "environment VIDAR_FUSION__VOXEL_SIZE_M");
}

#[test]
fn a_flag_overrides_file_and_set_and_its_origin_is_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("r");
    run_on(&shared().sequence, &out, &["-q", "--set", "input.stride=5", "--stride", "2"]).ends_with(0);
    let resolved = std::fs::read_to_string(out.join("config.resolved.toml")).unwrap();
    let line = resolved.lines().find(|l| l.starts_with("stride ")).unwrap();
    assert!(line.starts_with("stride = 2 ") && line.ends_with("# --stride"), "{line}");
    assert!(files_under(&out).contains(&"manifest.json".to_owned()));
}

#[test]
fn what_config_show_prints_is_taken_back_unchanged() {
    let shown = vidar(&["config", "show", "--preset", "quality"]).ends_with(0).stdout;
    let file = shared().root.join("shown.toml");
    std::fs::write(&file, &shown).unwrap();
    assert_eq!(vidar(&["config", "show", "--config", file.to_str().unwrap()]).ends_with(0).stdout, shown);
    let origins = vidar(&["config", "show", "--preset", "quality", "--origin"]).ends_with(0).stdout;
    assert!(origins.contains("# preset quality") && origins.contains("# default"));
}

#[test]
fn an_unknown_key_from_any_source_is_refused_with_the_nearest_name() {
    vidar(&["config", "show", "--set", "fusion.voxel_size=0.03"]).ends_with(2).says(&[
        "error[E0101]",
        "fusion.voxel_size\"",
        "--set",
        "did you mean \"fusion.voxel_size_m\"?",
    ]);
    let file = shared().root.join("typo.toml");
    std::fs::write(&file, "[keyframes]\nmin_translaton_m = 0.1\n").unwrap();
    vidar(&["config", "show", "--config", file.to_str().unwrap()]).ends_with(2).says(&[
        "error[E0101]",
        "typo.toml",
        "keyframes.min_translation_m",
    ]);
    vidar(&["config", "explain", "fusion.voxl_size_m"]).ends_with(2).says(&["fusion.voxel_size_m"]);
    let ran = vidar(&["config", "explain", "nonsense"]).ends_with(2);
    let ran = ran.says(&["error[E0101]", "\"nonsense\"", "vidar config show"]);
    assert!(!ran.stderr.contains("did you mean"), "{}", ran.stderr);
    let ran = command().args(["config", "show"]).env("VIDAR_FUSION__VOXEL", "1").output().unwrap();
    assert_eq!(ran.status.code(), Some(2));
}

#[test]
fn wrong_values_files_and_presets_are_refused_with_their_names() {
    vidar(&["config", "show", "--set", "fusion.voxel_size_m=thick"]).ends_with(2).says(&["E0102", "thick"]);
    vidar(&["config", "show", "--set", "fusion.voxel_size_m=-1"])
        .ends_with(2)
        .says(&["E0102", "voxel_size_m"]);
    vidar(&["config", "show", "--set", "input.stride=0"]).ends_with(2).says(&["E0102", "input.stride"]);
    vidar(&["config", "show", "--preset", "fastest"]).ends_with(2).says(&["E0104", "fast", "quality"]);
    vidar(&["config", "show", "--config", "not-there.toml"]).ends_with(2).says(&["E0103", "not-there.toml"]);
    let file = shared().root.join("broken.toml");
    std::fs::write(&file, "[fusion\nvoxel_size_m = ").unwrap();
    vidar(&["config", "show", "--config", file.to_str().unwrap()])
        .ends_with(2)
        .says(&["E0103", "broken.toml"]);
}

#[test]
fn errors_are_one_json_object_on_request() {
    let ran = vidar(&["config", "show", "--json", "--set", "a.b=1"]).ends_with(2);
    assert_eq!(keys(&ran.json(), 1), ["schema", "code", "message", "hint", "exit"]);
    assert_eq!(ran.json()["code"], "E0101");
    assert_eq!(ran.json()["exit"], 2);
}

#[test]
fn presets_are_listed_and_each_one_builds() {
    let json = vidar(&["config", "presets", "--json"]).ends_with(0).json();
    let presets = json["presets"].as_array().unwrap();
    assert!(presets.len() >= 4);
    for preset in presets {
        let name = preset["name"].as_str().unwrap();
        vidar(&["config", "show", "--preset", name]).ends_with(0);
        assert!(vidar(&["config", "presets"]).stdout.contains(name));
    }
}

#[test]
fn the_schema_describes_every_setting() {
    let schema = vidar(&["config", "schema"]).ends_with(0).json();
    let shown = vidar(&["config", "show", "--json"]).json();
    for row in shown["settings"].as_array().unwrap() {
        let section = row["key"].as_str().unwrap().split('.').next().unwrap();
        assert!(schema["properties"][section].is_object(), "{section}");
    }
    assert_eq!(schema["additionalProperties"], false);
    let ran = vidar(&["config", "explain", "fusion.voxel_size_m"]).ends_with(0);
    assert!(ran.stdout.contains("default"), "{}", ran.stdout);
}

#[cfg(unix)]
#[test]
fn an_environment_that_is_no_text_is_no_panic() {
    use std::os::unix::ffi::OsStrExt;
    let odd = std::ffi::OsStr::from_bytes(b"\xff\xfe");
    let with = |name: &std::ffi::OsStr| -> ProgramOutput {
        command().args(["config", "show"]).env(name, odd).output().unwrap().into()
    };
    with("SOMETHING_ELSE".as_ref()).ends_with(0);
    with(odd).ends_with(0);
    with("VIDAR_FUSION__VOXEL_SIZE_M".as_ref()).ends_with(2).says(&["fusion.voxel_size_m"]);
}
