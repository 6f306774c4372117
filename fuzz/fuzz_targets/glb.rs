//! GLB: whatever is read keeps its promises and can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_export::{read_glb, write_glb_mesh};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(glb) = read_glb(bytes) {
        assert!(glb.mesh.is_consistent());
        let mut again = Vec::new();
        write_glb_mesh(&mut again, &glb.mesh, &glb.comments).expect("what was read is finite");
        assert_eq!(read_glb(&again).expect("our own file"), glb);
    }
});
