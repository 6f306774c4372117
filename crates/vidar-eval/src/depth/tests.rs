use super::*;
use vidar_core::{Confidence, FrameId, Image, Pinhole, Se3, Timestamp};

fn depth(values: &[f32]) -> MetricDepth {
    MetricDepth::new(Image::from_vec(values.len(), 1, values.to_vec()).unwrap())
}

const NAN: f32 = f32::NAN;

fn evaluate(predicted: &[f32], truth: &[f32]) -> Result<DepthReport, EvalError> {
    DepthAccumulator::new().push(&depth(predicted), &depth(truth))
}

#[test]
fn errors_of_three_pixels_are_those_computed_by_hand() {
    let report = evaluate(&[1.0, 3.0, 4.0, NAN, 5.0], &[2.0, 2.0, 4.0, 1.0, NAN]).unwrap();
    assert_eq!((report.truth_pixels, report.predicted_pixels, report.valid_pixels), (4, 4, 3));
    assert_eq!(report.completeness, 0.75);
    let e = report.metric.unwrap();
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} is not {b}");
    close(e.abs_rel, (0.5 + 0.5) / 3.0);
    close(e.sq_rel_m, (0.5 + 0.5) / 3.0);
    close(e.rmse_m, (2.0_f64 / 3.0).sqrt());
    close(e.mae_m, 2.0 / 3.0);
    close(e.rmse_log, ((2.0_f64.ln().powi(2) + 1.5_f64.ln().powi(2)) / 3.0).sqrt());
    // Ratios 2, 1.5 and 1 against 1.25, 1.5625 and 1.953125.
    close(e.delta_1, 1.0 / 3.0);
    close(e.delta_2, 2.0 / 3.0);
    close(e.delta_3, 2.0 / 3.0);
}

#[test]
fn a_ratio_at_the_threshold_is_outside() {
    let e = evaluate(&[1.25], &[1.0]).unwrap().metric.unwrap();
    assert_eq!((e.delta_1, e.delta_2), (0.0, 1.0));
}

#[test]
fn median_scaling_removes_an_error_of_scale_and_nothing_else() {
    let report = evaluate(&[0.5, 1.0, 1.5], &[1.0, 2.0, 3.0]).unwrap();
    assert_eq!(report.median_scale, Some(2.0));
    let scaled = report.median_scaled.unwrap();
    assert_eq!((scaled.abs_rel, scaled.rmse_log, scaled.delta_1), (0.0, 0.0, 1.0));
    assert_eq!(report.metric.unwrap().abs_rel, 0.5);
}

#[test]
fn disjoint_pixels_give_none_and_different_sizes_an_error() {
    let report = evaluate(&[NAN, 1.0], &[1.0, NAN]).unwrap();
    assert_eq!((report.metric, report.median_scaled, report.median_scale), (None, None, None));
    assert_eq!(report.completeness, 0.0);
    let error = evaluate(&[1.0], &[1.0, 2.0]).unwrap_err();
    assert_eq!(error.to_string(), "predicted depth is 1x1, ground truth is 2x1");
}

#[test]
fn summary_has_means_over_pixels_and_over_frames() {
    let mut sums = DepthAccumulator::new();
    assert_eq!(sums.summary(), None);
    // One frame with one pixel off by half, one with three exact pixels, one with none.
    sums.push(&depth(&[1.0]), &depth(&[2.0])).unwrap();
    sums.push(&depth(&[1.0, 2.0, 3.0]), &depth(&[1.0, 2.0, 3.0])).unwrap();
    sums.push(&depth(&[NAN]), &depth(&[3.0])).unwrap();
    let summary = sums.summary().unwrap();
    assert_eq!((summary.frames, summary.frames_evaluated), (3, 2));
    assert_eq!(summary.pixel_weighted.valid_pixels, 4);
    assert_eq!(summary.pixel_weighted.completeness, 0.8);
    assert_eq!(summary.pixel_weighted.metric.unwrap().abs_rel, 0.125);
    assert_eq!(summary.frame_mean.abs_rel, 0.25);
    assert_eq!(summary.frame_mean_median_scaled.abs_rel, 0.0);
    assert_eq!(summary.mean_median_scale, 1.5);
}

#[test]
fn views_are_summed_in_their_order_and_views_without_truth_are_left_out() {
    let intrinsics = Pinhole::new(2.0, 2.0, 1.0, 0.0, 3, 1).unwrap();
    let view = |i: u32| {
        let values = [1.0 + i as f32 * 0.1, 2.0, NAN];
        let (time, full) = (Timestamp::from_nanos(i64::from(i)), Confidence::full(3, 1));
        AlignedView::new(FrameId(i), time, Se3::IDENTITY, intrinsics, depth(&values), full).unwrap()
    };
    let views: Vec<AlignedView> = (0..7).map(view).collect();
    let truth = |v: &AlignedView| (v.frame_id().0 % 3 != 1).then(|| depth(&[1.5, 2.25, 3.0]));
    let (mut together, mut singly) = (DepthAccumulator::new(), DepthAccumulator::new());
    together.push_views(&views, truth).unwrap();
    for v in &views {
        truth(v).map(|t| singly.push(v.depth(), &t).unwrap());
    }
    assert_eq!(together.summary(), singly.summary());
    assert_eq!(together.summary().unwrap().frames, 5);
    let error = together.push_views(&views, |_| Some(depth(&[1.0]))).unwrap_err();
    assert!(matches!(error, EvalError::DepthSize { width: 3, truth_width: 1, .. }), "{error}");
}
