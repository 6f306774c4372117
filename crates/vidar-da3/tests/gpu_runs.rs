//! Runs on a device: the keys that are read, memory as planned, cancellation, refusals, two models at once.

#![cfg(feature = "gpu")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // helpers of tests

mod common;

use common::{tiny_config, tiny_json};
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use vidar_core::Image;
use vidar_da3::config::json;
use vidar_da3::gpu::{GpuError, MemoryPlan, adapters, memory_plan};
use vidar_da3::preprocess::PreprocessConfig;
use vidar_da3::weights::SyntheticWeights;
use vidar_da3::weights::inventory::parameters;
use vidar_da3::{Da3, Da3Error, Da3Options, Device, Hooks, InferOptions, Inputs, Precision};
use vidar_nn::{CheckpointError, Weight, WeightSource};

fn any_device() -> Option<Da3Options> {
    if adapters().is_empty() {
        eprintln!("skipped: no device; on Debian, mesa-vulkan-drivers brings one that runs on the CPU");
        return None;
    }
    let device = Device::Gpu { adapter: Some(0) };
    Some(Da3Options { precision: Precision::F32, device, ..Da3Options::default() })
}

fn pictures(views: usize) -> Vec<Image<[u8; 3]>> {
    (0..views)
        .map(|v| Image::from_fn(84, 56, |x, y| [(3 * x + 20 * v) as u8, (5 * y) as u8, (x * y) as u8]))
        .collect()
}

/// Small images' size on the network's side: rows and columns.
const SIZE: (usize, usize) = (56, 84);

fn small() -> InferOptions {
    let preprocess = PreprocessConfig { process_size_px: SIZE.1, ..PreprocessConfig::default() };
    InferOptions { preprocess, ..InferOptions::default() }
}

fn plan(model: &Da3, views: usize, wants_rays: bool) -> MemoryPlan {
    memory_plan(model.config(), (views, SIZE.0, SIZE.1), wants_rays)
}

/// Remembers what was asked for.
#[derive(Default)]
struct Remembering(Mutex<BTreeSet<String>>);

impl WeightSource for Remembering {
    fn weight(&self, name: &str, shape: &[usize]) -> Result<Weight, CheckpointError> {
        self.0.lock().unwrap().insert(name.to_owned());
        SyntheticWeights.weight(name, shape)
    }

    fn has(&self, name: &str) -> bool {
        SyntheticWeights.has(name)
    }
}

#[test]
fn the_device_reads_the_keys_that_the_network_has() {
    let Some(options) = any_device() else { return };
    for file in ["tiny_free_v3.safetensors", "tiny_nested_v2.safetensors"] {
        let config = json::parse(&tiny_json(file), "tiny").unwrap();
        let source = Arc::new(Remembering::default());
        let shared: Arc<dyn WeightSource> = Arc::clone(&source) as _;
        drop(Da3::with_weights(config.clone(), shared, &options).unwrap());
        let expected: BTreeSet<String> =
            parameters(&config).into_iter().filter(|p| p.is_read).map(|p| p.name).collect();
        assert_eq!(*source.0.lock().unwrap(), expected);
    }
}

#[test]
fn a_run_holds_no_more_device_memory_than_planned_and_gives_it_back() {
    let Some(options) = any_device() else { return };
    let model = Da3::synthetic_of(tiny_config(), &options).unwrap();
    let gpu = model.gpu().unwrap();
    let weights = gpu.held_bytes();
    for (views, wants_rays) in [(1, false), (5, false), (3, true)] {
        let planned = plan(&model, views, wants_rays);
        assert!(weights <= planned.weights + (64 << 10), "{weights} of {planned:?}");
        gpu.reset_peak();
        let infer = InferOptions { wants_rays, ..small() };
        model.infer(&Inputs::images(&pictures(views)), &infer).unwrap();
        let peak = gpu.peak_bytes() - weights;
        eprintln!("{views} views: peak {peak}, planned {}", planned.working);
        assert!(peak <= planned.working && 2 * peak > planned.working, "peak {peak} of {planned:?}");
        assert_eq!(gpu.held_bytes(), weights);
    }
}

#[test]
fn a_run_that_may_not_hold_its_memory_is_refused_before_it_starts() {
    let Some(options) = any_device() else { return };
    let model = Da3::synthetic_of(tiny_config(), &options).unwrap();
    let weights = model.gpu().unwrap().held_bytes();
    let (one, twelve) = (plan(&model, 1, false), plan(&model, 12, false));
    drop(model);
    let tight = Da3Options {
        max_device_bytes: Some(weights + u64::midpoint(one.working, twelve.working)),
        ..options
    };
    let model = Da3::synthetic_of(tiny_config(), &tight).unwrap();
    let said = model.infer(&Inputs::images(&pictures(12)), &small()).err().unwrap();
    assert!(matches!(said, Da3Error::Gpu(GpuError::OverBudget { .. })), "{said}");
    // Fewer views still run.
    model.infer(&Inputs::images(&pictures(1)), &small()).unwrap();
}

#[test]
fn a_run_on_a_device_stops_when_asked_to() {
    let Some(options) = any_device() else { return };
    let model = Da3::synthetic_of(tiny_config(), &options).unwrap();
    let asked = AtomicUsize::new(0);
    let cancel = |_| asked.fetch_add(1, Ordering::Relaxed) >= 6;
    let hooks = Hooks { watch: &cancel, trace: None };
    let said = model.infer_with(&Inputs::images(&pictures(3)), &small(), &hooks);
    assert!(matches!(said, Err(Da3Error::Cancelled)));
    assert!(asked.load(Ordering::Relaxed) < 10);
    // The next run is as if nothing had been.
    model.infer(&Inputs::images(&pictures(3)), &small()).unwrap();
}

#[test]
fn two_models_on_one_device_answer_as_each_alone() {
    let Some(options) = any_device() else { return };
    let model = Da3::synthetic_of(tiny_config(), &options).unwrap();
    let run = |views: usize| {
        let answer = model.infer(&Inputs::images(&pictures(views)), &small()).unwrap();
        answer.depth.iter().flat_map(|d| d.data().to_vec()).map(f32::to_bits).collect::<Vec<_>>()
    };
    let alone = (run(2), run(3));
    let together = std::thread::scope(|scope| {
        let (two, three) = (scope.spawn(|| run(2)), scope.spawn(|| run(3)));
        (two.join().unwrap(), three.join().unwrap())
    });
    assert!(alone == together, "runs influence each other");
}

#[test]
fn a_device_that_is_not_there_is_said_with_what_to_do() {
    let number = adapters().len();
    let options = Da3Options { device: Device::Gpu { adapter: Some(number) }, ..Da3Options::default() };
    let said = Da3::synthetic_of(tiny_config(), &options).err().unwrap().to_string();
    assert!(said.contains("Vulkan") && said.contains(&format!("number {number}")), "{said}");
    let auto = Da3Options { device: Device::Auto, ..Da3Options::default() };
    let model = Da3::synthetic_of(tiny_config(), &auto).unwrap();
    eprintln!("auto computes on {}", model.describe_compute());
}
