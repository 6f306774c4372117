//! The strict trajectory readers: what is read can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_export::{read_euroc_csv, read_kitti, read_kitti_times, read_tum, write_euroc_csv, write_tum};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(read) = read_tum(bytes) {
        let mut again = Vec::new();
        write_tum(&mut again, &read, "").expect("a Vec takes everything");
        assert_eq!(read_tum(&again).expect("our own file").len(), read.len());
    }
    if let Ok(read) = read_euroc_csv(bytes) {
        let mut again = Vec::new();
        write_euroc_csv(&mut again, &read, "").expect("a Vec takes everything");
        assert_eq!(read_euroc_csv(&again).expect("our own file").len(), read.len());
    }
    // Times first, then poses, with a zero byte between.
    if let Some(at) = bytes.iter().position(|b| *b == 0)
        && let Ok(times) = read_kitti_times(&bytes[..at])
        && let Ok(read) = read_kitti(&bytes[at + 1..], &times)
    {
        assert_eq!(read.len(), times.times.len());
    }
});
