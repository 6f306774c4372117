//! npz: no archive panics or grows beyond its bound, and a prediction that is read can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::io::Cursor;
use vidar_export::official::{NpyArray, NpzLimits, read_npz, read_prediction_npz, write_mini_npz};

const LIMITS: NpzLimits = NpzLimits { bytes: 1 << 20, arrays: 16 };

fuzz_target!(|bytes: &[u8]| {
    if let Ok(array) = NpyArray::read(&mut &bytes[..], "fuzz", LIMITS.bytes) {
        let mut again = Vec::new();
        array.write(&mut again).expect("a vector takes everything");
        assert_eq!(
            NpyArray::read(&mut again.as_slice(), "fuzz", u64::MAX).expect("our own file").shape,
            array.shape
        );
    }
    if let Ok(arrays) = read_npz(Cursor::new(bytes), LIMITS) {
        assert!(arrays.values().map(|a| a.data.bytes()).sum::<u64>() <= LIMITS.bytes);
    }
    if let Ok(prediction) = read_prediction_npz(Cursor::new(bytes), LIMITS) {
        let mut again = Cursor::new(Vec::new());
        write_mini_npz(&mut again, &prediction).expect("what was read is consistent");
        let back = read_prediction_npz(again, NpzLimits::default()).expect("our own file");
        assert_eq!(back.views.len(), prediction.views.len());
    }
});
