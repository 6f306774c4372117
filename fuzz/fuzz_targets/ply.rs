//! PLY: whatever is read keeps its promises and can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_export::{read_ply, write_ply_mesh};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(ply) = read_ply(bytes) {
        let mesh = ply.into_mesh();
        assert!(mesh.is_consistent());
        let mut again = Vec::new();
        write_ply_mesh(&mut again, &mesh, &[]).expect("what was read is finite");
        assert_eq!(read_ply(&again).expect("our own file").into_mesh(), mesh);
    }
});
