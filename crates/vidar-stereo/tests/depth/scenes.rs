//! Stereo on scenes whose depth is known exactly.

use crate::scene::{Scene, WALL, depth, poses, views};
use nalgebra::Vector3;
use vidar_core::{
    ChunkViews, FrameId, FrameImage, GeometryModel, Image, LieGroup, ModelError, Se3, So3, ViewGeometry,
};
use vidar_stereo::{StereoConfig, StereoError, StereoModel, TOLERANCE_RATIO};

const MIDDLE: usize = 2;

fn model() -> StereoModel {
    StereoModel::new(StereoConfig::default()).expect("defaults are valid")
}

fn middle(chunk: &ChunkViews) -> ViewGeometry {
    let mut output = model().predict_with(chunk, &[MIDDLE], &|_| false).expect("has parallax");
    output.prediction.views.remove(0)
}

/// Completeness and AbsRel against the truth.
fn evaluate(scene: &Scene, view: &ViewGeometry) -> (f64, f64) {
    let truth = depth(scene, &poses()[MIDDLE]);
    let errors: Vec<f64> = (view.depth.image().data().iter().zip(truth.data()))
        .filter(|(z, _)| z.is_finite())
        .map(|(z, t)| f64::from((z - t).abs() / t))
        .collect();
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    (errors.len() as f64 / truth.data().len() as f64, mean)
}

fn slanted() -> Scene {
    Scene { normal: Vector3::new(0.5, 0.2, 1.0).normalize(), distance: 2.6, ..WALL }
}

fn boxed() -> Scene {
    Scene { board: Some((0.45, 1.9)), ..WALL }
}

fn plain(_: usize) -> (f64, f64) {
    (1.0, 0.0)
}

#[test]
fn textured_walls_straight_and_slanted_are_dense_and_accurate() {
    for (name, scene) in [("straight", WALL), ("slanted", slanted())] {
        let (complete, absrel) = evaluate(&scene, &middle(&views(&scene, &poses(), plain, 0.0)));
        assert!(complete > 0.8 && absrel < 0.02, "{name}: completeness {complete:.3}, AbsRel {absrel:.4}");
    }
}

#[test]
fn a_board_in_front_keeps_its_edges() {
    let (complete, absrel) = evaluate(&boxed(), &middle(&views(&boxed(), &poses(), plain, 0.0)));
    assert!(complete > 0.7 && absrel < 0.02, "completeness {complete:.3}, AbsRel {absrel:.4}");
}

#[test]
fn exposure_of_each_view_has_little_effect() {
    let same = evaluate(&slanted(), &middle(&views(&slanted(), &poses(), plain, 0.0)));
    let varied = |i: usize| if i.is_multiple_of(2) { (0.6, 20.0) } else { (1.0, 0.0) };
    let other = evaluate(&slanted(), &middle(&views(&slanted(), &poses(), varied, 0.0)));
    assert!((same.1 - other.1).abs() < 0.01 && other.0 > 0.8, "{same:?} {other:?}");
}

#[test]
fn noise_of_five_gray_levels_is_tolerated() {
    let (complete, absrel) = evaluate(&slanted(), &middle(&views(&slanted(), &poses(), plain, 5.0)));
    assert!(complete > 0.7 && absrel < 0.02, "completeness {complete:.3}, AbsRel {absrel:.4}");
}

#[test]
fn a_bare_noisy_wall_has_hardly_any_depth() {
    let bare = Scene { textured: false, ..WALL };
    let view = middle(&views(&bare, &poses(), plain, 2.0));
    let (complete, absrel) = evaluate(&bare, &view);
    let trust =
        view.confidence.image().data().iter().sum::<f32>() / view.confidence.image().data().len() as f32;
    assert!(
        complete < 0.3 && trust < 0.2,
        "completeness {complete:.3}, trust {trust:.3}, AbsRel {absrel:.3}"
    );
}

#[test]
fn pure_rotation_is_an_error_of_missing_parallax() {
    let turns: Vec<Se3> = (0..4)
        .map(|i| Se3::new(So3::exp(&Vector3::new(0.0, 0.05 * i as f64, 0.0)), Vector3::zeros()))
        .collect();
    let result = model().predict_with(&views(&WALL, &turns, plain, 0.0), &[0, 1], &|_| false);
    assert!(
        matches!(result, Err(StereoError::NoParallax { found_deg, needed_deg, .. }) if found_deg < needed_deg),
        "{result:?}"
    );
}

