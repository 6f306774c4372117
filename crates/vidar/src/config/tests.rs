use super::*;
use crate::error::Error;

fn defaults() -> Layered {
    Layered::defaults().unwrap()
}

#[test]
fn the_defaults_are_valid_and_survive_a_round_trip() {
    let config = defaults().build().unwrap();
    assert_eq!(config, Config::default());
}

#[test]
fn every_preset_changes_something_and_is_valid() {
    for preset in PRESETS {
        let mut layered = defaults();
        layered.preset(preset.name).unwrap();
        assert_ne!(layered.build().unwrap(), Config::default(), "{}", preset.name);
    }
}

#[test]
fn later_layers_override_and_every_value_has_its_origin() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.toml");
    std::fs::write(&file, "[keyframes]\nmin_translation_m = 0.5\nmin_rotation_deg = 3\n").unwrap();
    let mut layered = defaults();
    layered.preset("fast").unwrap();
    layered.file(&file).unwrap();
    let variables = [("VIDAR_KEYFRAMES__MIN_ROTATION_DEG", "4"), ("VIDAR_HOME", "/x"), ("HOME", "/y")];
    layered.environment(variables.iter().map(|(a, b)| (a.to_string(), b.to_string()))).unwrap();
    layered.set("keyframes.max_count = 12").unwrap();
    let config = layered.build().unwrap();
    assert_eq!(
        config.keyframes,
        KeyframeConfig {
            min_translation_m: 0.5,
            min_rotation_deg: 4.0,
            max_count: 12,
            ..KeyframeConfig::default()
        }
    );
    let origin = |key: &str| layered.entries().into_iter().find(|(k, _, _)| k == key).unwrap().2;
    assert_eq!(origin("keyframes.min_translation_m"), Origin::File(file));
    assert!(matches!(origin("keyframes.min_rotation_deg"), Origin::Environment(_)));
    assert_eq!(origin("keyframes.max_count"), Origin::Set);
    assert_eq!(origin("geometry.max_width_px"), Origin::Preset("fast".into()));
    assert_eq!(origin("input.camera"), Origin::Default);
    assert!(layered.to_toml(true).contains("# --set"));
}

#[test]
fn printed_configuration_can_be_read_back() {
    let mut layered = defaults();
    layered.set("fusion.voxel_size_m=0.07").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("printed.toml");
    std::fs::write(&file, layered.to_toml(true)).unwrap();
    let mut again = defaults();
    again.file(&file).unwrap();
    assert_eq!(again.build().unwrap(), layered.build().unwrap());
}

#[test]
fn an_unknown_key_is_refused_with_the_nearest_name() {
    let nearest = |key: &str| match defaults().set(&format!("{key}=1")) {
        Err(Error::UnknownKey { nearest, .. }) => nearest,
        other => panic!("{other:?}"),
    };
    assert_eq!(nearest("fusion.voxel_size").as_deref(), Some("fusion.voxel_size_m"));
    assert_eq!(nearest("keyframe.min_translation_m").as_deref(), Some("keyframes.min_translation_m"));
    assert_eq!(nearest("chunk_keyframes").as_deref(), Some("geometry.chunk_keyframes"));
    assert_eq!(nearest("zzzz"), None);
}

#[test]
fn wrong_kinds_and_ranges_name_the_key() {
    let reason = |assignment: &str| {
        let mut layered = defaults();
        layered.set(assignment).and_then(|()| layered.build().map(|_| ())).unwrap_err().to_string()
    };
    assert!(
        reason("keyframes.min_translation_m=far").contains("keyframes.min_translation_m must be a number")
    );
    assert!(reason("output.images=1").contains("true or false"));
    assert!(reason("input.stride=0").contains("input.stride"));
    assert!(reason("keyframes.min_rotation_deg=-2").contains("keyframes.min_rotation_deg"));
    assert!(reason("geometry.chunk_keyframes=1").contains("at least 2 with stereo"));
    assert!(reason("geometry.source=magic").contains("geometry.source"));
    assert!(reason("geometry").contains("has no '='"));
}

#[test]
fn an_invalid_file_is_reported() {
    let missing = defaults().file(std::path::Path::new("/nowhere/x.toml")).unwrap_err();
    assert_eq!(missing.code(), "E0103");
    assert!(missing.to_string().contains("/nowhere/x.toml"));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("broken.toml");
    std::fs::write(&file, "[keyframes\n").unwrap();
    assert_eq!(defaults().file(&file).unwrap_err().code(), "E0103");
}

#[test]
fn the_built_in_network_gets_its_training_size_unless_another_is_set() {
    let size = |layered: &Layered| layered.build().unwrap().model.network.preprocess.process_size_px;
    let mut layered = defaults();
    layered.set("geometry.source=da3-nano").unwrap();
    assert_eq!(size(&layered), crate::models::bundled::PROCESS_SIZE_PX);
    let entries = layered.entries();
    let entry = entries.iter().find(|(key, ..)| key == "model.network.preprocess.process_size_px").unwrap();
    assert!(matches!(entry.2, Origin::Derived(_)), "{}", entry.2);
    let mode = |layered: &Layered| layered.build().unwrap().model.network.mode;
    assert_eq!(mode(&layered), vidar_da3::PoseMode::Conditioned);
    layered.set("geometry.source=da3-small").unwrap();
    assert_eq!(size(&layered), 504, "another network does not inherit it");
    assert_eq!(mode(&layered), vidar_da3::PoseMode::Free);
    layered.set("model.network.preprocess.process_size_px=140").unwrap();
    layered.set("geometry.source=da3-nano").unwrap();
    assert_eq!(size(&layered), 140, "an explicit value is kept");
}
