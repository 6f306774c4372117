//! Every shader text is valid, checked without a device.

#![cfg(feature = "device")]
#![allow(clippy::unwrap_used, clippy::panic)]

use vidar_gpu::ops::every_shader;
use wgpu::naga::{front::wgsl, valid};

#[test]
fn every_shader_is_valid_and_fits_every_device() {
    let all = every_shader();
    assert!(all.len() > 100, "{} shaders", all.len());
    for (name, text) in all {
        let module =
            wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{name}: {}\n{text}", e.emit_to_string(&text)));
        let halves = valid::Capabilities::SHADER_FLOAT16_IN_FLOAT32;
        let capabilities = valid::Capabilities::IMMEDIATES | halves;
        let info = valid::Validator::new(valid::ValidationFlags::all(), capabilities).validate(&module);
        info.unwrap_or_else(|e| panic!("{name}: {}\n{text}", e.emit_to_string(&text)));
        let size = |inner: &wgpu::naga::TypeInner| inner.size(module.to_ctx());
        let workgroup: u32 = module
            .global_variables
            .iter()
            .filter(|(_, v)| v.space == wgpu::naga::AddressSpace::WorkGroup)
            .map(|(_, v)| size(&module.types[v.ty].inner))
            .sum();
        assert!(workgroup <= 16 << 10, "{name}: {workgroup} bytes of workgroup memory");
        let invocations: u32 = module.entry_points[0].workgroup_size.iter().product();
        assert!(invocations <= 256, "{name}: {invocations} invocations");
        assert!(!text.contains("{{"), "{name}: a place was not filled");
    }
}

#[test]
fn names_of_shaders_tell_them_apart() {
    let mut names: Vec<String> = every_shader().into_iter().map(|(name, _)| name).collect();
    let all = names.len();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), all);
}
