//! Inference as a user sees it, on tiny networks.

use crate::common::{own, tiny, tiny_json};
use nalgebra::{Matrix3, Matrix4};
use std::sync::atomic::{AtomicUsize, Ordering};
use vidar_core::Image;
use vidar_da3::align::ScaleSource;
use vidar_da3::preprocess::{PreprocessConfig, ResizeMethod};
use vidar_da3::weights::synthetic::image_u8;
use vidar_da3::{
    Da3, Da3Error, Da3Options, Hooks, InferOptions, Inputs, Prediction, ReferenceStrategy, config::json,
};

fn pictures(n: u64) -> Vec<Image<[u8; 3]>> {
    (1..=n).map(|seed| image_u8(seed, 96, 72)).collect()
}

fn options() -> InferOptions {
    let preprocess = PreprocessConfig { process_size_px: 56, ..PreprocessConfig::default() };
    InferOptions { preprocess, ..InferOptions::default() }
}

fn cameras(n: usize) -> (Vec<Matrix4<f64>>, Vec<Matrix3<f64>>) {
    let pose = |i: usize| {
        let mut m = Matrix4::identity();
        m[(0, 3)] = -0.4 * i as f64;
        m[(1, 3)] = 0.1 * (i * i) as f64;
        m
    };
    let k = Matrix3::new(80.0, 0.0, 48.0, 0.0, 80.0, 36.0, 0.0, 0.0, 1.0);
    ((0..n).map(pose).collect(), vec![k; n])
}

/// All numbers of a prediction, to compare bits.
fn bits(p: &Prediction) -> Vec<u64> {
    let maps = p.depth.iter().chain(p.confidence.iter().flatten());
    let maps = maps.flat_map(|m| m.data().iter().map(|v| u64::from(v.to_bits())));
    let poses =
        p.camera_from_world.iter().flatten().flat_map(|m| m.iter().map(|v| v.to_bits()).collect::<Vec<_>>());
    let rays = p.rays.iter().flatten().flat_map(|r| r.rays.iter().flatten().map(|v| u64::from(v.to_bits())));
    maps.chain(poses).chain(rays).collect()
}

fn in_pool<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

#[test]
fn the_same_bits_come_out_for_any_number_of_threads() {
    let (model, images) = (tiny(), pictures(4));
    let options = InferOptions { use_ray_pose: true, wants_rays: true, ..options() };
    let run = |threads| in_pool(threads, || bits(&model.infer(&Inputs::images(&images), &options).unwrap()));
    let one = run(1);
    assert!(one.len() > 1000 && one == run(4) && one == run(3));
}

#[test]
fn two_models_run_at_once_without_minding_each_other() {
    let other = json::parse(&tiny_json("tiny_metric_v2.safetensors"), "tiny").unwrap();
    let (first, second) = (tiny(), Da3::synthetic_of(other, &Da3Options::default()).unwrap());
    let images = pictures(3);
    let run = |model: &Da3| bits(&model.infer(&Inputs::images(&images), &options()).unwrap());
    let alone = (run(&first), run(&second));
    for _ in 0..3 {
        let together = rayon::join(|| run(&first), || run(&second));
        assert!(alone == together);
        let same = rayon::join(|| run(&first), || run(&first));
        assert!(same.0 == alone.0 && same.1 == alone.0);
    }
}

#[test]
fn a_run_stops_wherever_it_is_told_to() {
    let (model, images) = (tiny(), pictures(3));
    let asked = AtomicUsize::new(0);
    let count = |_| {
        asked.fetch_add(1, Ordering::Relaxed);
        false
    };
    let hooks = Hooks { watch: &count, trace: None };
    model.infer_with(&Inputs::images(&images), &options(), &hooks).unwrap();
    let total = asked.load(Ordering::Relaxed);
    assert!(total > 20, "asked {total} times");
    for stop in 0..total {
        let asked = AtomicUsize::new(0);
        let cancel = |_| asked.fetch_add(1, Ordering::Relaxed) == stop;
        let hooks = Hooks { watch: &cancel, trace: None };
        let said = model.infer_with(&Inputs::images(&images), &options(), &hooks);
        assert!(matches!(said, Err(Da3Error::Cancelled)), "at question {stop}");
        assert_eq!(asked.load(Ordering::Relaxed), stop + 1, "nothing is asked after the answer");
    }
}

