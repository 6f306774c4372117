//! Parity with a reference in double precision on tiny networks (`tools/make_da3_goldens.py`), layer by layer.

use crate::common::own;
use vidar_da3::check::{CheckReport, CheckResult, Measure, check_file};
use vidar_da3::{Da3Options, Isa, Precision, Residency};

const FILES: [&str; 4] = [
    "tiny_free_v3.safetensors",
    "tiny_posed_v4.safetensors",
    "tiny_metric_v2.safetensors",
    "tiny_nested_v2.safetensors",
];

fn exact() -> Da3Options {
    Da3Options { precision: Precision::F32, ..Da3Options::default() }
}

fn check(file: &str, options: &Da3Options) -> CheckReport {
    check_file(&own(file), None, options).unwrap()
}

#[test]
fn every_layer_of_the_tiny_networks_holds_with_every_set_of_kernels() {
    for isa in Isa::available() {
        for file in FILES {
            let options = Da3Options { isa: Some(isa), precision: Precision::F32, ..Da3Options::default() };
            let report = check(file, &options);
            assert!(report.passed(), "{report}");
            let most = report.worst().unwrap().ratio();
            eprintln!("{file} {isa}: {} rows, worst {most:.1e}", report.rows.len());
        }
    }
}

#[test]
fn intermediate_results_are_among_what_is_compared() {
    let report = check(FILES[0], &exact());
    let names: Vec<&str> = report.rows.iter().map(|r| r.tensor.as_str()).collect();
    for name in [
        "patch_embed",
        "block03",
        "feat2",
        "head.refinenet3_aux",
        "out.ray_conf",
        "out.extrinsics",
        "ref_idx",
    ] {
        assert!(names.contains(&name), "{name} is not in {names:?}");
    }
    assert!(report.to_string().contains("rows pass"));
}

#[test]
fn by_default_every_pixel_of_depth_is_within_two_hundredths_of_its_deviation() {
    for precision in [Precision::Auto, Precision::Bf16] {
        for file in FILES {
            let report = check(file, &Da3Options { precision, ..Da3Options::default() });
            assert!(report.passed(), "{report}");
            assert_eq!(report.measure, Measure::Largest);
            let depth = report.rows.iter().find(|row| row.tensor == "out.depth").unwrap();
            assert!(depth.p999_difference <= depth.max_difference, "{report}");
            eprintln!("{file} {}: {:.1e}", report.compute, depth.ratio());
        }
    }
}

#[test]
fn bf16_throughout_is_evaluated_by_its_mean_square() {
    let options = Da3Options {
        precision: Precision::Bf16,
        head_precision: Some(Precision::Bf16),
        exact_blocks: Some(0),
        ..Da3Options::default()
    };
    // The tiny networks of one view have too little width to average rounding over.
    for file in &FILES[..2] {
        let report = check(file, &options);
        assert!(report.passed() && report.to_string().contains("evaluated by the"), "{report}");
        if Isa::detect().multiplies_bf16() {
            assert_eq!(report.measure, Measure::RootMeanSquare);
            assert!(report.rows.iter().any(|row| row.result == CheckResult::NotEvaluated));
        }
    }
}

#[test]
fn parts_built_on_demand_give_the_same_results() {
    let kept = check(FILES[0], &Da3Options::default());
    let on_demand = check(FILES[0], &Da3Options { residency: Residency::OnDemand, ..Da3Options::default() });
    let differences = |r: &CheckReport| r.rows.iter().map(|row| row.max_difference).collect::<Vec<_>>();
    assert_eq!(differences(&kept), differences(&on_demand));
}

#[test]
fn weights_of_another_network_fail_at_the_first_changed_layer() {
    let folder = tempfile::tempdir().unwrap();
    let mut tensors = crate::common::tensors(&crate::common::tiny_config());
    tensors.get_mut("model.backbone.pretrained.blocks.2.mlp.fc2.bias").unwrap().1[5] += 0.5;
    crate::common::write_safetensors(&folder.path().join("model.safetensors"), &tensors);
    std::fs::write(folder.path().join("config.json"), crate::common::tiny_json(FILES[0])).unwrap();
    let report = check_file(&own(FILES[0]), Some(folder.path()), &exact()).unwrap();
    assert_eq!(report.first_failure().unwrap().tensor, "block02");
}
