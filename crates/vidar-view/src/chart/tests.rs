use super::*;

fn ink(picture: &Picture, color: [u8; 3]) -> usize {
    picture.data().iter().filter(|p| **p == color).count()
}

fn histogram(values: Vec<f64>) -> Histogram {
    Histogram { x: AxisSpec::new("distance", "m"), values, ..Histogram::default() }
}

#[test]
fn every_value_is_counted_once() {
    let values: Vec<f64> = (0..1000).map(|i| (f64::from(i) * 0.618).fract()).collect();
    let bins = Bins::of(&histogram(values));
    assert_eq!(bins.counts.iter().sum::<usize>(), 1000);
    assert_eq!((bins.below, bins.above, bins.not_finite), (0, 0, 0));
    assert!((10..=60).contains(&bins.counts.len()), "{}", bins.counts.len());
    // Uniform values fill inner bins uniformly.
    let inner = &bins.counts[1..bins.counts.len() - 1];
    let (low, high) = (inner.iter().min().unwrap(), inner.iter().max().unwrap());
    assert!(high - low <= 3, "{inner:?}");
}

#[test]
fn values_outside_the_range_and_not_finite_are_counted() {
    let mut h = histogram(vec![-1.0, 0.1, 0.2, 0.2, 0.99, 1.0, 7.0, f64::NAN, f64::INFINITY]);
    h.x = h.x.between(0.0, 1.0);
    let bins = Bins::of(&h);
    assert_eq!(bins.note(&h), "n = 5, 1 below 0 m, 1 above 1 m, 2 without a value");
    assert_eq!(bins.counts.iter().sum::<usize>(), 5);
}

#[test]
fn a_bar_is_as_long_as_its_value() {
    let plot = BarPlot {
        value: AxisSpec::new("time", "s"),
        categories: vec!["a".to_owned(), "b".to_owned()],
        groups: vec![BarGroup { label: "wall".to_owned(), values: vec![2.0, 8.0] }],
        ..BarPlot::default()
    };
    let picture = plot_bars(&plot, PictureSize::new(800, 600));
    let longest: Vec<usize> = (100..600)
        .map(|y| picture.row(y).iter().filter(|p| **p == theme::DATA[0]).count())
        .filter(|n| *n > 0)
        .collect();
    let (short, long) = (longest[0] as f64, longest[longest.len() - 1] as f64);
    assert!((long / short - 4.0).abs() < 0.05, "{short} {long}");
}

#[test]
fn degenerate_input_gives_charts() {
    let sizes = [PictureSize::new(0, 0), PictureSize::new(300, 200), PictureSize::new(1200, 900)];
    let values = [
        vec![],
        vec![1.0],
        vec![3.0; 100],
        vec![f64::NAN; 3],
        vec![-1e14, 1e14],
        vec![1e300, -1e300, 5.0],
        vec![1e-12, 2e-12],
        vec![1e9, 1e9 + 1e-6],
    ];
    for size in sizes {
        for v in &values {
            let markers = vec![
                (0.5, "a long name of a marker, too long for the picture".to_owned()),
                (f64::NAN, String::new()),
            ];
            let h = plot_histogram(&Histogram { markers, ..histogram(v.clone()) }, size);
            assert_eq!(h.width(), size.width());
            let categories =
                (0..v.len() + 1).map(|i| format!("stage {i} with a very long name indeed")).collect();
            let groups = vec![BarGroup { label: "x".to_owned(), values: v.clone() }; 3];
            plot_bars(&BarPlot { categories, groups, ..BarPlot::default() }, size);
        }
    }
    assert_eq!(ink(&plot_bars(&BarPlot::default(), PictureSize::default()), theme::DATA[0]), 0);
}
