//! Planned memory against what a run allocates.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // helpers of tests

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use vidar_da3::preprocess::PreprocessConfig;
use vidar_da3::weights::synthetic::image_u8;
use vidar_da3::{Da3, Da3Options, InferOptions, Inputs, Variant};

/// Counts bytes in use and their maximum.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: passes everything on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = NOW.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        MOST.fetch_max(now, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Most bytes that `work` has in use beyond what was there before.
fn peak<T>(work: impl FnOnce() -> T) -> (T, usize) {
    let before = NOW.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    let result = work();
    (result, MOST.load(Ordering::Relaxed) - before)
}

/// One test only: others in this process would be counted too.
#[test]
fn the_plan_is_near_the_truth_and_a_thousand_calls_leave_nothing_behind() {
    let model = Da3::synthetic(Variant::Small, &Da3Options::default()).unwrap();
    for (views, size) in [(1, 252), (6, 140)] {
        let images: Vec<_> = (0..views).map(|i| image_u8(i as u64, 160, 120)).collect();
        let options = InferOptions {
            preprocess: PreprocessConfig { process_size_px: size, ..PreprocessConfig::default() },
            ..InferOptions::default()
        };
        let (found, truth) = peak(|| model.infer(&Inputs::images(&images), &options).unwrap());
        let planned = model.memory_estimate(views, found.height(), found.width()).working as f64;
        let ratio = planned / truth as f64;
        eprintln!(
            "{views} views of {size}: planned {:.1} MB, used {:.1} MB",
            planned / 1e6,
            truth as f64 / 1e6
        );
        assert!((0.6..1.7).contains(&ratio), "planned {planned}, used {truth}");
    }
    drop(model);

    let model = common::tiny();
    let images = [image_u8(1, 14, 14)];
    let options = InferOptions {
        preprocess: PreprocessConfig { process_size_px: 14, ..PreprocessConfig::default() },
        ..InferOptions::default()
    };
    let run = || drop(model.infer(&Inputs::images(&images), &options).unwrap());
    (0..20).for_each(|_| run());
    let before = NOW.load(Ordering::Relaxed);
    (0..1000).for_each(|_| run());
    let grown = NOW.load(Ordering::Relaxed).saturating_sub(before);
    assert!(grown < 64 << 10, "{grown} bytes more after a thousand calls");
}
