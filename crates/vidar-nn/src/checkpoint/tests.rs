use super::*;
use std::collections::HashMap;

use proptest::prelude::*;
use safetensors::tensor::{Dtype as FileDtype, TensorView as FileView};

fn file() -> Vec<u8> {
    let values: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let halves: Vec<u8> =
        [0.5f32, -2.0].iter().flat_map(|x| half::bf16::from_f32(*x).to_le_bytes()).collect();
    let small: Vec<u8> = [0.25f32, -3.0].iter().flat_map(|x| half::f16::from_f32(*x).to_le_bytes()).collect();
    let integers: Vec<u8> = [-1i64, 1 << 40].iter().flat_map(|x| x.to_le_bytes()).collect();
    let bytes = [7u8, 8, 9];
    let tensors = [
        ("a.weight", FileView::new(FileDtype::F32, vec![2, 3], &values).unwrap()),
        ("b", FileView::new(FileDtype::BF16, vec![2], &halves).unwrap()),
        ("c", FileView::new(FileDtype::U8, vec![3], &bytes).unwrap()),
        ("d", FileView::new(FileDtype::F16, vec![2, 1], &small).unwrap()),
        ("e", FileView::new(FileDtype::I64, vec![2], &integers).unwrap()),
        ("f", FileView::new(FileDtype::F32, vec![0, 5], &[]).unwrap()),
    ];
    let text = HashMap::from([("alias".to_owned(), "a.weight".to_owned())]);
    safetensors::serialize(tensors, Some(text)).unwrap()
}

/// A file with a hand-written header and `data` zero bytes.
fn with_header(json: &str, data: usize) -> Vec<u8> {
    let mut file = (json.len() as u64).to_le_bytes().to_vec();
    file.extend_from_slice(json.as_bytes());
    file.extend(std::iter::repeat_n(0, data));
    file
}

fn refused(file: Vec<u8>) -> String {
    match Checkpoint::from_bytes(file, "test") {
        Err(CheckpointError::Invalid { what, .. }) => what,
        other => panic!("not refused: {other:?}"),
    }
}