#[test]
fn wanted_views_are_those_of_the_whole() {
    let (model, images) = (tiny(), pictures(4));
    let whole = model.infer(&Inputs::images(&images), &options()).unwrap();
    let part = InferOptions { wanted: Some(1..3), ..options() };
    let part = model.infer(&Inputs::images(&images), &part).unwrap();
    assert_eq!(
        (part.wanted.clone(), part.depth.len(), part.camera_from_world.as_ref().unwrap().len()),
        (1..3, 2, 4)
    );
    assert_eq!(part.depth, whole.depth[1..3]);
    assert_eq!(part.camera_from_world, whole.camera_from_world);
    let none = InferOptions { wanted: Some(3..5), ..options() };
    assert!(model.infer(&Inputs::images(&images), &none).unwrap_err().to_string().contains("wanted"));
}

#[test]
fn where_the_official_code_raises_the_scale_that_is_seen_is_named() {
    let model = tiny();
    for (views, scale_source) in
        [(1, ScaleSource::Unobservable), (2, ScaleSource::LengthAlongLine), (5, ScaleSource::Similarity)]
    {
        let (images, (poses, k)) = (pictures(views as u64), cameras(views));
        let inputs = Inputs::posed(&images, &poses, &k);
        let found = model.infer(&inputs, &options()).unwrap();
        let alignment = found.alignment.unwrap();
        assert_eq!(alignment.scale_source, scale_source, "{views} views");
        assert_eq!(found.camera_from_world.unwrap(), poses);
        let compat = InferOptions { compat: true, ..options() };
        let raised = matches!(model.infer(&inputs, &compat), Err(Da3Error::DegenerateCameras { .. }));
        assert_eq!(raised, views < 3);
        let free = InferOptions { align_to_given: false, ..options() };
        let free = model.infer(&inputs, &free).unwrap();
        let ratio = free.depth[0].data()[100] / found.depth[0].data()[100];
        assert!((f64::from(ratio) / alignment.scale - 1.0).abs() < 1e-6);
    }
}

#[test]
fn intrinsics_alone_change_nothing_and_poses_need_them() {
    let (model, images) = (tiny(), pictures(2));
    let (poses, k) = cameras(2);
    let plain = model.infer(&Inputs::images(&images), &options()).unwrap();
    let known = Inputs { intrinsics: Some(&k), ..Inputs::images(&images) };
    assert!(bits(&plain) == bits(&model.infer(&known, &options()).unwrap()));
    let lone = Inputs { camera_from_world: Some(&poses), ..Inputs::images(&images) };
    assert!(model.infer(&lone, &options()).unwrap_err().to_string().contains("intrinsics"));
    let bad = vec![Matrix3::zeros(); 2];
    let said = model.infer(&Inputs::posed(&images, &poses, &bad), &options()).unwrap_err().to_string();
    assert!(said.contains("view 0") && said.contains("positive"), "{said}");
}

#[test]
fn pictures_of_two_sizes_are_cut_to_what_they_share() {
    let model = tiny();
    let images = [image_u8(1, 96, 72), image_u8(2, 72, 96)];
    let found = model.infer(&Inputs::images(&images), &options()).unwrap();
    assert!(found.was_cropped);
    assert_eq!((found.width(), found.height()), (42, 42));
    let none = model.infer(&Inputs::images(&[]), &options());
    assert!(matches!(none, Err(Da3Error::ViewCount { found: 0, .. })));
    let empty = [Image::filled(0, 5, [0; 3])];
    assert!(matches!(
        model.infer(&Inputs::images(&empty), &options()),
        Err(Da3Error::BadView { view: 0, .. })
    ));
}

