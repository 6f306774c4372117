use super::*;
use nalgebra::Vector3;
use proptest::prelude::*;
use vidar_core::{
    Confidence, FrameId, Image, LieGroup, Pinhole, RelativeDepth, Se3, Sim3, So3, ViewGeometry,
};

fn truth(scale: f64) -> Sim3 {
    Sim3::new(So3::exp(&Vector3::new(0.2, -0.6, 0.3)), Vector3::new(1.0, -2.0, 0.5), scale).unwrap()
}

/// Pairs between chunks whose units differ by `scale`, the target's unit being `unit` metres; noise is a share of depth.
fn pairs(n: usize, scale: f64, unit: f64, noise: f64, outliers: usize) -> PointPairs {
    let mut pairs = PointPairs::default();
    let wave = |i: usize, k: f64| (i as f64 * k).sin();
    for i in 0..n {
        let z = 2.0 + 1.5 * wave(i, 12.9898);
        let x = Vector3::new(wave(i, 78.233) * z, wave(i, 37.719) * z * 0.6, z);
        let y = x * unit;
        let off = Vector3::new(wave(i, 93.1), wave(i, 51.7), wave(i, 17.3)) * (noise * z * unit);
        let gross =
            if i % 100 < outliers { Vector3::new(0.3, 0.1, 0.6) * z * unit } else { Vector3::zeros() };
        let source = truth(scale).inverse().act(&y);
        pairs.push(source, y + off + gross, z * unit / scale, z * unit, 1.0);
    }
    pairs
}

#[test]
fn a_fifth_of_one_sided_gross_errors_leaves_the_scale_within_a_thousandth() {
    for unit in [1.0, 0.01, 250.0] {
        let fit = fit_overlap(&pairs(5000, 1.7, unit, 0.004, 20), &OverlapConfig::default()).unwrap();
        assert!(
            (fit.target_from_source.scale / 1.7 - 1.0).abs() < 1e-3,
            "{unit}: {}",
            fit.target_from_source.scale
        );
        assert!((fit.inlier_ratio - 0.8).abs() < 0.01, "{}", fit.inlier_ratio);
    }
}

#[test]
fn half_of_the_pairs_and_all_of_them_agree_within_the_stated_covariance() {
    let mut all = pairs(40_000, 0.8, 1.0, 0.02, 10);
    let every = |stride: usize| {
        let mut some = PointPairs::default();
        for i in (0..all.len()).step_by(stride) {
            some.push(all.source[i], all.target[i], all.source_depth[i], all.target_depth[i], all.weight[i]);
        }
        some.independent = 800;
        fit_overlap(&some, &OverlapConfig::default()).unwrap()
    };
    let (sparse, full) = (every(16), every(1));
    let apart = (full.target_from_source.inverse() * sparse.target_from_source).log();
    let chi2 = (apart.transpose() * full.covariance.try_inverse().unwrap() * apart)[0];
    assert!(chi2 < 7.0, "{chi2}");
    let ratio = sparse.log_scale_std() / full.log_scale_std();
    assert!((ratio - 1.0).abs() < 0.1, "more samples of the same pixels must not claim more: {ratio}");
    all.independent = 0;
    let naive = fit_overlap(&all, &OverlapConfig::default()).unwrap();
    assert!(naive.log_scale_std() < 0.3 * full.log_scale_std());
}

fn view(depth: impl Fn(usize, usize) -> f32, frame: u32) -> ViewGeometry {
    let (w, h) = (60, 40);
    ViewGeometry {
        frame_id: FrameId(frame),
        chunk_from_camera: Se3::IDENTITY,
        intrinsics: Pinhole::new(50.0, 50.0, 29.5, 19.5, w, h).unwrap(),
        depth: RelativeDepth::new(Image::from_fn(w, h, depth)),
        confidence: Confidence::full(w, h),
    }
}

#[test]
fn edges_and_holes_are_not_sampled_and_the_pattern_belongs_to_the_frame() {
    let stepped = view(|x, _| if x < 30 { 1.0 } else { 2.0 }, 3);
    let sampled = SampledView::new(&stepped, 60 * 40);
    assert_eq!(sampled.len(), 2400);
    // Columns 29 and 30 see the step.
    assert_eq!(sampled.confidences().count(), 2400 * 58 / 60);
    let holes = SampledView::new(&view(|x, _| if x % 2 == 0 { f32::NAN } else { 2.0 }, 3), 2400);
    assert_eq!(holes.confidences().count(), 1200);
    let (a, b) = (SampledView::new(&stepped, 300), SampledView::new(&view(|_, _| 2.0, 3), 300));
    let mut found = PointPairs::default();
    a.pair_with(&b, 1, |_| true, |_, _| 1.0, &mut found);
    assert!(
        found.len() > 250
            && found.source.iter().zip(&found.target).all(|(s, t)| (s.x / s.z - t.x / t.z).abs() < 1e-12)
    );
    let other = SampledView::new(&view(|_, _| 2.0, 4), 300);
    let before = found.len();
    a.pair_with(&other, 1, |_| true, |_, _| 1.0, &mut found);
    assert_eq!(found.len(), before, "another frame has no pairs");
}

proptest! {
    #[test]
    fn every_pixel_belongs_to_the_cell_that_samples_there(count in 1usize..3000, frame in 0u32..50) {
        let sampled = SampledView::new(&view(|_, _| 2.0, frame), count);
        for cell in 0..sampled.len() {
            let p = sampled.point(cell);
            let (x, y) = (p.x / p.z * 50.0 + 29.5, p.y / p.z * 50.0 + 19.5);
            prop_assert_eq!(sampled.cell_at(x, y).map(|c| c.0), Some(cell));
        }
    }
}

#[test]
fn too_few_pairs_are_refused() {
    assert!(fit_overlap(&pairs(20, 1.0, 1.0, 0.0, 0), &OverlapConfig::default()).is_err());
}
