//! Parity with recordings of the official code. They lie outside the repository; without them nothing is tested here.

use vidar_core::testing::shared_data;
use vidar_da3::check::{CheckResult, check_file};
use vidar_da3::{Da3Options, Precision, Residency};

/// Checks the files with synthetic weights, block by block.
fn all_hold(files: &[&str], precision: Precision) {
    let Some(folder) = shared_data("golden/da3") else { return };
    let options = Da3Options { precision, residency: Residency::OnDemand, ..Da3Options::default() };
    for file in files {
        let report = check_file(&folder.join(format!("{file}.safetensors")), None, &options).unwrap();
        assert!(report.passed(), "{report}");
        let evaluated = report.rows.iter().filter(|row| row.result != CheckResult::NotEvaluated).count();
        assert!(evaluated > 0, "{report}");
        let worst = report.worst().unwrap();
        eprintln!(
            "{file} {precision}: {evaluated} rows pass, worst {:.1e} ({})",
            worst.ratio(),
            worst.tensor
        );
    }
}

#[test]
fn small_without_poses_holds() {
    all_hold(&["small_v2_42x56_full", "small_v1_70x98", "small_v2_70x98", "small_v3_56x84"], Precision::F32);
}

#[test]
fn small_chooses_the_reference_view_as_the_official_code() {
    let files = ["small_v5_42x56_first", "small_v5_42x56_saddle_balanced", "small_v5_42x56_saddle_sim_range"];
    all_hold(&files, Precision::F32);
}

#[test]
fn small_with_poses_holds() {
    let files = ["small_posed_v1", "small_posed_v2", "small_posed_v3", "small_posed_v12_ransac"];
    all_hold(&files, Precision::F32);
}

#[test]
fn small_at_full_size_holds() {
    all_hold(&["small_v1_378x504"], Precision::F32);
}

#[test]
fn small_in_bf16_keeps_its_depth() {
    all_hold(&["small_v2_42x56_full", "small_v3_56x84", "small_posed_v3"], Precision::Bf16);
}

#[test]
#[ignore = "a minute; cargo test -p vidar-da3 --test network official_goldens -- --ignored large"]
fn base_metric_and_large_hold() {
    let files = ["base_v2_42x56", "metric_v2_42x56_full", "large_v2_42x56", "small_v1_518x518"];
    all_hold(&files, Precision::F32);
    all_hold(&files, Precision::Bf16);
}

#[test]
#[ignore = "makes 12 GB of weights, block by block; cargo test -p vidar-da3 --test network official_goldens -- --ignored giant"]
fn giant_and_nested_hold() {
    let files = ["giant_v2_28x42", "giant_posed_v3", "nested_giant_large_v2_28x42"];
    all_hold(&files, Precision::F32);
    all_hold(&files, Precision::Auto);
}
