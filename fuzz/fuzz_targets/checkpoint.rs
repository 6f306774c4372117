//! Weights files: any bytes give a checkpoint whose tensors can all be read, or an error.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_nn::{Checkpoint, WeightSource};

fuzz_target!(|bytes: &[u8]| {
    let Ok(checkpoint) = Checkpoint::from_bytes(bytes.to_vec(), "fuzz") else { return };
    for name in checkpoint.names() {
        let tensor = checkpoint.tensor(name).expect("a name the checkpoint gave");
        let elements = tensor.shape.iter().product::<usize>();
        assert_eq!(tensor.bytes.len(), elements * tensor.dtype.size());
        if let Ok(values) = tensor.to_f32() {
            assert_eq!(values.len(), elements);
            let weight = checkpoint.weight(name, tensor.shape).expect("a floating tensor of its own shape");
            assert_eq!(weight.to_f32().len(), elements);
        }
        let _ = (tensor.to_i64(), tensor.to_u8(), tensor.to_f64());
    }
});