#[test]
fn a_view_far_away_is_omitted_and_the_others_are_estimated() {
    let mut places = poses();
    places.push(Se3::from_translation(Vector3::new(500.0, 0.0, 0.0)));
    let chunk = views(&WALL, &places, plain, 0.0);
    let output = model().predict_with(&chunk, &[MIDDLE, 5], &|_| false).expect("one has parallax");
    assert_eq!(output.prediction.views.len(), 1);
    assert_eq!(output.omitted.iter().map(|o| o.frame_id).collect::<Vec<_>>(), [FrameId(5)]);
}

#[test]
fn errors_name_the_bad_view() {
    let good = views(&WALL, &poses()[..3], plain, 0.0);
    let mut one = good.clone();
    one.views.truncate(1);
    assert!(matches!(model().predict(&one), Err(ModelError::TooFewViews { found: 1, needed: 2, .. })));
    let mut bare = good.clone();
    bare.views[1].world_from_camera = None;
    assert!(matches!(model().predict(&bare), Err(ModelError::MissingPose { frame: FrameId(1) })));
    let mut lost = good.clone();
    lost.views[1].world_from_camera = Some(Se3::from_translation(Vector3::new(f64::NAN, 0.0, 0.0)));
    assert!(matches!(model().predict(&lost), Err(ModelError::BadView { frame: FrameId(1), .. })));
    let mut odd = good.clone();
    odd.views[2].intrinsics.width = 100;
    let result = model().predict_with(&odd, &[0], &|_| false);
    assert!(matches!(result, Err(StereoError::SizeMismatch { frame: FrameId(2), .. })));
    let result = model().predict_with(&good, &[0], &|_| true);
    assert!(matches!(result, Err(StereoError::Cancelled)));
    let result = StereoModel::new(StereoConfig { max_planes: 1, ..StereoConfig::default() });
    assert!(matches!(result, Err(StereoError::BadConfig { key: "max_planes", .. })));
}

fn bits(view: &ViewGeometry) -> Vec<u32> {
    let confidence = view.confidence.image().data();
    view.depth.image().data().iter().chain(confidence).map(|v| v.to_bits()).collect()
}

#[test]
fn the_bits_do_not_depend_on_threads_nor_on_the_order_of_views() {
    let chunk = views(&boxed(), &poses(), plain, 3.0);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
        pool.install(|| bits(&middle(&chunk)))
    };
    let one = with(1);
    assert!(one == with(4));
    let mut turned = chunk.clone();
    turned.views.reverse();
    // Five views: the middle stays the middle.
    assert!(one == bits(&middle(&turned)));
}

#[test]
fn confidence_is_the_share_of_correct_pixels() {
    let mut bins = [(0usize, 0usize, 0.0f64); 5];
    // None of these was used when the weights were fitted.
    let small_board = Scene { board: Some((0.3, 1.5)), ..WALL };
    let steep = Scene { normal: Vector3::new(-0.7, 0.3, 1.0).normalize(), distance: 2.2, ..WALL };
    let far = Scene { distance: 4.5, ..WALL };
    for (scene, noise) in [(small_board, 6.0), (steep, 10.0), (far, 9.0)] {
        let view = middle(&views(&scene, &poses(), |i| (1.0 - 0.1 * i as f64, 5.0), noise));
        let truth = depth(&scene, &poses()[MIDDLE]);
        for ((z, t), c) in
            view.depth.image().data().iter().zip(truth.data()).zip(view.confidence.image().data())
        {
            if z.is_finite() {
                let bin = &mut bins[((c * 5.0) as usize).min(4)];
                bin.0 += 1;
                bin.1 += usize::from((z - t).abs() / t < TOLERANCE_RATIO);
                bin.2 += f64::from(*c);
            }
        }
    }
    for (count, right, sum) in bins.iter().filter(|b| b.0 >= 500) {
        let (predicted, observed) = (sum / *count as f64, *right as f64 / *count as f64);
        assert!(
            (predicted - observed).abs() < 0.15,
            "predicted {predicted:.3}, observed {observed:.3} of {count}: {bins:?}"
        );
    }
}