#[test]
fn tensors_come_back_with_shape_type_values_and_metadata() {
    let checkpoint = Checkpoint::from_bytes(file(), "test").unwrap();
    assert_eq!(checkpoint.names().collect::<Vec<_>>(), ["a.weight", "b", "c", "d", "e", "f"]);
    let a = checkpoint.tensor("a.weight").unwrap();
    assert_eq!((a.shape, a.dtype), (&[2, 3][..], Dtype::F32));
    assert_eq!(a.to_f32().unwrap(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(checkpoint.tensor("b").unwrap().to_f32().unwrap(), [0.5, -2.0]);
    assert_eq!(checkpoint.tensor("c").unwrap().to_u8().unwrap(), [7, 8, 9]);
    assert_eq!(checkpoint.tensor("d").unwrap().to_f32().unwrap(), [0.25, -3.0]);
    assert_eq!(checkpoint.tensor("e").unwrap().to_i64().unwrap(), [-1, 1 << 40]);
    assert!(checkpoint.tensor("f").unwrap().is_empty());
    assert_eq!(checkpoint.metadata()["alias"], "a.weight");
}

#[test]
fn a_mapped_file_gives_the_same_weights_as_one_in_memory() {
    let path = std::env::temp_dir().join(format!("vidar-nn-{}.safetensors", std::process::id()));
    std::fs::write(&path, file()).unwrap();
    let mapped = Checkpoint::open(&path).unwrap();
    let weight = mapped.weight("a.weight", &[2, 3]).unwrap();
    drop(mapped); // the weight keeps the mapping
    assert_eq!(weight.to_f32(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!((weight.name(), weight.dtype(), weight.len()), ("a.weight", Dtype::F32, 6));
    std::fs::write(&path, []).unwrap();
    assert!(matches!(Checkpoint::open(&path), Err(CheckpointError::Invalid { .. })));
    std::fs::remove_file(&path).unwrap();
    assert!(matches!(Checkpoint::open(&path), Err(CheckpointError::Io { .. })));
}

#[test]
fn what_is_missing_or_does_not_fit_is_named() {
    let checkpoint = Checkpoint::from_bytes(file(), "model.safetensors").unwrap();
    let message = |result: Result<Weight, CheckpointError>| result.unwrap_err().to_string();
    assert_eq!(message(checkpoint.weight("x", &[1])), "model.safetensors: tensor \"x\" is missing");
    assert_eq!(
        message(checkpoint.weight("a.weight", &[3, 2])),
        "model.safetensors: tensor \"a.weight\" has shape [2, 3], expected [3, 2]"
    );
    assert_eq!(
        message(checkpoint.weight("e", &[2])),
        "model.safetensors: tensor \"e\" holds I64, expected F32, F16, BF16 or F64"
    );
    assert!(checkpoint.tensor("e").unwrap().to_f32().is_err());
    assert!(checkpoint.tensor("b").unwrap().to_u8().is_err());
    assert!(checkpoint.tensor("b").unwrap().to_i64().is_err());
    assert!(checkpoint.tensor("c").unwrap().to_f64().is_err());
}

#[test]
fn hostile_headers_are_refused_with_the_reason() {
    let huge = (u64::MAX).to_le_bytes().to_vec();
    assert!(refused(huge).contains("at most"));
    assert!(refused(vec![1, 2, 3]).contains("too short"));
    assert!(refused(1000u64.to_le_bytes().to_vec()).contains("truncated"));
    assert!(refused(with_header("{", 0)).contains("header"));
    assert!(refused(with_header("[]", 0)).contains("header"));
    let tensor = |offsets: &str, shape: &str, dtype: &str| {
        format!(r#"{{"t":{{"dtype":"{dtype}","shape":{shape},"data_offsets":{offsets}}}}}"#)
    };
    assert!(refused(with_header(&tensor("[0,8]", "[2]", "F32"), 4)).contains("truncated"));
    assert!(refused(with_header(&tensor("[8,0]", "[2]", "F32"), 8)).contains("lies at 8..0"));
    assert!(refused(with_header(&tensor("[0,8]", "[3]", "F32"), 8)).contains("do not hold shape [3]"));
    assert!(refused(with_header(&tensor("[4,8]", "[1]", "F32"), 8)).contains("hole"));
    assert!(refused(with_header(&tensor("[0,4]", "[1]", "F32"), 8)).contains("the file at"));
    assert!(refused(with_header(&tensor("[0,4]", "[1]", "F8_E4M3"), 4)).contains("not supported"));
    assert!(refused(with_header(&tensor("[0,4]", "[1]", "Q7"), 4)).contains("header"));
    assert!(
        refused(with_header(&tensor("[0,8]", "[9223372036854775807,4]", "F32"), 8)).contains("do not hold")
    );
    assert!(refused(with_header(&tensor("[0,18446744073709551615]", "[4]", "F32"), 8)).contains("truncated"));
    assert!(refused(with_header(&tensor("[0,4]", "[-1]", "F32"), 4)).contains("header"));
    let overlapping = r#"{"a":{"dtype":"U8","shape":[4],"data_offsets":[0,4]},"b":{"dtype":"U8","shape":[4],"data_offsets":[2,6]}}"#;
    assert!(refused(with_header(overlapping, 6)).contains("overlaps"));
    assert!(refused(with_header(r#"{"t":{"note":"text"}}"#, 0)).contains("neither"));
    // Deep nesting must not exhaust the stack.
    assert!(refused(with_header(&"[".repeat(1 << 20), 0)).contains("header"));
}

proptest! {
    #[test]
    fn any_damage_to_a_file_is_an_error_or_still_readable(at in 0usize..600, bit in 0u8..8, cut in 0usize..600) {
        let mut file = file();
        let at = at % file.len();
        file[at] ^= 1 << bit;
        file.truncate(file.len() - cut.min(file.len()) / 7 * 7);
        if let Ok(checkpoint) = Checkpoint::from_bytes(file, "test") {
            for name in checkpoint.names() {
                let tensor = checkpoint.tensor(name).unwrap();
                prop_assert_eq!(tensor.bytes.len(), tensor.shape.iter().product::<usize>() * tensor.dtype.size());
                let _ = (tensor.to_f32(), tensor.to_f64(), tensor.to_i64(), tensor.to_u8());
            }
        }
    }
}
