//! A kernel set that is insisted on is the only one that runs.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // helpers of tests

mod common;

use common::{tiny_config, tiny_json};
use nalgebra::{Matrix3, Matrix4};
use vidar_core::Image;
use vidar_da3::config::json;
use vidar_da3::preprocess::PreprocessConfig;
use vidar_da3::weights::synthetic::image_u8;
use vidar_da3::{Da3, Da3Options, InferOptions, Inputs, Isa, Precision};

/// One test only: kernels of others in this process would be seen too.
#[test]
fn a_forced_kernel_set_is_the_only_one_that_runs() {
    let preprocess = PreprocessConfig { process_size_px: 56, ..PreprocessConfig::default() };
    let plain = InferOptions { preprocess, ..InferOptions::default() };
    let all = InferOptions { wants_rays: true, feature_layers: vec![0, 3], ..plain.clone() };
    let images: Vec<Image<[u8; 3]>> = (1..=3).map(|seed| image_u8(seed, 96, 72)).collect();
    let k = vec![Matrix3::new(80.0, 0.0, 48.0, 0.0, 80.0, 36.0, 0.0, 0.0, 1.0); 3];
    let poses: Vec<Matrix4<f64>> = (0..3)
        .map(|i| Matrix4::new_translation(&[0.4 * f64::from(i), 0.1 * f64::from(i * i), 0.0].into()))
        .collect();
    let nested = json::parse(&tiny_json("tiny_nested_v2.safetensors"), "tiny").unwrap();
    for isa in Isa::available() {
        for precision in [Precision::Auto, Precision::F32] {
            let options = Da3Options { isa: Some(isa), precision, ..Da3Options::default() };
            Isa::take_used();
            let model = Da3::synthetic_of(tiny_config(), &options).unwrap();
            assert_eq!(model.arithmetic().isa, isa);
            model.infer(&Inputs::images(&images), &all).unwrap();
            model.infer(&Inputs::posed(&images, &poses, &k), &plain).unwrap();
            let model = Da3::synthetic_of(nested.clone(), &options).unwrap();
            model.infer(&Inputs::images(&images), &plain).unwrap();
            assert_eq!(Isa::take_used(), [isa], "{}", model.arithmetic());
        }
    }
}
