//! The same parity on a device: any adapter there is, one that runs shaders on the CPU included. Without one nothing is
//! tested here.

#![cfg(feature = "gpu")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // helpers of tests

mod common;

use common::own;
use std::path::Path;
use vidar_core::testing::shared_data;
use vidar_da3::check::{CheckReport, CheckResult, check_file};
use vidar_da3::gpu::adapters;
use vidar_da3::{Da3Options, Device, Precision, Residency};

const FILES: [&str; 4] = [
    "tiny_free_v3.safetensors",
    "tiny_posed_v4.safetensors",
    "tiny_metric_v2.safetensors",
    "tiny_nested_v2.safetensors",
];

/// Options for the first device of this machine; says so when there is none.
fn any_device(precision: Precision) -> Option<Da3Options> {
    if adapters().is_empty() {
        eprintln!("skipped: no device; on Debian, mesa-vulkan-drivers brings one that runs on the CPU");
        return None;
    }
    Some(Da3Options { precision, device: Device::Gpu { adapter: Some(0) }, ..Da3Options::default() })
}

fn check(file: &Path, options: &Da3Options) -> CheckReport {
    let report = check_file(file, None, options).unwrap();
    let evaluated = report.rows.iter().filter(|row| row.result != CheckResult::NotEvaluated).count();
    let worst = report.worst().unwrap();
    let name = file.file_name().unwrap().to_string_lossy();
    eprintln!(
        "{name} · {}: {evaluated} rows, worst {:.1e} ({})",
        report.compute,
        worst.ratio(),
        worst.tensor
    );
    report
}

#[test]
fn every_layer_of_the_tiny_networks_holds_on_a_device() {
    let Some(options) = any_device(Precision::F32) else { return };
    for file in FILES {
        let report = check(&own(file), &options);
        assert!(report.passed(), "{report}");
        assert!(report.compute.contains("gpu"), "{}", report.compute);
    }
}

#[test]
fn as_much_is_compared_on_a_device_as_on_the_cpu() {
    let Some(options) = any_device(Precision::F32) else { return };
    let names = |options: &Da3Options| {
        let report = check_file(&own(FILES[0]), None, options).unwrap();
        let mut names: Vec<String> = report.rows.into_iter().map(|row| row.tensor).collect();
        names.sort();
        names
    };
    let cpu = Da3Options { precision: Precision::F32, ..Da3Options::default() };
    assert_eq!(names(&options), names(&cpu));
}

#[test]
fn packed_weights_keep_depth_within_two_hundredths_of_its_deviation() {
    for precision in [Precision::Bf16, Precision::F16] {
        let Some(options) = any_device(precision) else { return };
        for file in &FILES[..2] {
            let report = check(&own(file), &options);
            assert!(report.passed(), "{report}");
            assert!(report.rows.iter().any(|row| row.result == CheckResult::NotEvaluated));
        }
    }
}

#[test]
fn parts_put_on_the_device_on_demand_answer_the_same() {
    let Some(options) = any_device(Precision::F32) else { return };
    let differences = |options: &Da3Options| {
        let report = check_file(&own(FILES[0]), None, options).unwrap();
        report.rows.iter().map(|row| row.max_difference).collect::<Vec<_>>()
    };
    let on_demand = Da3Options { residency: Residency::OnDemand, ..options };
    assert_eq!(differences(&options), differences(&on_demand));
}

/// The official recordings: small ones here, the others as `cargo test … -- --ignored`.
fn official(files: &[&str], precision: Precision) {
    let Some(folder) = shared_data("golden/da3") else { return };
    let Some(options) = any_device(precision) else { return };
    let options = Da3Options { residency: Residency::OnDemand, ..options };
    for file in files {
        let report = check(&folder.join(format!("{file}.safetensors")), &options);
        assert!(report.passed(), "{report}");
    }
}

#[test]
fn small_holds_on_a_device() {
    official(&["small_v2_42x56_full"], Precision::F32);
}

#[test]
#[ignore = "minutes on a device that runs shaders on the CPU"]
fn small_in_all_forms_holds_on_a_device() {
    let files = [
        "small_v5_42x56_saddle_balanced",
        "small_posed_v3",
        "small_v1_70x98",
        "small_v2_70x98",
        "small_v3_56x84",
        "small_v5_42x56_first",
        "small_v5_42x56_saddle_sim_range",
        "small_posed_v1",
        "small_posed_v2",
        "small_posed_v12_ransac",
        "small_v1_378x504",
        "small_v1_518x518",
        "small_v2_soh_280x504",
    ];
    official(&files, Precision::F32);
}

#[test]
#[ignore = "minutes and gigabytes on a device that runs shaders on the CPU"]
fn larger_networks_hold_on_a_device() {
    let files = [
        "base_v2_42x56",
        "large_v2_42x56",
        "metric_v2_42x56_full",
        "giant_v2_28x42",
        "giant_posed_v3",
        "nested_giant_large_v2_28x42",
    ];
    official(&files, Precision::F32);
}

#[test]
#[ignore = "minutes on a device that runs shaders on the CPU"]
fn depth_in_bf16_holds_on_a_device() {
    let files =
        ["small_v2_42x56_full", "small_v2_70x98", "small_v3_56x84", "base_v2_42x56", "large_v2_42x56"];
    official(&files, Precision::Bf16);
}
