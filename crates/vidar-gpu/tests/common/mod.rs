//! What the tests of this folder share.

#![allow(dead_code)] // each test file uses a part
#![allow(clippy::unwrap_used, clippy::print_stderr)]

use vidar_gpu::{Gpu, GpuOptions, adapters};

/// Any device at all, software included; says so when there is none.
pub fn any_device() -> Option<Gpu> {
    let Some(first) = adapters().into_iter().next() else {
        eprintln!("skipped: no device; on Debian, mesa-vulkan-drivers brings one that runs on the CPU");
        return None;
    };
    Some(Gpu::open(&GpuOptions { adapter: Some(first.index), ..GpuOptions::default() }).unwrap())
}

/// Numbers between −1 and 1 by a rule.
pub fn numbers(seed: u32, count: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9) | 1;
    (0..count)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        })
        .collect()
}

/// Asserts that no number departs by more than `bound` times the largest expected one.
pub fn assert_near(what: &str, found: &[f32], expected: &[f32], bound: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let size = expected.iter().fold(1e-12f32, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= bound * size, "{what}: number {i} is {f}, expected {e} (largest {size})");
    }
}
