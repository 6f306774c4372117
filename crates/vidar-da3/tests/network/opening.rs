//! Opening models: what fits, and how what does not fit is named.

use crate::common::{tensors, tiny_config, tiny_folder, tiny_json, write_safetensors};
use std::collections::BTreeMap;
use std::path::Path;
use vidar_da3::weights::{inventory, synthetic};
use vidar_da3::{Da3, Da3Error, Da3Options, Variant, WeightsOrigin};

type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn open(path: &Path) -> Result<Da3, Da3Error> {
    Da3::open(path, &Da3Options::default())
}

fn refusal(path: &Path) -> String {
    open(path).err().expect("a refusal").to_string()
}

/// What opening says of the tiny model after a change to its tensors.
fn refusal_after(change: impl FnOnce(&mut Tensors)) -> String {
    let folder = tiny_folder();
    let mut all = tensors(&tiny_config());
    change(&mut all);
    write_safetensors(&folder.path().join("model.safetensors"), &all);
    refusal(folder.path())
}

#[test]
fn a_folder_and_a_file_open_alike() {
    let folder = tiny_folder();
    let model = open(folder.path()).unwrap();
    assert_eq!(model.config().name, "tiny-any");
    assert!(matches!(model.origin(), WeightsOrigin::File { bytes, .. } if *bytes > 100_000));
    assert!(open(&folder.path().join("model.safetensors")).is_ok());
}

#[test]
fn missing_wrong_and_unknown_keys_are_named_one_by_one() {
    let said = refusal_after(|all| {
        all.remove("model.backbone.pretrained.blocks.3.attn.qkv.bias");
        all.get_mut("model.head.projects.1.weight").unwrap().0 = vec![96, 12, 1, 1];
        all.insert("model.backbone.pretrained.mask_token".into(), (vec![2], vec![0.0; 2]));
    });
    for words in [
        "is not a checkpoint of tiny-any",
        "model.backbone.pretrained.blocks.3.attn.qkv.bias: missing, expected shape [144]",
        "model.head.projects.1.weight: shape [96, 12, 1, 1], expected [12, 96, 1, 1]",
        "model.backbone.pretrained.mask_token: not a tensor of this network",
    ] {
        assert!(said.contains(words), "{words:?} is not in {said}");
    }
}

#[test]
fn a_foreign_checkpoint_is_not_listed_without_end() {
    let said = refusal_after(|all| {
        let foreign = (0..500).map(|i| (format!("layer.{i}.weight"), (vec![1], vec![0.0])));
        *all = foreign.collect();
    });
    assert!(said.lines().count() < 30 && said.contains("more"), "{said}");
}

#[test]
fn what_inference_never_reads_may_be_absent_and_the_gaussian_head_present() {
    let folder = tiny_folder();
    let mut all = tensors(&tiny_config());
    let unread = inventory::parameters(&tiny_config()).into_iter().filter(|p| !p.is_read).map(|p| p.name);
    let before = all.len();
    unread.for_each(|name| assert!(all.remove(&name).is_some()));
    assert!(all.len() < before);
    all.insert("model.gs_head.projects.0.bias".into(), (vec![1], vec![0.0]));
    // The shared norm, stored under its other names as well.
    all.insert("model.head.scratch.output_conv2_aux.3.2.bias".into(), (vec![32], vec![0.0; 32]));
    write_safetensors(&folder.path().join("model.safetensors"), &all);
    open(folder.path()).unwrap();
}

#[test]
fn a_truncated_file_is_refused() {
    let folder = tiny_folder();
    let file = folder.path().join("model.safetensors");
    let bytes = std::fs::read(&file).unwrap();
    for length in [0, 5, 8, 1000, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&file, &bytes[..length]).unwrap();
        let said = refusal(folder.path());
        assert!(said.contains("model.safetensors"), "{length} bytes: {said}");
    }
}

#[test]
fn a_folder_without_a_model_says_what_is_expected() {
    let folder = tempfile::tempdir().unwrap();
    assert!(refusal(folder.path()).contains("expected a folder with model.safetensors"));
    assert!(matches!(open(&folder.path().join("nothing")), Err(Da3Error::NoModel { .. })));
}

#[test]
fn without_a_description_the_keys_tell_the_network() {
    let folder = tiny_folder();
    std::fs::remove_file(folder.path().join("config.json")).unwrap();
    let said = refusal(folder.path());
    assert!(said.contains("any-view network of width 48; a config.json can describe it"), "{said}");
    // A class token as wide as the small network's: taken for it, and every other key is then wrong.
    let mut all = tensors(&tiny_config());
    let name = "model.backbone.pretrained.cls_token";
    all.insert(name.into(), (vec![1, 1, 384], synthetic::tensor(name, &[1, 1, 384])));
    write_safetensors(&folder.path().join("model.safetensors"), &all);
    assert!(refusal(folder.path()).contains("is not a checkpoint of da3-small"));
}

#[test]
fn a_hostile_description_is_refused_before_the_weights_are_read() {
    let folder = tiny_folder();
    let file = folder.path().join("config.json");
    let huge = tiny_json("tiny_free_v3.safetensors").replace("\"features\":16", "\"features\":3000000000");
    for text in ["{", "null", "[[[", "{\"model_name\": \"\\u0000\"}"] {
        std::fs::write(&file, text).unwrap();
        assert!(refusal(folder.path()).contains("config.json"), "{text}");
    }
    std::fs::write(&file, huge).unwrap();
    assert!(refusal(folder.path()).contains("head.features is 3000000000"));
    std::fs::write(&file, vec![b' '; 2 << 20]).unwrap();
    assert!(refusal(folder.path()).contains("2097152 bytes"));
    std::fs::write(&file, [0xFF, 0xFE, 0x00]).unwrap();
    assert!(refusal(folder.path()).contains("config.json"));
}

#[test]
fn small_from_a_file_opens_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("model.safetensors");
    write_safetensors(&file, &tensors(&Variant::Small.config()));
    let start = std::time::Instant::now();
    let model = open(folder.path()).unwrap();
    assert_eq!(model.config(), &Variant::Small.config());
    assert!(start.elapsed().as_millis() < 500, "{:?}", start.elapsed());
    let said = Da3::open(&file, &Da3Options { isa: Some(vidar_da3::Isa::Neon), ..Da3Options::default() });
    assert_eq!(said.is_err(), !vidar_da3::Isa::available().contains(&vidar_da3::Isa::Neon));
}
