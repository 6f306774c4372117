use super::*;

fn plot(points: Vec<[f64; 2]>) -> LinePlot {
    LinePlot {
        x: AxisSpec::new("time", "s"),
        y: AxisSpec::new("error", "m"),
        series: vec![Series::line("a", points)],
        ..LinePlot::default()
    }
}

/// Pixels of the series' own colour below the legend.
fn ink(picture: &Picture) -> Vec<(usize, usize)> {
    let all = (60..picture.height()).flat_map(|y| (0..picture.width()).map(move |x| (x, y)));
    all.filter(|&(x, y)| picture[(x, y)] == theme::DATA[0]).collect()
}

#[test]
fn a_flat_line_is_drawn_across_and_axes_contain_all_data() {
    let picture = plot_lines(&plot(vec![[0.0, 1.0], [10.0, 1.0]]), PictureSize::new(640, 480));
    let ink = ink(&picture);
    let (left, right) = (ink.iter().map(|p| p.0).min().unwrap(), ink.iter().map(|p| p.0).max().unwrap());
    assert!(right - left > 500, "{left} {right}");
    let (top, bottom) = (ink.iter().map(|p| p.1).min().unwrap(), ink.iter().map(|p| p.1).max().unwrap());
    assert!(bottom - top <= 2);
}

#[test]
fn a_value_that_is_not_a_number_breaks_the_line() {
    let points =
        |gap: f64| (0..=100).map(|i| [f64::from(i), if (40..60).contains(&i) { gap } else { 1.0 }]).collect();
    let whole = ink(&plot_lines(&plot(points(1.0)), PictureSize::new(640, 480))).len();
    let broken = ink(&plot_lines(&plot(points(f64::NAN)), PictureSize::new(640, 480))).len();
    let share = broken as f64 / whole as f64;
    assert!((share - 0.79).abs() < 0.02, "{share}");
}

#[test]
fn errors_start_at_zero_and_negative_data_ends_there() {
    let axis = AxisSpec::new("e", "m").from_zero();
    assert_eq!(axis_range(&axis, Some((0.2, 0.8)), 0.05).0, 0.0);
    assert_eq!(axis_range(&axis, Some((-0.8, -0.2)), 0.05).1, 0.0);
    let (low, high) = axis_range(&axis, Some((-1.0, 1.0)), 0.05);
    assert!(low < -1.0 && high > 1.0);
    let (low, high) = axis_range(&axis, Some((0.0, 0.0)), 0.05);
    assert!(low < high);
    assert_eq!(axis_range(&axis.between(3.0, 1.0), None, 0.05), (0.0, 1.0), "a reversed range is ignored");
}

#[test]
fn thinning_keeps_spikes() {
    let mut points: Vec<(f64, f64)> = (0..100_000).map(|i| (f64::from(i) * 0.005, 10.0)).collect();
    points[54_321].1 = 99.0;
    points[54_322].1 = -99.0;
    let kept = thinned(&points);
    assert!(kept.len() <= 4 * 501);
    assert!(kept.iter().any(|p| p.1 == 99.0) && kept.iter().any(|p| p.1 == -99.0));
    assert_eq!((kept[0], kept[kept.len() - 1]), (points[0], points[99_999]));
}

#[test]
fn nothing_is_drawn_outside_a_fixed_range() {
    let mut p = plot((0..100).map(|i| [f64::from(i), f64::from(i * i)]).collect());
    p.y = p.y.between(0.0, 100.0);
    let picture = plot_lines(&p, PictureSize::new(640, 480));
    // Below the legend and above the axis labels.
    let top = (30..480).find(|&y| picture[(320, y)] == theme::FRAME).unwrap();
    let series = |y: &usize| picture.row(*y).contains(&theme::DATA[0]);
    let highest = (30..480).find(series).unwrap();
    assert!(highest + 2 >= top && highest < top + 10, "the line starts at {highest}, the frame at {top}");
}

#[test]
fn degenerate_input_gives_plots() {
    let inputs = [
        vec![],
        vec![[1.0, 1.0]],
        vec![[f64::NAN, f64::NAN]],
        vec![[0.0, 1e300], [1.0, -1e300]],
        vec![[1e14, 1e14], [-1e14, -1e14]],
        vec![[5.0, 5.0]; 1000],
        (0..300_000).map(|i| [f64::from(i), f64::from(i % 1000)]).collect(),
    ];
    for points in inputs {
        for size in [PictureSize::new(1, 1), PictureSize::new(640, 480)] {
            let mut p = plot(points.clone());
            p.references = vec![ReferenceLine { value: f64::NAN, label: "x".repeat(500) }];
            p.series.push(Series::dots("b", points.clone()));
            let picture = plot_lines(&p, size);
            assert_eq!((picture.width(), picture.height()), (size.width(), size.height()));
        }
    }
}
