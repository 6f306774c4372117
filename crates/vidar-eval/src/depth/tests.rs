use super::*;
use vidar_core::Image;

fn depth(values: &[f32]) -> MetricDepth {
    MetricDepth::new(Image::from_vec(values.len(), 1, values.to_vec()).unwrap())
}

const NAN: f32 = f32::NAN;

#[test]
fn errors_of_three_pixels_are_those_computed_by_hand() {
    let report =
        evaluate_depth(&depth(&[1.0, 3.0, 4.0, NAN, 5.0]), &depth(&[2.0, 2.0, 4.0, 1.0, NAN])).unwrap();
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
    let e = evaluate_depth(&depth(&[1.25]), &depth(&[1.0])).unwrap().metric.unwrap();
    assert_eq!((e.delta_1, e.delta_2), (0.0, 1.0));
}

#[test]
fn median_scaling_forgives_a_wrong_unit_and_nothing_else() {
    let report = evaluate_depth(&depth(&[0.5, 1.0, 1.5]), &depth(&[1.0, 2.0, 3.0])).unwrap();
    assert_eq!(report.median_scale, Some(2.0));
    let scaled = report.median_scaled.unwrap();
    assert_eq!((scaled.abs_rel, scaled.rmse_log, scaled.delta_1), (0.0, 0.0, 1.0));
    assert_eq!(report.metric.unwrap().abs_rel, 0.5);
}

#[test]
fn nothing_in_common_is_no_number_and_another_size_is_an_error() {
    let report = evaluate_depth(&depth(&[NAN, 1.0]), &depth(&[1.0, NAN])).unwrap();
    assert_eq!((report.metric, report.median_scaled, report.median_scale), (None, None, None));
    assert_eq!(report.completeness, 0.0);
    let error = evaluate_depth(&depth(&[1.0]), &depth(&[1.0, 2.0])).unwrap_err();
    assert_eq!(error.to_string(), "predicted depth is 1x1, ground truth is 2x1");
}

#[test]
fn over_frames_pixels_count_alike_or_frames_do() {
    let mut sums = DepthAccumulator::new();
    assert_eq!(sums.summary().frame_mean, None);
    // One frame with one pixel off by half, one with three exact pixels, one with none.
    sums.push(&depth(&[1.0]), &depth(&[2.0])).unwrap();
    sums.push(&depth(&[1.0, 2.0, 3.0]), &depth(&[1.0, 2.0, 3.0])).unwrap();
    sums.push(&depth(&[NAN]), &depth(&[3.0])).unwrap();
    let summary = sums.summary();
    assert_eq!((summary.frames, summary.frames_judged), (3, 2));
    assert_eq!(summary.pixel_weighted.valid_pixels, 4);
    assert_eq!(summary.pixel_weighted.completeness, 0.8);
    assert_eq!(summary.pixel_weighted.metric.unwrap().abs_rel, 0.125);
    assert_eq!(summary.frame_mean.unwrap().abs_rel, 0.25);
    assert_eq!(summary.frame_mean_median_scaled.unwrap().abs_rel, 0.0);
    assert_eq!(summary.mean_median_scale, Some(1.5));
}