/// The wall with a board in front that moves with the camera at half its speed, as a person does who walks along, and the masks of the board.
fn walking() -> (ChunkViews, Vec<Option<Image<bool>>>) {
    let mut chunk = views(&WALL, &poses(), plain, 0.0);
    let mut masks = Vec::new();
    for (view, pose) in chunk.views.iter_mut().zip(poses()) {
        // From half as far the board that stands still is where the moving one is.
        let beside = Se3::new(pose.rotation, pose.translation * 0.5);
        let seen = views(&boxed(), &[beside], plain, 0.0).views.remove(0).image.to_gray8();
        let mask = depth(&boxed(), &beside).map(|z| *z < 2.5);
        let FrameImage::Gray8(wall) = &view.image else { unreachable!("rendered in grey") };
        let at = |x, y| if mask[(x, y)] { seen[(x, y)] } else { wall[(x, y)] };
        view.image = FrameImage::Gray8(Image::from_fn(mask.width(), mask.height(), at));
        masks.push(Some(mask));
    }
    (chunk, masks)
}

/// Pixels with depth in the mask, and of those beside it how many have depth, and how many one that is 3 % off.
fn around(view: &ViewGeometry, mask: &Image<bool>) -> (usize, usize, usize) {
    let truth = depth(&WALL, &poses()[MIDDLE]);
    let is_near = |x: usize, y: usize| {
        let rows = y.saturating_sub(6)..(y + 7).min(mask.height());
        rows.into_iter().any(|v| mask.row(v)[x.saturating_sub(6)..(x + 7).min(mask.width())].contains(&true))
    };
    let (mut inside, mut near, mut wrong) = (0, 0, 0);
    for (x, y) in (0..mask.height()).flat_map(|y| (0..mask.width()).map(move |x| (x, y))) {
        let (z, t) = (view.depth.image()[(x, y)], truth[(x, y)]);
        match mask[(x, y)] {
            true => inside += usize::from(z.is_finite()),
            false if z.is_finite() && is_near(x, y) => {
                near += 1;
                wrong += usize::from((z - t).abs() > 0.03 * t);
            }
            false => {}
        }
    }
    (inside, near, wrong)
}

#[test]
fn what_is_masked_gets_no_depth_and_spoils_none() {
    let (chunk, masks) = walking();
    let mask = masks[MIDDLE].clone().expect("every view has one");
    let predict = |masks: &[Option<Image<bool>>]| {
        let depths = model().predict_unmasked(&chunk, masks, MIDDLE..MIDDLE + 1, &|_| false);
        depths.expect("has parallax").prediction.views.remove(0)
    };
    let (inside, near, wrong) = around(&predict(&[]), &mask);
    assert!(inside > 500, "the walker is taken for something that stands still at {inside} pixels");
    let (masked_inside, masked_near, masked_wrong) = around(&predict(&masks), &mask);
    assert_eq!(masked_inside, 0);
    let (right, masked_right) = (near - wrong, masked_near - masked_wrong);
    assert!(masked_right > right, "{masked_right} pixels beside it are right, without masks {right}");
    assert!(masked_wrong * 10 <= wrong, "{masked_wrong} pixels beside it are wrong, without masks {wrong}");
    let confidence = predict(&masks).confidence;
    assert!(mask.data().iter().zip(confidence.image().data()).all(|(m, c)| !m || *c == 0.0));
    let wrong_size = vec![Some(Image::filled(4, 4, true)); 5];
    let refused = model().predict_unmasked(&chunk, &wrong_size, 0..1, &|_| false);
    assert!(matches!(refused, Err(StereoError::MaskSize { width: 4, .. })), "{refused:?}");
}

#[test]
fn masks_of_nothing_change_no_bit() {
    let chunk = views(&boxed(), &poses(), plain, 0.0);
    let none = vec![Some(Image::filled(192, 144, false)); 5];
    let bits = |masks: &[Option<Image<bool>>]| -> Vec<u32> {
        let depths = model().predict_unmasked(&chunk, masks, 1..4, &|_| false).expect("has parallax");
        depths
            .prediction
            .views
            .iter()
            .flat_map(|v| v.depth.image().data().iter().map(|z| z.to_bits()))
            .collect()
    };
    assert!(bits(&none) == bits(&[]));
}
