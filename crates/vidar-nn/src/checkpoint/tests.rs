use super::*;
use std::collections::HashMap;

use safetensors::tensor::{Dtype as FileDtype, TensorView as FileView};

fn file() -> Vec<u8> {
    let values: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let halves: Vec<u8> =
        [0.5f32, -2.0].iter().flat_map(|x| half::bf16::from_f32(*x).to_le_bytes()).collect();
    let bytes = [7u8, 8, 9];
    let tensors = [
        ("a.weight", FileView::new(FileDtype::F32, vec![2, 3], &values).unwrap()),
        ("b", FileView::new(FileDtype::BF16, vec![2], &halves).unwrap()),
        ("c", FileView::new(FileDtype::U8, vec![3], &bytes).unwrap()),
    ];
    let text = HashMap::from([("alias".to_owned(), "a.weight".to_owned())]);
    safetensors::serialize(tensors, Some(text)).unwrap()
}

#[test]
fn tensors_come_back_with_shape_type_values_and_metadata() {
    let checkpoint = Checkpoint::from_bytes(file(), "test").unwrap();
    assert_eq!(checkpoint.names().collect::<Vec<_>>(), ["a.weight", "b", "c"]);
    let a = checkpoint.tensor("a.weight").unwrap();
    assert_eq!((a.shape, a.dtype), (&[2, 3][..], Dtype::F32));
    assert_eq!(a.to_f32().unwrap(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(checkpoint.tensor("b").unwrap().to_f32().unwrap(), [0.5, -2.0]);
    assert_eq!(checkpoint.tensor("c").unwrap().to_u8().unwrap(), [7, 8, 9]);
    assert_eq!(checkpoint.metadata()["alias"], "a.weight");
}