#[test]
fn features_come_in_the_order_of_the_views() {
    let (model, images) = (tiny(), pictures(3));
    let layers =
        InferOptions { feature_layers: vec![0, 5], reference: ReferenceStrategy::View(2), ..options() };
    let found = model.infer(&Inputs::images(&images), &layers).unwrap();
    let maps = &found.features[&5];
    assert_eq!((maps.rows, maps.columns, maps.channels, maps.views.len()), (3, 4, 48, 3));
    assert_eq!(found.reference_view, 2);
    // The first block looks at one view at a time: its tokens are those of the view by itself.
    let alone = model.infer(&Inputs::images(&images[2..]), &layers).unwrap();
    assert_eq!(found.features[&0].views[2], alone.features[&0].views[0]);
    let compat = InferOptions { compat: true, ..layers.clone() };
    let compat = model.infer(&Inputs::images(&images), &compat).unwrap();
    assert_eq!(compat.features[&5].views[0], found.features[&5].views[2], "the reference comes first");
    let beyond = InferOptions { feature_layers: vec![6], ..options() };
    assert!(model.infer(&Inputs::images(&images), &beyond).unwrap_err().to_string().contains("layer 6 of 6"));
}

#[test]
fn networks_of_single_views_answer_sky_and_refuse_cameras() {
    let config = json::parse(&tiny_json("tiny_metric_v2.safetensors"), "tiny").unwrap();
    let model = Da3::synthetic_of(config, &Da3Options::default()).unwrap();
    let (images, (poses, k)) = (pictures(2), cameras(2));
    let found = model.infer(&Inputs::images(&images), &options()).unwrap();
    assert!(found.sky.is_some() && found.confidence.is_none() && found.camera_from_world.is_none());
    assert!(model.infer(&Inputs::posed(&images, &poses, &k), &options()).is_err());
    let rays = InferOptions { use_ray_pose: true, ..options() };
    assert!(model.infer(&Inputs::images(&images), &rays).is_err());
}

#[test]
fn a_nested_model_answers_in_metres() {
    let config = json::parse(&tiny_json("tiny_nested_v2.safetensors"), "tiny").unwrap();
    let model = Da3::synthetic_of(config, &Da3Options::default()).unwrap();
    let images = [image_u8(1, 56, 42), image_u8(5, 56, 42)];
    let found = model.infer(&Inputs::images(&images), &options()).unwrap();
    assert!(found.is_metric && found.scale_factor.unwrap() > 0.0 && found.sky.is_none());
    assert!(
        found.confidence.unwrap().iter().any(|c| c.data().contains(&1.0)),
        "sky has the least confidence"
    );
}

#[test]
fn every_resize_method_and_a_cut_are_accepted() {
    let (model, images) = (tiny(), pictures(2));
    for (method, size) in [
        (ResizeMethod::UpperBoundResize, (56, 42)),
        (ResizeMethod::UpperBoundCrop, (56, 42)),
        (ResizeMethod::LowerBoundResize, (70, 56)),
        (ResizeMethod::LowerBoundCrop, (70, 56)),
    ] {
        let preprocess = PreprocessConfig { process_size_px: 56, method };
        let found = model.infer(&Inputs::images(&images), &InferOptions { preprocess, ..options() }).unwrap();
        assert_eq!((found.width(), found.height()), size, "{method:?}");
    }
}

#[test]
fn a_reference_file_that_is_no_run_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("x.safetensors");
    std::fs::copy(own("tiny_posed_v4.safetensors"), &file).unwrap();
    let check = || vidar_da3::check::check_file(&file, None, &Da3Options::default());
    assert!(check().is_err(), "no manifest");
    for entry in [
        "{}",
        r#"{"kind": "unit-level"}"#,
        r#"{"kind": "net forward", "model": "?", "views": 1, "H": 14, "W": 14}"#,
        r#"{"kind": "net forward", "model": "da3-small", "views": 99999999, "H": 14, "W": 14}"#,
    ] {
        std::fs::write(
            folder.path().join("manifest.json"),
            format!(r#"{{"files": {{"x.safetensors": {entry}}}}}"#),
        )
        .unwrap();
        assert!(check().is_err(), "{entry}");
    }
}
